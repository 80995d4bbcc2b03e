"""`palpate.probe`: what it measures, for one, several encoders and several splits."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from forge.errors import fails
from palpate import probe
from palpate.cli import main
from palpate.core import Split
from palpate.data.manifest import SCHEMA
from palpate.report.results import Results

pytest.importorskip("torch")
from forge.models import make_encoders
from palpate.report.labels import label_of

DIRECTIONS = [
    "text by tactile",
    "tactile by text",
    "similar text by tactile",
    "tactile by similar text",
    "vision by tactile",
    "tactile by vision",
]


def with_columns(manifest, **columns):
    return replace(manifest, table=manifest.table.with_columns(**columns))


@pytest.fixture
def manifest(small_manifest):
    """Six videos of three materials; each contact has a text."""
    texts = [f"number {contact}" for contact in small_manifest.column("contact")]
    return with_columns(small_manifest, text=pl.Series(texts))


def split_of(manifest, *test, name="s"):
    """A split with the given videos in test."""
    part = ["test" if v in test else "train" for v in manifest.column("video")]
    return Split(dict(zip(manifest.ids, part, strict=True)), {"name": name, "group": "video"})


@pytest.fixture
def split(manifest):
    return split_of(manifest, "v3", "v4", "v5")


@pytest.fixture(scope="module")
def encoders():
    return make_encoders()


def test_one_call_gives_both_classifiers_and_retrieval_in_all_directions(
    manifest, split, encoders, tmp_path
):
    results = probe(manifest, split, encoder=encoders, cache=tmp_path / "cache")
    names = ["material accuracy", "material accuracy, balanced"]
    names += ["material accuracy, 20-NN", "material accuracy, 20-NN, balanced"]
    for direction in DIRECTIONS:
        names += [f"top-{k} of 24 ({direction})" for k in (1, 5, 10)]
    medians = [f"median rank of 24 ({direction})" for direction in DIRECTIONS]
    assert [label_of(s) for s in results] == names + medians
    assert {s.a for s in results} == {"real"}
    assert all(s.details["chance"] > 0 for s in results)
    accuracy = results["material accuracy", "real"]
    assert (accuracy.n, accuracy.split) == (24, split.digest)
    assert accuracy.details["majority"] == pytest.approx(1 / 3)
    # Each strip is one query with the most similar keys, among which its own may be right.
    kinds = {(s.queries, s.keys) for s in results.strips}
    pairs = [("tactile", "text"), ("tactile", "vision")]
    assert kinds == {*pairs, *(pair[::-1] for pair in pairs)}
    for strip in results.strips:
        similar = [m.similarity for m in strip.matches]
        assert similar == sorted(similar, reverse=True)
        for match in strip.matches:
            own = match.sample.id == strip.query.id
            assert match.right >= own
            assert match.right == own or "text" in (strip.queries, strip.keys)
    results.save(tmp_path / "p.json")
    assert Results.load(tmp_path / "p.json").strips == [*results.with_paths(lambda p: p).strips]


def test_a_page_shows_confusions_and_what_was_retrieved(manifest, split, encoders, tmp_path):
    results = probe(manifest, split, encoder=encoders)
    results.to_html(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "Rows: the true class of test samples" in page
    assert page.count('<figure class="strip">') == len(results.strips) > 0
    assert "number v3#0" in page
    assert page.count("data:image/") > 10
    assert "chance" in results.to_latex()
    results.save(tmp_path / "p.json")
    assert main(["report", str(tmp_path / "p.json"), "-o", str(tmp_path / "report.html")]) == 0
    report = (tmp_path / "report.html").read_text()
    assert report.count('<figure class="strip">') == len(results.strips)
    assert report.count("data:image/png") == page.count("data:image/png")


def test_encoders_are_compared_on_the_same_videos(manifest, split, encoders):
    results = probe(manifest, split, encoder={"a": encoders, "b": make_encoders(7)}, top=(1,))
    assert {s.a for s in results if s.b is None} == {"a", "b"}
    difference = results["material accuracy difference", "a - b"]
    a, b = (results["material accuracy", name] for name in "ab")
    assert difference.value == pytest.approx(a.value - b.value)
    assert a.encoder != b.encoder
    # An encoder is no worse than itself, in any score.
    same = probe(manifest, split, encoder={"a": encoders, "b": encoders}, top=(1,))
    assert {s.value for s in same if s.b is not None} == {0.0}


def test_splits_are_compared_with_pools_of_one_size(manifest, encoders):
    splits = {"Orig": split_of(manifest, "v3", "v4", "v5")}
    splits["NoLeak"] = split_of(manifest, "v0", "v5")
    results = probe(manifest, splits, encoder=encoders, top=(1,))
    assert {label_of(s) for s in results if s.metric == "top-1" and s.b is None} == {
        f"top-1 of 16 ({direction})" for direction in DIRECTIONS
    }
    pools = {s.details["pools"] for s in results["top-1 of 16 (text by tactile)"]}
    assert pools == {20, 1}
    assert any("points" in fact for fact in results.facts)
    alone = probe(manifest, split_of(manifest, "v2", "v5"), encoder=encoders, top=())
    unseen = alone["material accuracy", "real"].details["unseen_classes"]
    assert unseen == ["Brick"]  # of v2 and v5 alone
    assert alone["material accuracy", "real"].value == 0
    assert len(str(results)) > 100  # both stand in one column


def test_splits_are_compared_where_samples_lack_an_image(manifest, encoders):
    splits = {"a": split_of(manifest, "v3", "v4", "v5"), "b": split_of(manifest, "v0", "v1", "v2")}
    lost = manifest.ids[0], manifest.ids[-1], manifest.ids[-2]  # one of v0, two of v5
    for column, pools in (("vision", {"vision": 22, "text": 24}), ("tactile", {"vision": 22})):
        rows = zip(manifest.ids, manifest.column(column), strict=True)
        cells = pl.Series([None if i in lost else v for i, v in rows])
        some = with_columns(manifest, **{column: cells})
        results = probe(some, splits, encoder=encoders, top=(1,))
        for other, n in {"text": 22, **pools}.items():
            name = f"top-1 of {n} ({other} by tactile)"
            a, b = (results[name, subject].value for subject in "ab")
            assert results[f"{name} difference", "a - b"].value == pytest.approx(a - b)
        counts = {n.params["count"] for n in results.notes if n.code == "probe-no-image"}
        assert counts == ({3} if column == "tactile" else set())


def test_several_labels_and_rows_without_one(manifest, split, encoders):
    rng = np.random.default_rng(0)
    hard = [None if k % 5 == 0 else str(rng.integers(2)) for k in range(len(manifest))]
    hardness = pl.Series(hard, dtype=pl.String)
    table = with_columns(manifest, hardness=hardness, sensor=pl.lit("DIGIT"))
    labels = ["material", "hardness", "sensor"]
    results = probe(table, split, encoder=encoders, label=labels, top=())
    tested = [v for v, i in zip(hard, table.ids, strict=True) if split.parts[i] == "test"]
    assert results["hardness accuracy", "real"].n == len(tested) - tested.count(None)
    codes = [note.code for note in results.notes]
    assert codes == ["recordings", "groups-few", "probe-unlabeled", "probe-one-class"]
    assert not [s for s in results if "sensor" in s.metric]
    assert results["material accuracy", "real"].n == 24


def test_samples_without_a_partner_are_left_out_and_counted(manifest, split, encoders):
    photos = [None if k % 4 == 3 else v for k, v in enumerate(manifest.column("vision"))]
    none = pl.lit(None, pl.String)
    some = with_columns(manifest, vision=pl.Series(photos), text=none, material=none)
    results = probe(some, split, encoder=encoders, top=(1,))
    ways, kinds = ("vision by tactile", "tactile by vision"), ("top-1", "median rank")
    assert [label_of(s) for s in results] == [f"{kind} of 18 ({w})" for kind in kinds for w in ways]
    codes = [note.code for note in results.notes]
    assert codes[2:] == ["probe-no-label", "probe-no-partner", "probe-some-partners"]


def test_a_vision_encoder_needs_no_tactile_encoder(manifest, split):
    alone = make_encoders().without_tactile()
    results = probe(manifest, split, encoder=alone, modality="vision", top=(1,))
    assert "probe-no-encoder" in {note.code for note in results.notes}
    assert results["top-1 of 24 (text by vision)", "real"].n == 24


@pytest.mark.parametrize("named", [True, False])
def test_what_belongs_together_is_asked_as_a_score_asks(manifest, split, encoders, named):
    """Names show the videos; where nothing does, or they are fewer than eight, no interval."""
    nulls = {c: pl.lit(None, SCHEMA[c]) for c in ("video", "contact", "frame")}
    bare = with_columns(manifest, **nulls)
    if not named:  # the same files under names that say nothing
        ids = [chr(97 + k // 26) + chr(97 + k % 26) for k in range(len(bare))]
        for i, path in zip(ids, manifest.paths("tactile"), strict=True):
            (manifest.root / f"{i}.png").write_bytes(path.read_bytes())
        paths = pl.Series([f"{i}.png" for i in ids])
        bare = with_columns(bare, id=pl.Series(ids), tactile=paths, vision=pl.lit(None, pl.String))
        split = Split(dict(zip(ids, map(split.parts.get, manifest.ids), strict=True)), split.rule)
    results = probe(bare, split, encoder=encoders, top=())
    assert all(s.interval is None for s in results)
    codes = {note.code: note.params for note in results.notes}
    levels = dict(codes["recordings"]["levels"])
    if named:
        assert levels["video"] == "file names `{video}/tactile/{frame:d}.png`"
        assert codes["groups-few"] == {"level": "video", "count": 3, "least": 8}
    else:
        assert not levels
        assert "groups-unknown" in codes
        frames = probe(bare, split, encoder=encoders, top=(), group="frame")
        assert all(s.interval for s in frames if s.value not in (0, 1))


def test_what_a_split_shares_is_said(manifest, split, encoders):
    leaking = replace(split_of(manifest, "v0"), rule={"name": "Orig"})
    part = {i: "train" if k % 2 else "test" for k, i in enumerate(manifest.ids)}
    results = probe(manifest, replace(leaking, parts=part), encoder=encoders, top=())
    (note,) = [note for note in results.notes if note.code == "split-shares"]
    assert note.params == {"name": "Orig", "group": "video", "count": 6, "of": 6}
    codes = {note.code for note in probe(manifest, split, encoder=encoders, top=()).notes}
    assert "split-shares" not in codes


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"label": "color"}, "A column must be one of"),
        ({"modality": "text"}, "modality"),
        ({"top": (0, 1)}, "`top` must be ranks from 1"),
        ({"pool": 100}, "`pool` must lie in 2 to 24"),
        ({"text_threshold": float("nan")}, r"`text_threshold` must lie in \[-1, 1\]"),
        ({"encoder": []}, "`encoder` must hold at least one"),
        ({"label": "session", "top": ()}, "a label of two classes, or another"),
    ],
)
def test_what_cannot_be_probed_is_refused(manifest, split, encoders, options, match):
    fails(match, probe, manifest, split, **{"encoder": encoders, **options})


def test_several_splits_and_several_encoders_at_once_are_refused(manifest, split, encoders):
    fails("one where several splits", probe, manifest, [split, split], encoder=[encoders, encoders])

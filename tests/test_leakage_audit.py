"""The audit and its exact signals: against double loops, the published facts, planted files."""

import json
import shutil
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import palpate as pp
from palpate.core import PalpateError, Split
from palpate.data.manifest import Manifest
from palpate.data.recordings import NAMES, same_names
from palpate.evaluation.auditing import audit as measured
from palpate.leakage import audit, signals
from palpate.leakage.auditing import known_group
from palpate.leakage.signals import Gaps, nearest_in_video
from palpate.report.results import Audit


def manifest(rows, prefix="", root="."):
    return Manifest.from_rows([{"id": f"{prefix}{k}", **row} for k, row in enumerate(rows)], root)


def frames_of(rows):
    """Rows (video, frame, material)."""
    rows = [{"id": f"{v}/{f}", "video": v, "frame": f, "material": m} for v, f, m in rows]
    return Manifest.from_rows(rows, ".")


def codes(notes):
    return [note.code for note in notes]


FRAMES = st.lists(
    st.tuples(st.sampled_from("abcd"), st.integers(0, 40), st.sampled_from(["Wood", "Grass"])),
    min_size=1,
    max_size=25,
)
CELLS = st.fixed_dictionaries(
    {
        "video": st.sampled_from(["a", "b", None]),
        "frame": st.one_of(st.none(), st.integers(0, 90)),
        "object": st.sampled_from(["cup", "mug", None]),
    }
)
ROWS = st.lists(CELLS, min_size=1, max_size=14)


@settings(max_examples=100)
@given(FRAMES, FRAMES)
def test_the_audit_equals_a_double_loop(train, test):
    result = audit(frames_of(train), frames_of(test))
    videos = {v for v, _, _ in train}
    gaps = [min(abs(f - g) for v, g, _ in train if v == u) for u, f, _ in test if u in videos]
    assert result.test_samples_in_shared_groups == len(gaps)
    assert result.groups_shared == len(videos & {v for v, _, _ in test})
    assert result.leaked_fraction == round(len(gaps) / len(test), 5)
    same = {(v, g) for v, g, _ in train}
    assert result.identical_samples == sum((u, f) in same for u, f, _ in test)
    for row in result.materials:
        of = [{v for v, _, m in part if m == row["material"]} for part in (train, test)]
        assert (row["groups_train"], row["groups_test"]) == tuple(map(len, of))
    if not gaps:
        assert (result.gap_min, result.gap_counts, result.worst) == (None, [], [])
        return
    middle = float(np.median(gaps))
    assert (result.gap_min, result.gap_median, result.gap_max) == (min(gaps), middle, max(gaps))
    assert sum(result.gap_counts) == len(gaps)
    assert result.worst[0].gap == min(gaps)
    for pair in result.worst:
        assert pair.test.video == pair.train.video
        assert abs(pair.test.frame - pair.train.frame) == pair.gap


@settings(max_examples=100)
@given(ROWS, ROWS, st.integers(0, 40))
def test_the_signals_equal_double_loops(train_rows, test_rows, near):
    train, test = manifest(train_rows, "r"), manifest(test_rows, "t")
    for column in ("video", "object"):
        flags = signals.shared_group(train, test, column, counts=True)
        known = {r[column] for r in train_rows} - {None}
        wanted = [r[column] for r in test_rows]
        if not known or set(wanted) == {None}:
            assert flags is None
            continue
        assert flags.flag.tolist() == [v in known for v in wanted]
        assert np.isnan(flags.score).tolist() == [v is None for v in wanted]
    gaps = nearest_in_video(train.table, test.table)
    expected = [
        min(
            (
                abs(r["frame"] - t["frame"])
                for r in train_rows
                if r["video"] == t["video"] and None not in (t["video"], r["frame"], t["frame"])
            ),
            default=-1,
        )
        for t in test_rows
    ]
    assert gaps.frames.tolist() == expected
    timed = signals.time_gap(gaps, near)
    if timed is None:
        assert set(expected) == {-1}
    else:
        assert timed.flag.tolist() == [0 <= g <= near for g in expected]
        scores = [0 if g < 0 else 0.5 ** (g / max(near, 1)) for g in expected]
        assert timed.score == pytest.approx(scores, abs=1e-6)
        assert (timed.score[timed.flag] >= timed.threshold).all()
    assert signals.identical_samples(train, test, gaps).flag.tolist() == [g == 0 for g in expected]


def test_the_published_lists_leak_as_measured(real_data):
    lists = real_data / "touch_and_go" / "lists"
    result = audit(lists / "train.txt", lists / "test.txt")
    assert (result.test_samples, result.groups_train, result.groups_test) == (29879, 120, 106)
    assert (result.groups_shared, result.test_samples_in_shared_groups) == (100, 29597)
    assert (result.leaked_fraction, result.identical_samples) == (0.99056, 0)
    assert (result.gap_min, result.gap_median, result.gap_max) == (31, 304, 2485)
    rough = audit(lists / "train_rough.txt", lists / "test_rough.txt", pretrain=lists / "train.txt")
    assert (rough.groups_shared, rough.leaked_fraction, rough.gap_min) == (0, 0.0, None)
    assert rough.others[0].identical_samples == 3289
    contacts = audit(lists / "train.txt", lists / "test.txt", by="contact")
    numbers = (contacts.groups_train, contacts.groups_test, contacts.groups_shared)
    assert numbers == (3378, 1113, 0)  # no contact mixes the lists


def test_names_count_where_they_are_declared_or_the_roots_are_one_data_set(tmp_path):
    """A row: facts of train and of test, and whether the names of different roots count."""
    row = {"id": "x/1", "video": "x", "frame": 1, "tactile": "x/1.png"}
    folder = {"format": "pairs", "template_tactile": "{video}/{frame:d}.png"}
    table = {"format": "pairs", "layout": "table csv", "dataset": "t"}
    world = {"format": "touch-and-go", "dataset": "palpate's procedural world", "digest": "a"}
    ycb = {"format": "ycb-slide", "dataset": "YCB-Slide"}
    for a, b, expected in (
        (folder, folder, ()),
        ({"source": "train.txt"}, {"source": "test.txt"}, ()),
        (table, folder, ()),
        (table, table, ("video",)),
        ({}, {}, ("video",)),  # the id is the path
        (ycb, ycb, NAMES),
        (world, world, NAMES),
        (world, world | {"digest": "b"}, ()),
    ):
        parts = [Manifest.from_rows([row], tmp_path / r, f) for r, f in (("1", a), ("2", b))]
        assert same_names(*parts, "auto") == expected, (a, b)
        assert same_names(parts[0], replace(parts[1], root=parts[0].root), "auto") == NAMES
        result = audit(*parts, images=False)
        assert (result.groups_shared, result.leaked_fraction) == (
            (1, 1.0) if expected else (0, 0.0)
        )
    declared = Manifest.from_rows([row | {"id": "press 7"}], tmp_path / "1")
    assert "id" in same_names(declared, replace(declared, root=tmp_path / "2"), "auto")
    with pytest.raises(PalpateError, match="`identity` must be one of auto, names, images"):
        audit(declared, declared, identity="paths")


@pytest.mark.parametrize("kind", ["polars", "pandas"])
def test_two_data_frames_are_audited(kind):
    train = {"id": ["1", "2"], "video": ["a", "b"], "frame": [5, 7]}
    test = {"id": ["3", "4"], "video": ["a", "c"], "frame": [50, 7]}
    frame = pl.DataFrame if kind == "polars" else pytest.importorskip("pandas").DataFrame
    result = pp.audit(frame(train), frame(test))
    assert (result.leaked_fraction, result.gap_min, result.name) == (0.5, 45, "train / test")
    assert "train / test: leaks. 50.0 % of the test samples share a video with train" in str(result)


def test_rows_without_a_group_are_noted_and_mistakes_are_errors():
    a = manifest([{"video": "v", "frame": 0}, {}], "a")
    result = audit(a, manifest([{"video": "v", "frame": 4}, {}], "b"))
    assert (result.leaked_fraction, result.gap_min) == (0.5, 4)
    assert codes(result.notes) == ["recordings"]
    assert "At least 1 of 2 test samples leaks" in str(result)
    for options, words in (
        ({"test": a, "by": "object"}, "column of nulls"),
        ({"test": a, "by": "color"}, "`by` must be auto or one of video"),
        ({"split": Split.from_ids(train=["a0"])}, "test part"),
        ({}, "neither test samples nor a split"),
        ({"test": a, "near_frames": -1}, "`near_frames` must be at least 0"),
        ({"test": a, "false_positives": 0.5}, "`false_positives` must lie in"),
        ({"test": a, "modalities": ["smell"]}, "`modalities` must be among"),
        ({"test": a, "impact": print}, "`impact` needs all samples and a split"),
    ):
        with pytest.raises(PalpateError, match=words):
            audit(a, **options)


def test_what_a_reader_must_know_of_a_split_is_noted():
    m = frames_of([("a", 1, "Wood"), ("a", 9, "Wood"), ("b", 1, "Wood"), ("c", 1, "Wood")])
    parts = {"train": ["a/1"], "val": ["a/9"], "test": ["b/1"]}
    result = audit(m, split=Split.from_ids(**parts, manifest="0" * 64))
    assert result.leaked_fraction == 0
    expected = ["recordings", "split-of-other-manifest", "samples-in-no-part", "validation-leaks"]
    assert codes(result.notes) == expected
    assert "1 of 4 samples" in str(result)


def image(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((8, 8, 3), value, np.uint8)).save(path)


def test_equal_bytes_match_under_other_names_and_bad_files_do_not(tmp_path):
    for k in range(4):
        image(tmp_path / "v" / f"{k}.png", 10 * k)
        image(tmp_path / "t" / f"{k}.png", 100 + 10 * k)
    shutil.copy(tmp_path / "v" / "0.png", tmp_path / "v" / "copy of 0.png")
    shutil.copy(tmp_path / "t" / "1.png", tmp_path / "t" / "again.png")
    for k in (1, 2):
        (tmp_path / "v" / f"empty{k}.png").write_bytes(b"")
    rows = [{"vision": f"v/{k}.png", "tactile": f"t/{k}.png"} for k in range(2)]
    train = manifest([*rows, {"vision": "v/empty1.png"}], "r", tmp_path)
    test = manifest(
        [
            {"vision": "v/copy of 0.png", "tactile": "t/2.png"},
            {"vision": "v/3.png", "tactile": "t/again.png"},
            {"vision": "v/2.png", "tactile": "t/3.png"},
            {"vision": "v/empty2.png"},
            {"vision": "v/gone.png"},
            {},
        ],
        "t",
        tmp_path,
    )
    flags = signals.identical_bytes(train, test)
    assert flags.flag.tolist() == [True, True, False, False, False, False]
    assert flags.nearest.tolist() == [0, 1, -1, -1, -1, -1]
    assert np.isnan(flags.score).tolist() == [False, False, False, False, True, True]
    assert flags.notes[0].params == {"count": 2}
    assert signals.identical_bytes(train, manifest([{}], "x", tmp_path)) is None


@pytest.mark.parametrize("other", [False, True])
def test_samples_of_one_name_with_other_images_are_not_identical(other, tmp_path):
    rows = [{"video": "rec1", "frame": k, "tactile": f"t/{k}.png"} for k in range(3)]
    train, test = (manifest(rows, "r", tmp_path / part) for part in ("train", "test"))
    for part, first in (("train", 0), ("test", 100 * other)):
        for k in range(2):  # the third is not at hand
            image(tmp_path / part / "t" / f"{k}.png", first + 10 * k)
    flags = signals.identical_samples(train, test, nearest_in_video(train.table, test.table))
    assert flags.flag.tolist() == [not other, not other, True]


def test_only_the_audits_group_counts_and_the_table_holds_every_signal():
    train = manifest([{"video": "a", "frame": f, "object": "cup"} for f in (0, 9)], "r")
    test = manifest(
        [
            {"video": "b", "frame": 0, "object": "cup"},
            {"video": "a", "frame": 300, "object": "mug"},
        ],
        "t",
    )
    result = audit(train, test)
    kinds = {s.kind: s for s in result.signals}
    assert list(kinds) == ["identical sample", "shared video", "shared object", "time gap"]
    assert (kinds["shared object"].flagged, kinds["time gap"].checked) == (1, 2)
    assert codes(kinds["shared object"].notes) == ["signal-not-counted"]
    table = result.to_frame()
    assert table["leaking"].to_list() == [False, True]
    assert table["gap"].to_list() == [None, 291]
    assert table["time_gap_nearest"].to_list() == [None, "r1"]
    by_object = audit(train, test, by="object")
    assert (by_object.leaking_samples, by_object.groups_shared) == (1, 1)
    again = Audit.from_json(json.loads(json.dumps(by_object.to_json())))
    assert again.signals[1].flagged == 1


def untouched(root, contact):
    """Ten materials in turn under one gel: slow drift and noise, and a contact if asked for."""
    rng, (y, x) = np.random.default_rng(0), np.mgrid[:64, :64] / 64
    gel = np.stack([90 + 60 * x, 110 + 50 * y, 140 - 40 * x], -1)
    rows = []
    for k in range(320):
        video, t = f"v{k // 8}", k / 320
        slow = np.sin(2 * np.pi * (t + x)) * np.cos(2 * np.pi * (y - 3 * t)) * 4
        picture = gel + slow[..., None] * [1, 0.8, 0.6] + rng.normal(0, 1, gel.shape)
        at = 0.2 + 0.6 * np.random.default_rng(k // 8).random(2)
        if contact:
            picture += 5 * (np.hypot(y - at[0], x - at[1]) < 0.1)[..., None]
        path = root / video / f"{k}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.clip(picture + 0.5, 0, 255).astype(np.uint8)).save(path)
        material = f"m{k // 32}"
        rows.append(
            {"id": f"{k}", "video": video, "material": material, "tactile": f"{video}/{k}.png"}
        )
    return Manifest.from_rows(rows, root)


@pytest.mark.parametrize("contact", [False, True])
def test_materials_that_differ_by_drift_alone_cannot_be_judged(contact, tmp_path):
    samples = untouched(tmp_path, contact)
    split = pp.split(samples, by="video")
    result = measured(samples, split=split, impact=True)
    numbers = result.verdict, result.questions[2].reason, result.leaking_samples
    assert numbers == (("no leak found", "", 0) if contact else ("cannot tell", "untouched", 0))
    assert (result.impact is None, "impact-of-nothing" in codes(result.notes)) == 2 * (not contact,)
    assert ("cannot tell. Too many images show no contact" in str(result)) != contact
    page = tmp_path / "p.html"
    result.to_html(page)
    assert ("cannot tell</p>" in page.read_text()) != contact
    assert ("Too many images show no contact" in page.with_suffix(".md").read_text()) != contact
    by_frame = Split({i: "test" if k % 4 == 0 else "train" for k, i in enumerate(samples.ids)})
    leaking = audit(samples, split=by_frame, impact=lambda *_: 1 / 0 if not contact else None)
    assert (leaking.verdict, leaking.leaked_fraction) == ("leaks", 1)


def test_photos_that_are_all_alike_cannot_be_judged(tmp_path):
    samples = untouched(tmp_path, contact=False).table
    photos = samples.with_columns(vision="tactile", tactile=pl.lit(None, pl.String))
    result = audit(*(Manifest(photos[a:b], tmp_path) for a, b in ((0, 240), (240, 320))))
    assert (result.verdict, result.questions[2].reason) == ("cannot tell", "similar")


def test_the_matrix_puts_shared_groups_first():
    counts = {
        ("a", "train"): 5,
        ("b", "train"): 1,
        ("b", "test"): 3,
        ("c", "val"): 2,
        ("c", "test"): 4,
        ("d", "test"): 9,
    }
    rows = [(f"{v}{p}{k}", v, p) for (v, p), n in counts.items() for k in range(n)]
    whole = Manifest.from_rows([{"id": i, "video": v} for i, v, _ in rows], ".")
    result = audit(whole, split=Split({i: p for i, _, p in rows}))
    assert [tuple(row.values()) for row in result.matrix] == [
        ("b", 1, 0, 3, 3),
        ("d", 0, 0, 9, 0),
        ("c", 0, 2, 4, 0),
        ("a", 5, 0, 0, 0),
    ]
    assert result.groups_in_all == 4


def test_the_group_is_the_first_that_both_parts_know():
    for a, b, expected in (
        ({"video": "v", "object": "o"}, {"video": "w", "object": "o"}, "video"),
        ({"object": "o", "video": "v"}, {"object": "o"}, "object"),
        ({"session": "s"}, {"session": "s"}, "session"),
        ({}, {"video": "v"}, "none"),
    ):
        assert known_group(manifest([a]), manifest([b])) == expected
    assert audit(manifest([{}], "a"), manifest([{"video": "v"}], "b")).verdict == "cannot tell"


def test_the_worst_pairs_come_from_different_videos_first():
    test, train = manifest([{"video": v} for v in "aaab"], "t"), manifest([{"video": "c"}], "r")
    scores = np.array([0.9, 0.8, 1.0, 0.7], np.float32)
    flags = signals.Flags.of("x", scores, np.ones(4, bool), np.zeros(4, np.int64))
    none = Gaps(np.full(4, -1), np.full(4, -1))
    worst = flags.summary(train, test, none).worst
    assert [p.test.id for p in worst] == ["t2", "t3", "t0", "t1"]
    assert signals.varied(np.arange(4), scores, test, 3) == [2, 3, 0]


def test_frames_whose_images_are_not_at_hand_are_audited_by_names_with_a_note(small_manifest):
    table = small_manifest.table
    audited = audit(table[: len(table) // 2], table[len(table) // 2 :])
    assert [note.code for note in audited.notes].count("images-not-found") == 1
    assert not any("near-duplicate" in signal.kind for signal in audited.signals)
    with_root = audit(table[:4], table[4:], root=small_manifest.root, modalities=["vision"])
    assert "images-not-found" not in {note.code for note in with_root.notes}

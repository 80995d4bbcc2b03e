"""What leaking costs: against brute force, loops, and worlds in which the price is known."""

from __future__ import annotations

import itertools
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from forge.commands import python
from forge.errors import fails
from palpate.core import FeatureSet, ProblemsError, Split
from palpate.core.records import from_plain
from palpate.data.importing import import_dataset
from palpate.data.manifest import Manifest
from palpate.evaluation import impact as module
from palpate.evaluation.impact import Source, fit_reduction, nearest_hits, thin
from palpate.leakage.splitting import split as leak_free_split
from palpate.report.records import Impact


def videos(materials: int = 4, each: int = 5, frames: int = 6, **columns: object) -> Manifest:
    """``each`` videos a material, ``frames`` frames a video, no pictures."""
    rows = []
    for m, v, k in itertools.product(range(materials), range(each), range(frames)):
        video = f"v{m}.{v}"
        contact = {"contact": f"{video}#{k // 3}", "material": f"M{m}"}
        rows.append({"id": f"{video}/{k}", "video": video, "frame": k, **contact, **columns})
    return Manifest.from_rows(rows, Path())


def by_frame(manifest: Manifest, every: int = 3) -> Split:
    """Every third frame of each video in test: each video on both sides."""
    parts = {
        i: "test" if f % every == 0 else "train"
        for i, f in zip(manifest.ids, manifest.column("frame"), strict=True)
    }
    return Split(parts, {"name": "Orig"}, manifest.digest)


def impact(manifest: Manifest, split: Split, features: Any = "pixels", **options: Any) -> Impact:
    """The impact of a leak on arrays (n, d) in the order of the samples."""
    if not isinstance(features, str):
        features = {
            name: x if isinstance(x, FeatureSet) else FeatureSet(manifest.ids, x)
            for name, x in features.items()
        }
    return module.impact(manifest, split, features=features, **options)


def one_hot(names: list[str]) -> np.ndarray:
    distinct = sorted(set(names))
    return np.eye(len(distinct), dtype=np.float32)[[distinct.index(n) for n in names]]


def test_thinning_keeps_every_class_and_the_shares_of_groups() -> None:
    classes = np.repeat([0, 1, 2], [600, 299, 1])
    groups = np.concatenate([np.arange(600) % 4, 4 + np.arange(299) % 2, [6]])
    rows = np.arange(900) + 1000
    kept = thin(rows, groups, classes, 90, seed=3)
    assert len(kept) == 90 == len(set(kept.tolist()))
    assert set(kept.tolist()) <= set(rows.tolist())
    assert np.bincount(classes[kept - 1000])[2] == 1
    assert np.abs(np.bincount(classes[kept - 1000]) - [60, 29.9, 0.1]).max() <= 1
    assert np.abs(np.bincount(groups[kept - 1000])[:4] - 15).max() <= 1
    assert (
        kept.tolist()
        == thin(rows, groups, classes, 90, seed=3).tolist()
        != thin(rows, groups, classes, 90, seed=4).tolist()
    )
    assert sorted(thin(rows, groups, classes, 900, seed=3).tolist()) == rows.tolist()
    assert sorted(classes[thin(rows, groups, classes, 3, seed=3) - 1000].tolist()) == [0, 1, 2]


def test_nearest_hits_are_those_of_brute_force(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    x, z = (rng.standard_normal((n, 5)).astype(np.float32) for n in (37, 83))
    y, w = rng.integers(0, 3, 37), rng.integers(0, 4, 83)
    expected = [
        float(w[((z.astype(float) - row) ** 2).sum(axis=1).argmin()] == label)
        for row, label in zip(x.astype(float), y, strict=True)
    ]
    assert nearest_hits(x, z, y, w).tolist() == expected
    monkeypatch.setattr(module, "CELLS", 200)  # two test rows a block
    assert nearest_hits(x, z, y, w).tolist() == expected
    assert 0 < sum(expected) < 37


def test_ties_count_as_a_random_choice_would() -> None:
    base = np.array([[0, 0], [0, 0], [0, 0], [3, 4]], np.float32)
    queries = np.array([[0, 1], [0, 1], [3, 3], [1.5, 2]], np.float32)
    hits = nearest_hits(queries, base, np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1]))
    # The last query is 2.5 from all four rows, of which two are of its class.
    np.testing.assert_allclose(hits, [2 / 3, 1 / 3, 0, 1 / 2])


def test_the_reduction_spans_the_principal_axes_of_train_alone() -> None:
    rng = np.random.default_rng(2)
    x = (rng.standard_normal((300, 60)) * 0.8 ** np.arange(60)).astype(np.float32) @ np.linalg.qr(
        rng.standard_normal((60, 60))
    )[0].astype(np.float32)
    x[200:] += 50  # what train must not see
    source = Source("x", 60, lambda at: x[at], False, "")
    train = np.arange(200)
    found = fit_reduction(source, train, 6, seed=0)
    centered = x[:200].astype(float) - x[:200].mean(axis=0)
    _, _, axes = np.linalg.svd(centered, full_matrices=False)
    np.testing.assert_allclose(found.axes @ found.axes.T, axes[:6].T @ axes[:6], atol=1e-3)
    np.testing.assert_allclose(
        np.linalg.norm(found.apply(source, train), axis=1),
        np.linalg.norm(centered @ axes[:6].T, axis=1),
        atol=1e-2,
    )


def test_directions_without_spread_in_train_are_left_out() -> None:
    x = np.array([[1, 0.1, 5], [2, 0.1, 7], [4, 0.1, 9], [3, 8.0, 6]], np.float32)
    source = Source("x", 3, lambda at: x[at], True, "")
    found = fit_reduction(source, np.arange(3), 10, seed=0)
    out = found.apply(source, np.arange(4))
    assert out.shape == (4, 2)
    np.testing.assert_allclose(out[:3].std(axis=0), 1, rtol=1e-5)
    wide = Source("x", 3, lambda at: x[at], False, "")
    assert fit_reduction(wide, np.arange(3), 2, seed=0).axes.shape[1] == 2
    assert fit_reduction(wide, np.array([0, 0]), 2, seed=0).apply(wide, np.arange(4)).shape[0] == 4


def test_a_leak_of_known_worth() -> None:
    """Features that name the video alone: 1-NN is right when it saw the video, else it guesses."""
    manifest = videos()
    features = {"video": one_hot(manifest.column("video"))}
    found = impact(manifest, by_frame(manifest), features, seeds=(0, 1))
    row = found.rows[0]
    # A new video is equally far from all train rows, a quarter of which have its material.
    assert (row.features, row.classifier, row.given, row.chance) == ("video", "1-NN", 1.0, 0.25)
    assert (row.clean, row.cost) == pytest.approx((0.25, 0.75), abs=1e-6)
    assert (found.rows[1].given, found.rows[1].clean) == (1.0, pytest.approx(0.25))
    assert "100.0 % under Orig, 25.0 % under 2 leak-free splits by video" in found.headline
    assert "leaking is worth 75.0 points" in found.headline
    assert (found.group, len(found.clean_splits)) == ("video", 2)
    assert (found.settings["shared_groups"], found.settings["test_groups"][0]) == (20, 20)


def test_no_leak_costs_nothing_where_the_material_is_known() -> None:
    manifest = videos()
    features = {"material": one_hot(manifest.column("material"))}
    rows = impact(manifest, by_frame(manifest), features, seeds=(0,)).rows
    assert [(r.given, r.clean, r.cost, r.cost_interval) for r in rows] == [(1, 1, 0, None)] * 2


def test_a_run_is_the_explicit_one() -> None:
    """The clean side by hand: standardized by train, 1-NN by loops, all seeds together."""
    manifest = videos(3, 6, 6)
    rng = np.random.default_rng(5)
    video, material = manifest.column("video"), manifest.column("material")
    x = (
        one_hot(video)
        + one_hot(material).repeat(6, axis=1) * 0.15
        + rng.standard_normal((len(manifest), 18)) * 0.25
    ).astype(np.float32)
    split = by_frame(manifest)
    found = impact(manifest, split, features={"x": x}, seeds=(0, 1, 2))
    size, y = found.settings["train_samples"], np.array(material)
    assert size == 72
    hits: list[list[float]] = []
    plans = [leak_free_split(manifest, train=72 / 108, by="video", seed=s) for s in (0, 1, 2)]
    assert [p.digest for p in plans] == list(found.clean_splits)
    for parts in (split, *plans):
        side = np.array([parts.parts[i] for i in manifest.ids])
        train, test = np.flatnonzero(side == "train"), np.flatnonzero(side == "test")
        assert len(train) == size  # so that thinning leaves all
        z = x / x[train].std(axis=0)
        hits.append(
            [float(y[train[((z[train] - z[k]) ** 2).sum(axis=1).argmin()]] == y[k]) for k in test]
        )
    assert found.rows[0].given == pytest.approx(np.mean(hits[0]))
    assert found.rows[0].clean == pytest.approx(np.mean(np.concatenate(hits[1:])))
    assert found.rows[0].given - found.rows[0].clean > 0.1


def test_equal_input_gives_an_equal_result_whatever_the_order() -> None:
    manifest = videos(3, 4, 6)
    rng = np.random.default_rng(0)
    x = rng.standard_normal((len(manifest), 7)).astype(np.float32)
    found = impact(manifest, by_frame(manifest), features={"x": x})
    assert found == impact(manifest, by_frame(manifest), features={"x": x})
    order = rng.permutation(len(manifest))
    turned = manifest.take([manifest.ids[k] for k in order])
    again = impact(turned, by_frame(turned), features={"x": x[order]})
    assert again.rows == found.rows
    assert list(again.clean_splits) == list(found.clean_splits)
    assert from_plain(Impact, json.loads(json.dumps(asdict(found)))) == found


def test_both_sides_get_the_same_materials_and_as_many_train_samples() -> None:
    base = videos(3, 4, 6)
    lone = [{"id": f"lone/{k}", "video": "lone", "frame": k, "material": "Lone"} for k in range(30)]
    unknown = [{"id": f"blank/{k}", "video": "blank", "frame": k} for k in range(5)]
    onesided = [
        {"id": f"s{k % 2}/{k}", "video": f"s{k % 2}", "frame": 1, "material": "Trained"}
        for k in range(6)
    ]
    manifest = Manifest.from_rows(
        [*base.table.iter_rows(named=True), *lone, *unknown, *onesided], Path()
    )
    features = {"v": one_hot(manifest.column("video"))}
    found = impact(manifest, by_frame(manifest), features, seeds=(0, 1))
    assert found.settings["materials"] == ["M0", "M1", "M2"]
    assert found.rows[0].chance == pytest.approx(1 / 3)
    left_out = {"Lone": "one video", "Trained": "not in test of the given split"}
    assert found.settings["left_out"] == left_out
    assert (found.rows[0].given, found.settings["test_samples"][0]) == (1.0, 24)
    assert found.settings["train_samples"] <= 48
    notes = {note.code: note.params for note in found.notes}
    assert notes["no-material"] == {"count": 5}
    assert notes["materials-excluded"]["materials"] == found.settings["left_out"]


def test_features_may_be_sets_by_id_and_keep_cosine_order() -> None:
    manifest = videos(3, 4, 6)
    rng = np.random.default_rng(0)
    x = rng.standard_normal((len(manifest), 7)).astype(np.float32)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    back = np.arange(len(manifest))[::-1]
    given = FeatureSet([manifest.ids[k] for k in back], x[back], encoder="encoder")
    features = {"set": given, "array": x, "scaled": 3 * x}
    found = impact(manifest, by_frame(manifest), features, seeds=(0,))
    assert [r.features for r in found.rows] == ["set", "set", "array", "array", "scaled", "scaled"]
    assert found.settings["features"]["set"] == "encoder"
    assert [r.given for r in found.rows[:2]] == [r.given for r in found.rows[2:4]]


def test_each_kind_of_pixels_has_a_row(small_manifest: Manifest, tmp_path: Path) -> None:
    split = by_frame(small_manifest, every=4)
    found = impact(small_manifest, split, seeds=(0,), cache=tmp_path / "cache")
    kinds = ["tactile pixels", "tactile minus background", "vision pixels"]
    assert [r.features for r in found.rows[::2]] == kinds
    assert [found.rows[k].clean for k in (0, 4)] == [1.0, 1.0]  # brightness is the material there
    assert found.headline.startswith("1-NN on tactile pixels: ")
    assert len(list((tmp_path / "cache").glob("*.npy"))) == 3
    table = small_manifest.table.with_columns(background=None, vision=None)
    bare = Manifest(table.cast(small_manifest.table.schema), small_manifest.root)
    again = impact(bare, split, seeds=(0,))
    assert [r.features for r in again.rows] == ["tactile pixels"] * 2
    assert again.rows[0] == found.rows[0]


def test_tactile_minus_background_is_the_difference(small_manifest: Manifest) -> None:
    sources = module.pixel_sources(small_manifest)
    at = np.array([3, 17])
    by_name = {s.name: s.read(at) for s in sources}
    raw = [
        [np.asarray(Image.open(small_manifest.paths(c)[k]), float) for k in at]
        for c in ("tactile", "background")
    ]
    difference = by_name["tactile minus background"].reshape(2, 32, 32, 3)
    np.testing.assert_array_equal(difference, np.array(raw[0]) - np.array(raw[1]))


def test_a_leak_free_split_is_not_charged() -> None:
    manifest = videos(3, 6, 4)
    split = leak_free_split(manifest, train=0.66, by="video", seed=9)
    found = impact(manifest, split, features={"v": one_hot(manifest.column("video"))}, seeds=(0,))
    assert ("shares no video" in found.headline, "worth" in found.headline) == (True, False)
    assert found.rows[0].cost == pytest.approx(0, abs=0.02)


GOOD = videos(2, 3, 4)
FEW = FeatureSet(GOOD.ids[:20], np.zeros((20, 2), np.float32))


@pytest.mark.parametrize(
    ("manifest", "split", "options", "words"),
    [
        (videos(2, 3, 4, material=None), None, {}, "needs materials"),
        (videos(1, 3, 4), None, {}, "two materials .* Got 1 material"),
        (videos(2, 1, 6), None, {}, "Got 0 of 2 .2 one video.*group='contact'"),
        (videos(2, 3, 4, video=None), None, {}, "needs a video. Got 24 without"),
        (GOOD, dict.fromkeys(GOOD.ids, "test"), {}, "train part must hold samples"),
        (GOOD, {**by_frame(GOOD).parts, "else": "train"}, {}, "must be in the manifest"),
        (GOOD, None, {"group": "color"}, "must be one of"),
        (GOOD, None, {"features": {}}, "must hold features"),
        (GOOD, None, {"features": {"x": FEW}}, "missing, first"),
        (GOOD, None, {"features": "pixels"}, "vision or tactile"),
    ],
)
def test_bad_input_is_refused_in_words(manifest, split, options, words) -> None:
    features = {"features": {"v": np.eye(len(manifest))}}
    parts = by_frame(manifest) if split is None else Split(split)
    fails(words, impact, manifest, parts, **features | options)


def test_missing_and_broken_pictures_are_named(small_manifest: Manifest) -> None:
    split = by_frame(small_manifest, every=4)
    small_manifest.paths("tactile")[5].write_bytes(b"")
    with pytest.raises(ProblemsError) as error:
        impact(small_manifest, split)
    assert [p.where for p in error.value.problems] == [str(small_manifest.paths("tactile")[5])]
    small_manifest.paths("tactile")[5].write_bytes(small_manifest.paths("tactile")[6].read_bytes())
    rows = small_manifest.table.to_dicts()
    rows[2]["vision"] = None
    words = r"Every sample must have a vision image here\. Got 1 without"
    fails(words, impact, Manifest.from_rows(rows, small_manifest.root), split)


def test_features_without_any_spread_give_chance() -> None:
    manifest = videos(4, 4, 3)
    features = {"flat": np.ones((len(manifest), 5))}
    found = impact(manifest, by_frame(manifest), features, seeds=(0,))
    assert (found.rows[0].given, found.rows[0].clean) == pytest.approx((0.25, 0.25), abs=0.01)


def test_torch_is_not_needed() -> None:
    code = """
import sys, numpy as np
from pathlib import Path
from palpate.core import FeatureSet, Split
from palpate.data.manifest import Manifest
from palpate.evaluation.impact import impact
frames = [(v, k) for v in range(6) for k in range(4)]
rows = [{"id": f"{v}/{k}", "video": str(v), "frame": k, "material": f"m{v % 2}"} for v, k in frames]
m = Manifest.from_rows(rows, Path())
split = Split({i: "test" if i.endswith("0") else "train" for i in m.ids})
print(impact(m, split, features={"x": FeatureSet(m.ids, np.eye(24))}).headline)
sys.exit("torch" in sys.modules)
"""
    assert "under the given split" in python(code)


@pytest.mark.nightly
def test_the_five_real_clips_can_be_compared_by_contact_only(
    real_data: Path, tmp_path: Path
) -> None:
    clips = real_data / "touch_and_go" / "clips"
    manifest = import_dataset(clips, tmp_path / "out", size=64, format="touch-and-go").manifest
    split = by_frame(manifest, every=5)
    fails(r"Got 0 of 5 .5 one video.*group='contact'", impact, manifest, split)
    found = impact(manifest, split, group="contact", cache=tmp_path / "cache")
    assert len(found.rows) == 6
    assert len(found.settings["materials"]) == 5
    assert min(r.given for r in found.rows) > 0.9  # every test frame has a neighbor in train
    assert "shared-videos" in [note.code for note in found.notes]

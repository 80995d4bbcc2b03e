"""Other photos of the same contacts: touch stays, and what moves a generator is measured."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from palpate.core import FeatureSet, PalpateError
from palpate.data.manifest import Manifest
from palpate.metrics.intervals import jackknife_errors
from palpate.sim import Video, World, WorldOptions, write_world
from palpate.sim.appearance import APPEARANCES, FREE
from palpate.sim.photos import with_photos
from palpate.studies.appearance import AGAIN, RECORDED, appearance_claims, appearance_table, moves

OPTIONS = WorldOptions(size=32, materials=4, objects_per_material=2, tile=128, seed=11)
CHANGES = APPEARANCES[1:]


@pytest.mark.parametrize("change", CHANGES)
def test_only_the_photo_changes(change):
    plain, other = World(OPTIONS), pickle.loads(pickle.dumps(World(OPTIONS, appearance=change)))
    assert other.appearance == change
    moved = 0
    for k in range(0, len(plain), 7):
        a, b = plain[k], other[k]
        for name in ("tactile", "background"):
            assert np.array_equal(a[name], b[name]), name
        assert {n: v for n, v in a.items() if isinstance(v, str | int)} == {
            n: v for n, v in b.items() if isinstance(v, str | int)
        }
        moved += int(np.abs(a["vision"].astype(int) - b["vision"]).mean() > 2)
    assert moved > len(range(0, len(plain), 7)) / 2


def test_clutter_leaves_the_contact_and_balance_turns_color_alone():
    y, x = np.mgrid[0:32, 0:32] / 15.5 - 1
    inside = np.hypot(y, x) < FREE - 0.12  # the photo's blur reaches a little further
    for index in range(4):
        plain, clutter, tinted = (
            Video(OPTIONS, index, a).vision(6).astype(int)
            for a in ("as recorded", "clutter", "other white balance")
        )
        assert np.abs(plain - clutter)[inside].max() <= 2
        assert np.abs(plain - clutter)[~inside].max() > 20
        mid = (plain > 20).all(axis=2) & (plain < 180).all(axis=2) & (tinted < 250).all(axis=2)
        ratio = np.median(tinted[mid] / plain[mid], axis=0)
        assert ratio[1] == pytest.approx(1, abs=0.01)
        assert sorted(ratio) == pytest.approx([1.35**-0.8, 1, 1.35**0.8], rel=0.02)
    with pytest.raises(PalpateError, match="appearance"):
        World(OPTIONS, appearance="dark")


def test_photos_as_recorded_are_those_of_the_world(tmp_path):
    write_world(tmp_path / "w", OPTIONS)
    manifest = Manifest.load(tmp_path / "w")
    part = manifest.take(manifest.ids[5:9])
    same = with_photos(part, OPTIONS, "as recorded", tmp_path / "same")
    lit = with_photos(part, OPTIONS, "other light", tmp_path / "lit")
    for old, new, other in zip(*(m.paths("vision") for m in (part, same, lit)), strict=True):
        assert old.read_bytes() == new.read_bytes()
        assert other.read_bytes() != old.read_bytes()
        assert Image.open(other).size == (32, 32)
    assert lit.paths("tactile") == part.paths("tactile")
    assert lit.ids == part.ids
    with pytest.raises(PalpateError, match="of the world"):
        with_photos(part, WorldOptions(size=32, seed=12), "clutter", Path(tmp_path / "x"))


def rows(scale, seed, shift=0.0, videos=24, frames=4, width=8):
    """Features near fixed ones of each sample, moved by ``scale``, and all by ``shift``."""
    base = np.random.default_rng(0).normal(size=(videos * frames, width))
    base += 2 * np.repeat(np.random.default_rng(1).normal(size=(videos, width)), frames, 0)
    x = base + shift + scale * np.random.default_rng(seed).normal(size=base.shape)
    groups = [f"v{k // frames}" for k in range(len(x))]
    labels = [f"m{k // frames % 3}" for k in range(len(x))]
    ids = [f"{g}/{k}" for k, g in enumerate(groups)]
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    return FeatureSet(ids, x.astype(np.float32), labels, groups)


def study(by_light, seed=0, noise=True):
    """A method of which noise moves images by 0.3, and the changes by so much and by nothing."""
    base = rows(0.0, 0)
    renderings = {
        RECORDED: base,
        "other light": rows(by_light, 3 + seed, by_light),
        "other white balance": base,
        "clutter": rows(0.3, 4 + seed),
    }
    again = rows(0.3, 5 + seed) if noise else None
    return moves(renderings, again, base, train=base, subject="m")


def test_movement_is_the_mean_distance_and_relative_to_noise():
    table = appearance_table({"Ours": [study(0.6)]})
    cells = {row[1]: row[2:] for row in table.rows}
    a, b = rows(0.0, 0).features, rows(0.6, 3, 0.6).features
    each = np.array([float(np.linalg.norm(x - y)) for x, y in zip(a, b, strict=True)])
    assert float(cells["other light"][0]) == pytest.approx(each.mean(), rel=1e-5)
    noise = np.linalg.norm(a - rows(0.3, 5).features, axis=1)
    relative = cells["other light"][1]
    assert float(relative) == pytest.approx(each.mean() / noise.mean(), rel=1e-5)
    left = [
        np.delete(each, s).mean() / np.delete(noise, s).mean()
        for s in (slice(k, k + 4) for k in range(0, 96, 4))
    ]
    error = jackknife_errors(np.array(left)[:, None])[0]
    assert relative.interval[1] - relative.value == pytest.approx(2.0687 * error, rel=1e-3)
    assert float(cells["other white balance"][0]) == 0
    assert float(cells["clutter"][1]) == pytest.approx(1, abs=0.1)
    assert cells[AGAIN][1] is None
    assert cells["other light"][2].metric == "change of TMMD"
    assert float(cells["other white balance"][2]) == 0
    assert float(cells["other light"][2]) > float(cells["clutter"][2])
    assert float(cells["other light"][3]) < 0  # the probe knew the recorded ones by heart


def test_what_has_no_noise_moves_by_no_multiple_of_it():
    runs = {"Ours": [study(0.2)], "GVST": [study(0.8)], "real": [study(0.4, noise=False)]}
    table = appearance_table(runs)
    cells = {row[1]: row[2:] for row in table.rows if row[0] == "real"}
    assert AGAIN not in cells
    assert cells["other light"][1] is None
    assert float(cells["other light"][0]) > 0.2
    assert appearance_claims(runs)[0].verdict == "holds"


def test_claims_follow_who_moves_less():
    made = {c.claim: c for c in appearance_claims({"Ours": [study(0.2)], "GVST": [study(0.8)]})}
    assert made["Text drops light"].verdict == "holds"
    assert made["Text drops unrelated objects"].verdict == "undecided"
    flipped = appearance_claims({"Ours": [study(0.8)], "GVST": [study(0.2)]})
    assert flipped[0].verdict == "does not hold"
    assert flipped[0].evidence[0].interval[1] < 0
    seeds = {"Ours": [study(0.2, s) for s in (0, 10)], "GVST": [study(0.8, s) for s in (0, 10)]}
    assert appearance_claims(seeds)[0].verdict == "holds"
    assert len(appearance_table(seeds).rows) == 2 * 4
    assert {c.verdict for c in appearance_claims({"Ours": [study(0.2)]})} == {"undecided"}


def test_recorded_photos_are_needed():
    with pytest.raises(PalpateError, match="as recorded"):
        moves({"clutter": rows(0, 0)}, rows(0, 0), rows(0, 0), subject="m")

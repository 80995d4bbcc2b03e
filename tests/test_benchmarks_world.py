"""The benchmarks of the world: cuts, words, partners and costs are what their tables say."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import split_protocols as protocols
import world_background as background

from palpate.sim import Video, WorldOptions, plan_world
from palpate.sim.plan import contact_frames

OPTIONS = WorldOptions(
    seed=5,
    size=32,
    tile=128,
    materials=("Wood", "Brick", "Leather", "Grass"),
    objects_per_material=3,
    two_videos=0.5,
    mixed=0.3,
    sensors=2,
    contacts_per_video=3,
    frames_per_contact=3,
    free_written="background",
)


@pytest.fixture(scope="module")
def frames():
    return protocols.render(OPTIONS, processes=1)


def test_rendered_frames_are_the_worlds_in_order(frames):
    plans = plan_world(OPTIONS)
    assert len(frames.ids) == len(plans) * 9 == len(set(frames.ids))
    video = Video(OPTIONS, plans[4])
    first = contact_frames(OPTIONS, 1)[0]
    row = list(frames.ids).index(f"{plans[4].name}/{first}")
    np.testing.assert_array_equal(frames.vision[row], video.vision(first))
    np.testing.assert_array_equal(frames.touch[row], video.tactile(first))
    np.testing.assert_array_equal(frames.background[row], video.tactile(first - 4))
    assert (frames.material[row], frames.video[row]) == (
        plans[4].object_of(1).material,
        plans[4].name,
    )
    assert frames.thing[row] == plans[4].objects[0].name


@pytest.mark.parametrize("protocol", protocols.PROTOCOLS)
def test_a_cut_keeps_its_units_whole_and_only_its_units(frames, protocol):
    folds = [protocols.cut(frames, protocol, 3, fold) for fold in range(protocols.FOLDS)]
    assert sorted(row for _, test in folds for row in test) == list(
        range(len(frames.ids))
    )  # every frame is tested once
    train, test = folds[1]
    assert sorted([*train, *test]) == list(range(len(frames.ids)))
    assert 0.1 < len(test) / len(frames.ids) < 0.45
    units = {
        "frame": frames.ids,
        "contact": frames.contact,
        "video": frames.video,
        "object": frames.thing,
    }
    order = list(units)
    shared = {name: set(column[train]) & set(column[test]) for name, column in units.items()}
    for name in order:
        assert (not shared[name]) if order.index(name) <= order.index(protocol) else shared[name]
    assert not np.array_equal(test, protocols.cut(frames, protocol, 4, 1)[1])


def test_equal_cuts_train_on_equally_many_frames_and_never_on_a_test_frame(frames):
    cuts = protocols.equal_cuts(frames, seed=0)
    assert len(cuts) == len(protocols.PROTOCOLS) * protocols.FOLDS
    assert len({len(train) for train, _ in cuts.values()}) == 1
    assert all(not set(train) & set(test) for train, test in cuts.values())


def test_patch_words_are_frequencies_and_come_from_train_alone(frames):
    images = frames.images("touch")
    train = np.arange(0, len(images), 2)
    words = protocols.patch_words(images, train, seed=0, words=12)
    np.testing.assert_allclose((words**2).sum(axis=1), 1, rtol=1e-5)
    changed = images.copy()
    changed[1::2] = -changed[1::2]
    again = protocols.patch_words(changed, train, seed=0, words=12)
    np.testing.assert_array_equal(again[train], words[train])
    assert not np.array_equal(again[1::2], words[1::2])


def test_markers_are_filled_in_and_the_rest_is_kept():
    y, x = np.mgrid[:64, :64] / 64
    plain = np.stack([0.5 + 0.2 * x, 0.6 - 0.1 * y, 0.5 + 0.1 * x * y], -1)
    dotted = plain.copy()
    for row in range(6, 64, 12):
        for column in range(6, 64, 12):
            dotted[row - 1 : row + 2, column - 1 : column + 2] *= 0.1
    images = (np.stack([plain, dotted]) * 255).round().astype(np.uint8)
    filled = protocols.without_markers(images)
    assert np.abs(dotted - plain).max() > 0.5
    assert np.abs(filled[1] - plain).max() < 0.02
    np.testing.assert_allclose(filled[0], images[0] / 255, atol=1e-6)


def test_classifiers_find_a_planted_class_and_not_noise():
    rng = np.random.default_rng(0)
    labels, groups = np.repeat(["a", "b"], 60), np.repeat([f"v{k}" for k in range(24)], 5)
    planted = rng.standard_normal((120, 6)).astype(np.float32)
    planted[:, 0] += 6 * (labels == "a")

    def side(x, rows):
        return protocols.FeatureSet(
            [str(k) for k in rows], x[rows], list(labels[rows]), list(groups[rows]), "e"
        )

    train, test = np.arange(0, 120, 2), np.arange(1, 120, 2)
    hit, penalty = protocols.logistic(side(planted, train), side(planted, test), seed=0)
    assert hit.mean() > 0.95
    assert penalty in protocols.PENALTIES
    noise = rng.standard_normal((120, 6)).astype(np.float32)
    assert protocols.logistic(side(noise, train), side(noise, test), seed=0)[0].mean() < 0.75
    unit = noise / np.linalg.norm(noise, axis=1, keepdims=True)  # as patch words are
    best = [int(np.argmin(((unit[train] - row) ** 2).sum(axis=1))) for row in unit[test]]
    np.testing.assert_array_equal(
        protocols.nearest(side(unit, train), side(unit, test)), labels[train][best] == labels[test]
    )


def test_folds_are_combined_over_their_frames_and_videos():
    fold = lambda hits, videos, top: {
        "hits": {"touch": np.array(hits)},
        "videos": np.array(videos),
        "frames": (9, len(hits)),
        "C": {"touch": 0.01},
        "across": {"top": top},
    }
    row = protocols.combine(
        [
            fold([1, 1, 0], ["a", "a", "b"], (0.2, (0.1, 0.3), 0.01)),
            fold([0], ["c"], (0.4, (0.3, 0.5), 0.01)),
        ],
        0.25,
    )
    value, interval, chance = row["touch"]
    assert (value, chance, row["frames"], row["C"]) == (0.5, 0.25, (9, 4), {"touch": [0.01]})
    assert interval == protocols.spread_of_values(np.array([1.0, 1, 0, 0]), list("aabc")).interval()
    np.testing.assert_allclose(row["top"][0], 0.3)
    np.testing.assert_allclose(
        row["top"][1], (0.3 - 0.1 / np.sqrt(2), 0.3 + 0.1 / np.sqrt(2))
    )  # two equal errors


def test_the_table_holds_means_ranges_and_steps():
    def row(v):
        return {
            "frames": (6, 2),
            "C": {"touch": [0.01]},
            "touch, logistic regression": (v, (v - 0.1, v + 0.1), 0.25),
        }

    first = dict(zip(protocols.PROTOCOLS, map(row, (0.8, 0.6, 0.5, 0.4)), strict=True))
    second = dict(zip(protocols.PROTOCOLS, map(row, (0.9, 0.7, 0.68, 0.4)), strict=True))
    np.testing.assert_allclose(protocols.steps_of([first, second]), [(20, 10), (20, 2)])
    text = protocols.table([first, second])
    assert "| random frame | 85.0 ± 10.0 % (80.0 to 90.0) |" in text
    assert "| chance | 25.0 % |" in text


def test_partners_are_of_the_right_kind(frames):
    units = background.unit_of(frames, OPTIONS)
    rows = background.partners(frames, units, 40, seed=1)
    true, same, other, beside = rows["true"], rows["same"], rows["other"], rows["neighbor"]
    assert len(true) == 40 == len(set(true))
    for picked in (same, other):
        assert (units[picked] == units[true]).all()
        assert (frames.video[picked] != frames.video[true]).all()
    assert (frames.material[same] == frames.material[true]).all()
    assert (frames.material[other] != frames.material[true]).all()
    assert (frames.contact[beside] == frames.contact[true]).all()
    number = lambda at: np.array([int(name.split("/")[1]) for name in frames.ids[at]])
    assert (np.abs(number(beside) - number(true)) == 1).all()


def test_background_table_says_which_is_better(frames):
    pairs = background.pairwise(frames, background.unit_of(frames, OPTIONS), count=20)
    found = background.halves(frames, words=12)
    text = background.tables(pairs, found)
    assert all(title in text for title in background.SUBJECTS.values())
    whole = background.page(text, "tiny", OPTIONS, frames, pairs, "command")
    better = (
        pairs["background"][0].value > pairs["same"][0].value
        and pairs["background"][1].value > pairs["same"][1].value
    )
    assert ("NOT better" in whole) == (not better)
    assert found[1].value > found[0].value  # halves of videos differ more than random ones

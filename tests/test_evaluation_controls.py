"""Train videos in the place of test videos: the rule, and floors against a planted truth."""

from collections import Counter

import numpy as np
import pytest

from palpate.core import FeatureSet, Split
from palpate.evaluation import score
from palpate.evaluation.controls import matched_features, matched_rows
from palpate.metrics import compare

CLASSES, FRAMES, DIM = 6, 4, 32


def videos_of(rng, part, centers, count):
    """Features of ``count`` videos a class: frames about a video's mean, these about a class's."""
    means = np.repeat(centers, count, axis=0) + 0.25 * rng.normal(size=(CLASSES * count, DIM))
    x = np.repeat(means, FRAMES, axis=0)
    x = x + 0.1 * rng.normal(size=x.shape)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    videos = [f"{part}{k}" for k in range(CLASSES * count) for _ in range(FRAMES)]
    labels = [f"class {k}" for k in range(CLASSES) for _ in range(count * FRAMES)]
    return FeatureSet([f"{part}/{k}" for k in range(len(x))], x.astype("f4"), labels, videos)


def columns(rows):
    return [m for m, _ in rows], [v for _, v in rows]


def test_one_other_video_of_the_material_stands_for_a_test_video():
    rng = np.random.default_rng(0)
    names = {part: [f"{part}{k}" for k in range(12)] for part in ("train", "test")}
    made = {
        part: [(m, v) for v in names[part] for m in ("Wood", "Grass") for _ in range(lengths)]
        for part, lengths in (("train", 6), ("test", 3))
    }
    train, test = ([rows[k] for k in rng.permutation(len(rows))] for rows in made.values())
    # A train video that is tested as well must not be used.
    leaking = [*train, *[("Wood", "test3")] * 50]
    rows = matched_rows(columns(leaking), columns(test), 0)
    chosen = [leaking[k] for k in rows]
    assert [m for m, _ in chosen] == [m for m, _ in test]
    pairs = {(m, v, w) for (m, v), (_, w) in zip(test, chosen, strict=True)}
    assert len(pairs) == 24  # one a material and test video
    assert {*Counter((m, w) for m, _, w in pairs).values()} == {1}  # each once
    assert len({*rows}) == len(rows)  # other frames
    assert not any(w.startswith("test") for _, _, w in pairs)


@pytest.mark.parametrize(
    ("train", "used"),
    [
        ([("Wood", "a")], {"a"}),  # repeated where there is no other
        ([("Wood", "t"), ("Wood", "b")], {"b"}),
        ([("Wood", "t")], None),
        ([("Grass", "a"), (None, "b")], None),
    ],
)
def test_without_another_video_of_the_material_there_is_none(train, used):
    train = [(m or "", v) for m, v in train]
    rows = matched_rows(columns(train), (["Wood"] * 4, ["t", "t", "u", "u"]), 0)
    assert (rows and {train[k][1] for k in rows}) == used


def test_samples_without_videos_are_videos_of_their_own():
    rows = matched_rows(([""] * 9, [""] * 9), ([""] * 4, [""] * 4), 0)
    assert rows is not None
    assert len({*rows}) == 4


def test_the_floor_of_tmmd_is_0_where_train_and_test_are_alike():
    """Of materials that differ, and as many videos of each; all train rows score -0.4."""
    rng, floors = np.random.default_rng(0), []
    for _ in range(8):
        centers = 0.4 * rng.normal(size=(CLASSES, DIM))
        test, train = videos_of(rng, "test", centers, 5), videos_of(rng, "train", centers, 8)
        real = FeatureSet(
            *([*a, *b] for a, b in ((train.ids, test.ids), (train.features, test.features))),
            [*train.labels, *test.labels],
            [*train.groups, *test.groups],
        )
        split = Split.from_ids(train=train.ids, test=test.ids, rule={}, manifest="m" * 64)
        how = {"split": split, "companions": [], "permutations": 0, "sigma": 10}
        [scored] = score(test, real, presets=["grouped"], **how)["TMMD"]
        floors.append(scored.floor)
    assert abs(np.mean(floors)) < 0.06
    assert np.std(floors) < 0.12


def test_matched_videos_score_as_the_real_ones_do():
    """They are of videos: what is drawn row by row has I-, CI- and D-TMMD of about 0."""
    rng, values = np.random.default_rng(1), []
    for seed in range(6):
        centers = 0.4 * rng.normal(size=(CLASSES, DIM))
        test, train = videos_of(rng, "test", centers, 8), videos_of(rng, "train", centers, 16)
        sets = {"train": matched_features(train, test, seed)}
        result = compare(sets, test, floor=test, preset="grouped", sigma=10, permutations=0)
        values.append([(s.value, s.floor) for s in result.scores if s.kind == "value"][1:])
    of_train, of_test = np.mean(values, axis=0).T
    assert len(of_test) == 3
    assert (of_test > 0.01).all()
    assert of_train == pytest.approx(of_test, rel=0.15)

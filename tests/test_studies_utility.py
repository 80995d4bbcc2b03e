"""What generated images are worth: noise nothing, real images of other videos much."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from palpate.core import FeatureSet, PalpateError
from palpate.studies.controls import CEILING
from palpate.studies.utility import (
    REAL,
    Draws,
    Training,
    _tested,
    fewest_videos,
    linear_map,
    material_utility,
    retrieval_utility,
    utility,
    utility_claims,
)

CLASSES, FRAMES, DIM = 4, 3, 12
CENTERS = np.random.default_rng(9).normal(size=(CLASSES, DIM))
FEW = Draws(shots=(1, 2, 4), draws=3)


def videos(per_class, prefix, seed, shift=0.0, of_video=1.5):
    """Frames of videos of each class: class center, deviation of the video, of the frame."""
    rng = np.random.default_rng(seed)
    rows, labels, groups = [], [], []
    for c in range(CLASSES):
        for v in range(per_class):
            center = CENTERS[c] + of_video * rng.normal(size=DIM) + shift
            rows += [center + 0.2 * rng.normal(size=DIM) for _ in range(FRAMES)]
            labels += [f"class {c}"] * FRAMES
            groups += [f"{prefix}{c}-{v}"] * FRAMES
    ids = [f"{g}/{k}" for k, g in enumerate(groups)]
    return FeatureSet(ids, np.array(rows, np.float32), labels, groups)


TRAIN, TEST = videos(8, "train", 1), videos(20, "test", 2)


def like_test(features):
    """Rows that pass for images generated for the photos of the test part."""
    return replace(features, ids=TEST.ids, labels=TEST.labels, groups=TEST.groups)


def cells(table):
    return {row[0]: row[1:] for row in table.rows}


@pytest.fixture(scope="module")
def material():
    noise = np.random.default_rng(3).normal(size=TEST.features.shape).astype(np.float32)
    generated = {
        "noise": like_test(replace(TEST, features=noise)),
        "good": like_test(videos(20, "other", 4)),
        "leak": TEST,  # the very test images: folds must keep them from their own videos
    }
    return material_utility(TRAIN, TEST, generated, FEW)


def test_noise_does_not_help_and_real_images_of_other_videos_do(material):
    rows = cells(material[0])
    assert all(float(gain) <= 0.02 for gain in rows["gain by noise"])
    one = rows["gain by good"][0]
    assert one.interval[0] > 0.02
    assert float(rows["gain by good"][0]) > float(rows["gain by good"][2])  # less is missing
    assert float(rows["noise alone"][0]) == pytest.approx(0.25, abs=0.12)
    accuracies = [float(score) for score in rows[REAL]]
    assert accuracies == sorted(accuracies)


def test_the_claim_follows_the_gain_at_one_video(material):
    made = {c.claim: c for c in utility_claims(material[0])}
    assert made["Images of good help a classifier of real touch"].verdict == "holds"
    noise = made["Images of noise help a classifier of real touch"]
    assert noise.verdict in ("undecided", "does not hold")
    assert noise.why.startswith("Accuracy on real images of new videos changes by −0.")
    assert "at k = 4 real videos a class" in noise.why
    assert len(noise.evidence) == 3
    reversed_rows = [
        [
            row[0],
            *(
                replace(c, value=-c.value, interval=(-c.interval[1], -c.interval[0]))
                for c in row[1:]
            ),
        ]
        for row in material[0].rows
        if str(row[0]).startswith("gain")
    ]
    flipped = utility_claims(replace(material[0], rows=reversed_rows))
    assert flipped[1].verdict == "does not hold"


def test_controls_are_rows_and_neither_lines_nor_claims():
    good = {name: like_test(videos(20, "other", 4)) for name in ("made", "retrieved")}
    draws = Draws(shots=(1,), draws=1)
    table, curve = material_utility(TRAIN, TEST, good, draws, controls=["retrieved"])
    aside = ["k real + retrieved", "retrieved alone", "gain by retrieved"]
    assert sorted(table.controls) == sorted(aside)
    assert {*aside} < {*cells(table)}
    assert [line.label for line in curve.lines] == [REAL, "k real + made", "made alone"]
    assert [c.claim for c in utility_claims(table)] == [
        "Images of made help a classifier of real touch"
    ]


def test_no_image_trains_what_names_its_video(material):
    """Of the test images themselves a probe would know each video's deviation by heart."""
    rows = cells(material[0])
    good, leak = (float(rows[f"{REAL} + {name}"][0]) for name in ("good", "leak"))
    assert leak == pytest.approx(good, abs=0.08)
    by_heart = material_utility(TRAIN, TEST, {"x": _renamed(TEST)}, FEW)[0]
    assert float(cells(by_heart)[f"{REAL} + x"][0]) > leak + 0.15


def test_every_fold_leaves_out_as_many_videos_of_a_class():
    """Else a class is rarer in training where it is tested, and no knowledge is below chance."""
    uneven = [
        i for i, g in zip(TEST.ids, TEST.groups, strict=True) if g not in ("test0-1", "test2-3")
    ]
    test, seen = TEST.take(uneven), []

    def fit(features):
        pairs = {*zip(features.labels, features.groups, strict=True)}
        seen.append(Counter(label for label, _ in pairs))
        return lambda rows: np.zeros(len(rows.ids))

    _tested(Draws(folds=3), 0, test, Training(generated=test), fit)
    assert seen == 3 * [{"class 0": 12, "class 1": 13, "class 2": 12, "class 3": 13}]
    other = Training(generated=replace(test, groups=[f"other {g}" for g in test.groups]))
    seen.clear()
    _tested(Draws(folds=3), 0, test, other, fit)
    assert seen == [{"class 0": 19, "class 1": 20, "class 2": 19, "class 3": 20}]


def test_a_claim_names_what_a_perfect_generator_would_add():
    good = {name: like_test(videos(20, "other", 4)) for name in ("made", CEILING)}
    draws = Draws(shots=(1,), draws=1)
    table = material_utility(TRAIN, TEST, good, draws, controls=[CEILING])[0]
    [claim] = utility_claims(table)
    assert "Images of a perfect generator would change it by 0." in claim.why
    assert claim.why.endswith("] at k = 1.")


def _renamed(features):
    """The same rows under other videos, which no fold can keep apart."""
    return replace(features, groups=[f"renamed {g}" for g in features.groups])


def test_the_curve_is_the_table_and_says_how_it_was_drawn(material):
    table, curve = material
    rows = cells(table)
    assert curve.log_x
    for line in curve.lines:
        assert [x for x, _ in line.points] == [1, 2, 4]
        assert [s.value for _, s in line.points] == [s.value for s in rows[line.label]]
    score = rows[REAL][0]
    assert len(score.details["by_seed"]) == 3
    assert score.value == pytest.approx(np.mean(score.details["by_seed"]))
    assert score.interval[0] < score.value < score.interval[1]
    gain = rows["gain by good"][1]
    pair = rows[f"{REAL} + good"][1].value - rows[REAL][1].value
    assert gain.value == pytest.approx(pair)


def test_the_drawn_videos_are_nested_and_the_same_for_all_sets():
    one, two = (FEW.rows(TRAIN, k, 0) for k in (1, 2))
    assert set(one) < set(two)
    assert len(one) == CLASSES * FRAMES
    assert FEW.rows(TRAIN, 1, 1) != one
    assert len({TRAIN.groups[k] for k in two}) == 2 * CLASSES
    each = {f"class {c}": c for c in range(CLASSES)}
    assert Counter(TRAIN.labels[k] for k in FEW.rows(TRAIN, each, 0)) == {
        f"class {c}": c * FRAMES for c in range(1, CLASSES)
    }
    fold = FEW.fold_of(TEST, TEST)
    assert len(set(fold)) == FEW.folds
    assert all(
        len({f for f, g in zip(fold, TEST.groups, strict=True) if g == v}) == 1 for v in TEST.groups
    )
    assert set(FEW.fold_of(TEST, TRAIN)) == {0}
    table, _ = material_utility(TRAIN, TEST, {}, Draws(shots=(1, 16), draws=2))
    assert cells(table)[REAL][1] is None  # no class has 16 videos


def part(counts, prefix):
    """One frame a video, as many videos of each class as ``counts`` says."""
    labels = [f"class {c}" for c, n in enumerate(counts) for _ in range(n)]
    names = [f"{prefix}{k}" for k in range(len(labels))]
    return FeatureSet(names, np.zeros((len(names), 2), np.float32), labels, names)


def test_k_is_what_every_tested_class_has_without_its_fold():
    """Folds are dealt within a class; of all in one pot, 1 of 5 videos would be left to some."""
    test = part([5] * 10, "v")
    for seed in range(5):
        draws = Draws(seed=seed)
        fold = draws.fold_of(test, test)
        for c in range(10):
            of_class = [
                int(f) for f, of in zip(fold, test.labels, strict=True) if of == f"class {c}"
            ]
            assert sorted(np.bincount(of_class, minlength=4)) == [1, 1, 1, 2]
        assert fewest_videos(draws, test, test) == 3  # 5 less the 2 of a fold
        assert fewest_videos(draws, part([9, 2, *[7] * 8], "train"), test) == 2
        assert fewest_videos(draws, part([9, 0, *[7] * 8], "train"), test) == 7
    assert fewest_videos(Draws(), part([5, 1], "v"), part([5, 1], "v")) == 0


def test_the_map_is_the_minimum_and_without_data_the_identity():
    rng = np.random.default_rng(0)
    x, turn = rng.normal(size=(40, 3)), np.linalg.qr(rng.normal(size=(3, 3)))[0]
    weight, bias = linear_map(x, x @ turn + 2, 1e-9)
    assert np.allclose(weight, turn, atol=1e-6)
    assert np.allclose(bias, 2, atol=1e-6)
    weight, _ = linear_map(x, x @ turn, 1e9)
    assert np.allclose(weight, np.eye(3), atol=1e-6)

    def loss(w):
        b = (x @ turn).mean(axis=0) - x.mean(axis=0) @ w
        error = ((x @ w + b - x @ turn) ** 2).sum()
        return error + 40 * 0.5 / 3 * ((w - np.eye(3)) ** 2).sum()

    best, _ = linear_map(x, x @ turn, 0.5)
    steps = (0.01 * rng.normal(size=(3, 3)) for _ in range(20))
    assert all(loss(best) < loss(best + step) for step in steps)


def test_pairs_of_other_videos_help_retrieval_and_shuffled_ones_do_not():
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(DIM, DIM)))[0].astype(np.float32)
    every = [TRAIN, TEST]
    x = np.concatenate([part.features for part in every])
    ids = [i for part in every for i in part.ids]
    keys = FeatureSet(ids, (x @ turn + 0.05).astype(np.float32))
    shuffled = np.random.default_rng(6).permutation(TEST.features)
    generated = {"good": TEST, "wrong": replace(TEST, features=shuffled)}
    table = retrieval_utility(TRAIN, TEST, keys, generated, draws=FEW)
    rows = cells(table)
    assert rows["gain by good"][0].interval[0] > 0
    assert float(rows["gain by wrong"][2]) < 0.02
    assert float(rows["the encoder"][0]) < float(rows[f"{REAL} + good"][0])
    assert rows[REAL][0].metric == "top-5 of 240 (vision by tactile)"
    with pytest.raises(PalpateError, match="share a space"):
        retrieval_utility(TRAIN, TEST, FeatureSet(ids, x[:, :3]), {})


def test_mistakes_are_named():
    with pytest.raises(PalpateError, match="'test' must have materials"):
        material_utility(TRAIN, replace(TEST, labels=None), {})
    with pytest.raises(PalpateError, match="in order"):
        Draws(shots=(2, 1))


def test_an_encoder_that_saw_test_videos_is_rejected(tmp_path):
    """On files: features, keys and generated images come together by id; the guard stands first."""
    from PIL import Image

    from mini_fixtures import make_encoders
    from palpate.core import Split
    from palpate.data.manifest import Manifest
    from palpate.sim import WorldOptions, write_world

    options = WorldOptions(
        materials=2,
        objects_per_material=6,
        contacts_per_video=1,
        size=16,
        frames_per_contact=2,
        tile=64,
        mixed=0.0,
        leak="none",
    )
    write_world(tmp_path / "w", options)
    manifest = Manifest.load(tmp_path / "w")
    split = Split.load(tmp_path / "w" / "splits" / "Orig.json")
    folder = tmp_path / "g"
    (folder / "images").mkdir(parents=True)
    files = {}
    for k, i in enumerate(split.ids("test")):
        row = manifest.take([i])
        Image.open(row.paths("tactile")[0]).save(folder / "images" / f"{k}.png")
        files[i] = f"{k}.png"
    rows = [{"id": i, "tactile": f"images/{name}"} for i, name in files.items()]
    Manifest.from_rows(rows, folder).save(folder / "manifest.parquet")
    generated = {"Ours": folder}
    encoders = make_encoders()
    tables, curve = utility(manifest, split, encoders, generated, Draws(shots=(1,), draws=2))
    assert [t.title for t in tables] == [
        "Material accuracy by training data",
        "Retrieval of vision by training data",
        "Retrieval of text by training data",
    ]
    # A test video a class: nothing is left to train its own material on, so no "Ours alone".
    assert {line.label for line in curve.lines} == {REAL, f"{REAL} + Ours"}
    assert cells(tables[0])[REAL][0].split == split.digest
    from palpate.encoders.preprocess import digest_images

    pixels = np.stack([np.asarray(Image.open(p)) for p in manifest.paths("tactile")])
    encoders.seen = np.unique(digest_images(encoders.preprocess("tactile").fit(pixels)))
    with pytest.raises(PalpateError, match="has not seen"):
        utility(manifest, split, encoders, generated, Draws(shots=(1,), draws=2))

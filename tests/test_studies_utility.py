"""What generated images are worth: noise nothing, real images of other videos much."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.core import FeatureSet, PalpateError, Score
from palpate.report.records import StudyTable
from palpate.report.results import Results
from palpate.studies import utility as utility_module
from palpate.studies.graph import Work
from palpate.studies.names import CEILING, NEAREST
from palpate.studies.utility import (
    GAIN,
    REAL,
    Draws,
    Training,
    _hits,
    fewest_videos,
    material_utility,
    measure_utility,
    table_over_seeds,
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
    rows = cells(material)
    assert all(float(gain) <= 0.02 for gain in rows["gain by noise"])
    one = rows["gain by good"][0]
    assert one.interval[0] > 0.02
    assert float(rows["gain by good"][0]) > float(rows["gain by good"][2])  # less is missing
    assert float(rows["noise alone"][0]) == pytest.approx(0.25, abs=0.12)
    accuracies = [float(score) for score in rows[REAL]]
    assert accuracies == sorted(accuracies)


def test_the_claim_follows_the_gain_at_one_video(material):
    made = {c.claim: c for c in utility_claims(material, ["noise", "good", "leak"])}
    assert made["Images of good help a classifier of real touch"].verdict == "holds"
    noise = made["Images of noise help a classifier of real touch"]
    assert noise.verdict in ("undecided", "does not hold")
    assert noise.why.startswith("Accuracy on real images of new videos changes by −0.")
    assert "at k = 4 real videos a class" in noise.why
    assert len(noise.evidence) == 3
    turned = lambda c: replace(c, value=-c.value, interval=(-c.interval[1], -c.interval[0]))
    rows = [[row[0], *map(turned, row[1:])] for row in material.rows if row[0] == f"{GAIN}good"]
    flipped = utility_claims(replace(material, rows=rows), ["good"])
    assert flipped[0].verdict == "does not hold"


def test_controls_are_rows_and_no_claims_and_a_perfect_generator_is_named():
    good = {name: like_test(videos(20, "other", 4)) for name in ("made", CEILING)}
    draws = Draws(shots=(1,), draws=1)
    table = material_utility(TRAIN, TEST, good, draws, controls=[CEILING])
    aside = [f"k real + {CEILING}", f"{CEILING} alone", f"gain by {CEILING}"]
    assert sorted(table.controls) == sorted(aside)
    assert {*aside} < {*cells(table)}
    [claim] = utility_claims(table, good)
    assert claim.claim == "Images of made help a classifier of real touch"
    assert "Images of a perfect generator would change it by 0." in claim.why
    assert claim.why.endswith("] at k = 1.")


def test_no_image_trains_what_names_its_video(material):
    """Of the test images themselves a probe would know each video's deviation by heart."""
    rows = cells(material)
    good, leak = (float(rows[f"{REAL} + {name}"][0]) for name in ("good", "leak"))
    assert leak == pytest.approx(good, abs=0.08)
    by_heart = material_utility(TRAIN, TEST, {"x": _renamed(TEST)}, FEW)
    assert float(cells(by_heart)[f"{REAL} + x"][0]) > leak + 0.15


def test_every_fold_leaves_out_as_many_videos_of_a_class(monkeypatch):
    """Else a class is rarer in training where it is tested, and no knowledge is below chance."""
    uneven = [
        i for i, g in zip(TEST.ids, TEST.groups, strict=True) if g not in ("test0-1", "test2-3")
    ]
    test, seen = TEST.take(uneven), []

    def named(features, rows, l2):
        pairs = {*zip(features.labels, features.groups, strict=True)}
        seen.append(Counter(label for label, _ in pairs))
        return [""] * len(rows)

    monkeypatch.setattr(utility_module, "_named", named)
    _hits(Draws(folds=3), 0, test, Training(generated=test))
    assert seen == 3 * [{"class 0": 12, "class 1": 13, "class 2": 12, "class 3": 13}]
    other = Training(generated=replace(test, groups=[f"other {g}" for g in test.groups]))
    seen.clear()
    _hits(Draws(folds=3), 0, test, other)
    assert seen == [{"class 0": 19, "class 1": 20, "class 2": 19, "class 3": 20}]


def _renamed(features):
    """The same rows under other videos, which no fold can keep apart."""
    return replace(features, groups=[f"renamed {g}" for g in features.groups])


def test_scores_say_how_they_were_drawn_and_gains_are_paired(material):
    rows = cells(material)
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
    table = material_utility(TRAIN, TEST, {}, Draws(shots=(1, 16), draws=2))
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


def test_mistakes_are_named():
    with pytest.raises(PalpateError, match="'test' must have materials"):
        material_utility(TRAIN, replace(TEST, labels=None), {}, FEW)


def test_an_encoder_that_saw_test_videos_is_rejected(tmp_path):
    """On files: features, keys and generated images come together by id; the guard stands first."""
    from PIL import Image

    from forge.models import make_encoders
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
    table = utility(manifest, split, encoders, generated, Draws(shots=(1,), draws=2))
    # A test video a class: nothing is left to train its own material on, so no "Ours alone".
    assert {*cells(table)} == {REAL, f"{REAL} + Ours", "gain by Ours"}
    assert cells(table)[REAL][0].split == split.digest
    from palpate.encoders.models import digest_images

    pixels = np.stack([np.asarray(Image.open(p)) for p in manifest.paths("tactile")])
    encoders.seen["tactile"] = np.unique(digest_images(encoders.preprocess("tactile").fit(pixels)))
    with pytest.raises(PalpateError, match="has not seen"):
        utility(manifest, split, encoders, generated, Draws(shots=(1,), draws=2))


def score(value, subject="Ours"):
    return Score("accuracy", subject, value, (value - 0.05, value + 0.05))


def table_of(*cells):
    return StudyTable("T", "", ["trained on", "k = 1", "k = 2"], [[f"{GAIN}Ours", *cells]])


def test_cells_are_means_and_what_a_seed_lacks_is_left_out():
    tables = [table_of(score(0.1), score(0.5)), table_of(score(0.3), None)]
    (label, mean, none), *_ = table_over_seeds(tables).rows
    assert label == f"{GAIN}Ours"
    assert mean.value == pytest.approx(0.2)
    assert mean.details["by_seed"] == [0.1, 0.3]
    assert mean.interval[1] - mean.interval[0] > 0.1  # wider than that of one seed
    assert none is None


@pytest.mark.parametrize(
    ("gains", "verdict"), [((0.1,), "holds"), ((0.1, -0.08, 0.02), "undecided")]
)
def test_whether_images_help_is_decided_by_all_seeds(tmp_path, monkeypatch, gains, verdict):
    """One training may gain where the next loses."""
    left = list(gains)

    def forged(manifest, split, judge, images, draws, *, controls, progress):
        assert controls == [NEAREST]
        assert images[NEAREST].name == "real-nearest-photo"
        gain = score(left.pop(0), images["Ours"].parent.name)
        assert judge == tmp_path / f"encoder-{gain.a[-1]}" / "encoders"
        gain = score(gain.value)
        return table_of(gain, gain)

    monkeypatch.setattr(utility_module, "utility", forged)
    monkeypatch.setattr(utility_module, "data_of", lambda work: (None, None))
    load = SimpleNamespace(load=lambda folder, device: folder)
    monkeypatch.setattr(utility_module, "EncoderSet", load)
    runs = {f"encoder-{k}": {"Ours": f"images-{k}"} for k in range(len(gains))}
    names = [n for encoders, made in runs.items() for n in (encoders, *made.values())]
    names.append("controls-NoLeak")
    after = {name: tmp_path / name for name in names}
    (after["controls-NoLeak"] / "real-nearest-photo").mkdir(parents=True)
    control_names = [NEAREST, "mean image"]
    measure_utility(Work(tmp_path, after), runs=runs, controls=control_names, draws=Draws())
    results = Results.load(tmp_path / "results.json")
    assert results.claims[0].verdict == verdict
    assert results.tables[0].rows[0][1].details["by_seed"] == list(gains)

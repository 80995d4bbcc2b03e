"""Quality against compute: curves from planted features."""

from dataclasses import replace

import numpy as np

from palpate.core import FeatureSet
from palpate.studies.lengths import compute_curves

RNG = np.random.default_rng(0)
KINDS = np.array(["Brick", "Wood", "Sand"])


def features(n, spread, prefix="", shift=0.0):
    """Two images a video, materials apart by 1; ``spread`` blurs them, ``shift`` moves them all."""
    labels = [str(KINDS[k // 2 % 3]) for k in range(n)]
    centers = np.eye(8)[[list(KINDS).index(m) for m in labels]]
    x = centers + spread * RNG.normal(size=(n, 8))
    x[:, 7] += shift
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    videos = [f"{prefix}video {k // 2}" for k in range(n)]
    return FeatureSet([f"{prefix}{k}" for k in range(n)], x, labels, videos)


REAL = features(60, 0.1)
#: Images after few and after many steps: far from real touches, then as these.
TRAINED = {"Ours": [(10, features(60, 2.0, shift=6.0)), (40, features(60, 0.1))]}
TRAIN = features(90, 0.1, "train ")


def test_curves_tell_few_steps_from_many_on_the_same_samples():
    some = [str(k) for k in range(0, 60, 3)]
    sampled = {"Ours": [(2, TRAINED["Ours"][0][1].take(some)), (10, REAL.take(some))]}
    training, material, sampling, _ = compute_curves(TRAINED, sampled, REAL, TRAIN, "split")
    few, many = (score for _, score in training.lines[0].points)
    assert few.value > many.interval[1]
    assert abs(many.value) < 0.3
    assert {s.split for s in (few, many)} == {"split"}
    ours, real = material.lines
    assert [x for x, _ in ours.points] == [x for x, _ in real.points] == [10, 40]
    assert ours.points[0][1].value < 0.6 < 0.95 < ours.points[1][1].value
    assert real.label == "real images"
    assert real.points[0][1].value == 1
    assert sampling.lines[0].points[1][1].n == len(some)


def test_without_materials_only_distances_are_left():
    bare = {"Ours": [(n, replace(x, labels=None)) for n, x in TRAINED["Ours"]]}
    curves = compute_curves(bare, bare, replace(REAL, labels=None), replace(TRAIN, labels=None))
    assert [c.title for c in curves] == [
        "Quality against training steps",
        "Quality against sampling steps",
    ]

"""Vendi, MIND and FD-DINOv2 against their reference implementations, or slow ones."""

from functools import partial

import numpy as np
import pytest
import torch
from vendi_score import vendi as reference_vendi

from forge.errors import fails
from forge.pictures import photos
from forge.scores import codes, jackknife
from forge.scores import numbered as features
from palpate.core import rng_for
from palpate.evaluation import score
from palpate.metrics import compare_mind, compare_vendi, fid, mind, vendi
from palpate.metrics.sets import DIRECTIONS
from test_encoders_families import write


def slow_mind(x, y, seed=0):
    """Every direction alone; both sides repeated to a common length, so that points pair up."""
    u = rng_for(seed, "directions of MIND").normal(size=(DIRECTIONS, x.shape[1]))
    times = np.lcm(len(x), len(y))
    total = 0.0
    for direction in u:
        direction = direction / np.sqrt(direction @ direction)
        a, b = (
            np.repeat(np.sort(v.astype(np.float64) @ direction), times // len(v)) for v in (x, y)
        )
        total += np.mean((a - b) ** 2)
    return x.shape[1] * total / DIRECTIONS


@pytest.mark.parametrize(("n", "d"), [(40, 8), (12, 30)])
def test_vendi_is_that_of_its_authors(n, d):
    x = np.random.default_rng(0).normal(size=(n, d)) + 1
    assert vendi(features(x)).value == pytest.approx(reference_vendi.score_dual(x), rel=1e-9)
    assert vendi(np.ones((5, 3))).value == pytest.approx(1)
    assert vendi(np.eye(6)).value == pytest.approx(6)


@pytest.mark.parametrize(("n", "m"), [(30, 30), (30, 20), (7, 24)])
def test_mind_is_the_sliced_distance(n, m):
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(n, 5)), 2 * rng.normal(size=(m, 5)) + 1
    assert mind(x, y, seed=3).value == pytest.approx(slow_mind(x, y, 3), rel=1e-9)
    assert mind(x, x).value == 0
    shift = np.array([1.0, 2, 0, 0, 0])  # a moved mean counts as in FID, up to the drawn directions
    assert mind(x, x + shift).value == pytest.approx(5, rel=0.1)


@pytest.mark.parametrize("metric", ["vendi", "mind"])
def test_intervals_leave_out_whole_groups(metric):
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(24, 4)), rng.normal(size=(24, 4)) + 2
    groups = [f"g{k // 3}" for k in range(24)]
    a, b = (features(v, groups=groups) for v in (x, y))
    of = (lambda p, q: vendi(p)) if metric == "vendi" else mind
    made = of(a, b)
    without = [
        of(x[keep], y[keep]).value
        for g in sorted(set(groups))
        for keep in [np.array([h != g for h in groups])]
    ]
    assert made.interval == jackknife(made.value, without, 1e-6)[1]


def test_generators_are_compared_on_the_same_samples_with_real_images_as_floor():
    rng = np.random.default_rng(4)
    real = features(rng.normal(size=(40, 6)))
    wide, narrow = (features(s * rng.normal(size=(40, 6)) + c) for s, c in ((1, 0), (0.1, 2)))
    sets = {"wide": wide, "narrow": narrow}
    of_vendi, of_mind = compare_vendi(sets, real), compare_mind(sets, real)
    floor = vendi(real).value
    assert [s.floor for s in of_vendi.scores] == [floor, floor]
    assert of_vendi.scores[1].value < of_vendi.scores[0].value
    assert of_vendi.differences[0].details["better"] == "wide"
    assert of_mind.differences[0].details["better"] == "wide"
    assert "vendi-of-n" in codes(of_vendi.scores[0])
    few = features(rng.normal(size=(30, 6)))
    assert compare_vendi({"few": few}, real).scores[0].floor is None


def test_they_come_with_other_scores_where_they_are_requested():
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(2, 40, 8)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=2, keepdims=True)
    call = partial(score, rows[0], rows[1], permutations=0)
    results = call(companions=["vendi", "mind"])
    assert results["MIND (embeddings)"][0].value == pytest.approx(mind(*rows).value, rel=1e-6)
    assert results["Vendi (embeddings)"][0].floor == pytest.approx(vendi(rows[1]).value, rel=1e-6)
    assert not {"MIND", "Vendi", "FD"} & {s.metric for s in call()}
    fails("must hold a DINOv2", lambda: call(companions=["fd-dinov2"]))
    fails("`dinov2` must go with images", lambda: call(dinov2="x"))


def test_fd_dinov2_is_the_distance_of_class_tokens(tmp_path):
    model, config = write("dinov2", tmp_path / "dino")
    real, made = photos(12, 48), photos(12, 48)[:, ::-1].copy()
    call = partial(score, made, real, companions=["fd-dinov2"], permutations=0)
    tokens = []
    for images in (made, real):  # 48 pixels, of which the middle 42 are seen
        x = (images[:, 3:45, 3:45] / 255 - config["image_mean"]) / config["image_std"]
        with torch.no_grad():
            pixels = torch.tensor(x.transpose(0, 3, 1, 2), dtype=torch.float32)
            tokens.append(model(pixel_values=pixels).pooler_output.numpy())
    made_of = call(dinov2=tmp_path / "dino")["FD (DINOv2)"][0]
    assert made_of.value == pytest.approx(fid(*tokens).value, rel=1e-4)
    fails("must be a DINOv2", lambda: call(dinov2="palpate/mini"))

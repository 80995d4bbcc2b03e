"""MS-SSIM against a loop over windows, what it equals by hand, how many scales fit, and what it refuses."""

import json
import math

import numpy as np
import pytest

from palpate.core import PalpateError, require_comparable
from palpate.metrics.multiscale import (
    WEIGHTS,
    least_side,
    ms_ssim,
    ms_ssim_per_image,
    scale_weights,
)
from palpate.metrics.pairwise import ssim, ssim_per_image


def images(seed, n=2, h=45, w=50, c=3, noise=60):
    rng = np.random.default_rng(seed)
    coarse = rng.random((n, 6, 6, c)).repeat(-(-h // 6), 1).repeat(-(-w // 6), 2)[:, :h, :w]
    a = np.clip(255 * coarse + rng.normal(size=coarse.shape) * 10, 0, 255).astype(np.uint8)
    return a, np.clip(a + rng.normal(size=a.shape) * noise, 0, 255).astype(np.uint8)


def slow_terms(x, y):
    """Mean SSIM and mean contrast-structure of two (h, w) in [0, 1], window by window with a two-dimensional Gaussian."""
    at = np.arange(11) - 5
    window = np.exp(-(at[:, None] ** 2 + at[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    whole, structure = [], []
    for i in range(x.shape[0] - 10):
        for j in range(x.shape[1] - 10):
            u, v = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
            mu, mv = (window * u).sum(), (window * v).sum()
            vu, vv, uv = (
                (window * (u - mu) ** 2).sum(),
                (window * (v - mv) ** 2).sum(),
                (window * (u - mu) * (v - mv)).sum(),
            )
            structure.append((2 * uv + 0.0009) / (vu + vv + 0.0009))
            whole.append(structure[-1] * (2 * mu * mv + 0.0001) / (mu**2 + mv**2 + 0.0001))
    return np.mean(whole), np.mean(structure)


def slow_halved(x):
    return np.array(
        [
            [x[2 * i : 2 * i + 2, 2 * j : 2 * j + 2].mean() for j in range(x.shape[1] // 2)]
            for i in range(x.shape[0] // 2)
        ]
    )


def slow(a, b, scales, weights):
    values = []
    for x, y in zip(a / 255, b / 255, strict=True):
        products = []
        for channel in range(x.shape[2]):
            u, v, product = x[..., channel], y[..., channel], 1.0
            for j in range(scales):
                whole, structure = slow_terms(u, v)
                product *= max(0.0, whole if j == scales - 1 else structure) ** weights[j]
                u, v = slow_halved(u), slow_halved(v)
            products.append(product)
        values.append(np.mean(products))
    return values


@pytest.mark.parametrize(("scales", "c"), [(1, 1), (2, 3), (3, 1)])
def test_equals_a_loop_over_windows(scales, c):
    a, b = images(scales, c=c)
    weights = np.array([0.0448, 0.2856, 0.3001][:scales]) / sum([0.0448, 0.2856, 0.3001][:scales])
    expected = slow(a, b, scales, weights)
    np.testing.assert_allclose(ms_ssim_per_image(a, b, scales=scales), expected, atol=1e-12)
    np.testing.assert_allclose(
        ms_ssim_per_image(a / 255, b / 255, scales=scales), expected, atol=1e-12
    )
    np.testing.assert_allclose(
        ms_ssim_per_image(a / 127.5 - 1, b / 127.5 - 1, scales=scales, data_range=(-1, 1)),
        expected,
        atol=1e-9,
    )
    assert ms_ssim(a, b, scales=scales).value == pytest.approx(np.mean(expected), abs=1e-12)


def test_one_scale_is_ssim():
    a, b = images(4)
    np.testing.assert_allclose(ms_ssim_per_image(a, b, scales=1), ssim_per_image(a, b), atol=1e-12)


def test_five_scales_of_constant_images_by_hand():
    a, b = np.full((1, 176, 180, 3), 0.2), np.full((1, 176, 180, 3), 0.6)
    luminance = (2 * 0.2 * 0.6 + 1e-4) / (0.04 + 0.36 + 1e-4)
    assert ms_ssim(a, b).value == pytest.approx(luminance**0.1333, abs=1e-9)
    assert ms_ssim(a, a, scales=5).value == 1


def test_a_negative_structure_counts_as_nothing():
    a, _ = images(5, noise=0)
    assert (ssim_per_image(a, 255 - a) < 0).all()
    assert ms_ssim_per_image(a, 255 - a) == pytest.approx([0, 0])


@pytest.mark.parametrize(
    ("side", "scales"),
    [
        (11, 1),
        (21, 1),
        (22, 2),
        (43, 2),
        (44, 3),
        (64, 3),
        (87, 3),
        (88, 4),
        (175, 4),
        (176, 5),
        (352, 5),
    ],
)
def test_as_many_scales_as_fit(side, scales):
    a = np.zeros((1, side, side + 3, 1), dtype=np.uint8)
    score = ms_ssim(a, a)
    assert score.settings["scales"] == scales
    assert len(score.settings["weights"]) == scales
    assert ("5 scales" in score.note) == (scales < 5)
    assert least_side(scales) <= side
    if scales < 5:
        assert sum(score.settings["weights"]) == pytest.approx(1, abs=1e-5)
        with pytest.raises(PalpateError, match=f"at least {11 * 2**scales} x"):
            ms_ssim(a, a, scales=scales + 1)


def test_weights():
    assert tuple(scale_weights(5)) == WEIGHTS == (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
    assert scale_weights(3) == pytest.approx(np.array(WEIGHTS[:3]) / math.fsum(WEIGHTS[:3]))


def test_unequal_numbers_of_scales_do_not_mix():
    a, b = images(6, n=4)
    two, three = ms_ssim(a, b, scales=2), ms_ssim(a, b)
    assert "as asked" in two.note
    with pytest.raises(PalpateError, match="settings"):
        require_comparable([two, three])
    require_comparable([three, ms_ssim(b, a, scales=3, groups=list("uuvv"), subject="other")])
    json.dumps(three.to_json(), allow_nan=False)
    assert (three.metric, three.higher_is_better, three.n, three.estimator) == (
        "MS-SSIM",
        True,
        4,
        "per-image mean",
    )
    assert three.interval[1] <= 1
    assert three.value > ssim(a, b).value  # white noise is averaged away at the coarser scales


A, B = images(7)


@pytest.mark.parametrize(
    ("a", "b", "options", "words"),
    [
        (A, B, {"scales": 5}, ["176 x 176", "5 scales", "45 x 50", 'scales="auto"']),
        (A[:, :10], B[:, :10], {}, ["11 x 11", "10 x 50"]),
        (A, B, {"scales": 0}, ["from 1 to 5", "0"]),
        (A, B, {"scales": 6}, ["from 1 to 5"]),
        (A, B, {"scales": 2.0}, ["from 1 to 5"]),
        (A, B, {"scales": True}, ["from 1 to 5"]),
        (A, B, {"scales": "all"}, ["from 1 to 5", "all"]),
        (A / 127.5 - 1, B, {}, ["[0, 1]", "image 0"]),
        (A * np.array([1 / 255, np.nan])[:, None, None, None], B, {}, ["nan", "image 1"]),
        (A[:, :30], B, {}, ["one to one"]),
        (A[:0], B[:0], {}, ["n >= 1"]),
    ],
)
def test_refuses_bad_input(a, b, options, words):
    for call in (ms_ssim, ms_ssim_per_image):
        with pytest.raises(PalpateError) as caught:
            call(a, b, **options)
        for word in words:
            assert word in str(caught.value)

"""SSIM against scikit-image, PSNR by hand, MS-SSIM against a loop, means over images."""

import json
import math

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from forge.pictures import slow_ssim
from forge.scores import codes, jackknife, without_each
from palpate.core import Note, PalpateError, require_comparable
from palpate.metrics.images import (
    WEIGHTS,
    PerImage,
    fitting_scales,
    least_side,
    ms_ssim,
    per_image,
    psnr,
    scale_means,
    scale_weights,
    ssim,
)
from palpate.report.notes import sentence


def images(seed, n=6, h=20, w=27, c=3, noise=25):
    rng = np.random.default_rng(seed)
    a = rng.integers(0, 256, (n, h, w, c), dtype=np.uint8)
    return a, np.clip(a + rng.normal(size=a.shape) * noise, 0, 255).astype(np.uint8)


def coarse_images(seed, n=2, h=45, w=50, c=3, noise=60):
    """Images with structure at several scales."""
    rng = np.random.default_rng(seed)
    coarse = rng.random((n, 6, 6, c)).repeat(-(-h // 6), 1).repeat(-(-w // 6), 2)[:, :h, :w]
    a = np.clip(255 * coarse + rng.normal(size=coarse.shape) * 10, 0, 255).astype(np.uint8)
    return a, np.clip(a + rng.normal(size=a.shape) * noise, 0, 255).astype(np.uint8)


def ssim_per_image(a, b):
    return per_image("SSIM", a, b).values


# ---- SSIM and PSNR


@pytest.mark.parametrize(("h", "w", "c"), [(20, 27, 3), (11, 11, 3), (64, 64, 1)])
def test_ssim_equals_scikit_image(h, w, c):
    a, b = images(0, 4, h, w, c)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    expected = [
        structural_similarity(x / 255, y / 255, data_range=1, channel_axis=-1, **options)
        for x, y in zip(a, b, strict=True)
    ]
    np.testing.assert_allclose(ssim_per_image(a, b), expected, atol=1e-12)
    np.testing.assert_allclose(ssim_per_image(a / 255, b / 255), expected, atol=1e-12)
    np.testing.assert_allclose(ssim_per_image((a / 255).astype(np.float32), b), expected, atol=1e-6)
    assert ssim(a, b).value == pytest.approx(np.mean(expected), abs=1e-12)


def test_ssim_of_constant_images_by_hand():
    a, b = np.full((1, 12, 12, 3), 0.2), np.full((1, 12, 12, 3), 0.6)
    expected = (2 * 0.2 * 0.6 + 1e-4) / (0.04 + 0.36 + 1e-4)
    assert ssim(a, b).value == pytest.approx(expected, abs=1e-12)
    assert ssim(a, a).value == 1


def test_psnr_by_hand_is_a_mean_over_images():
    a = np.zeros((2, 4, 5, 3))
    b = a.copy()
    b[0] += 0.1  # mean squared error 0.01
    b[1, 0, 0, 0] = 1.0  # 1/60
    assert per_image("PSNR", a, b).values == pytest.approx([20.0, 10 * math.log10(60)])
    assert psnr(a, b).value == pytest.approx((20 + 10 * math.log10(60)) / 2)
    u = np.zeros((1, 4, 5, 3), dtype=np.uint8)
    assert psnr(u, u + np.uint8(255)).value == pytest.approx(0)


def test_identical_images_are_counted_and_excluded_from_psnr():
    a, b = images(1)
    b[[1, 4]] = a[[1, 4]]
    score, others = psnr(a, b), [0, 2, 3, 5]
    assert score.value == pytest.approx(psnr(a[others], b[others]).value)
    assert score.interval == pytest.approx(psnr(a[others], b[others]).interval)
    assert score.details["identical"] == 2
    assert list(score.notes) == [Note("identical-pairs", {"count": 2, "n": 6})]
    every = psnr(a, a)
    assert (every.value, every.interval, codes(every)) == (None, None, ["all-identical"])
    json.dumps([score.to_json(), every.to_json()], allow_nan=False)


def test_tensors_and_lists_give_the_same_scores():
    torch = pytest.importorskip("torch")
    a, b = images(8, n=2)
    tensors = torch.tensor(a), torch.tensor(b / 255, requires_grad=True)
    assert ssim(*tensors).value == pytest.approx(ssim(a, b).value, abs=1e-12)
    assert psnr((a / 255).tolist(), b).value == pytest.approx(psnr(a, b).value)


# ---- means over images


def test_intervals_over_images_and_over_groups():
    a, b = images(2)
    values, score = ssim_per_image(a, b), ssim(a, b)
    assert score.interval == jackknife(values.mean(), without_each(values))[1]
    grouped = ssim(a, b, groups=["u", "v", "w"] * 2)
    means = [values[k::3].mean() for k in range(3)]
    assert grouped.interval == jackknife(np.mean(means), without_each(means))[1]
    assert grouped.interval_method == "leave-one-group-out jackknife, t, 2 df"
    for score in (ssim(a, b, groups=["u"] * 6), ssim(a[:1], b[:1]), ssim(a, a)):
        assert (score.interval, codes(score)) == (None, ["no-interval-over-images"])


def test_scores_name_their_settings_and_the_lowest_images():
    a, b = images(3)
    b[2] = 255 - a[2]
    score = ssim(a, b, ids=list("pqrstu"), subject="mini", split="s")
    assert score.details["lowest"][0]["id"] == "r"
    assert (score.a, score.split, score.n, score.m) == ("mini", "s", 6, 6)
    assert (score.higher_is_better, score.estimator) == (True, "per-image mean")
    assert score.settings["size"] == [20, 27]


def test_means_exclude_what_has_no_value_and_stay_in_their_bounds():
    values, note = np.array([0.9, np.nan, 1.0, 0.2]), Note("no-contact", {"count": 1, "n": 4})
    score = PerImage("x", values, (0.0, 1.0), notes=[note]).score(ids=list("abcd"))
    assert (score.value, score.interval) == (pytest.approx(0.7), (0, 1))
    assert (score.details["identical"], score.notes) == (0, (note,))
    assert [row["id"] for row in score.details["lowest"]] == ["d", "a", "c"]
    down = PerImage("x", values, higher_is_better=False).score(ids=list("abcd"))
    assert [row["id"] for row in down.details["highest"]] == ["c", "a", "d"]
    none = PerImage("x", np.full(3, np.nan)).score()
    assert (none.value, codes(none)) == (None, ["no-pair-has-a-value"])
    assert sentence(none.notes[0]).startswith("Undefined")


# ---- MS-SSIM


def slow_halved(x):
    x = x[: x.shape[0] // 2 * 2, : x.shape[1] // 2 * 2]
    return (x[::2, ::2] + x[1::2, ::2] + x[::2, 1::2] + x[1::2, 1::2]) / 4


def slow_ms_ssim(x, y, scales, weights):
    products = []
    for channel in range(x.shape[2]):
        u, v, product = x[..., channel] / 255, y[..., channel] / 255, 1.0
        for j in range(scales):
            whole, structure = (terms.mean() for terms in slow_ssim(u, v))
            product *= max(0.0, whole if j == scales - 1 else structure) ** weights[j]
            u, v = slow_halved(u), slow_halved(v)
        products.append(product)
    return np.mean(products)


@pytest.mark.parametrize(("scales", "c"), [(1, 1), (2, 3), (3, 1)])
def test_ms_ssim_equals_a_loop_over_windows(scales, c):
    a, b = coarse_images(scales, c=c)
    weights = np.array([0.0448, 0.2856, 0.3001][:scales])
    expected = [slow_ms_ssim(x, y, scales, weights / weights.sum()) for x, y in zip(a, b)]  # noqa: B905
    values = per_image("MS-SSIM", a, b, scale_means(a, b, scales)).values
    np.testing.assert_allclose(values, expected, atol=1e-12)
    if scales == fitting_scales(a.shape[1:3]):
        assert ms_ssim(a, b).value == pytest.approx(np.mean(expected), abs=1e-12)
    if scales == 1:
        np.testing.assert_allclose(ssim_per_image(a, b), expected, atol=1e-12)


def test_five_scales_of_constant_images_by_hand():
    a, b = np.full((1, 176, 180, 3), 0.2), np.full((1, 176, 180, 3), 0.6)
    luminance = (2 * 0.2 * 0.6 + 1e-4) / (0.04 + 0.36 + 1e-4)
    assert ms_ssim(a, b).value == pytest.approx(luminance**0.1333, abs=1e-9)
    assert ms_ssim(a, a).value == 1


def test_a_negative_structure_counts_as_zero():
    a, _ = coarse_images(5, noise=0)
    assert (ssim_per_image(a, 255 - a) < 0).all()
    assert per_image("MS-SSIM", a, 255 - a).values == pytest.approx([0, 0])


@pytest.mark.parametrize(
    ("side", "scales"), [(11, 1), (21, 1), (22, 2), (43, 2), (64, 3), (88, 4), (175, 4), (176, 5)]
)
def test_as_many_scales_as_fit(side, scales):
    a = np.zeros((1, side, side + 3, 1), dtype=np.uint8)
    score = ms_ssim(a, a)
    assert fitting_scales((side, side + 3)) == score.settings["scales"] == scales
    assert ("fewer-scales" in codes(score)) == (scales < 5)
    total = math.fsum(WEIGHTS[:scales]) if scales < 5 else 1  # all five are as published
    assert score.settings["weights"] == [round(w / total, 6) for w in WEIGHTS[:scales]]


def test_weights_are_as_published():
    assert tuple(scale_weights(5)) == WEIGHTS == (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
    assert scale_weights(3) == pytest.approx(np.array(WEIGHTS[:3]) / math.fsum(WEIGHTS[:3]))
    assert least_side(5) == 176


def test_different_numbers_of_scales_are_not_comparable():
    a, b = coarse_images(6, n=4)
    two, three = ms_ssim(a[:, :30], b[:, :30]), ms_ssim(a, b)
    assert "five need 176 pixels" in sentence(three.notes[0])
    with pytest.raises(PalpateError, match="settings"):
        require_comparable([two, three])
    require_comparable([three, ms_ssim(b, a, groups=list("uuvv"), subject="other")])
    assert three.interval[1] <= 1
    assert three.value > ssim(a, b).value  # white noise averages out at the coarser scales

"""Other packages' SSIM and PSNR: scikit-image itself, and the formulas of torchmetrics and piq window by window."""

import json
import math

import numpy as np
import pytest
from scipy import ndimage, stats
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from palpate.core import PalpateError, require_comparable
from palpate.metrics.pairwise import psnr, psnr_per_image, ssim, ssim_per_image


def images(seed, n=3, h=20, w=17, c=3, noise=25):
    rng = np.random.default_rng(seed)
    a = rng.integers(0, 256, (n, h, w, c), dtype=np.uint8)
    return a, np.clip(a + rng.normal(size=a.shape) * noise, 0, 255).astype(np.uint8)


def windowed(x, y, window):
    """Mean SSIM of two (h, w) over all windows that lie inside; data range 1."""
    side = len(window)
    values = []
    for i in range(x.shape[0] - side + 1):
        for j in range(x.shape[1] - side + 1):
            u, v = x[i : i + side, j : j + side], y[i : i + side, j : j + side]
            mu, mv = (window * u).sum(), (window * v).sum()
            vu, vv, uv = (
                (window * (u - mu) ** 2).sum(),
                (window * (v - mv) ** 2).sum(),
                (window * (u - mu) * (v - mv)).sum(),
            )
            values.append(
                (2 * mu * mv + 1e-4) * (2 * uv + 9e-4) / ((mu**2 + mv**2 + 1e-4) * (vu + vv + 9e-4))
            )
    return np.mean(values)


def gaussian():
    at = np.arange(11) - 5
    window = np.exp(-(at[:, None] ** 2 + at[None] ** 2) / (2 * 1.5**2))
    return window / window.sum()


@pytest.mark.parametrize(("h", "w", "c"), [(20, 17, 3), (7, 7, 3), (64, 64, 1)])
def test_skimage_is_scikit_image(h, w, c):
    a, b = images(0, 4, h, w, c)
    expected = [
        structural_similarity(x, y, data_range=255, channel_axis=-1)
        for x, y in zip(a, b, strict=True)
    ]
    np.testing.assert_allclose(ssim_per_image(a, b, compat="skimage"), expected, atol=1e-12)
    assert ssim(a, b, compat="skimage").value == pytest.approx(np.mean(expected), abs=1e-12)
    signed = a / 127.5 - 1, b / 127.5 - 1
    expected = [
        structural_similarity(x, y, data_range=2, channel_axis=-1)
        for x, y in zip(*signed, strict=True)
    ]
    np.testing.assert_allclose(
        ssim_per_image(*signed, compat="skimage", data_range=(-1, 1)), expected, atol=1e-12
    )
    expected = [peak_signal_noise_ratio(x, y, data_range=255) for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose(psnr_per_image(a, b, compat="skimage"), expected, rtol=1e-12)


def test_torchmetrics_mirrors_the_image_and_averages_every_pixel():
    a, b = images(1, 2)
    padded = [np.pad(v / 255, ((0, 0), (5, 5), (5, 5), (0, 0)), mode="reflect") for v in (a, b)]
    expected = [
        np.mean([windowed(x[..., k], y[..., k], gaussian()) for k in range(3)])
        for x, y in zip(*padded, strict=True)
    ]
    np.testing.assert_allclose(ssim_per_image(a, b, compat="torchmetrics"), expected, atol=1e-12)
    assert np.abs(ssim_per_image(a, b) - expected).min() > 1e-4


def test_numbers_that_torchmetrics_and_piq_gave():
    """torchmetrics 1.9.0 and piq 0.8.0 (torch 2.13.0, float64) on these images; PSNR of torchmetrics counts in float32."""
    a, b = peer_images()
    for compat, (similarity, noise) in PEERS.items():
        assert ssim(a, b, compat=compat).value == pytest.approx(similarity, abs=1e-9)
        assert psnr(a, b, compat=compat).value == pytest.approx(noise, abs=1e-5)


def peer_images():
    """(2, 400, 390, 3), the first pair identical."""
    i, j, k, n = np.meshgrid(
        np.arange(400), np.arange(390), np.arange(3), np.arange(2), indexing="ij"
    )
    a = (i * 7 + j * 3 + k * 50 + i * j // 40 + 90 * n) % 256
    b = np.where(n == 0, a, (a + (i * 13 + j * 29 + k * 17) % 41 - 20).clip(0, 255))
    return tuple(np.moveaxis(v, 3, 0).astype(np.uint8) for v in (a, b))


PEERS = {
    "torchmetrics": (0.9563529992212696, 29.865734068782313),
    "piq": (0.9976571001618828, 53.427707206604325),
}


@pytest.mark.parametrize(("side", "factor"), [(384, 2), (383, 1), (385, 2), (640, 2), (641, 3)])
def test_piq_pools_large_images_before(side, factor):
    rng = np.random.default_rng(side)
    a = rng.integers(0, 256, (1, side, side + 2, 1), dtype=np.uint8)
    b = np.clip(a + rng.normal(size=a.shape) * 60, 0, 255).astype(np.uint8)
    h, w = side // factor, (side + 2) // factor
    small = [
        v[:, : h * factor, : w * factor].reshape(1, h, factor, w, factor, 1).mean(axis=(2, 4)) / 255
        for v in (a, b)
    ]
    score = ssim(a, b, compat="piq")
    assert score.value == pytest.approx(ssim(*small).value, abs=1e-12)
    assert score.settings["pooling"] == factor


def test_piq_of_a_small_image_is_ours():
    a, b = images(2)
    np.testing.assert_array_equal(ssim_per_image(a, b, compat="piq"), ssim_per_image(a, b))
    expected = np.mean(
        [windowed(a[0, ..., k] / 255, b[0, ..., k] / 255, gaussian()) for k in range(3)]
    )
    assert ssim_per_image(a, b, compat="piq")[0] == pytest.approx(expected, abs=1e-12)


def test_piq_gives_identical_images_eighty_decibels():
    a, b = images(3)
    b[1] = a[1]
    errors = ((a / 255 - b / 255) ** 2).mean(axis=(1, 2, 3))
    score = psnr(a, b, compat="piq")
    assert psnr_per_image(a, b, compat="piq")[1] == pytest.approx(80)
    assert score.value == pytest.approx(np.mean([-10 * math.log10(e + 1e-8) for e in errors]))
    assert score.details["identical"] == 0
    assert psnr(a, a, compat="piq").value == pytest.approx(80)


def test_torchmetrics_pools_the_squared_errors():
    a, b = images(4, n=6)
    b[1] = a[1]
    score = psnr(a, b, compat="torchmetrics", ids=list("pqrstu"))
    pooled = ((a / 255 - b / 255) ** 2).mean()
    assert score.value == pytest.approx(-10 * math.log10(pooled))
    assert score.value != pytest.approx(psnr(a, b).value, abs=0.1)
    errors = ((a / 255 - b / 255) ** 2).mean(axis=(1, 2, 3))
    reach = stats.t.ppf(0.975, 5) * errors.std(ddof=1) / math.sqrt(6) / pooled * 10 / math.log(10)
    assert score.interval == pytest.approx((score.value - reach, score.value + reach))
    assert "delta" in score.interval_method
    assert score.details["identical"] == 1
    assert score.details["lowest"][0]["id"] == "pqrstu"[int(np.argmax(errors))]
    assert len(score.details["lowest"]) == 5
    grouped = psnr(a, b, compat="torchmetrics", groups=list("uvwuvw"))
    assert grouped.value == score.value
    assert "groups" in grouped.interval_method
    every = psnr(a, a, compat="torchmetrics")
    assert (every.value, every.interval) == (None, None)
    assert every.note.startswith("Undefined: all 6")
    one = psnr(a[:1], b[:1], compat="torchmetrics")
    assert one.interval is None
    assert "No interval" in one.note
    json.dumps([score.to_json(), every.to_json()], allow_nan=False)


@pytest.mark.parametrize("metric", [ssim, psnr])
def test_conventions_do_not_mix(metric):
    a, b = images(5)
    scores = [metric(a, b, compat=c) for c in (None, "torchmetrics", "skimage", "piq")]
    assert [s.settings.get("compat") for s in scores] == [None, "torchmetrics", "skimage", "piq"]
    for i, x in enumerate(scores):
        for y in scores[i + 1 :]:
            with pytest.raises(PalpateError, match="must agree"):
                require_comparable([x, y])
        require_comparable([x, metric(b, a, compat=x.settings.get("compat"), subject="other")])


def test_a_peers_ssim_depends_on_the_coding_and_says_so():
    a, b = images(6)
    plain = ssim(a, b, compat="torchmetrics")
    signed = ssim(a / 127.5 - 1, b / 127.5 - 1, compat="torchmetrics", data_range=(-1, 1))
    assert abs(plain.value - signed.value) > 1e-3
    assert signed.settings["data_range"] == [-1, 1]
    with pytest.raises(PalpateError, match="settings"):
        require_comparable([plain, signed])
    require_comparable([plain, ssim(a.astype(float), b, compat="torchmetrics", data_range=255)])


def test_refuses_unknown_conventions_and_small_images():
    a, b = images(7)
    for metric in (ssim, psnr, ssim_per_image, psnr_per_image):
        with pytest.raises(PalpateError, match="torchmetrics, skimage, piq"):
            metric(a, b, compat="opencv")
    with pytest.raises(PalpateError, match="from 0"):
        ssim(a / 127.5 - 1, b / 127.5 - 1, compat="piq", data_range=(-1, 1))
    with pytest.raises(PalpateError, match="7 x 7"):
        ssim(a[:, :6], b[:, :6], compat="skimage")
    assert ssim(a[:, :7], b[:, :7], compat="skimage").value is not None
    with pytest.raises(PalpateError, match="11 x 11"):
        ssim(a[:, :10], b[:, :10], compat="torchmetrics")


def test_torchmetrics_takes_no_negative_variance():
    """Constant patches far from 0 in units of the range, as torchmetrics leaves its lower end: E x^2 - (E x)^2 falls below 0 by rounding."""
    low = 1e4
    a, b = (np.full((1, 24, 24, 1), low + v) for v in (0.3, 0.7))
    a[:, 12:], b[:, :, 9:] = low + 0.1, low + 1 / 3

    def blur(image):
        at = np.exp(-((np.arange(11) - 5) ** 2) / 4.5)
        return ndimage.correlate1d(
            ndimage.correlate1d(image, at / at.sum(), axis=0, mode="mirror"),
            at / at.sum(),
            axis=1,
            mode="mirror",
        )

    x, y = a[0, ..., 0], b[0, ..., 0]
    mx, my = blur(x), blur(y)
    vx, vy, xy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    assert min(vx.min(), vy.min()) < -1e-8
    similarity = lambda variances: (  # noqa: E731
        ((2 * mx * my + 1e-4) * (2 * xy + 9e-4)) / ((mx**2 + my**2 + 1e-4) * (variances + 9e-4))
    ).mean()
    clamped, plain = similarity(np.maximum(vx, 0) + np.maximum(vy, 0)), similarity(vx + vy)
    assert abs(clamped - plain) > 1e-7
    found = ssim_per_image(a, b, compat="torchmetrics", data_range=(low, low + 1))[0]
    assert found == pytest.approx(clamped, abs=abs(clamped - plain) / 10)

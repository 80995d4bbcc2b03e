"""SSIM against scikit-image, PSNR by hand, intervals by hand, data ranges, pairing by id, and what they refuse."""

import json
import math

import numpy as np
import pytest
from scipy import stats
from skimage.metrics import structural_similarity

from palpate.core import PalpateError
from palpate.core.score import require_comparable
from palpate.metrics.pairwise import (
    mean_score,
    paired_by_id,
    psnr,
    psnr_per_image,
    ssim,
    ssim_per_image,
)


def images(seed, n=6, h=20, w=27, c=3, noise=25):
    rng = np.random.default_rng(seed)
    a = rng.integers(0, 256, (n, h, w, c), dtype=np.uint8)
    return a, np.clip(a + rng.normal(size=a.shape) * noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("h", "w", "c"), [(20, 27, 3), (11, 11, 3), (64, 64, 1)])
def test_ssim_equals_scikit_image(h, w, c):
    a, b = images(0, 4, h, w, c)
    expected = [
        structural_similarity(
            x / 255,
            y / 255,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            data_range=1,
            channel_axis=-1,
        )
        for x, y in zip(a, b, strict=True)
    ]
    np.testing.assert_allclose(ssim_per_image(a, b), expected, atol=1e-12)
    np.testing.assert_allclose(ssim_per_image(a / 255, b / 255), expected, atol=1e-12)
    np.testing.assert_allclose(ssim_per_image((a / 255).astype(np.float32), b), expected, atol=1e-6)
    assert ssim(a, b).value == pytest.approx(np.mean(expected), abs=1e-12)


def test_ssim_of_constant_images_by_hand():
    a, b = np.full((1, 12, 12, 3), 0.2), np.full((1, 12, 12, 3), 0.6)
    assert ssim(a, b).value == pytest.approx(
        (2 * 0.2 * 0.6 + 1e-4) / (0.04 + 0.36 + 1e-4), abs=1e-12
    )
    assert ssim(a, a).value == 1


def test_psnr_by_hand():
    a = np.zeros((2, 4, 5, 3))
    b = a.copy()
    b[0] += 0.1  # mse 0.01
    b[1, 0, 0, 0] = 1.0  # mse 1/60
    assert psnr_per_image(a, b) == pytest.approx([20.0, 10 * math.log10(60)])
    assert psnr(a, b).value == pytest.approx(
        (20 + 10 * math.log10(60)) / 2
    )  # over images, not over pooled pixels
    u = np.zeros((1, 4, 5, 3), dtype=np.uint8)
    assert psnr(u, u + np.uint8(255)).value == pytest.approx(0)


def test_identical_images_are_counted_not_averaged():
    a, b = images(1)
    b[[1, 4]] = a[[1, 4]]
    score = psnr(a, b)
    rest = [0, 2, 3, 5]
    assert score.value == pytest.approx(psnr(a[rest], b[rest]).value)
    assert score.interval == pytest.approx(psnr(a[rest], b[rest]).interval)
    assert score.details["identical"] == 2
    assert "2 of 6" in score.note
    every = psnr(a, a)
    assert (every.value, every.interval) == (None, None)
    assert every.note.startswith("Undefined: ")
    json.dumps([score.to_json(), every.to_json()], allow_nan=False)


def test_intervals_over_images_and_over_groups():
    a, b = images(2)
    values = ssim_per_image(a, b)
    score = ssim(a, b)
    reach = stats.t.ppf(0.975, 5) * values.std(ddof=1) / math.sqrt(6)
    assert score.interval == pytest.approx((values.mean() - reach, values.mean() + reach))
    grouped = ssim(a, b, groups=["u", "v", "w"] * 2, level=0.9)
    means = np.array([values[k::3].mean() for k in range(3)])
    reach = stats.t.ppf(0.95, 2) * means.std(ddof=1) / math.sqrt(3)
    assert grouped.interval == pytest.approx((means.mean() - reach, means.mean() + reach))
    assert "groups" in grouped.interval_method
    one = ssim(a, b, groups=["u"] * 6)
    assert one.interval is None
    assert "No interval" in one.note
    assert ssim(a[:1], b[:1]).interval is None


def test_scores_name_their_settings_and_the_lowest_images():
    a, b = images(3)
    b[2] = 255 - a[2]
    score = ssim(a, b, ids=list("pqrstu"), subject="mini", split="s")
    assert score.details["lowest"][0]["id"] == "r"
    assert (score.subject, score.split, score.n, score.m, score.higher_is_better) == (
        "mini",
        "s",
        6,
        6,
        True,
    )
    assert score.settings["size"] == [20, 27]
    assert score.estimator == "per-image mean"


A, B = images(4)


def spoilt(value):
    x = A / 255
    x[3, 0, 0, 0] = value
    return x


@pytest.mark.parametrize("metric", [ssim, psnr])
@pytest.mark.parametrize(
    ("a", "b", "options", "words"),
    [
        (A[0], B[0], {}, ["shape (n, h, w, 3)"]),
        (A[:0], B[:0], {}, ["n >= 1"]),
        (A[:5], B, {}, ["pair one to one"]),
        (A, B[:, :, :20], {}, ["pair one to one"]),
        (A.transpose(0, 3, 1, 2), B.transpose(0, 3, 1, 2), {}, ["channels last"]),
        (A.astype(int), B, {}, ["uint8", "int64"]),
        (A, B.astype(np.float32), {}, ["reference", "[0, 1]", "image 0"]),
        (spoilt(np.nan), B, {}, ["generated", "image 3"]),
        (spoilt(-0.5), B, {}, ["generated", "-0.5", "image 3"]),
        (A, B, {"groups": ["g"] * 5}, ["groups", "6", "5"]),
        (A, B, {"ids": ["g"] * 5}, ["ids", "6", "5"]),
    ],
)
def test_refuses_bad_images(metric, a, b, options, words):
    with pytest.raises(PalpateError) as caught:
        metric(a, b, **options)
    for word in words:
        assert word in str(caught.value)


def test_images_smaller_than_the_window_are_refused():
    with pytest.raises(PalpateError, match="11 x 11"):
        ssim(A[:, :10], B[:, :10])
    assert psnr(A[:, :10], B[:, :10]).value is not None


def test_a_score_does_not_depend_on_the_coding_of_the_pictures():
    plain = ssim(A, B), psnr(A, B)
    wide = A.astype(np.uint16) * 257, B.astype(np.uint16) * 257
    signed = A / 127.5 - 1, B / 127.5 - 1
    for (a, b), given in ((signed, (-1, 1)), (wide, 65535), ((A.astype(float), B), 255)):
        for metric, first in zip((ssim, psnr), plain, strict=True):
            score = metric(a, b, data_range=given)
            assert score.value == pytest.approx(first.value, abs=1e-9)
            assert score.details["coding"] == [
                *(given if isinstance(given, tuple) else (0.0, given))
            ]
            require_comparable([first, score])


@pytest.mark.parametrize("metric", [ssim, psnr])
@pytest.mark.parametrize(
    ("a", "b", "given", "words"),
    [
        (A / 127.5 - 1, B / 127.5 - 1, None, ["[0, 1]", "image 0"]),
        (A / 127.5 - 1, B / 127.5 - 1, 2, ["data range [0, 2]", "image 0", "data_range=(-1, 1)"]),
        (A, B / 127.5 - 1, (-1, 1), ["generated", "[-1, 1]", "255"]),
        (A / 255, B / 255, 255, ["generated", "[0, 255]", "floats in [0, 1]"]),
        (spoilt(np.nan) * 255, B, 255, ["generated", "nan", "image 3"]),
        (A / 255, B / 255, 0, ["positive"]),
        (A / 255, B / 255, (1, -1), ["low < high"]),
        (A / 255, B / 255, (0, np.inf), ["low < high"]),
        (A / 255, B / 255, "wide", ["low < high"]),
        (A / 255, B / 255, (0, 1, 2), ["low < high"]),
        (A[0], B[0], 255, ["shape (n, h, w, 3)"]),
        (A[:0], B[:0], 255, ["n >= 1"]),
        (A[:5], B, 255, ["pair one to one"]),
        (A > 0, B, 255, ["numbers", "bool"]),
        ([[1], [1, 2]], B, 255, ["NumPy array"]),
    ],
)
def test_refuses_numbers_outside_the_data_range(metric, a, b, given, words):
    with pytest.raises(PalpateError) as caught:
        metric(a, b, data_range=given)
    for word in words:
        assert word in str(caught.value)


def test_black_images_are_in_every_data_range():
    black = np.zeros((2, 12, 12, 3))
    assert ssim(black, black, data_range=255).value == 1


def test_one_image_and_identical_images():
    one = ssim(A[:1], A[:1])
    assert (one.value, one.interval) == (1, None)
    every = ssim(A, A)
    assert (every.value, every.interval) == (1, None)
    assert "no variation" in every.note
    assert psnr(A[:1], B[:1]).value == pytest.approx(psnr_per_image(A, B)[0])


def test_means_leave_out_what_has_no_value_and_stay_in_their_bounds():
    score = mean_score(
        "x",
        np.array([0.9, np.nan, 1.0, 0.2]),
        list("abcd"),
        None,
        bounds=(0.0, 1.0),
        level=0.95,
        subject="s",
        note="one has none",
    )
    assert score.value == pytest.approx(0.7)
    assert score.interval == (0, 1)
    assert score.details["identical"] == 0
    assert [row["id"] for row in score.details["lowest"]] == ["d", "a", "c"]
    assert score.note == "one has none"
    worse = mean_score(
        "x",
        np.array([0.9, np.nan, 1.0, 0.2]),
        list("abcd"),
        None,
        better=False,
        level=0.95,
        subject="s",
    )
    assert [row["id"] for row in worse.details["highest"]] == ["c", "a", "d"]
    assert not worse.higher_is_better
    none = mean_score(
        "x", np.full(3, np.nan), None, None, level=0.95, subject="s", note="no contact"
    )
    assert none.value is None
    assert none.note.startswith("Undefined: no pair has a value")


def test_pairs_are_found_by_id():
    made, wanted = ["c", "a", "b"], ["a", "b", "c"]
    first, second = paired_by_id(made, wanted)
    assert [made[i] for i in first] == [wanted[i] for i in second] == wanted
    rng = np.random.default_rng(0)
    names = [f"video/{k}" for k in range(50)]
    order = rng.permutation(50)
    first, second = paired_by_id([names[i] for i in order], names)
    np.testing.assert_array_equal(order[first], second)
    a, b = images(5, 3)
    first, second = paired_by_id(made, wanted)
    assert ssim(a[first], b[second]).value == pytest.approx(
        np.mean([ssim(a[[made.index(i)]], b[[wanted.index(i)]]).value for i in wanted])
    )


@pytest.mark.parametrize(
    ("made", "wanted", "words"),
    [
        (["a", "b"], ["a", "b", "c", "d", "e", "f"], ["4 not generated: 'c', 'd', 'e' and 1 more"]),
        (["a", "x", "b"], ["a", "b"], ["1 without reference: 'x'"]),
        (["a", "x"], ["a", "b"], ["1 not generated: 'b'; 1 without reference: 'x'"]),
        (["a", "a", "b"], ["a", "b"], ["generated id must stand once", "'a'"]),
        (["a", "b"], ["a", "b", "b"], ["reference id must stand once", "'b'"]),
        ([], ["a"], ["generated ids"]),
        (["a"], [], ["reference ids"]),
    ],
)
def test_unequal_ids_are_refused_and_named(made, wanted, words):
    with pytest.raises(PalpateError) as caught:
        paired_by_id(made, wanted)
    for word in words:
        assert word in str(caught.value)

"""Contact metrics: differences and masks by hand and by loops, empty gel, the simulated world, the real clips, and what they refuse."""

import json
import math

import numpy as np
import pytest
from scipy import ndimage, stats

from palpate.core import PalpateError, require_comparable
from palpate.metrics import masks
from palpate.metrics.contact import (
    contact_iou,
    contact_ms_ssim,
    contact_per_image,
    contact_pictures,
    contact_psnr,
    contact_residual,
    contact_scores,
    contact_ssim,
)
from palpate.metrics.masks import LEAST, contact_mask
from palpate.sim import Video, World, WorldOptions
from palpate.sim.fidelity import change, contact_area
from palpate.sim.plan import first_contact, plan_world


def gel(n=3, size=48, level=0.5):
    return np.full((n, size, size, 3), level)


def pressed(seed, n=3, size=48, strength=0.15):
    """Backgrounds, and touches with a textured square from 12 to 36."""
    rng = np.random.default_rng(seed)
    background = gel(n, size)
    texture = ndimage.gaussian_filter(rng.normal(size=(n, 24, 24, 3)), (0, 2, 2, 0))
    touch = background.copy()
    touch[:, 12:36, 12:36] += strength * (0.6 + texture / texture.std() / 5)
    return background, touch


def test_the_mask_is_the_square_and_little_more():
    background, touch = pressed(0)
    mask = contact_mask(touch, background)
    assert mask[:, 12:36, 12:36].all()
    outside = np.ones((48, 48), bool)
    outside[8:40, 8:40] = False
    assert not mask[:, outside].any()
    np.testing.assert_array_equal(
        contact_mask(
            (touch * 255).round().astype(np.uint8), (background * 255).round().astype(np.uint8)
        ),
        mask,
    )


def test_the_digest_of_gels_is_one_for_all_processes():
    gels = np.concatenate([gel(1, 16, level) for level in (0.2, 0.5, 0.6, 0.7, 0.8, 0.9)])
    assert masks.pictures_digest(gels) == masks.pictures_digest(gels[::-1]) == "988fd396bc9f00be"
    assert masks.pictures_digest(np.rint(gels * 255).astype(np.uint8)) == masks.pictures_digest(
        np.rint(gels * 255) / 255
    )


def test_nothing_touched_is_an_empty_mask():
    rng = np.random.default_rng(1)
    background = gel(4, 64)
    for noise in (0.004, 0.02, 0.06):
        empty = np.clip(background + rng.normal(size=background.shape) * noise, 0, 1)
        noisy = np.clip(background + rng.normal(size=background.shape) * noise, 0, 1)
        assert not contact_mask(empty, noisy).any()
        dent = empty.copy()
        dent[:, 20:44, 20:44] += 0.12
        assert contact_mask(np.clip(dent, 0, 1), noisy)[:, 24:40, 24:40].all()
    assert not contact_mask(background, background).any()
    speck = background.copy()
    speck[:, 30:32, 30:32] += 0.3
    assert not contact_mask(speck, background).any()  # 16 pixels exceed the threshold: under 1 %
    assert contact_mask(speck, background, least=LEAST / 4).any()


def test_moved_markers_are_no_contact():
    background = gel(1, 64, 0.6)
    touch = background.copy()
    for i in range(4, 64, 8):
        for j in range(4, 62, 8):
            background[:, i : i + 2, j : j + 2] = 0.1
            touch[:, i : i + 2, j + 1 : j + 3] = 0.1
    assert not contact_mask(touch, background).any()
    dent = touch.copy()
    dent[:, 16:48, 16:48] += 0.1
    mask = contact_mask(dent, background)[0]
    assert mask[18:46, 18:46].all()
    assert mask.mean() < 0.4
    # The same print with markers elsewhere: perfect where there are no markers, not so where they count.
    other = np.where(background == 0.1, background, 0.6) + np.where(dent - touch > 0.05, 0.1, 0)
    skip, keep = (contact_per_image(other, dent, background, markers=m) for m in ("skip", "keep"))
    assert skip.residual[0] == pytest.approx(0, abs=1e-12)
    assert keep.residual[0] > 0.3


def test_the_area_is_that_of_the_worlds_own_measure():
    options = WorldOptions(objects_per_material=1, materials=6)
    world = World(options)
    for k in range(0, len(world), 9):
        touch, background = world[k]["tactile"], world[k]["background"]
        theirs = np.asarray(change(touch.astype(np.float32), background.astype(np.float32)) > 4)
        ours = contact_mask(touch[None], background[None])[0]
        if theirs.mean() < 0.01:
            assert not ours.any()
            continue
        np.testing.assert_array_equal(ours, ndimage.binary_dilation(theirs))
        assert ours.mean() >= contact_area(
            touch.astype(np.float32), background.astype(np.float32), 4.0
        )


def test_the_untouched_gel_of_the_world_has_no_contact():
    options = WorldOptions(objects_per_material=1)
    before = first_contact(options, 1)
    videos = [Video(options, plan) for plan in plan_world(options)[::4]]
    free, background = (np.stack([v.tactile(before - k) for v in videos]) for k in (2, 4))
    assert not contact_mask(free, background).any()


def test_values_by_hand():
    """One constant square: every metric of a weaker one follows from the two heights."""
    background = gel(1)
    real, made = background.copy(), background.copy()
    real[:, 12:36, 12:36] += 0.2
    made[:, 12:36, 12:36] += 0.1
    mask = contact_mask(real, background)[0]
    share = 24 * 24 / mask.sum()  # the mask is dilated: around the square both differences are 0
    found = contact_per_image(made, real, background)
    assert found.area[0] == pytest.approx(mask.mean())
    assert found.residual[0] == pytest.approx(0.01 / (0.01 + 0.04))
    assert found.per_real_energy[0] == pytest.approx(0.25)
    assert found.psnr[0] == pytest.approx(20 - 10 * math.log10(share))
    assert found.empty_psnr[0] == pytest.approx(-10 * math.log10(0.04 * share))
    assert found.iou[0] == pytest.approx(
        (mask & contact_mask(made, background)[0]).sum()
        / (mask | contact_mask(made, background)[0]).sum()
    )
    negative = 2 * background - real
    assert contact_per_image(negative, real, background).residual[0] == pytest.approx(2)


@pytest.mark.parametrize("sigma", [4, 8, 16])
def test_the_negative_of_a_touch_is_not_called_alike(sigma):
    background, real = np.full((1, 64, 64, 3), 0.5), np.full((1, 64, 64, 3), 0.5)
    at = np.arange(64) - 32
    real += 0.3 * np.exp(-(at[:, None] ** 2 + at**2) / (2 * sigma**2))[..., None]
    found = contact_per_image(1 - real, real, background)
    assert found.ssim[0] < 0 < found.empty_ssim[0]
    assert found.ms_ssim[0] <= found.empty_ms_ssim[0]


def slow(made, real, mask):
    """SSIM of two differences (h, w, c) at the pixels of the mask, window by window on mirrored images, data range 0.25."""
    at = np.arange(11) - 5
    window = np.exp(-(at[:, None] ** 2 + at[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    c1, c2, values = (0.01 * 0.25) ** 2, (0.03 * 0.25) ** 2, []
    for k in range(real.shape[2]):
        x, y = (np.pad(v[..., k], 5, mode="reflect") for v in (made, real))
        for i, j in zip(*np.nonzero(mask), strict=True):
            u, v = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
            mu, mv = (window * u).sum(), (window * v).sum()
            vu, vv, uv = (
                (window * (u - mu) ** 2).sum(),
                (window * (v - mv) ** 2).sum(),
                (window * (u - mu) * (v - mv)).sum(),
            )
            bright, alike = (
                (2 * mu * mv + c1) / (mu**2 + mv**2 + c1),
                (2 * uv + c2) / (vu + vv + c2),
            )
            values.append(-bright * alike if bright < 0 and alike < 0 else bright * alike)
    return np.mean(values)


def test_equals_loops_over_the_mask():
    background, real = pressed(2, 2)
    other = pressed(3, 2)[1]
    own = background + 0.05
    found = contact_per_image(other + 0.05, real, background, generated_background=own)
    masks = contact_mask(real, background)
    made_masks = contact_mask(other + 0.05, own)
    for n in range(2):
        error = energy = both = count = 0.0
        for i, j in zip(*np.nonzero(masks[n]), strict=True):
            for k in range(3):
                d, e = (
                    real[n, i, j, k] - background[n, i, j, k],
                    other[n, i, j, k] + 0.05 - own[n, i, j, k],
                )
                error, energy, both, count = (
                    error + (e - d) ** 2,
                    energy + d**2,
                    both + d**2 + e**2,
                    count + 1,
                )
        assert found.residual[n] == pytest.approx(error / both, abs=1e-12)
        assert found.per_real_energy[n] == pytest.approx(error / energy, abs=1e-12)
        assert found.psnr[n] == pytest.approx(-10 * math.log10(error / count))
        assert found.ssim[n] == pytest.approx(
            slow(other[n] + 0.05 - own[n], real[n] - background[n], masks[n]), abs=1e-12
        )
        assert found.empty_ssim[n] == pytest.approx(
            slow(np.zeros_like(real[n]), real[n] - background[n], masks[n]), abs=1e-12
        )
        assert found.iou[n] == (masks[n] & made_masks[n]).sum() / (masks[n] | made_masks[n]).sum()


def test_what_lies_outside_the_contact_earns_and_costs_nothing():
    background, real = pressed(4, 3, 64)
    made = pressed(5, 3, 64)[1]
    far = np.zeros((64, 64), bool)
    far[44:] = True  # further from the mask than half a window
    assert not ndimage.binary_dilation(contact_mask(real, background).any(0), iterations=5)[
        far
    ].any()
    junk = made.copy()
    junk[:, far] = np.random.default_rng(6).random((3, int(far.sum()), 3))
    plain, spoilt = (contact_per_image(v, real, background) for v in (made, junk))
    for name in ("psnr", "ssim", "residual"):
        np.testing.assert_allclose(getattr(plain, name), getattr(spoilt, name), rtol=1e-12)
    assert (spoilt.iou < plain.iou).all()  # a contact that is not there is the mask's affair


def test_empty_gel_and_the_touch_itself_are_the_two_ends():
    background, real = pressed(7)
    residual, similarity, noise, overlap, several = contact_scores(background, real, background)
    assert residual.value == residual.details["empty"] == residual.details["per_real_energy"] == 1
    assert overlap.value == 0
    assert similarity.value == pytest.approx(similarity.details["empty"], abs=1e-12)
    assert similarity.value < 0.05
    assert several.value == pytest.approx(several.details["empty"], abs=1e-12)
    assert several.value < 0.1
    assert noise.value == pytest.approx(noise.details["empty"])
    elsewhere = np.clip(
        background + 0.1, 0, 1
    )  # empty gel of another sensor, on its own background
    assert contact_residual(elsewhere, real, background, generated_background=elsewhere).value == 1
    residual, similarity, noise, overlap, several = contact_scores(real, real, background)
    assert (residual.value, overlap.value) == (0, 1)
    assert several.value == pytest.approx(1)
    assert similarity.value == pytest.approx(1)
    assert noise.value is None
    assert noise.details["identical"] == 3


def world_touches():
    world = World(
        WorldOptions(
            objects_per_material=2, contacts_per_video=2, frames_per_contact=1, materials=8
        ),
        cache=40,
    )
    samples = [world[k] for k in range(len(world))]
    stacks = [np.stack([s[k] for s in samples]) for k in ("tactile", "background")]
    return (*stacks, [s["material"] for s in samples], [s["video"] for s in samples])


def partners(keep):
    """For each sample the first other one, cyclically, that may stand in for it, and whom it stands in for."""
    n, found = len(keep), []
    for i in range(n):
        found += [(i, (i + k) % n) for k in range(1, n) if keep[i][(i + k) % n]][:1]
    return np.array(found).T


def test_another_touch_of_the_same_material_does_not_lose_to_empty_gel():
    touch, background, material, video = world_touches()
    material, video = np.array(material), np.array(video)
    same_video = (video[:, None] == video) & ~np.eye(len(video), dtype=bool)
    same_material = (material[:, None] == material) & (video[:, None] != video)
    values = {}
    for name, keep in (("video", same_video), ("material", same_material)):
        i, j = partners(keep)
        values[name] = contact_scores(
            touch[j],
            touch[i],
            background[i],
            generated_background=background[j],
            groups=video[i].tolist(),
        )
    empty = contact_scores(background, touch, background)
    assert empty[0].value == 1
    for scores in values.values():
        assert scores[0].value < 0.97
        assert scores[0].interval[1] < 1
        assert (
            scores[0].details["per_real_energy"] > 1.2
        )  # by the real energy alone, and by PSNR, empty gel would win
        assert scores[2].value < scores[2].details["empty"]
        assert scores[1].value > scores[1].details["empty"]
        assert scores[3].value > 0.15
        assert scores[4].value > scores[4].details["empty"]
    assert values["video"][0].value < values["material"][0].value
    blurred = ndimage.gaussian_filter(touch, (0, 2, 2, 0))
    assert contact_residual(blurred, touch, background).value < values["video"][0].value


def test_touches_without_contact_are_counted_and_named():
    background, real = pressed(8, 5)
    real[1], real[3] = background[1], background[3]
    made = pressed(9, 5)[1]
    scores = contact_scores(
        made, real, background, ids=list("abcde"), groups=list("uuvvw"), subject="mini", split="s"
    )
    kept = [0, 2, 4]
    alone = contact_scores(made[kept], real[kept], background[kept], groups=list("uvw"))
    for score, other in zip(scores, alone, strict=True):
        assert score.details["no_contact"] == {"count": 2, "ids": ["b", "d"]}
        assert "2 of 5 real touches show no contact" in score.note
        assert score.value == pytest.approx(other.value)
        assert score.interval == pytest.approx(other.interval)
        assert (score.n, score.subject, score.split) == (5, "mini", "s")
        assert other.note == ""
    json.dumps([s.to_json() for s in scores], allow_nan=False)
    none = contact_residual(made, background, background)
    assert none.value is None
    assert none.details["no_contact"]["count"] == 5
    assert "Undefined" in none.note
    one = contact_residual(made[:1], real[:1], background[:1])
    assert one.interval is None


def test_single_scores_directions_intervals_and_settings():
    background, real = pressed(10, 6)
    made = pressed(11, 6)[1]
    scores = contact_scores(made, real, background)
    assert [s.metric for s in scores] == [
        "contact residual",
        "contact SSIM",
        "contact PSNR",
        "contact IoU",
        "contact MS-SSIM",
    ]
    assert [s.higher_is_better for s in scores] == [False, True, True, True, True]
    for call, score in zip(
        (contact_residual, contact_ssim, contact_psnr, contact_iou, contact_ms_ssim),
        scores,
        strict=True,
    ):
        assert call(made, real, background) == score
    values = contact_per_image(made, real, background).residual
    reach = stats.t.ppf(0.975, 5) * values.std(ddof=1) / math.sqrt(6)
    assert scores[0].interval == pytest.approx((values.mean() - reach, values.mean() + reach))
    assert scores[0].details["highest"][0]["value"] == values.max()
    for options in ({"markers": "keep"}, {"least": 0.03}, {"generated_background": background}):
        with pytest.raises(PalpateError, match="settings"):
            require_comparable([scores[0], contact_residual(made, real, background, **options)])
    require_comparable([scores[0], contact_residual(real, real, background, subject="real")])
    turned = slice(None, None, -1)
    require_comparable(
        [scores[0], contact_residual(made[turned], real[turned], background[turned])]
    )
    some = contact_residual(made[:2], real[:2], background[:2])
    assert (
        some.settings["background"]
        == contact_residual(
            *(np.concatenate([v[:2]] * 2) for v in (made, real, background))
        ).settings["background"]
    )
    gray = [v.mean(axis=3, keepdims=True) for v in (made, real, background)]
    assert 0 < contact_residual(*gray).value < 2


REAL_BACKGROUND, REAL = pressed(12)
MADE = pressed(13)[1]


def spoilt(x, value):
    x = x.copy()
    x[2, 0, 0, 0] = value
    return x


@pytest.mark.parametrize("call", [contact_scores, contact_per_image])
@pytest.mark.parametrize(
    ("made", "real", "background", "options", "words"),
    [
        (spoilt(MADE, np.nan), REAL, REAL_BACKGROUND, {}, ["The generated images", "image 2"]),
        (MADE, spoilt(REAL, np.nan), REAL_BACKGROUND, {}, ["The reference images", "image 2"]),
        (
            MADE,
            REAL,
            spoilt(REAL_BACKGROUND, 1.5),
            {},
            ["The reference background images", "1.5", "image 2"],
        ),
        (
            MADE,
            REAL,
            REAL_BACKGROUND,
            {"generated_background": spoilt(REAL_BACKGROUND, -1)},
            ["The generated background images", "image 2"],
        ),
        (
            MADE,
            REAL,
            REAL_BACKGROUND[:2],
            {},
            ["The reference touches and their backgrounds", "one to one"],
        ),
        (MADE[:2], REAL, REAL_BACKGROUND, {}, ["one to one"]),
        (MADE[:, :40], REAL[:, :40], REAL_BACKGROUND, {}, ["one to one"]),
        (
            MADE[:, :40],
            REAL,
            REAL_BACKGROUND,
            {"generated_background": REAL_BACKGROUND[:, :40]},
            ["Generated and reference", "one to one"],
        ),
        (MADE[:0], REAL[:0], REAL_BACKGROUND[:0], {}, ["n >= 1"]),
        (MADE[0], REAL[0], REAL_BACKGROUND[0], {}, ["shape (n, h, w, 3)"]),
        (MADE[:, :10], REAL[:, :10], REAL_BACKGROUND[:, :10], {}, ["11 x 11", "10 x 48"]),
        (MADE, REAL, REAL_BACKGROUND, {"markers": "drop"}, ["markers", "skip, keep"]),
        (MADE, REAL, REAL_BACKGROUND, {"least": 0}, ["least", "(0, 1)"]),
        ([[1], [1, 2]], REAL, REAL_BACKGROUND, {}, ["NumPy array"]),
    ],
)
def test_refuses_bad_input(call, made, real, background, options, words):
    with pytest.raises(PalpateError) as caught:
        call(made, real, background, **options)
    for word in words:
        assert word in str(caught.value)


def test_refuses_bad_options():
    with pytest.raises(PalpateError, match="color"):
        contact_scores(MADE, REAL, REAL_BACKGROUND, color=1)
    with pytest.raises(PalpateError, match="ids"):
        contact_scores(MADE, REAL, REAL_BACKGROUND, ids=["a"])
    with pytest.raises(PalpateError, match="least"):
        contact_mask(REAL, REAL_BACKGROUND, least=math.nan)
    with pytest.raises(PalpateError, match="touch background"):
        contact_mask(REAL, REAL_BACKGROUND + 1)


def test_the_real_clips(real_data):
    """Touches and the frames four before, as the loader has them: contact in nearly all, little in frames long before any."""
    av = pytest.importorskip("av", reason="PyAV is not installed")
    root = real_data / "touch_and_go" / "clips"
    for clip, area in {"clip_stone_0001": (0.25, 0.75), "clip_wood_00001": (0.7, 1.0)}.items():
        lines = (root / "label.txt").read_text().split()
        numbers = sorted(
            int(line.split(",")[0].split("/")[1][:-4])
            for line in lines
            if line.startswith(clip + "/")
        )
        first = numbers[0]
        with av.open(str(root / "dataset" / clip / "gelsight.mp4")) as file:
            frames = [
                f.to_ndarray(format="rgb24")[:480:8, 80:560:8]
                for _, f in zip(range(first + 20), file.decode(video=0), strict=False)
            ]
        used = [k for k in numbers if k < len(frames)][8::4]
        touch, background = (
            np.stack([frames[k] for k in used]),
            np.stack([frames[first - 4]] * len(used)),
        )
        mask = contact_mask(touch, background)
        assert mask.any(axis=(1, 2)).all()
        assert area[0] <= mask.mean() <= area[1]
        assert not contact_mask(
            np.stack(frames[4 : first - 15 : 4]),
            np.stack(frames[0 : first - 19 : 4])[: len(frames[4 : first - 15 : 4])],
        ).any()
        scores = contact_scores(background, touch, background)
        assert scores[0].value == 1
        assert scores[1].value < 0.05
        half = np.clip(background + (touch.astype(float) - background) / 2, 0, 255).astype(np.uint8)
        assert contact_residual(half, touch, background).value == pytest.approx(0.2, abs=0.05)


def test_noise_is_that_of_the_gel_and_not_of_its_markers():
    rng = np.random.default_rng(14)
    slope = np.linspace(0.3, 0.6, 64)[:, None, None] + np.zeros((64, 64, 3))
    every = np.ones((64, 64), bool)
    for deviation in (0.01, 0.05):
        noisy = slope + rng.normal(size=slope.shape) * deviation
        assert masks._noise(noisy, every) == pytest.approx(deviation, rel=0.05)
        keep = every.copy()
        keep[::5] = False
        noisy[::5] = rng.random((13, 64, 3))
        assert masks._noise(noisy, keep) == pytest.approx(deviation, rel=0.08)
        keep[::2] = False
        assert masks._noise(noisy, keep) == 0


def slow_ms_ssim(made, real, kept, scales):
    """MS-SSIM of two differences over some pixels, window by window."""
    at = np.arange(11) - 5
    window = np.exp(-0.5 * (at[:, None] ** 2 + at**2) / 1.5**2)
    window /= window.sum()
    c1, c2, values = (0.01 * 0.25) ** 2, (0.03 * 0.25) ** 2, []
    exponents = np.array([0.0448, 0.2856, 0.3001, 0.2363, 0.1333][:scales])
    for channel in range(real.shape[2]):
        x, y, weight, product = made[..., channel], real[..., channel], kept.astype(float), 1.0
        for j in range(scales):
            if j:
                pad = [(0, n % 2) for n in x.shape]
                x, y, weight = np.pad(x, pad, "edge"), np.pad(y, pad, "edge"), np.pad(weight, pad)
                x, y, weight = (
                    (v[::2, ::2] + v[1::2, ::2] + v[::2, 1::2] + v[1::2, 1::2]) / 4
                    for v in (x, y, weight)
                )
            above = below = 0.0
            wide = [np.pad(v, 5, "reflect") for v in (x, y)]
            for r in range(x.shape[0]):
                for c in range(x.shape[1]):
                    a, b = (v[r : r + 11, c : c + 11] for v in wide)
                    ma, mb = (window * a).sum(), (window * b).sum()
                    va, vb, cov = (
                        (window * (a - ma) ** 2).sum(),
                        (window * (b - mb) ** 2).sum(),
                        (window * (a - ma) * (b - mb)).sum(),
                    )
                    value = (2 * cov + c2) / (va + vb + c2)
                    if j == scales - 1:
                        bright = (2 * ma * mb + c1) / (ma**2 + mb**2 + c1)
                        value *= -bright if bright < 0 and value < 0 else bright
                    above, below = above + weight[r, c] * value, below + weight[r, c]
            product *= max(above / below, 0) ** (exponents / exponents.sum())[j]
        values.append(product)
    return np.mean(values)


@pytest.mark.parametrize("size", [(64, 64), (47, 51)])
def test_contact_ms_ssim_is_the_definition_by_windows(size):
    rng = np.random.default_rng(15)
    background = np.full((1, *size, 3), 0.5)
    real, made = background.copy(), background.copy()
    shape = np.clip(ndimage.gaussian_filter(rng.normal(size=(30, 40, 3)), (2, 2, 0)), -0.4, 0.4)
    real[0, -30:, -40:] += 0.8 * shape
    made[0, -30:, -40:] += 0.8 * ndimage.shift(shape, (1, 1, 0)) + 0.01 * rng.normal(
        size=shape.shape
    )
    score = contact_ms_ssim(made, real, background, markers="keep")
    kept = contact_mask(real, background)[0]
    scales = 3
    assert score.settings["scales"] == scales
    assert score.value == pytest.approx(
        slow_ms_ssim((made - background)[0], (real - background)[0], kept, scales), rel=1e-9
    )
    assert 0.05 < score.value < 0.95


def test_contact_pictures_are_gray_but_for_the_contact():
    background, real = pressed(16)
    made = pressed(17)[1]
    found = contact_pictures(made, real, background)
    found_8_bit = contact_pictures(
        *(np.round(v * 255).astype(np.uint8) for v in (made, real, background))
    )
    for picture, touch in ((found.generated, made), (found.reference, real)):
        assert picture.dtype == np.float32
        assert (picture[~found.mask] == 0.5).all()
        np.testing.assert_allclose(
            picture[found.mask], np.clip(0.5 + touch - background, 0, 1)[found.mask], atol=1e-6
        )
    assert (
        np.abs(found_8_bit.reference - found.reference)[found.mask & found_8_bit.mask].max() < 0.01
    )
    assert (found.mask & ~contact_mask(real, background)).sum() == 0
    assert found.mask.any(axis=(1, 2)).all()
    assert not contact_pictures(made, background, background).mask.any()

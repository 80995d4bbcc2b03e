"""Contact metrics: masks and values by hand and by loops, empty gel, the world, the real clips."""

import json

import numpy as np
import pytest
from scipy import ndimage
from world_statistics import change, contact_area

from forge.pictures import slow_ssim
from forge.scores import jackknife, without_each
from palpate.core import Note, PalpateError, require_comparable
from palpate.metrics import background_digest, contact, contact_mask, contact_scores
from palpate.metrics.contact import contact_per_image
from palpate.sim import Video, World, WorldOptions
from palpate.sim.plan import first_contact, plan_world

RESIDUAL, SSIM, IOU = (f"contact {name}" for name in ("residual", "SSIM", "IoU"))


def measured(generated, reference, background):
    """Metric -> values by pair."""
    each = contact_per_image({"": generated}, reference, background)[""]
    return {metric.metric: metric.values for metric in each}


def contact_residual(*images, **options):
    return contact_scores(*images, **options)[0]


def gel(n=3, size=48, level=0.5):
    return np.full((n, size, size, 3), level)


def pressed(seed, n=3, size=48, strength=0.15):
    """Backgrounds, and tactile images with a textured square from 12 to 36."""
    rng = np.random.default_rng(seed)
    background = gel(n, size)
    texture = ndimage.gaussian_filter(rng.normal(size=(n, 24, 24, 3)), (0, 2, 2, 0))
    image = background.copy()
    image[:, 12:36, 12:36] += strength * (0.6 + texture / texture.std() / 5)
    return background, image


def bytes_of(x):
    return (x * 255).round().astype(np.uint8)


# ---- the mask


def test_the_mask_is_the_square_and_little_more():
    background, image = pressed(0)
    mask = contact_mask(image, background)
    assert mask[:, 12:36, 12:36].all()
    outside = np.ones((48, 48), bool)
    outside[8:40, 8:40] = False
    assert not mask[:, outside].any()
    np.testing.assert_array_equal(contact_mask(bytes_of(image), bytes_of(background)), mask)


def test_noise_alone_is_an_empty_mask():
    rng = np.random.default_rng(1)
    background = gel(4, 64)
    for noise in (0.004, 0.02, 0.06):
        free, noisy = (
            np.clip(background + rng.normal(size=background.shape) * noise, 0, 1) for _ in range(2)
        )
        assert not contact_mask(free, noisy).any()
        dent = free.copy()
        dent[:, 20:44, 20:44] += 0.12
        assert contact_mask(np.clip(dent, 0, 1), noisy)[:, 24:40, 24:40].all()
    assert not contact_mask(background, background).any()
    speck = background.copy()
    speck[:, 30:32, 30:32] += 0.3
    assert not contact_mask(speck, background).any()  # 16 pixels exceed the threshold: under 1 %


def test_moved_markers_are_no_contact():
    background = gel(1, 64, 0.6)
    image = background.copy()
    for i in range(4, 64, 8):
        for j in range(4, 62, 8):
            background[:, i : i + 2, j : j + 2] = 0.1
            image[:, i : i + 2, j + 1 : j + 3] = 0.1
    assert not contact_mask(image, background).any()
    dent = image.copy()
    dent[:, 16:48, 16:48] += 0.1
    mask = contact_mask(dent, background)[0]
    assert mask[18:46, 18:46].all()
    assert mask.mean() < 0.4
    # the same print with its markers elsewhere: identical away from the markers
    moved = np.where(background == 0.1, background, 0.6) + np.where(dent - image > 0.05, 0.1, 0)
    residual = measured(moved, dent, background)[RESIDUAL][0]
    assert residual == pytest.approx(0, abs=1e-12)


def test_noise_is_estimated_away_from_the_markers():
    rng = np.random.default_rng(14)
    slope = np.linspace(0.3, 0.6, 64)[:, None, None] + np.zeros((64, 64, 3))
    for deviation in (0.01, 0.05):
        noisy, keep = slope + rng.normal(size=slope.shape) * deviation, np.ones((64, 64), bool)
        assert contact._noise(noisy, keep) == pytest.approx(deviation, rel=0.05)
        keep[::5] = False
        noisy[::5] = rng.random((13, 64, 3))
        assert contact._noise(noisy, keep) == pytest.approx(deviation, rel=0.08)
        keep[::2] = False
        assert contact._noise(noisy, keep) == 0


def test_noise_equals_a_loop_over_pixels_whose_neighbors_are_all_kept():
    rng = np.random.default_rng(15)
    image, keep = rng.random((30, 31, 3)), rng.random((30, 31)) > 0.03
    wide, pad = (
        np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="reflect"),
        np.pad(keep, 1, mode="edge"),
    )
    weights = np.outer([1, -2, 1], [1, -2, 1])[..., None]
    changes = [
        np.abs((weights * wide[i : i + 3, j : j + 3]).sum(axis=(0, 1)))
        for i, j in np.ndindex(keep.shape)
        if pad[i : i + 3, j : j + 3].all()
    ]
    expected = 1.4826 * np.median(changes) / 6
    assert contact._noise(image, keep) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("shape", "step"), [((40, 50), 1), ((100, 90), 1), ((130, 140), 2)])
def test_markers_are_darker_than_the_median_around_on_a_coarse_grid(shape, step):
    gray = ndimage.gaussian_filter(np.random.default_rng(16).random(shape), 1)
    small = gray[::step, ::step]
    around = ndimage.median_filter(small, min(small.shape) // 6 | 1, mode="reflect")
    around = np.kron(around, np.ones((step, step)))[: shape[0], : shape[1]]
    expected = gray < 0.82 * around
    assert 0 < expected.mean() < 0.5
    np.testing.assert_array_equal(contact.marker_mask(gray[..., None]), expected)


def test_the_digest_of_backgrounds_ignores_order_and_dtype():
    gels = np.concatenate([gel(1, 16, level) for level in (0.2, 0.5, 0.6, 0.7, 0.8, 0.9)])
    assert background_digest(gels) == background_digest(gels[::-1]) == "988fd396bc9f00be"
    assert background_digest(bytes_of(gels)) == background_digest(np.rint(gels * 255) / 255)


def test_the_mask_agrees_with_the_area_that_the_world_knows():
    world = World(WorldOptions(objects_per_material=1, materials=6))
    for k in range(0, len(world), 9):
        image, background = world[k]["tactile"], world[k]["background"]
        wide = image.astype(np.float32), background.astype(np.float32)
        expected = np.asarray(change(*wide) > 4)
        mask = contact_mask(image[None], background[None])[0]
        if expected.mean() < 0.01:
            assert not mask.any()
            continue
        np.testing.assert_array_equal(mask, ndimage.binary_dilation(expected))
        assert mask.mean() >= contact_area(*wide, 4.0)


def test_the_gel_of_the_world_before_contact_has_none():
    options = WorldOptions(objects_per_material=1)
    before = first_contact(options, 1)
    videos = [Video(options, plan) for plan in plan_world(options)[::4]]
    free, background = (np.stack([v.tactile(before - k) for v in videos]) for k in (2, 4))
    assert not contact_mask(free, background).any()


# ---- values


def test_values_by_hand():
    """One constant square: every metric of a weaker one follows from the two heights."""
    background = gel(1)
    real, made = background.copy(), background.copy()
    real[:, 12:36, 12:36] += 0.2
    made[:, 12:36, 12:36] += 0.1
    mask, made_mask = contact_mask(real, background)[0], contact_mask(made, background)[0]
    values = measured(made, real, background)
    area = contact_scores(made, real, background)[0].details["area"]
    assert area == pytest.approx(mask.mean())
    assert values[RESIDUAL][0] == pytest.approx(0.01 / (0.01 + 0.04))
    assert values[IOU][0] == (mask & made_mask).sum() / (mask | made_mask).sum()
    negative = measured(2 * background - real, real, background)
    assert negative[RESIDUAL][0] == pytest.approx(2)


def test_stacks_measured_together_score_as_each_alone():
    rng = np.random.default_rng(0)
    background, real = gel(3), gel(3)
    real[:2, 12:36, 12:36] += 0.2  # the third shows no contact
    stacks = {name: np.clip(real + rng.normal(0, 0.05, real.shape), 0, 1) for name in "ab"}
    for name, together in contact_per_image(stacks, real, background).items():
        alone = contact_per_image({"": stacks[name]}, real, background)[""]
        for a, b in zip(together, alone, strict=True):
            assert np.array_equal(a.values, b.values, equal_nan=True)
            assert (a.details, a.notes) == (b.details, b.notes)
            assert np.isnan(a.values).tolist() == [False, False, True]


@pytest.mark.parametrize("sigma", [4, 8, 16])
def test_the_negative_of_a_contact_is_not_similar(sigma):
    background, real = gel(1, 64), gel(1, 64)
    at = np.arange(64) - 32
    real += 0.3 * np.exp(-(at[:, None] ** 2 + at**2) / (2 * sigma**2))[..., None]
    _, similarity, _ = contact_scores(1 - real, real, background)
    assert similarity.value < 0 < similarity.details["empty"]


def looped_ssim(made, real, mask):
    """With a window at every pixel of mirrored images."""
    wide = [np.pad(v, ((5, 5), (5, 5), (0, 0)), mode="reflect") for v in (made, real)]
    maps = (slow_ssim(*(v[..., k] for v in wide), 0.25)[0] for k in range(3))
    return np.mean([values[mask].mean() for values in maps])


def test_values_equal_loops_over_the_mask():
    background, real = pressed(2, 2)
    made = pressed(3, 2)[1]
    values, empty = (measured(x, real, background) for x in (made, background))
    real_masks, made_masks = contact_mask(real, background), contact_mask(made, background)
    for n in range(2):
        mask, union = real_masks[n], real_masks[n] | made_masks[n]
        d, e = (real - background)[n], (made - background)[n]
        error = sum((e[i, j, k] - d[i, j, k]) ** 2 for i, j in np.argwhere(mask) for k in range(3))
        both = (d[mask] ** 2 + e[mask] ** 2).sum()
        expected = {
            RESIDUAL: error / both,
            SSIM: looped_ssim(e, d, mask),
            IOU: (mask & made_masks[n]).sum() / union.sum(),
        }
        for metric, value in expected.items():
            assert values[metric][n] == pytest.approx(value, abs=1e-12), metric
        expected = looped_ssim(np.zeros_like(d), d, mask)
        assert empty[SSIM][n] == pytest.approx(expected, abs=1e-12)


def test_what_lies_outside_the_contact_earns_and_costs_nothing():
    background, real = pressed(4, 3, 64)
    made = pressed(5, 3, 64)[1]
    far = np.zeros((64, 64), bool)
    far[44:] = True  # further from the mask than half a window
    junk = made.copy()
    junk[:, far] = np.random.default_rng(6).random((3, int(far.sum()), 3))
    plain, with_junk = (measured(v, real, background) for v in (made, junk))
    for metric in (SSIM, RESIDUAL):
        np.testing.assert_allclose(plain[metric], with_junk[metric], rtol=1e-12)
    assert (with_junk[IOU] < plain[IOU]).all()  # a contact that is not there shows in the mask


# ---- scores


def test_empty_gel_and_the_real_image_are_the_two_ends():
    background, real = pressed(7)
    empty = {s.metric: s for s in contact_scores(background, real, background)}
    assert empty[RESIDUAL].value == empty[RESIDUAL].details["empty"] == 1
    assert empty[IOU].value == 0
    expected = empty[SSIM].details["empty"]
    assert empty[SSIM].value == pytest.approx(expected, abs=1e-12)
    assert expected < 0.05
    same = {s.metric: s for s in contact_scores(real, real, background)}
    assert [same[m].value for m in (RESIDUAL, IOU)] == [0, 1]
    assert same[SSIM].value == pytest.approx(1)


def partners(keep):
    """For each sample the first other one, cyclically, that may replace it; (which, by which)."""
    n = len(keep)
    pairs = ([(i, (i + k) % n) for k in range(1, n) if keep[i][(i + k) % n]][:1] for i in range(n))
    return np.array([pair for some in pairs for pair in some]).T


def test_another_image_of_the_same_material_does_not_lose_to_empty_gel():
    options = {"objects_per_material": 2, "contacts_per_video": 2, "frames_per_contact": 1}
    world = World(WorldOptions(materials=8, **options), cache=40)
    samples = [world[k] for k in range(len(world))]
    image, background = (np.stack([s[k] for s in samples]) for k in ("tactile", "background"))
    material, video = (np.array([s[k] for s in samples]) for k in ("material", "video"))
    same_video = (video[:, None] == video) & ~np.eye(len(video), dtype=bool)
    same_material = (material[:, None] == material) & (video[:, None] != video)
    residual = {}
    for name, keep in (("video", same_video), ("material", same_material)):
        i, j = partners(keep)
        moved = background[i].astype(float) + image[j] - background[j]  # the contact on gel i
        moved = np.clip(moved, 0, 255).astype(np.uint8)
        scores = contact_scores(moved, image[i], background[i], groups=video[i].tolist())
        values = {s.metric: s.value for s in scores}
        empty = {s.metric: s.details["empty"] for s in scores}
        residual[name] = values[RESIDUAL]
        assert scores[0].interval[1] < 1
        assert values[SSIM] > empty[SSIM]
        assert values[IOU] > 0.15
    blurred = ndimage.gaussian_filter(image, (0, 2, 2, 0))
    blurred = contact_residual(blurred, image, background).value
    assert blurred < residual["video"] < residual["material"] < 0.97


def test_images_without_contact_are_excluded_and_named():
    background, real = pressed(8, 5)
    real[1], real[3] = background[1], background[3]
    made, kept = pressed(9, 5)[1], [0, 2, 4]
    options = {"subject": "mini", "split": "s"}
    scores = contact_scores(
        made, real, background, ids=list("abcde"), groups=list("uuvvw"), **options
    )
    others = contact_scores(made[kept], real[kept], background[kept], groups=list("uvw"))
    for score, other in zip(scores, others, strict=True):
        assert score.details["no_contact"] == {"count": 2, "ids": ["b", "d"]}
        assert Note("no-contact", {"count": 2, "n": 5}) in score.notes
        assert score.value == pytest.approx(other.value)
        assert score.interval == pytest.approx(other.interval)
        assert (score.n, score.a, score.split) == (5, "mini", "s")
        assert other.notes == ()
    json.dumps([s.to_json() for s in scores], allow_nan=False)
    none = contact_residual(made, background, background)
    assert (none.value, none.details["no_contact"]["count"]) == (None, 5)
    assert none.notes[0].code == "no-pair-has-a-value"
    assert contact_residual(made[:1], real[:1], background[:1]).interval is None


def test_directions_and_intervals():
    background, real = pressed(10, 6)
    made = pressed(11, 6)[1]
    scores = contact_scores(made, real, background)
    assert [s.metric for s in scores] == [RESIDUAL, SSIM, IOU]
    assert [s.higher_is_better for s in scores] == [False, True, True]
    values = measured(made, real, background)[RESIDUAL]
    assert scores[0].interval == jackknife(values.mean(), without_each(values))[1]
    assert scores[0].details["highest"][0]["value"] == values.max()
    gray = [v.mean(axis=3, keepdims=True) for v in (made, real, background)]
    assert 0 < contact_residual(*gray).value < 2


def test_scores_of_other_backgrounds_are_not_comparable():
    background, real = pressed(10, 6)
    made = pressed(11, 6)[1]
    score = contact_residual(made, real, background)
    with pytest.raises(PalpateError, match="settings"):
        require_comparable([score, contact_residual(made, real, 0.99 * background)])
    require_comparable([score, contact_residual(real, real, background, subject="real")])
    backwards = [v[::-1] for v in (made, real, background)]
    require_comparable([score, contact_residual(*backwards)])


def test_the_real_clips(real_data):
    """Contact in nearly all in-contact frames, hardly any in frames long before."""
    av = pytest.importorskip("av", reason="PyAV is not installed")
    root = real_data / "touch_and_go" / "clips"
    lines = (root / "label.txt").read_text().split()
    for clip, area in {"clip_stone_0001": (0.25, 0.75), "clip_wood_00001": (0.7, 1.0)}.items():
        names = [line.split(",")[0] for line in lines if line.startswith(clip + "/")]
        numbers = sorted(int(name.split("/")[1][:-4]) for name in names)
        first = numbers[0]
        with av.open(str(root / "dataset" / clip / "gelsight.mp4")) as file:
            frames = [
                f.to_ndarray(format="rgb24")[:480:8, 80:560:8]
                for _, f in zip(range(first + 20), file.decode(video=0), strict=False)
            ]
        used = [k for k in numbers if k < len(frames)][8::4]
        image = np.stack([frames[k] for k in used])
        background = np.stack([frames[first - 4]] * len(used))
        mask = contact_mask(image, background)
        assert mask.any(axis=(1, 2)).all()
        assert area[0] <= mask.mean() <= area[1]
        later, earlier = frames[4 : first - 15 : 4], frames[0 : first - 19 : 4]
        assert not contact_mask(np.stack(later), np.stack(earlier[: len(later)])).any()
        residual, similarity, *_ = contact_scores(background, image, background)
        assert residual.value == 1
        assert similarity.value < 0.05
        half = background + (image.astype(float) - background) / 2
        half = np.clip(half, 0, 255).astype(np.uint8)
        assert contact_residual(half, image, background).value == pytest.approx(0.2, abs=0.05)

"""Marker motion: displacements of drawn dots, of the world's own markers, and of real clips."""

import itertools

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

import palpate as pp
from palpate.data.video import VideoReader
from palpate.metrics import marker_scores
from palpate.metrics.markers import marker_motion
from palpate.sim import World, WorldOptions

SIDE = 96


def dots(centers, radii, side=SIDE):
    """(side, side, 3) uint8: dark round dots on gray, drawn at four times the size."""
    image, at = np.full((4 * side, 4 * side), 150.0), (np.arange(4 * side) + 0.5) / 4
    for (cx, cy), radius in zip(centers, radii, strict=True):
        rows, columns = (slice(*np.searchsorted(at, (c - 3, c + 3))) for c in (cy, cx))
        inside = np.hypot(at[rows, None] - cy, at[None, columns] - cx) < radius
        image[rows, columns][inside] = 20
    image = image.reshape(side, 4, side, 4).mean((1, 3))
    image += np.random.default_rng(0).normal(0, 1, image.shape)
    return np.rint(image.clip(0, 255)).astype(np.uint8)[..., None].repeat(3, 2)


def lattice(rng, step=12.0):
    """Centers (m, 2) in pixels and radii (m,), a third of the dots worn."""
    grid = np.arange(step / 2, SIDE, step)
    centers = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    radii = np.where(rng.random(len(centers)) < 0.3, 2.6, 1.6)
    return centers + rng.normal(0, 0.3, centers.shape), radii


@pytest.mark.parametrize(
    ("shift", "divergence", "curl"),
    [((2.0, -1.3), 0, 0), ((0, 0), 6, 0), ((0, 0), 0, 5), ((-1.5, 2.2), 4, -3), ((7, 2), 0, 0)],
)
def test_an_affine_motion_of_drawn_dots_is_measured(shift, divergence, curl):
    centers, radii = lattice(np.random.default_rng(1))
    d, c = divergence / 200, curl / 200
    gradient = np.array([[d, c], [-c, d]])  # rows: by x, by y
    moved = np.array(shift) + (centers - SIDE / 2) @ gradient
    motion = marker_motion(dots(centers + moved, radii), dots(centers, radii))
    assert len(motion.at) >= 40
    middle = np.array(shift) + (motion.at * SIDE / 100 - SIDE / 2).mean(0) @ gradient
    np.testing.assert_allclose(motion.mean * SIDE / 100, middle, atol=0.03)
    assert motion.divergence == pytest.approx(divergence, abs=0.15)
    assert motion.curl == pytest.approx(curl, abs=0.15)
    each = np.array(shift) + (motion.at * SIDE / 100 - SIDE / 2) @ gradient
    assert np.linalg.norm(motion.moves * SIDE / 100 - each, axis=1).max() < 0.15
    assert motion.rms == pytest.approx(100 / SIDE * np.sqrt((each**2).sum(1).mean()), rel=0.02)


def test_it_is_zero_of_the_gel_itself_and_robust_to_markers_that_vanish_or_appear():
    rng = np.random.default_rng(2)
    centers, radii = lattice(rng)
    gel = dots(centers, radii)
    assert marker_motion(gel, gel).rms == 0
    kept, more = rng.random(len(centers)) < 0.8, rng.uniform(5, SIDE - 5, (6, 2))
    image = dots([*(centers[kept] + (1.5, 0)), *more], [*radii[kept], *[1.5] * 6])
    motion = marker_motion(image, gel)
    np.testing.assert_allclose(motion.mean * SIDE / 100, (1.5, 0), atol=0.1)


def world_pairs(count, **options):
    """Touch, gel and true displacement (dy, dx) in pixels of contact frames of a world."""
    shape = {"seed": 11, "objects_per_material": 1, "contacts_per_video": 2, "sensors": 5}
    world = World(WorldOptions(**shape, **options))
    for row in world.rows[:: len(world.rows) // count][:count]:
        video = world.video(row.video)
        state, sensor = video.state(row.frame), video.sensor
        shift = sensor.ink is not None and sensor.shift(video.membrane(state)[0], state.shear)
        yield video.tactile(row.frame), video.background_of(row.contact), shift


@pytest.mark.parametrize(("size", "error", "least"), [(64, 0.08, 0.998), (128, 0.08, 0.9995)])
def test_the_worlds_markers_are_followed_below_a_tenth_of_a_pixel(size, error, least):
    off, net = [], []
    for image, gel, shift in world_pairs(20, size=size):
        motion = marker_motion(image, gel)
        at = motion.at[:, ::-1] * size / 100
        to = at  # a marker is drawn where its displacement, looked up there, leads back to it
        for _ in range(6):
            true = np.stack([ndimage.map_coordinates(s, to.T, order=1) for s in shift], 1)
            to = at + true
        moved = motion.moves[:, ::-1] * size / 100
        off.append(np.linalg.norm(moved - true, axis=1))
        net.append([true.mean(0), moved.mean(0)])
    assert np.sqrt(np.mean(np.concatenate(off) ** 2)) < error
    true, measured = np.swapaxes(net, 0, 1)
    assert all(np.corrcoef(true[:, k], measured[:, k])[0, 1] > least for k in (0, 1))


@pytest.mark.parametrize("options", [{"look": "digit"}, {"markers": 0}])
def test_a_gel_without_markers_has_no_motion(options):
    assert all(marker_motion(*pair[:2]) is None for pair in world_pairs(10, **options))


def test_dirt_at_random_places_is_no_marker():
    rng = np.random.default_rng(3)
    centers = rng.uniform(6, SIDE - 6, (30, 2))
    gel = dots(centers, np.full(30, 1.5))
    assert marker_motion(gel, gel) is None


def test_markers_of_a_real_press_are_those_followed_from_frame_to_frame(real_data):
    """Up to two fifths of the pitch and a dilation of an eighth, between two images alone."""
    file = real_data / "touch_and_go" / "clips" / "dataset" / "clip_wood_00001" / "gelsight.mp4"
    gel_frame, last, size = 30, 63, (160, 120)
    with VideoReader(file) as reader:
        frames = [
            np.asarray(Image.fromarray(frame).resize(size, Image.Resampling.BOX))
            for _, frame in reader.frames(range(gel_frame, last + 1, 3))
        ]
    direct = marker_motion(frames[-1], frames[0])
    at = direct.at
    for before, after in itertools.pairwise(frames):
        step = marker_motion(after, before)
        distance = np.linalg.norm(at[:, None] - step.at[None], axis=2)
        at = at + step.moves[distance.argmin(1)]
    off = np.linalg.norm(at - direct.at - direct.moves, axis=1)
    assert len(direct.at) > 60
    assert direct.rms > 2.5  # % of the width; the pitch is 8.8
    assert np.median(off) < 0.25
    assert (off > 1).mean() < 0.1


def moved_stack(rng, count, shift):
    """Images (n, h, w, 3) whose markers go ``shift`` pixels, more or less, and their gels."""
    gels, images = [], []
    for k in range(count):
        centers, radii = lattice(rng)
        gels.append(dots(centers, radii))
        images.append(dots(centers + shift * (1 + 0.1 * (-1) ** k), radii))
    return np.stack(images), np.stack(gels)


def test_scores_are_means_over_images_with_real_ones_as_floor():
    rng, n = np.random.default_rng(4), 8
    real, gels = moved_stack(rng, n, np.array([1.8, 2.4]))
    half = np.stack([dots(*lattice_of) for lattice_of in halves(n)])
    groups = [f"v{k // 2}" for k in range(n)]
    scores = {s.metric: s for s in marker_scores(half, real, gels, groups=groups)}
    assert [*scores] == ["marker motion", "marker shear", "marker divergence", "marker curl"]
    motion, shear = scores["marker motion"], scores["marker shear"]
    assert motion.floor == pytest.approx(100 * 3 / SIDE, rel=0.02)
    assert motion.value == pytest.approx(100 * 1.5 / SIDE, rel=0.03)
    assert motion.interval[0] < motion.value < motion.interval[1] < motion.floor
    assert shear.details["mean"] == pytest.approx([90 / SIDE, 120 / SIDE], rel=0.05)
    assert shear.value == pytest.approx(motion.value, rel=0.01)
    assert scores["marker divergence"].value == pytest.approx(0, abs=0.1)
    own = marker_scores(real, real, gels, groups=groups)
    assert all(s.value == pytest.approx(s.floor) for s in own)
    still = marker_scores(gels, real, gels)
    assert [s.value for s in still] == pytest.approx([0, 0, 0, 0])


def halves(count):
    """The same markers as of the seed of :func:`moved_stack`, moved half as far."""
    rng = np.random.default_rng(4)
    for k in range(count):
        centers, radii = lattice(rng)
        yield centers + np.array([0.9, 1.2]) * (1 + 0.1 * (-1) ** k), radii


def test_images_without_their_markers_are_counted_and_gels_without_have_no_score():
    real, gels = moved_stack(np.random.default_rng(5), 4, np.array([2.0, 0.0]))
    lost = real.copy()
    lost[0] = 150
    motion = marker_scores(lost, real, gels)[0]
    assert motion.details["no_markers"] == 1
    assert [note.code for note in motion.notes if note.code == "no-markers"] == ["no-markers"]
    plain = np.full_like(real, 150)
    assert marker_scores(plain, plain, plain) == []


def test_real_presses_move_their_markers_and_a_generator_of_gels_does_not(real_data):
    clips = real_data / "touch_and_go" / "clips" / "dataset"
    presses = {
        "clip_wood_00001": (30, 63),
        "clip_brick_0001": (30, 119),
        "clip_grass_0001": (20, 41),
    }
    images, gels = [], []
    for name, (gel, press) in presses.items():
        with VideoReader(clips / name / "gelsight.mp4") as reader:
            for frame, stack in ((gel, gels), (press, images)):
                image = Image.fromarray(reader[frame]).resize((160, 120), Image.Resampling.BOX)
                stack.append(np.asarray(image))
    real, gels = np.stack(images), np.stack(gels)
    motion, shear, divergence, _ = marker_scores(gels, real, gels, groups=[*presses])
    assert (motion.value, shear.value, divergence.value) == (0, 0, 0)
    assert motion.floor > 1.5
    assert 0 < shear.floor < motion.floor
    assert divergence.floor > 2


def test_score_compares_the_markers_of_generators_with_real_ones(tmp_path):
    world = World(WorldOptions(seed=12, objects_per_material=1, materials=8, contacts_per_video=2))
    samples = [world[k] for k in range(0, len(world), 3)]
    real, gels = (np.stack([s[kind] for s in samples]) for kind in ("tactile", "background"))
    for name, images in {"gels": gels, "half": (real // 2 + gels // 2), "real": real}.items():
        (tmp_path / name).mkdir()
        for sample, image in zip(samples, images, strict=True):
            Image.fromarray(image).save(tmp_path / name / f"{sample['id'].replace('/', '_')}.png")
    sides = {"gels": tmp_path / "gels", "half": tmp_path / "half"}
    gel = tmp_path / "gel.png"
    Image.fromarray(gels[0]).save(gel)
    one = [k for k, s in enumerate(samples) if s["sensor"] == samples[0]["sensor"]]
    for name in ("gels", "half", "real"):
        for k, file in enumerate(sorted((tmp_path / name).iterdir())):
            if k not in one:
                file.unlink()
    results = pp.score(sides, tmp_path / "real", background=gel, companions=["contact"])
    motion = {s.a: s for s in results.scores if s.metric == "marker motion" and s.b is None}
    expected = np.mean([marker_motion(real[k], gels[0]).rms for k in one])
    assert motion["gels"].floor == pytest.approx(expected, rel=0.02)
    assert motion["gels"].value < 0.25 * motion["half"].floor
    difference = next(s for s in results.scores if s.metric == "marker motion" and s.b)
    assert difference.details["better"] is None  # closer to the floor is better
    assert "Marker motion" in str(results)

"""Touches that are asked for: maps for the denoiser, scales, draws, profiles, videos."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import polars as pl
import pytest
import torch
from PIL import Image

from forge.errors import fails
from forge.models import StandInEncoders
from palpate import generate
from palpate.core import PalpateError, quiet
from palpate.data.manifest import Manifest
from palpate.data.video import VideoReader, write_video
from palpate.diffusion import contact
from palpate.diffusion.autoencoder import BackgroundAutoencoder, LatentStats
from palpate.diffusion.contact import ContactScale, channels_of, drawn, maps_of, marks_of
from palpate.diffusion.denoiser import Denoiser
from palpate.diffusion.denoiser_training import Rows, train_denoiser
from palpate.diffusion.encoding import _contacts
from palpate.diffusion.options import ConditionPolicy
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import TINY
from palpate.diffusion.requested import Profile, Requested
from palpate.diffusion.unet import build_unet
from palpate.metrics.conditions import contact_conditions
from palpate.metrics.markers import marker_motion
from palpate.sim import World, WorldOptions
from palpate.training.options import LoopOptions
from palpate.training.run import TrainingRun

PLAIN = LatentStats((0.0,) * 4, (1.0,) * 4)
NONE = np.full((1, 6), np.nan)
SCALE = (torch.tensor([0.5, 0.5, 0.3, 0.5, 0.0, 0.0]), torch.ones(6))
#: Touches that training saw, as they are asked for.
TOUCHES = torch.tensor(
    [[0.2, 0.3, 0.2, 0.1, 0.5, 0.0], [0.5, 0.7, 0.5, 0.5, -0.5, 0.4], [0.8, 0.5, 0.9, 0.9, 1.0, 0]]
)


@pytest.fixture(scope="module")
def world():
    return World(WorldOptions(objects_per_material=1, contacts_per_video=1, seed=81))


@pytest.fixture(scope="module")
def code():
    torch.manual_seed(0)
    return BackgroundAutoencoder(channels=4, narrow=8, wide=8).eval()


def make(code, gel, contact=True):
    """An untrained pipeline of 64 px that knows contacts, or does not."""
    torch.manual_seed(0)
    policy = ConditionPolicy(width=6, contact=contact)
    maps = channels_of(4) if contact else 0
    unet = build_unet(TINY.unet, policy, channels=4, size=16, background=maps)
    touches = (TOUCHES, torch.zeros(3, dtype=torch.int64)) if contact else None
    denoiser = Denoiser(unet, policy, touches=touches).eval()
    scale = ContactScale({"": [0.0, 10.0]}, {}, {"": [0.1, 0.3, 0.2, 0.8]}, gain=[1.0] * 6)
    scale = scale if contact else None
    parts = TINY.schedule, TINY.sampler, 64, StandInEncoders(), "tiny", {"split": None}, gel
    return TactilePipeline(code, denoiser, PLAIN, *parts, contact=scale)


def test_maps_show_what_is_asked_and_that_alone():
    marks = torch.ones(1, 12, 16, 16)
    nothing = maps_of(torch.from_numpy(NONE).float(), marks, SCALE)
    assert nothing.shape == (1, channels_of(4), 16, 16)
    assert not nothing[:, :15].any()  # place, numbers, what is known, the markers as asked
    assert (nothing[:, 15:] == 1).all()  # what the gel's markers look like is always shown
    asked = torch.tensor([[0.25, 0.75, 0.1, 0.9, 1.0, -1.0]])
    maps = maps_of(asked, marks, SCALE)[0]
    y, x = divmod(int(maps[0].argmax()), 16)
    assert (abs(x - 3.5) <= 1, abs(y - 11.5) <= 1) == (True, True)
    values = [round(float(maps[k, 0, 0]), 4) for k in range(3, 11)]
    assert values == [-0.2, 0.4, 1.0, -1.0, 1, 1, 1, 1]
    # a shear alone moves markers, and places nothing
    asked[:, :4] = torch.nan
    maps = maps_of(asked, marks, SCALE)[0]
    assert not maps[:3].any()
    assert (maps[11:15] == 1).all()


def test_parts_are_dropped_together_and_at_random():
    draws = torch.rand(4000, 5, generator=torch.Generator().manual_seed(0))
    known = torch.isfinite(contact.dropped(torch.zeros(4000, 6), draws)).float()
    assert (known[:, 0] == known[:, 1]).all()
    assert (known[:, 4] == known[:, 5]).all()
    share = (1 - contact.DROP_ALL) * (1 - contact.DROP)
    assert known.mean(0).numpy() == pytest.approx(share, abs=0.03)
    assert (known.sum(1) == 0).float().mean().item() == pytest.approx(contact.DROP_ALL, abs=0.03)


def test_markers_of_a_gel_are_moved_by_the_shear(world, code):
    gel = world[0]["background"]
    moved = contact._moved(*contact._ink(gel), np.array([1.5, -1.0]))
    motion = marker_motion(moved, gel)
    assert motion is not None
    assert motion.mean == pytest.approx([1.5, -1.0], abs=0.15)
    gels = np.stack([gel, gel, np.full_like(gel, 120)])
    assert contact.has_markers(gels).tolist() == [True, True, False]
    marks = marks_of(code, gels, np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0]]))
    assert marks.shape == (3, 12, 16, 16)
    assert marks[0, :4].abs().max() < 1e-5
    assert torch.allclose(marks[1, :4], marks[1, 4:8])  # asked: 1 % to the right
    assert marks[2].abs().max() < 1e-5  # without markers nothing moves


def test_strength_is_a_quantile_of_the_sensor_and_depth_maps_to_it():
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.1, 0.4, 600)
    rows = np.full((600, 8), np.nan)
    rows[:, :3], rows[:, 7] = 0.5, depth
    sensors = ["a"] * 300 + ["b"] * 300
    rows[:, 3] = depth * np.repeat([10, 100], 300) + rng.normal(0, 0.01, 600)
    rows[0, :4] = [np.nan, np.nan, 0, 0]  # no contact
    scale = ContactScale.of(rows, sensors)
    asked = scale.requested(rows, sensors)
    for of in (slice(1, 300), slice(300, 600)):
        ranks = rows[of, 3].argsort().argsort() / len(rows[of])
        assert asked[of, 3] == pytest.approx(ranks, abs=0.02)
    assert asked[0, 3] == 0
    assert scale.missing == {"at": 1, "area": 0, "strength": 0, "shear": 600}
    values = [scale.strength_of("depth", d, "b") for d in (0.11, 0.2, 0.25, 0.3, 0.39)]
    assert values == sorted(values)
    assert values == pytest.approx([0.03, 0.33, 0.5, 0.67, 0.97], abs=0.06)
    with pytest.raises(PalpateError, match=r"must lie in 0\.1.* to 0\.4.* mm"):
        scale.strength_of("depth", 0.5)
    with pytest.raises(PalpateError, match="training knew none"):
        scale.strength_of("force", 2.0)


def test_what_is_not_asked_is_drawn_jointly_by_seed_and_id():
    touches = TOUCHES.numpy()
    ids = [f"s{k}" for k in range(200)]
    asked = np.repeat(NONE, 200, axis=0)
    rows = drawn(asked, touches, None, ids, 0)
    each, counts = np.unique(rows, axis=0, return_counts=True)
    assert np.array_equal(each, touches)  # whole rows of training
    assert counts.min() > 40
    assert np.array_equal(drawn(asked[:1], touches, None, ids[7:8], 0), rows[7:8])
    assert not np.array_equal(drawn(asked, touches, None, ids, 1), rows)
    asked[:, 3] = 0.88  # the rest is that of touches that are nearly so strong
    near = drawn(asked, touches, None, ids, 0)
    assert np.allclose(near[:, 3], 0.88)
    assert np.allclose(near[:, :3], touches[2, :3])
    similar = np.tile([0.0, 1.0, 0.0], (200, 1))  # and of surfaces like it
    assert np.array_equal(drawn(np.repeat(NONE, 200, 0), touches, similar, ids, 0)[3], touches[1])
    reach = contact.reach(touches[:, 3], similar)
    assert reach[0].tolist() == pytest.approx([0.5, 0.5])


def test_new_inputs_change_nothing_before_training(code, tmp_path):
    start = make(code, None, contact=False).denoiser
    rng = np.random.default_rng(0)
    asked = rng.uniform(size=(4, 6)).astype(np.float32)
    rows = Rows(torch.randn(4, 4, 16, 16), {"text": torch.randn(4, 6)}, requested=asked)
    rows = replace(rows, marks=rng.normal(size=(4, 12, 16, 16)).astype(np.float16))
    policy = replace(start.policy, contact=True)
    for steps, same in ((0, True), (2, False)):
        loop = LoopOptions(steps=steps, batch=2, lr=1e-2, warmup=0)
        preset = replace(TINY, condition=policy, loop=loop)
        run = TrainingRun(tmp_path / str(steps))
        wide = train_denoiser(rows, preset, PLAIN, run, start=start)
        x, t, tokens = torch.randn(2, 4, 16, 16), torch.tensor([3, 9]), torch.randn(2, 1, 6)
        maps = torch.randn(2, channels_of(4), 16, 16)
        assert torch.equal(wide(x, t, tokens, maps), start(x, t, tokens)) is same
        assert torch.equal(wide.touches, torch.from_numpy(asked))


def test_the_manifest_goes_before_what_images_show(world, tmp_path):
    rows = [world[k] for k in (0, 1, 2)]
    images, gels = (np.stack([row[name] for row in rows]) for name in ("tactile", "background"))
    table = {"id": ["a", "b", "c"], "background": ["gel.png"] * 3, "shear_x": [2.0, None, None]}
    table |= {"strength": [None, 7.5, None], "depth": [0.1, None, 0.3]}
    Manifest.of_table(pl.DataFrame(table), tmp_path).save(tmp_path / "manifest.parquet")
    manifest = Manifest.load(tmp_path)
    assert manifest.table.schema["strength"] == pl.Float64
    known = _contacts(manifest, images, gels, tmp_path / "contacts.npy", quiet)
    shown = contact_conditions(images, gels)
    assert known[1, 3] == 7.5
    assert known[0, 4] == 2.0
    assert known[:, 7] == pytest.approx([0.1, np.nan, 0.3], nan_ok=True)
    assert known[[0, 2], 3] == pytest.approx(shown[[0, 2], 3])
    assert known[:, :3] == pytest.approx(shown[:, :3])
    # without gels only what the manifest says is known
    bare = replace(manifest, table=manifest.table.with_columns(background=pl.lit(None, pl.String)))
    assert np.isfinite(_contacts(bare, images, gels, tmp_path / "none.npy", quiet)).sum() == 4


def test_images_follow_what_is_asked_and_the_folder_keeps_it(world, code, tmp_path):
    gel = world[0]["background"]
    pipeline = make(code, gel)
    photos, ids = torch.nn.functional.normalize(torch.randn(3, 6), dim=1), ["a", "b", "c"]
    asked = np.repeat(NONE, 3, axis=0)
    asked[:, :2] = 0.2
    plain = pipeline.sample(photos, ids, seed=0)
    images = pipeline.sample(photos, ids, seed=0, touches=asked)
    assert not np.array_equal(images, plain)
    one = pipeline.sample(photos[1:2], ids[1:2], seed=0, touches=asked[1:2])
    assert np.abs(one[0].astype(int) - images[1]).max() <= 1
    replace(pipeline, encoders=None).save(tmp_path / "model")
    again = TactilePipeline.from_pretrained(tmp_path / "model")
    assert again.contact == pipeline.contact
    assert again.digest == replace(pipeline, encoders=None).digest
    assert np.array_equal(again.sample(photos, ids, seed=0, touches=asked), images)
    with_shear = asked.copy()
    with_shear[:, 4:] = [3.0, 0.0]
    bare = np.broadcast_to(np.full_like(gel, 120), (3, *gel.shape))  # no markers: no shear
    same = (
        pipeline.sample(photos, ids, seed=0, background=bare, touches=t)
        for t in (asked, with_shear)
    )
    assert np.array_equal(*same)


@pytest.mark.parametrize(
    ("asked", "word"),
    [
        ({"at": (1.2, 0.5)}, "on the gel"),
        ({"at": (float("nan"), 0.5)}, "on the gel"),
        ({"strength": 1.01}, "0 to 1"),
        ({"area": 0.0}, "above 0"),
        ({"shear": (12.0, 0.0)}, "within 10 %"),
        ({"strength": 0.5, "depth": 0.2}, "stand alone"),
    ],
)
def test_what_no_gel_can_do_is_refused(asked, word):
    fails(word, Requested, **asked)


def test_generate_takes_what_is_asked(world, code, tmp_path):
    photo, gel = tmp_path / "photo.png", world[0]["background"]
    Image.fromarray(world[0]["vision"]).save(photo)
    Image.fromarray(np.full_like(gel, 120)).save(tmp_path / "bare.png")
    model = make(code, gel)
    made = generate(photo, model=model, at=(0.2, 0.3), depth=0.2, shear=(1.0, 0.0))
    assert made.settings["touch"] == {"at": (0.2, 0.3), "shear": (1.0, 0.0), "depth": 0.2}
    assert made.notes == []
    direct = model(photo, at=(0.2, 0.3), strength=0.5, shear=(1.0, 0.0)).images[0]
    assert np.array_equal(np.asarray(made.images[0]), np.asarray(direct))  # 0.2 mm is 0.5 here
    made = generate(photo, model=model, shear=(1.0, 0.0), gel=tmp_path / "bare.png")
    assert "shear-without-markers" in [note.code for note in made.notes]
    fails("0.1 to 0.3 mm", generate, photo, model=model, depth=0.4)
    fails("training knew none", generate, photo, model=model, force=1.0)
    fails("trained without contacts", generate, photo, model=make(code, gel, False), area=0.3)
    fails("with a video", generate, photo, model=model, profile=tmp_path / "profile.csv")
    fails("one video", generate, photo, model=model, output=tmp_path / "touch.mp4")


HEAD = "time_s,strength,shear_x,shear_y\n"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "empty"),
        (HEAD, "no rows"),
        ("time_s,strength\n0,1\n", "shear_x"),
        (HEAD + "0,0,0,0\n0,1,0,0\n", "time_s 0 in row 2"),
        (HEAD + "0,1.5,0,0\n", "strength 1.5 in row 1"),
        (HEAD + "0,,0,0\n", "strength nan in row 1"),
        (HEAD + "0,soft,0,0\n", "soft"),
        (HEAD + "0,0,0,0\n0.5,1,0,0\n", "ends at 0.50 s"),
    ],
)
def test_profiles_that_are_none_are_refused(tmp_path, text, word):
    (tmp_path / "profile.csv").write_text(text)
    seconds = np.arange(30) / 30
    fails(word, lambda: Profile.load(tmp_path / "profile.csv").at(seconds))


def test_a_profile_makes_a_video_without_flicker(world, code, tmp_path):
    pytest.importorskip("av")
    gel, clip = world[0]["background"], tmp_path / "clip" / "video.mp4"
    clip.parent.mkdir()
    write_video(clip, [world[0]["vision"]] * 10, Fraction(10))
    rows = [(0, 0, 0, 0), (0.2, 0, 0, 0), (0.4, 0.9, 0, 0), (0.7, 0.9, 0, 0), (0.9, 0.9, 2, 0)]
    profile = tmp_path / "profile.csv"
    profile.write_text(HEAD + "".join(",".join(map(str, row)) + "\n" for row in rows))
    model, output = make(code, gel), tmp_path / "touch.mp4"
    fails("gelsight.mp4 beside it", generate, clip, model=model, output=output)
    made = generate(clip, model=model, output=output, profile=profile)
    assert (made.new, made.paths) == (10, [output])
    with VideoReader(output) as reader:
        frames = np.stack([reader[k] for k in range(len(reader))]).astype(float)
        assert reader.seconds[-1] == pytest.approx(0.9)
    change = np.abs(np.diff(frames, axis=0)).mean(axis=(1, 2, 3))
    assert np.abs(frames[:3] - gel).mean() < 4  # nothing touches
    assert change[4:7].max() < 3  # held, up to the codec
    assert change[2:4].max() > 3 * change[4:7].max()  # pressed
    # Its own touches, where they lie beside it, take the place of a profile.
    touches = [gel] * 6 + [np.roll(world[0]["tactile"], 5 * k, 1) for k in range(4)]
    write_video(clip.with_name("gelsight.mp4"), touches, Fraction(10))
    generate(clip, model=model, output=output)
    with VideoReader(output) as reader:
        first, last = (reader[k].astype(float) for k in (2, 8))
    assert np.abs(first - gel).mean() < 4 < np.abs(last - gel).mean()
    output.write_bytes(b"another")
    fails("palpate generated", generate, clip, model=model, output=output)

"""Whole recordings are looked at: what is planted is named, clean data raise no suspicion."""

import os
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from forge.errors import fails
from forge.pictures import write_images
from palpate.cli import main
from palpate.data.importing import import_dataset, validate
from palpate.data.streams import findings
from palpate.data.suspicions import exchanged_sides, looked_at, startup_frames
from palpate.data.video import VideoReader

HEIGHT, WIDTH = 48, 64
Y, X = np.mgrid[:HEIGHT, :WIDTH] / [[[HEIGHT]], [[WIDTH]]]
CLIPS = Path(os.environ.get("PALPATE_SHARED_DATA", "../shared/data")) / "touch_and_go" / "clips"


def rng_of(*key):
    return np.random.default_rng(key)


def photo(recording, k=0):
    """A scene of two colors in stripes of its own, seen a little shifted in each frame."""
    rng = rng_of(1, recording)
    (a, b), waves = rng.uniform(20, 235, (2, 3)), rng.uniform(5, 25, 2)
    mix = 0.5 + 0.5 * np.sin(waves[0] * (X + k / 60) + waves[1] * Y)[..., None]
    return noisy(a * mix + b * (1 - mix), recording, k)


def gel(recording, k=0, press=None, *, base=(150, 120, 90), slope=(60, -40, 80)):
    """A gel under colored lights, pressed at a place of its own, more and more by ``k`` up to 5."""
    press = min(k, 5) if press is None else press
    light = np.array(base) + np.array(slope) * (X + Y - 1)[..., None] / 2
    x, y = rng_of(2, recording).uniform(0.3, 0.7, 2)
    bump = np.exp(-((X - x) ** 2 + (Y - y) ** 2) / 0.01)[..., None]
    return noisy(light + 10 * press * bump * [1, -1, 0.5], recording, k)


def noisy(image, recording, k):
    noise = rng_of(3, recording, k).normal(0, 2, image.shape)
    return (image + noise).clip(0, 255).round().astype(np.uint8)


def sides(r, k):
    return photo(r, k), gel(r, k)


def exchanged(r, k):
    return sides(r, k)[:: -1 if r == 4 else 1]


def bgr_touch(r, k):
    return photo(r, k), gel(r, k)[..., :: -1 if r in (2, 6) else 1]


def other_gel(r, k):
    return photo(r, k), gel(r, k, base=(60, 160, 190)) if r == 5 else gel(r, k)


def green_start(r, k):
    image = gel(r, k)
    return photo(r, k), image * np.array([0, 1, 0], np.uint8) if r == 3 and k == 0 else image


def frozen(r, k):
    return photo(r, 0 if r == 1 else k), gel(r, k)


def two_gels(r, k):
    """As in sets of two rigs: no recording is the odd one."""
    return photo(r, k), gel(r, k, base=(60, 160, 190)) if r % 2 else gel(r, k)


PLANTED = {
    sides: {},
    two_gels: {},
    exchanged: {("4", "exchanged-sides")},
    bgr_touch: {("2", "channel-order"), ("6", "channel-order")},
    other_gel: {("5", "another-gel")},
    green_start: {("3", "startup-frames")},
    frozen: {("1", "frozen-stream")},
}


def planted(problems):
    return {(p.where.rpartition("_")[2], p.kind) for p in problems}


@pytest.mark.parametrize("make", PLANTED)
def test_what_is_planted_in_a_folder_of_pairs_is_named(tmp_path, make):
    for r in range(9):
        for k in range(20):
            for side, image in zip(("photo", "touch"), make(r, k), strict=True):
                path = tmp_path / f"video_{r}" / side / f"{k:04d}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(image).save(path, compress_level=1)
    report = validate(tmp_path)
    assert report.ok
    assert planted(report.suspicious) == set(PLANTED[make])
    assert planted(import_dataset(tmp_path, tmp_path / "out").suspicious) == set(PLANTED[make])


@pytest.mark.parametrize(
    ("photos", "touches", "word"),
    [
        (range(20), range(1, 21), "1 apart"),  # one side is counted from 1
        (range(30), range(15), "other rates"),  # 30 and 15 frames a second
        (range(15), range(25), "other rates"),
        (range(30), range(0, 30, 2), ""),  # one clock
        (range(20), range(20), ""),
        (range(20), [*range(7), *range(9, 20)], ""),  # two frames are lost
        (range(1), range(20), ""),  # one photo of all touches
    ],
)
@pytest.mark.parametrize("form", ["v{v}/{s}/{k:04d}.png", "{s}/v{v}_{k:04d}.png"])
def test_frames_of_other_rates_or_first_numbers_are_named(tmp_path, form, photos, touches, word):
    own = {"photo": photos, "touch": touches}
    names = [form.format(s=s, v=v, k=k) for s in own for v in range(3) for k in own[s]]
    write_images(tmp_path / "own", names)
    said = [p for p in validate(tmp_path / "own").suspicious if p.kind == "other-clock"]
    assert len(said) == 3 * bool(word)
    assert all(word in problem.text for problem in said)
    if word:  # a refusal says it, too
        fails(word, import_dataset, tmp_path / "own", tmp_path / "out")


@pytest.mark.parametrize("make", [sides, exchanged, bgr_touch, other_gel, green_start])
def test_what_is_planted_in_stacks_of_frames_is_named(tmp_path, make):
    for r in range(7):
        pairs = [make(r, k if k < 30 else 60 - k) for k in range(60)]
        (tmp_path / f"video_{r}").mkdir()
        for side, images in zip(("camera", "gelsight"), zip(*pairs, strict=True), strict=True):
            np.save(tmp_path / f"video_{r}" / f"{side}.npy", np.stack(images))
    assert planted(validate(tmp_path).suspicious) == set(PLANTED[make])


def test_sizes_tell_exchanged_sides_apart_where_colors_do_not(tmp_path):
    gray = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    rows = []
    for r in range(5):
        rows.append({"video": str(r), "vision": f"{r}v.png", "tactile": f"{r}t.png"})
        images = [gray.repeat(2, axis=0), gray]
        for side, image in zip("vt", images[:: -1 if r == 2 else 1], strict=True):
            Image.fromarray(image).save(tmp_path / f"{r}{side}.png")
    looks = looked_at(rows, tmp_path, lambda *_, **__: None)
    assert [problem.where for problem in exchanged_sides(looks)] == ["2"]


def test_startup_frames_end_with_a_jump_that_no_later_step_is_like():
    gels = np.stack([gel(0, k) for k in range(40)])
    assert startup_frames(gels) == 0
    green = gels.copy()
    green[:2, ..., [0, 2]] = 0
    assert startup_frames(green) == 2
    dark = gels.copy()
    dark[0] = 0
    assert startup_frames(dark) == 1
    blinking = gels.copy()
    blinking[::2] = blinking[::2] // 2
    assert startup_frames(blinking) == 0
    assert startup_frames(green[:6]) == 0


@pytest.mark.parametrize(("factor", "named"), [(1, False), (0.5, True), (2, True), (25 / 30, True)])
def test_contacts_that_were_counted_at_another_rate_are_named(factor, named):
    pressed = [k % 60 >= 40 and k < 240 for k in range(300)]
    images = np.stack([gel(0, k, 5 * on) for k, on in enumerate(pressed)])
    numbers = {round(k / factor) for k, on in enumerate(pressed) if on}
    found = [text for kind, text in findings({"tactile": images}, {}, numbers)]
    assert len(found) == named
    assert not named or f"{factor:.3g} times" in found[0]


def write_clip(path, images):
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=30, options={"crf": "18"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in images:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        file.mux(stream.encode())


def test_a_camera_that_stands_still_is_named_through_a_codec(tmp_path):
    for r in range(2):
        write_clip(tmp_path / f"{r}" / "camera.mp4", [photo(r, 0)] * 60)
        touch = [gel(r, k, 5 * (20 < k < 40)) for k in range(60)]
        write_clip(tmp_path / f"{r}" / "gelsight.mp4", touch)
    kinds = [p.kind for p in validate(tmp_path).suspicious]
    assert kinds.count("frozen-stream") == 2


def test_startup_frames_of_a_video_are_no_contact(tmp_path):
    touch = np.stack([gel(0, k, 5 * (20 < k < 40)) for k in range(60)])
    touch[:2, ..., [0, 2]] = 0
    np.save(tmp_path / "cup_gelsight.npy", touch)
    np.save(tmp_path / "mug_gelsight.npy", touch)
    imported = import_dataset(tmp_path, tmp_path / "out")
    assert {p.kind for p in imported.suspicious} == {"startup-frames"}
    assert min(imported.manifest.column("frame")) > 5


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_videos_are_read_upright(tmp_path, degrees):
    if not hasattr(av.VideoStream, "set_display_rotation"):
        pytest.skip("this PyAV writes no display matrix")
    image = photo(0)
    with av.open(str(tmp_path / "x.mov"), "w") as file:
        stream = file.add_stream("libx264", rate=30, options={"crf": "5"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.set_display_rotation(degrees)
        for _ in range(12):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        file.mux(stream.encode())
    expect = np.rot90(image, degrees // 90)  # both count counterclockwise
    with VideoReader(tmp_path / "x.mov") as reader:
        assert abs(reader[3].astype(int) - expect).mean() < 8
        assert reader.turned == bool(degrees)
        small = reader.thumbnails()[3]
    small_expect = Image.fromarray(np.ascontiguousarray(expect)).resize((WIDTH, HEIGHT))
    assert abs(small.astype(int) - np.asarray(small_expect)).mean() < 12


@pytest.mark.slow
@pytest.mark.skipif(not CLIPS.is_dir(), reason="no real clips")
def test_real_clips_raise_no_suspicion():
    assert validate(CLIPS).suspicious == []


def test_a_page_shows_what_is_suspicious(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for r in range(5):
        pairs = [exchanged(r, k if k < 30 else 60 - k) for k in range(60)]
        Path(f"set/video_{r}").mkdir(parents=True)
        for side, images in zip(("camera", "gelsight"), zip(*pairs, strict=True), strict=True):
            np.save(f"set/video_{r}/{side}.npy", np.stack(images))
    assert main(["validate", "set", "--page", "check.html"]) == 0
    assert "its sides are exchanged" in capsys.readouterr().out
    page = Path("check.html").read_text(encoding="utf-8")
    assert "exchanged-sides" in page
    assert page.count("data:image/") == 2
    with Image.open("check/4-vision.png") as shown:
        assert abs(np.asarray(shown).astype(int) - gel(4, 0)).mean() < 3


def test_a_summary_says_how_images_were_read(tmp_path):
    for side in ("photo", "touch"):
        for k in range(3):
            path = tmp_path / "set" / "cup" / side / f"{k}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            deep = (gel(0, k)[..., 0].astype(np.uint16) * 257) if side == "touch" else photo(0, k)
            Image.fromarray(deep).save(path)
    words = "16-bit gray with 65535 as white (3)"
    assert words in str(validate(tmp_path / "set"))
    assert words in str(import_dataset(tmp_path / "set", tmp_path / "out"))

"""Photo-scanned surfaces: true scale, heights of maps and normals, and what is refused."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from forge.commands import call, mistake
from forge.errors import fails
from palpate.sim import Video, WorldOptions
from palpate.sim.plan import ObjectRef, VideoPlan
from palpate.sim.scans import integrated, read_scans, scan_notes
from palpate.sim.video import make_object

N = 64
HEADER = "name,class,width_mm,width_mm_guess\n"


def waves():
    """Height (n, n) in pixels, periodic, two waves."""
    at = 2 * np.pi * np.arange(N) / N
    return 2 * np.sin(3 * at[:, None] + 2 * at) + 1.5 * np.cos(2 * at)


def normals(height, up):
    """Bytes of the normals of a periodic height; green is up (1) or down (-1)."""
    down, right = ((np.roll(height, -1, k) - np.roll(height, 1, k)) / 2 for k in (0, 1))
    n = np.dstack([-right, up * down, np.ones_like(height)])
    n /= np.linalg.norm(n, axis=2, keepdims=True)
    return np.uint8(np.round((n + 1) * 127.5))


def scan(folder, name="brick001", kind="brick", widths="512,", relief="height", size=(N, N)):
    """Write a scan and its row."""
    at = folder / kind.replace(" ", "_") / name
    at.mkdir(parents=True)
    rng = np.random.default_rng(len(list(folder.rglob("*.jpg"))))
    Image.fromarray(rng.integers(0, 255, (*size[::-1], 3), dtype=np.uint8)).save(at / "color.jpg")
    height = waves()
    if relief == "normal":
        Image.fromarray(normals(height, 1)).save(at / "normal.png")
    else:
        deep = np.uint16((height - height.min()) / np.ptp(height) * 65535)
        Image.fromarray(deep[: size[1], : size[0]]).save(at / "height.png")
    table = folder / "surfaces.csv"
    table.write_text(
        (table.read_text() if table.exists() else HEADER) + f"{name},{kind},{widths}\n"
    )
    read_scans.cache_clear()
    return at


@pytest.mark.parametrize("up", [1, -1], ids=["green up", "green down"])
def test_heights_of_normals(up):
    height = integrated(np.float32(normals(waves(), up)) / 127.5 - 1)
    wanted = waves() - waves().mean()
    # central differences of a wave of k periods are sin(k) / k of its slope
    assert np.abs(height - wanted).max() < 0.06 * np.ptp(wanted)


def test_what_a_folder_says(tmp_path):
    scan(tmp_path)
    scan(tmp_path, "grey", "leaf litter", ",20", relief="normal")
    scan(tmp_path, "coarse", "Wood", ",900")
    first, second, third = read_scans(tmp_path)
    assert (first.material, first.width_mm, first.guessed, first.relief_mm) == (
        "Brick",
        512,
        False,
        8,
    )
    assert (second.material, second.px, second.guessed) == ("Soil", 20 / N, True)
    assert third.material == "Wood"
    color, height, side = first.read(128)
    assert (color.shape, height.shape, side) == ((128, 128, 3), (128, 128), 512)
    assert np.ptp(height) == pytest.approx(8, rel=0.1)
    assert np.ptp(second.read(N)[1]) == pytest.approx(np.ptp(waves()) * 20 / N, rel=0.1)
    guesses, pixels = scan_notes([first, second, third])
    assert guesses == "Widths of 2 of 3 surfaces are guesses: grey, coarse."
    assert "below 1 pixel per mm" in pixels
    assert "brick001 (0.12), coarse (0.071)" in pixels
    assert "grey" not in pixels


def test_a_strip_is_repeated_to_a_square(tmp_path):
    scan(tmp_path, widths="256,", size=(N, N // 2))
    color, _, side = read_scans(tmp_path)[0].read(N)
    assert side == 256
    assert np.array_equal(color[: N // 2], color[N // 2 :])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"widths": ","}, "brick001 must have its width in mm in surfaces.csv"),
        ({"widths": "wide,"}, "width_mm of brick001 must be a number of mm above 0. Got 'wide'"),
        ({"kind": "cheese"}, "The class of brick001 must be a material, or one of brick, paving"),
        ({"size": (N, N // 2)}, "must be as large as color.jpg, 64 x 32 pixels. Got 64 x 64"),
        ({"name": "../../other"}, "must lie in its folder. Got '../../other'"),
        ({"relief": "none"}, "must hold one of height.jpg, height.png, normal.jpg, normal.png"),
    ],
)
def test_what_is_refused(tmp_path, change, words):
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    at = scan(folder, **change)
    if "size" in change:
        Image.fromarray(np.zeros((N, N), np.uint8)).save(at / "height.png")
    if "relief" in change:
        (at / "height.png").unlink()
    fails(words, WorldOptions, scale="real", surfaces=str(folder))


def test_near_worlds_and_absent_folders_are_refused(tmp_path):
    fails("`scale` must be real for scanned surfaces", WorldOptions, surfaces=str(tmp_path))
    fails("no file", WorldOptions, scale="real", surfaces=str(tmp_path))


def test_each_scan_is_one_object_and_the_world_knows_their_bytes(tmp_path):
    folder = tmp_path / "scans"
    for name in ("one", "two"):
        at = scan(folder, name)
    options = WorldOptions(
        scale="real", surfaces=str(folder), materials=("Brick",), tile=64, size=16
    )
    grounds = [make_object(options, ObjectRef("Brick", k)).ground for k in range(8)]
    named = [ground.subtype for ground in grounds if ground.subtype in {"one", "two"}]
    assert sorted(named) == ["one", "two"]
    assert [g.side_mm for g in grounds] == [512.0] * 8
    moved = tmp_path / "moved"
    shutil.copytree(folder, moved)
    other = WorldOptions(**{**vars(options), "surfaces": str(moved)})
    assert other.digest == options.digest
    (at / "color.jpg").write_bytes((moved / "brick/one/color.jpg").read_bytes())
    assert other.digest != options.digest


def test_the_photo_is_the_scan_at_its_scale(tmp_path):
    """A view is never wider than the scan, which does not repeat in it."""
    scan(tmp_path, widths="100,")
    options = WorldOptions(scale="real", surfaces=str(tmp_path), tile=64, size=32, hard=0.0)
    video = Video(options, VideoPlan(0, "v", 0, (ObjectRef("Brick", 1),), (0, 0, 0, 0)))
    assert video.surface(0).ground.side_mm == 100 < video.camera.view
    assert video.vision(6).std() > 3


def test_the_command_says_what_is_guessed(tmp_path, capsys):
    scan(tmp_path / "scans", "grey", "wood", ",900")
    folder, where = tmp_path / "world", str(tmp_path / "scans")
    arguments = ("--preset", "tiny", "--surfaces", where, "--size", "16")
    arguments += ("--workers", "1", "--materials", "Wood", "--set", "tile=64", "test=.5")
    code, _, output = call(capsys, "world", "-o", str(folder), *arguments)
    assert code == 0
    assert "Widths of 1 of 1 surfaces are guesses: grey." in output
    assert "below 1 pixel per mm" in output
    record = json.loads((folder / "world.json").read_text())
    assert record["options"]["scale"] == "real"
    assert record["surfaces"][0].startswith("Widths of 1 of 1")
    near = ("-o", str(tmp_path / "near"), "--scale", "near", "--surfaces", where)
    mistake(capsys, "--scale must be real for scanned surfaces", "world", *near)

"""Images: read by fixed rules, bad files named, the array cache."""

import base64
import importlib.util
import io
import os

import numpy as np
import pytest
from PIL import Image, features

import palpate.data.images as images
from forge.commands import python
from forge.errors import fails
from forge.pictures import number, tree, write_image
from palpate.data.images import (
    cached_images,
    check_image,
    image_size,
    in_threads,
    load_images,
    read_image,
    square,
)
from palpate.data.manifest import Manifest

RNG = np.random.default_rng(0)


COLOR = np.tile(np.array([[[200, 30, 40], [20, 60, 210]]], np.uint8), (16, 1, 1))
#: 32 x 16 pixels, the left half (200, 30, 40), the right half (20, 60, 210); written by libheif.
HEIC = """
AAAAHGZ0eXBoZWljAAAAAG1pZjFoZWljbWlhZgAAAXxtZXRhAAAAAAAAACFoZGxyAAAAAAAAAABwaWN0AAAAAAAAAAAAAAAAAAAA
ACJpbG9jAAAAAERAAAEAAQAAAAABoAABAAAAAAAAAMYAAAAjaWluZgAAAAAAAQAAABVpbmZlAgAAAAABAABodmMxAAAAAA5waXRt
AAAAAAABAAAA/GlwcnAAAADcaXBjbwAAAHVodmNDAQNwAAAAkAAAAAAAHvAA/P34+AAADwNgAAEAGEABDAH//wNwAAADAJAAAAMA
AAMAHroCQGEAAQApQgEBA3AAAAMAkAAAAwAAAwAeoCCBBZbqrprm4CGgwIAAAAyAAAADAIRiAAEABkQBwXPBiQAAABNjb2xybmNs
eAABAA0ABoAAAAAUaXNwZQAAAAAAAABAAAAAQAAAAChjbGFwAAAAIAAAAAEAAAAQAAAAAf///+AAAAAC////0AAAAAIAAAAQcGl4
aQAAAAADCAgIAAAAGGlwbWEAAAAAAAAAAQABBYECAwWEAAAAzm1kYXQAAADCKAGvBPIZ/XKAcWTS3/xK///+cGOy/aXt8MD8kKH3
8lxH/+yR9EYyN+gtYXlrih7Pi2JPs+w42CbfWk1elRZan1mE7+TolM+vFWIpRvCHPL6uOmJGnvrPS+PeRt4g3kRHAcN6hxaHquTQ
ESoqNpfhTKAR9DrgGUzgo3Qgx1yaz1IcijoJIguvFNqp1KlCr263fEAAljCyQl0ARxdJzBedT4U2SWTtIeLjT1v/JC4iPygMxetY
bGInOOOwht3SrTkEwDc="""


def palette():
    image = Image.new("P", (2, 1))
    image.putpalette([1, 2, 3, 250, 251, 252])
    image.putpixel((1, 0), 1)
    return image


def gray16(*values):
    return np.array([values], np.uint16)


def tiff(pixels, **options):
    """A TIFF by another library than the one that reads it."""
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(data := io.BytesIO(), pixels, **options)
    return data.getvalue()


def image_file(image, form, **options):
    image = image if isinstance(image, Image.Image) else Image.fromarray(image)
    image.save(data := io.BytesIO(), form, **options)
    return data.getvalue()


def turned(orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    return exif


RGBA = np.array([[[10, 20, 30, 255], [10, 20, 30, 0], [0, 0, 0, 51]]], np.uint8)
CMYK = Image.new("CMYK", (1, 1), (10, 20, 30, 40))
WHITE_16 = "16-bit gray with 65535 as white"
DEEP = gray16(0, 257, 65535, 128, 129)


@pytest.mark.parametrize(
    ("content", "row", "taken"),
    [
        (lambda: image_file(DEEP, "PNG"), (0, 1, 255, 0, 1), [WHITE_16]),
        (lambda: image_file(DEEP, "TIFF"), (0, 1, 255, 0, 1), [WHITE_16]),
        (lambda: tiff(DEEP, photometric="miniswhite"), (255, 254, 0, 255, 254), [WHITE_16]),
        (lambda: tiff(DEEP.astype(np.uint32)), (0, 1, 255, 0, 1), [WHITE_16]),
        (lambda: b"P5 2 1 4095 " + np.array([0, 4095], ">u2").tobytes(), (0, 255), [WHITE_16]),
        (
            lambda: tiff(np.stack([DEEP] * 3, axis=-1), photometric="rgb"),
            (0, 1, 255, 0, 0),  # the upper eight bits
            ["16-bit color with 65535 as white"],
        ),
        (
            lambda: image_file(RGBA, "PNG"),
            ((10, 20, 30), (255, 255, 255), (204, 204, 204)),
            ["transparency laid over white"],
        ),
        (lambda: image_file(np.array([[7, 200]], np.uint8), "PNG"), (7, 200), []),
        (lambda: image_file(palette(), "PNG"), ((1, 2, 3), (250, 251, 252)), []),
        (lambda: image_file(CMYK, "TIFF"), ((207, 198, 190),), ["CMYK without its color profile"]),
        (
            lambda: image_file(
                palette(), "GIF", save_all=True, append_images=[Image.new("P", (2, 1))]
            ),
            ((1, 2, 3), (250, 251, 252)),
            ["the first of several images"],
        ),
        (
            lambda: image_file(COLOR[:1].transpose(1, 0, 2), "PNG", exif=turned(8)),
            ((200, 30, 40), (20, 60, 210)),
            ["turned upright by EXIF"],
        ),
        (lambda: image_file(COLOR[:1], "PNG", exif=turned(99)), ((200, 30, 40), (20, 60, 210)), []),
    ],
)
def test_every_kind_of_pixels_becomes_rgb_and_is_stated(tmp_path, content, row, taken):
    (path := tmp_path / "x.jpg").write_bytes(content())  # its name says nothing
    rows = [[k] * 3 if isinstance(k, int) else list(k) for k in row]
    assert np.asarray(read_image(path)).tolist() == [rows]
    checked = check_image(path)
    assert (checked.problem, checked.taken) == (None, taken)
    assert image_size(path) == (len(rows), 1)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (lambda: image_file(np.ones((2, 2), np.float32), "TIFF"), "floating-point"),
        (lambda: tiff(np.ones((2, 2), np.float64)), "not an image that can be read"),
        (lambda: image_file(gray16(0, 4095), "PNG"), "up to 4095 of 65535"),
        (lambda: image_file(gray16(0, 4095), "TIFF"), "up to 4095 of 65535"),
        (lambda: image_file(gray16(3, 200), "PNG"), "up to 200 of 65535"),
        (lambda: tiff(np.full((2, 2, 3), 4095, np.uint16), photometric="rgb"), "4095 of 65535"),
        (lambda: tiff(np.full((2, 2), -5, np.int16)), "from -5 to -5"),
        (lambda: image_file(np.full((2, 2), 70_000, np.int32), "TIFF"), "70000"),
        (lambda: image_file(Image.new("RGB", (4, 4)), "EPS"), "not an image that can be read"),
        (lambda: image_file(Image.new("RGB", (4, 4)), "TGA"), "not an image that can be read"),
        (lambda: image_file(Image.new("1", (8000, 7000)), "PNG"), "8000 x 7000 pixels, more than"),
        (lambda: b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "not an image"),
    ],
)
def test_what_has_no_right_reading_is_refused_with_the_reason(tmp_path, content, words):
    (path := tmp_path / "x.png").write_bytes(content())
    assert words in check_image(path).problem
    assert words in check_image(io.BytesIO(content())).problem
    fails(words, read_image, path)
    fails(words, load_images, [path], 8)


def test_photos_of_phones_are_read_or_name_the_package(tmp_path):
    (path := tmp_path / "x.heic").write_bytes(base64.b64decode(HEIC))
    readable = any(importlib.util.find_spec(name) for name in ("pi_heif", "pillow_heif"))
    assert ("pip install pi-heif" in (check_image(path).problem or "")) is not readable
    if readable:
        colors = np.asarray(read_image(path)).astype(int)[8, [4, 28]]
        assert abs(colors - COLOR[0]).max() < 4
    if features.check("avif"):
        wide = COLOR.repeat(16, axis=1)
        (path := tmp_path / "x.avif").write_bytes(image_file(wide, "AVIF", exif=turned(6)))
        assert image_size(path) == (16, 32)
        assert abs(np.asarray(read_image(path)).astype(int)[[4, 28], 8] - COLOR[0]).max() < 8


def test_an_image_on_a_full_disk_is_an_error_and_leaves_nothing(tmp_path):
    """Pillow does not notice that a file was written in part."""
    python(f"""
import errno, resource, numpy as np
from pathlib import Path
from palpate.core import save_image
noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
resource.setrlimit(resource.RLIMIT_FSIZE, (1024, resource.RLIM_INFINITY))
try:
    save_image(Path({str(tmp_path / "x.jpg")!r}), noise, "JPEG")
except OSError as error:
    assert error.errno == errno.EFBIG
else:
    raise AssertionError
""")
    assert tree(tmp_path) == set()


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_cut_empty_foreign_and_missing_files_are_rejected_by_name(tmp_path, suffix):
    noise = RNG.integers(0, 255, (120, 160, 3), np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noise).save(buffer, format={"jpg": "JPEG", "png": "PNG"}[suffix])
    data = buffer.getvalue()
    good = tmp_path / f"good.{suffix}"
    good.write_bytes(data)
    assert check_image(good).problem is None
    assert check_image(good, "header").problem is None
    contents = {"half": data[: len(data) // 2], "most": data[:-200], "empty": b"", "text": b"no"}
    for name, content in contents.items():
        bad = tmp_path / f"{name}.{suffix}"
        bad.write_bytes(content)
        assert check_image(bad).problem, name
        fails(f"{name}.{suffix}", read_image, bad)
    assert check_image(tmp_path / f"half.{suffix}", "header").problem is None
    assert check_image(tmp_path / f"none.{suffix}").problem == "no such file"
    assert check_image(tmp_path / f"none.{suffix}", "none").problem == "no such file"
    assert "0 bytes" in check_image(tmp_path / f"empty.{suffix}", "header").problem


def test_center_square_is_antialiased():
    wide = np.zeros((40, 100, 3), np.uint8)
    wide[:, 30:70] = 200  # exactly the center square
    assert (square(Image.fromarray(wide), 8) == 200).all()
    checks = (np.indices((64, 64)).sum(0) % 2 * 255).astype(np.uint8)
    small = square(Image.fromarray(checks).convert("RGB"), 8)
    # A filter without antialiasing would give 0 or 255.
    assert abs(small.astype(int) - 127).max() <= 3


def test_load_keeps_order_decodes_doubles_once_and_names_all_bad_files(tmp_path, monkeypatch):
    paths = [write_image(tmp_path / f"{k}.jpg", k) for k in range(30)]
    seen = []
    original = images.read_image
    monkeypatch.setattr(images, "read_image", lambda p: (seen.append(p), original(p))[1])
    steps = []
    out = load_images([*paths, paths[3], paths[3]], 64, progress=lambda *a: steps.append(a[:3]))
    assert out.shape == (32, 64, 64, 3)
    assert out.dtype == np.uint8
    assert [number(a) for a in out] == [*range(30), 3, 3]
    assert sorted(seen) == sorted(paths)
    assert steps[-1] == ("decoding images", 30, 30)
    paths[5].write_bytes(b"")
    paths[9].unlink()
    error = fails("", load_images, paths, 32)
    assert [p.where for p in error.problems] == [str(paths[5]), str(paths[9])]


def test_cache_is_mapped_reused_and_renewed_when_a_file_changes(tmp_path):
    for k in range(4):
        write_image(tmp_path / "d" / f"{k}.png", k)
    rows = [{"id": str(k), "tactile": f"d/{k}.png", "background": "d/0.png"} for k in range(4)]
    manifest, cache = Manifest.from_rows(rows, tmp_path), tmp_path / "cache"
    first = cached_images(manifest, "tactile", 16, cache)
    assert isinstance(first, np.memmap)
    assert not first.flags.writeable
    assert [number(a) for a in cached_images(manifest, "tactile", 64, cache)] == [0, 1, 2, 3]
    first = np.array(first)
    assert np.array_equal(first, cached_images(manifest, "tactile", 16))
    assert [number(a) for a in cached_images(manifest, "background", 64, cache)] == [0] * 4
    assert len(tree(cache)) == 2 * 3  # each with its digest
    file = next(cache.glob("tactile-16-*.npy"))
    stamp = file.stat().st_mtime_ns
    cached_images(manifest, "tactile", 16, cache)
    assert file.stat().st_mtime_ns == stamp
    whole = file.read_bytes()
    for damaged in (whole[:200], whole[:10] + b"{(((" + whole[14:], whole[:10] + b"0" + whole[11:]):
        file.write_bytes(damaged)
        assert np.array_equal(cached_images(manifest, "tactile", 16, cache), first)
    write_image(tmp_path / "d" / "1.png", 9)
    os.utime(tmp_path / "d" / "1.png", ns=(1, 1))
    assert number(cached_images(manifest, "tactile", 64, cache)[1]) == 9
    (tmp_path / "d" / "2.png").write_bytes(b"")
    before = tree(cache)
    fails("", cached_images, manifest, "tactile", 64, cache)
    assert tree(cache) == before


def test_in_threads_gives_every_result_and_stops_at_an_error():
    squares = in_threads(lambda k: k * k, range(100), threads=3)
    assert sorted(squares) == [(k, k * k) for k in range(100)]
    ran = []

    def fail(k):
        ran.append(k)
        if k == 3:
            raise RuntimeError
        return k

    with pytest.raises(RuntimeError):
        list(in_threads(fail, range(10_000), threads=2))
    assert len(ran) < 100

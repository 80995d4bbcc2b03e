"""Images: read by fixed rules, bad files named, the array cache."""

import io
import os

import numpy as np
import pytest
from PIL import Image

import palpate.data.images as images
from forge.errors import fails
from forge.pictures import number, tree, write_image
from palpate.data.images import (
    cached_images,
    check_image,
    in_threads,
    load_images,
    read_image,
    square,
)
from palpate.data.manifest import Manifest

RNG = np.random.default_rng(0)


def test_every_mode_becomes_rgb(tmp_path):
    palette = Image.new("P", (2, 1))
    palette.putpalette([1, 2, 3, 250, 251, 252])
    palette.putpixel((1, 0), 1)
    rgba = np.array([[[10, 20, 30, 255], [10, 20, 30, 0], [0, 0, 0, 51]]], np.uint8)
    gray16 = np.array([[0, 257, 65535, 128, 129]], np.uint16)
    cases = [
        (Image.fromarray(gray16), [[k] * 3 for k in (0, 1, 255, 0, 1)]),
        (Image.fromarray(rgba), [[10, 20, 30], [255, 255, 255], [204, 204, 204]]),
        (Image.fromarray(np.array([[7, 200]], np.uint8)), [[7] * 3, [200] * 3]),
        (palette, [[1, 2, 3], [250, 251, 252]]),
    ]
    for image, row in cases:
        image.save(tmp_path / "x.png")
        assert np.asarray(read_image(tmp_path / "x.png")).tolist() == [row], image.mode
    Image.fromarray(np.ones((2, 2), np.float32)).save(tmp_path / "f.tif")
    fails("floating-point", read_image, tmp_path / "f.tif")


def test_exif_orientation_is_applied(tmp_path):
    image = Image.fromarray(np.array([[[255, 0, 0], [0, 0, 255]]], np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 6  # stored on its side: turn clockwise
    image.save(tmp_path / "x.png", exif=exif)
    assert np.asarray(read_image(tmp_path / "x.png")).tolist() == [[[255, 0, 0]], [[0, 0, 255]]]


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_cut_empty_foreign_and_missing_files_are_rejected_by_name(tmp_path, suffix):
    noise = RNG.integers(0, 255, (120, 160, 3), np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noise).save(buffer, format={"jpg": "JPEG", "png": "PNG"}[suffix])
    data = buffer.getvalue()
    good = tmp_path / f"good.{suffix}"
    good.write_bytes(data)
    assert check_image(good) is None
    assert check_image(good, "header") is None
    contents = {"half": data[: len(data) // 2], "most": data[:-200], "empty": b"", "text": b"no"}
    for name, content in contents.items():
        bad = tmp_path / f"{name}.{suffix}"
        bad.write_bytes(content)
        assert check_image(bad), name
        fails(f"{name}.{suffix}", read_image, bad)
    assert check_image(tmp_path / f"half.{suffix}", "header") is None
    assert check_image(tmp_path / f"none.{suffix}") == "no such file"
    assert check_image(tmp_path / f"none.{suffix}", "none") == "no such file"
    assert "0 bytes" in (check_image(tmp_path / f"empty.{suffix}", "header") or "")


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
    assert len(tree(cache)) == 3
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

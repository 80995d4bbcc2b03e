"""What a user's machine, files and materials can get wrong: each told in one message, and nothing half-written is left."""

import dataclasses
import errno
import json
import os
import pickle
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from palpate.cli import main
from palpate.core import PalpateError, ProblemsError, digest_folder
from palpate.sim import (
    MATERIALS,
    MINI_SEEDS,
    PRESETS,
    VERSION,
    Material,
    Surface,
    World,
    WorldOptions,
    load_options,
    save_options,
    write_world,
)

TINY = dataclasses.replace(PRESETS["tiny"], size=16, tile=64)


def no_number(tile, rng):
    return Surface(
        tile.zeros() * np.nan, np.ones((tile.n, tile.n, 3), np.float32), "only", ("odd", "new")
    )


def wrong_shape(tile, rng):
    return Surface(
        tile.zeros()[1:], np.ones((tile.n, tile.n, 3), np.float32), "only", ("odd", "new")
    )


def left_behind(folder):
    """Hidden files and folders but for the unfinished worlds and their state."""
    return [p for p in folder.rglob(".*") if p.name != ".work" and not p.name.endswith(".part")]


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("draw", "word"), [(no_number, "finite height"), (wrong_shape, "height of shape (64, 64)")]
)
def test_a_broken_material_is_one_line_of_the_command(
    draw, word, workers, tmp_path, monkeypatch, capsys
):
    monkeypatch.setitem(MATERIALS, "Cork", Material(20, "cork", draw, ("only",)))
    out = tmp_path / "w"
    args = [
        "world",
        "-o",
        str(out),
        "--preset",
        "tiny",
        "--size",
        "16",
        "--tile",
        "64",
        "--materials",
        "Wood",
        "Cork",
        "--workers",
        str(workers),
    ]
    assert main(args) == 2
    said = capsys.readouterr().err
    (line,) = (line for line in said.splitlines() if line.startswith("palpate world:"))
    assert f"'Cork' must return a {word}" in line
    assert draw.__name__ in line
    assert "Traceback" not in said
    assert not out.exists()
    assert not left_behind(tmp_path)
    monkeypatch.setitem(
        MATERIALS, "Cork", Material(20, "cork", MATERIALS["Wood"].draw, MATERIALS["Wood"].subtypes)
    )
    assert main([*args, "--quiet"]) == 0  # mended, the same call goes on


@pytest.mark.parametrize("layout", ["frames", "hct", "raw"])
@pytest.mark.parametrize("step", [1, 5, 40])
def test_a_full_disk_is_told_and_a_rerun_gives_the_same_bytes(layout, step, tmp_path, monkeypatch):
    options = dataclasses.replace(TINY, layout=layout)
    write_world(tmp_path / "whole", options)
    name = {"frames": "write_jpeg", "hct": "write_jpeg", "raw": "write_json"}[layout]
    place = f"palpate.sim.trees.{name}"
    import palpate.sim.trees as trees

    real, count = getattr(trees, name), iter(range(10**6))
    step = min(step, 6) if layout == "raw" else step

    def full(path, value):
        if next(count) != step:
            return real(path, value)
        if name == "write_jpeg":
            path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(place, full)
        with pytest.raises(PalpateError) as error:
            write_world(tmp_path / "w", options)
    assert "must have room for the world" in error.value.must
    assert error.value.got == "No space left on device"
    assert "run the same command again" in error.value.fix
    assert not (tmp_path / "w").exists()
    assert not left_behind(tmp_path)
    write_world(tmp_path / "w", options)
    assert digest_folder(tmp_path / "w") == digest_folder(tmp_path / "whole")


def test_arrays_take_their_space_before_anything_is_rendered(tmp_path, monkeypatch):
    def full(file, start, size):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("os.posix_fallocate", full)
    with pytest.raises(PalpateError, match="must have room"):
        write_world(
            tmp_path / "w",
            dataclasses.replace(TINY, layout="raw"),
            progress=lambda *_: pytest.fail("rendered"),
        )
    assert not list(tmp_path.rglob("*.npy"))
    assert not left_behind(tmp_path)


def test_arrays_are_filled_where_space_cannot_be_reserved(tmp_path, monkeypatch):
    write_world(tmp_path / "a", dataclasses.replace(TINY, layout="raw"))
    monkeypatch.delattr("os.posix_fallocate")
    write_world(tmp_path / "b", dataclasses.replace(TINY, layout="raw"))
    assert digest_folder(tmp_path / "a") == digest_folder(tmp_path / "b")


def limited():
    resource.setrlimit(resource.RLIMIT_FSIZE, (600, 600))


def test_a_limit_on_file_sizes_is_told_as_a_full_disk(tmp_path):
    command = [
        sys.executable,
        "-m",
        "palpate",
        "world",
        "-o",
        str(tmp_path / "w"),
        "--preset",
        "tiny",
        "--size",
        "64",
        "--tile",
        "64",
        "-q",
    ]
    done = subprocess.run(
        [*command, "--workers", "1"],
        preexec_fn=limited,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "must have room for the world. Got File too large" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "w").exists()
    assert not left_behind(tmp_path)


def test_a_disk_that_is_full_by_the_manifest_is_told_and_a_rerun_goes_on(
    tmp_path, monkeypatch, capsys
):
    size = ["--size", "16", "--tile", "64", "--workers", "1", "-q"]
    args = ["world", "--preset", "tiny", *size, "-o"]
    real = Path.write_bytes

    def full(path, data):
        if "manifest.parquet" in path.name:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        assert main([*args, str(tmp_path / "w")]) == 2
    said = capsys.readouterr().err
    assert (
        f"The disk of {tmp_path} must have room for the world. Got No space left on device" in said
    )
    assert "Traceback" not in said
    assert not (tmp_path / "w").exists()
    assert not left_behind(tmp_path)
    assert main([*args, str(tmp_path / "w")]) == 0
    assert main([*args, str(tmp_path / "whole")]) == 0
    assert digest_folder(tmp_path / "w") == digest_folder(tmp_path / "whole")


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 256 KB and a function that makes it large; only where one may be mounted."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = lambda *options: (
        subprocess.run(["mount", *options, str(place)], capture_output=True, check=False).returncode
    )
    try:
        mounted = mount("-t", "tmpfs", "-o", "size=256k", "tmpfs") == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip("no rights to mount a small file system")
    yield place, lambda: mount("-o", "remount,size=20m")
    subprocess.run(["umount", str(place)], check=False)


@pytest.mark.parametrize("layout", ["frames", "raw", "hct", "videos"])
def test_a_disk_that_is_really_full(layout, small_disk, tmp_path):
    pytest.importorskip("av")
    place, enlarge = small_disk
    options = dataclasses.replace(TINY, layout=layout, size=64, objects_per_material=4)
    with pytest.raises(PalpateError, match=r"must have room for the world\. Got No space left"):
        write_world(place / "w", options)
    assert not (place / "w").exists()
    assert not left_behind(place)
    assert enlarge() == 0
    write_world(place / "w", options)
    write_world(tmp_path / "whole", options)
    assert digest_folder(place / "w") == digest_folder(tmp_path / "whole")


def test_a_folder_that_must_not_be_written_is_told(tmp_path, monkeypatch):
    def refused(path, image):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr("palpate.sim.trees.write_jpeg", refused)
    with pytest.raises(PalpateError, match=r"must be writable\. Got Permission denied"):
        write_world(tmp_path / "w", TINY)


def changed(path, **keys):
    data = json.loads(path.read_text())
    data.update(keys)
    path.write_text(json.dumps(data))


@pytest.mark.parametrize("version", [VERSION - 1, VERSION + 1, None])
def test_a_world_of_another_version_is_refused(version, tmp_path):
    write_world(tmp_path / "w", TINY)
    changed(tmp_path / "w" / "world.json", version=version)
    for call in (lambda: write_world(tmp_path / "w", TINY), lambda: load_options(tmp_path / "w")):
        with pytest.raises(
            PalpateError, match=f"must be of version {VERSION} of the world.*digests would lie"
        ):
            call()


def test_a_world_of_another_format_is_not_called_one_of_other_options(tmp_path):
    write_world(tmp_path / "w", TINY)
    changed(tmp_path / "w" / "world.json", format="palpate-world/3")
    with pytest.raises(
        PalpateError,
        match=r"must hold a world of the format palpate-world/2\. Got 'palpate-world/3'",
    ):
        write_world(tmp_path / "w", TINY)
    with pytest.raises(PalpateError, match="Got 'palpate-world/3'"):
        load_options(tmp_path / "w")
    changed(tmp_path / "w" / "world.json", format="palpate-world/2")
    with pytest.raises(PalpateError, match="a world of other options"):
        write_world(tmp_path / "w", dataclasses.replace(TINY, hard=0.25))


def test_an_unfinished_world_of_another_version_is_refused_by_name(tmp_path):
    def stop(what, done, total, remark=""):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_world(tmp_path / "w", TINY, progress=stop)
    (part,) = tmp_path.glob(".w.*.part")
    old = part.rename(tmp_path / ".w.0123456789ab.part")
    write_world(tmp_path / "x", TINY)  # another name is no business of it
    changed(old / ".work" / "state.json", version=VERSION - 1)
    with pytest.raises(PalpateError, match=r"\.w\.0123456789ab\.part.*Got version"):
        write_world(tmp_path / "w", TINY)
    (old / ".work" / "state.json").unlink()
    (old / "dataset").mkdir()  # as the first version left them
    with pytest.raises(PalpateError, match="Got no version"):
        write_world(tmp_path / "w", TINY)


def test_options_survive_a_file_and_repeat_a_world(tmp_path):
    options = WorldOptions(
        seed=5,
        view_mm=(31, 40),
        slide_mm=(1,),
        materials=3,
        layout="hct",
        size=16,
        tile=64,
        objects_per_material=2,
    )
    save_options(options, tmp_path / "o.json")
    assert load_options(tmp_path / "o.json") == options
    write_world(tmp_path / "w", options)
    assert load_options(tmp_path / "w") == load_options(tmp_path / "w" / "world.json") == options
    changed(tmp_path / "o.json", options={"seed": 5}, options_digest=WorldOptions(seed=5).digest)
    assert load_options(tmp_path / "o.json") == WorldOptions(seed=5)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"options": {"sed": 5}}, "Did you mean 'seed'"),
        ({"options": {"qqqq": 5}}, "Known: seed, size"),
        ({"options": {"seed": 6}}, "digest in .* must match"),
        ({"options": [1]}, "must be a world.json"),
        ({"format": "palpate-split/1"}, "must be a world.json.*Got 'palpate-split/1'"),
        (
            {"format": "palpate-world-options/9"},
            "have the format palpate-world-options/1.*Got 'palpate-world-options/9'",
        ),
        ({"format": "palpate-world/3"}, "format palpate-world/2.*Got 'palpate-world/3'"),
        ({"format": "palpate-world/3", "version": VERSION + 1}, f"must be of version {VERSION}"),
        ({"options": {"size": 5}}, "size must be a whole number"),
        ({"options": {"view_mm": [40, 30]}}, "lower end first"),
    ],
)
def test_files_that_are_no_options_are_refused(keys, message, tmp_path):
    save_options(WorldOptions(seed=5), tmp_path / "o.json")
    changed(tmp_path / "o.json", **keys)
    with pytest.raises(PalpateError, match=message):
        load_options(tmp_path / "o.json")


def test_options_that_are_not_there_or_no_json_are_refused(tmp_path):
    with pytest.raises(PalpateError, match="must exist"):
        load_options(tmp_path / "o.json")
    (tmp_path / "o.json").write_text("{")
    with pytest.raises(PalpateError, match="must be JSON"):
        load_options(tmp_path / "o.json")
    (tmp_path / "o.json").write_text("[]")
    with pytest.raises(PalpateError, match="Got something else"):
        load_options(tmp_path / "o.json")
    save_options(WorldOptions(), tmp_path / "o.json")
    changed(tmp_path / "o.json", options={"size": 5, "hard": 7.0})
    with pytest.raises(ProblemsError, match="Every option of the world must lie in its range"):
        load_options(tmp_path / "o.json")


def test_a_world_of_the_shipped_models_says_so(tmp_path, capsys):
    args = [
        "world",
        "-o",
        str(tmp_path / "w"),
        "--preset",
        "tiny",
        "--seed",
        str(MINI_SEEDS[3]),
        "--size",
        "16",
        "--tile",
        "64",
        "--workers",
        "1",
    ]
    assert main(args) == 0
    said = capsys.readouterr()
    assert "shipped mini models may have been trained on this world" in said.out
    assert "shipped mini models" in said.err
    assert (
        "shipped mini models"
        in json.loads((tmp_path / "w" / "world.json").read_text())["seen_by_shipped_models"]
    )
    write_world(tmp_path / "v", TINY)
    assert "seen_by_shipped_models" not in json.loads((tmp_path / "v" / "world.json").read_text())


HUGE = 10**400


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(
            (name, HUGE)
            for name in ("seed", "size", "hard", "pad_mm", "materials", "look", "view_mm")
        ),
        *((name, 10**5000) for name in ("seed", "hard", "materials", "look", "view_mm")),
        ("view_mm", (30.0, HUGE)),
        ("relax_mm", [10**5000]),
        ("materials", ["Wood", HUGE]),
        ("look", np.array(["gelsight", "digit"])),
        ("view_mm", np.array([30.0, 40.0])),
        ("hard", np.array([0.1, 0.2])),
        ("materials", np.arange(1000)),
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_huge_numbers_and_arrays_are_refused_in_one_short_line(name, value):
    with pytest.raises(PalpateError, match=f"{name} must be") as error:
        WorldOptions(**{name: value})
    assert error.value.got
    assert error.value.fix
    assert len(str(error.value)) < 400
    assert "\n" not in str(error.value)


def test_huge_numbers_in_a_file_are_refused(tmp_path):
    path = tmp_path / "o.json"
    save_options(WorldOptions(seed=5), path)
    text = path.read_text()
    path.write_text(text.replace('"seed": 5', f'"seed": {HUGE}'))
    with pytest.raises(PalpateError, match="seed must be a whole number"):
        load_options(path)
    path.write_text(text.replace('"hard": 0.5', f'"hard": {HUGE}'))
    with pytest.raises(PalpateError, match="hard must be a number"):
        load_options(path)
    path.write_text(text.replace('"seed": 5', f'"seed": {"1" * 5000}'))
    with pytest.raises(PalpateError, match="must be JSON"):
        load_options(path)
    path.write_text("[" * 100_000)
    with pytest.raises(PalpateError, match="must be JSON"):
        load_options(path)


def test_a_sample_that_is_not_there_is_an_index_error_too():
    world = World(TINY)
    for k in (len(world), -len(world) - 1, 10**5000):
        with pytest.raises(IndexError) as error:
            world[k]
        assert isinstance(error.value, PalpateError)
        assert f"0 to {len(world) - 1}" in error.value.must
        assert type(pickle.loads(pickle.dumps(error.value))) is type(error.value)


@pytest.mark.parametrize("cache", [0, 1.5, True, "a", None])
def test_a_cache_must_be_a_whole_number(cache):
    with pytest.raises(PalpateError, match="cache must be a whole number"):
        World(TINY, cache=cache)

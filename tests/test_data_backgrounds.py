"""Backgrounds proposed for samples that have none."""

import json
from dataclasses import replace

import polars as pl
import pytest
from PIL import Image

from forge.errors import fails
from palpate.cli import main
from palpate.core import Split
from palpate.data import load, propose_backgrounds
from palpate.data.manifest import Manifest
from palpate.sim import WorldOptions, write_world
from test_data_contacts import gel_video

PRESSES = ((20, 30), (45, 55))


@pytest.fixture
def folder(tmp_path):
    """Two videos of 70 frames as images named by their numbers."""
    for v in range(2):
        (tmp_path / f"v{v}").mkdir()
        for k, image in enumerate(gel_video(70, PRESSES, seed=v)):
            Image.fromarray(image).save(tmp_path / f"v{v}" / f"{k:03d}.png")
    return tmp_path


def manifest_of(root, frames, **cells):
    """A manifest of some frames of both videos."""
    rows = [
        {"id": f"v{v}/{k}", "video": f"v{v}", "frame": k, "tactile": f"v{v}/{k:03d}.png"}
        | {name: cell(v, k) for name, cell in cells.items()}
        for v in range(2)
        for k in frames
    ]
    return Manifest.from_rows(rows, root)


def contact_of(v, k):
    return next((f"v{v}#{i}" for i, (a, b) in enumerate(PRESSES) if a <= k <= b), None)


def frame_of(row):
    return int(row["background"].partition("/")[2][:3])


CASES = {
    "all frames": (range(70), {}, "contacts of the images"),
    "all frames, contacts named": (range(70), {"contact": contact_of}, "contacts of the manifest"),
    "frames in contact alone": (
        [*range(20, 31), *range(45, 56)],
        {"contact": contact_of},
        "contacts of the manifest",
    ),
    "every third": (range(0, 70, 3), {"contact": contact_of}, "contacts of the manifest"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_contact_takes_the_gel_before_it(folder, tmp_path, case):
    frames, cells, method = CASES[case]
    manifest = manifest_of(folder, frames, **cells)
    result = propose_backgrounds(manifest, tmp_path / "out")
    assert set(result.methods.values()) == {method}
    assert (result.kept, result.without, result.problems) == (0, 0, [])
    written = Manifest.load(tmp_path / "out").require_valid()
    assert written.digest == result.manifest.digest != manifest.digest
    assert written.table.drop("background").equals(manifest.table.drop("background"))
    for row in written.table.iter_rows(named=True):
        assert row["background"].startswith(row["video"])
        before, after = (frame_of(row), row["frame"])
        assert not any(a - 2 < before < b + 2 for a, b in PRESSES)
        if 47 <= after <= 53:
            assert 31 < before < 45


def test_backgrounds_that_are_there_stay(folder, tmp_path):
    declared = lambda v, k: f"v{v}/000.png" if k < 50 else None
    manifest = manifest_of(folder, range(20, 56), background=declared, contact=contact_of)
    result = propose_backgrounds(manifest, tmp_path / "a")
    assert result.kept == 60
    assert result.before == 12
    assert set(result.manifest.table.filter(pl.col("frame") < 50)["background"]) == {
        "v0/000.png",
        "v1/000.png",
    }
    full = manifest_of(folder, range(3), background=lambda v, _: f"v{v}/000.png")
    fails("a background for every sample", propose_backgrounds, full, tmp_path / "c")


def test_a_video_that_is_all_contact_gets_nothing(folder, tmp_path):
    for place in folder.glob("v0/*.png"):
        if not 20 <= int(place.stem) <= 30:
            place.unlink()
    (folder / "v1" / "025.png").write_bytes(b"no image")
    manifest = manifest_of(folder, range(20, 31), contact=contact_of)
    result = propose_backgrounds(manifest, tmp_path / "out")
    assert result.without == 12
    assert {p.kind for p in result.problems} == {"no-background", "bad-image"}
    nulls = result.manifest.table.filter(pl.col("background").is_null())
    assert set(nulls["id"]) == {f"v0/{k}" for k in range(20, 31)} | {"v1/25"}


def test_splits_follow_and_an_existing_manifest_stays(folder, tmp_path, capsys):
    manifest = manifest_of(folder, range(70))
    manifest.save(tmp_path / "m" / "manifest.parquet")
    split = Split(dict.fromkeys(manifest.ids, "train"))
    split.save(tmp_path / "m" / "splits" / "Orig.json")
    args = ["background", str(tmp_path / "m"), "-q", "--json", "-o", str(tmp_path / "out")]
    assert main(args) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["before"] > 20
    assert Split.load(tmp_path / "out" / "splits" / "Orig.json").digest == split.digest
    before = (tmp_path / "out" / "manifest.parquet").read_bytes()
    assert main(args) == 2
    assert "must hold no manifest yet" in capsys.readouterr().err
    assert (tmp_path / "out" / "manifest.parquet").read_bytes() == before


@pytest.mark.parametrize("look", ["gelsight", "digit"])
def test_contacts_of_a_world_take_a_frame_that_is_free(tmp_path, look):
    few = {"materials": 2, "objects_per_material": 1, "frames_per_contact": 8, "free_frames": 8}
    write_world(tmp_path / "w", WorldOptions(look=look, size=48, tile=64, **few))
    lines = (tmp_path / "w" / "label.txt").read_text().split()
    labeled = {(line[:15], int(line[16:26])) for line in lines}
    world = load(tmp_path / "w")
    bare = replace(world, table=world.table.with_columns(background=pl.lit(None, pl.String)))
    result = propose_backgrounds(bare, tmp_path / "out")
    assert result.without == 0
    for video, background in result.manifest.table.select("video", "background").iter_rows():
        assert (video, int(background[-14:-4])) not in labeled

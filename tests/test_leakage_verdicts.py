"""What audits of everyday inputs answer: leaks, no leak found, or cannot tell; never a guess."""

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from PIL import Image

from palpate.cli import main
from palpate.core import PalpateError, Split
from palpate.data.manifest import Manifest
from palpate.data.recordings import groups_of, name_recordings, same_names
from palpate.leakage import audit, split

TAC = "images_tac/image_{}_tac.jpg"


@pytest.fixture
def run(tmp_path, capsys, monkeypatch):
    """A function that runs a command in an empty folder: (exit status, JSON)."""
    monkeypatch.chdir(tmp_path)

    def call(line):
        status = main([*shlex.split(line), "--json"])
        out = capsys.readouterr().out
        return status, json.loads(out) if out else {}

    return call


def picture(path, seed):
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    small = np.random.default_rng(seed).integers(0, 255, (12, 12, 3)).astype(np.uint8)
    Image.fromarray(small).resize((48, 48), Image.Resampling.BICUBIC).save(path)


def answers(data):
    """Verdict and reason of each question."""
    return [(q["verdict"], q["reason"]) for q in data["questions"]]


@pytest.mark.parametrize(
    ("folders", "images"),
    [
        *((("train", "test"), images) for images in ("", "--as tactile", "--no-images")),
        (("w/training", "w/testing"), "--no-images"),
        (("a", "b"), "--as tactile"),
        (("a", "b"), "--no-images"),
    ],
)
def test_sibling_folders_named_as_parts_share_videos_by_names(folders, images, run):
    for k in range(60):
        part = folders[k % 10 in (3, 6) and k > 20]
        picture(f"{part}/v{k // 10}_{30 * k:04d}.png", k)
    status, data = run(f"audit {folders[0]} {folders[1]} {images}")
    if folders == ("a", "b"):  # nobody said that these are parts of one set
        first = ("no leak found", "") if images != "--no-images" else ("cannot tell", "names")
        assert answers(data)[0] == first
        assert status == (3 if images == "--no-images" else 0)
        return
    assert (status, data["leaking_samples"]) == (1, data["test_samples"])
    (note,) = [n["params"]["levels"] for n in data["notes"] if n["code"] == "recordings"]
    assert ["video", "file names `v{video}_{frame:d}.png`"] in note


def test_images_that_are_mapped_change_nothing_about_videos(run):
    rows = {"train": range(40), "test": [*range(40, 80, 4), 12]}  # 12 is in both
    for part, numbers in rows.items():
        paths = [f"rig/rec{k % 4}/rgb/{k:04d}.png" for k in numbers]
        for path, k in zip(paths, numbers, strict=True):
            picture(path, k)
        Path(f"{part}.csv").write_text("\n".join(["url", *paths]))
    for more in ("", "--map vision=url", "--map vision=url --no-images"):
        status, data = run(f"audit train.csv test.csv {more}")
        assert (status, data["leaking_samples"], data["test_samples"]) == (1, 11, 11), more
    shutil.rmtree("rig")
    assert run("audit train.csv test.csv")[1]["leaking_samples"] == 11


@pytest.mark.parametrize("odd", ["images_tac/image_3_tac", ""])
def test_one_odd_cell_changes_its_own_row_alone(odd, run):
    for part, numbers in (("train", range(200)), ("test", range(0, 200, 9))):
        lines = [
            f"images_rgb/image_{k}_rgb.jpg,{odd if k == 3 else TAC.format(k)},soft"
            for k in numbers
            if part == "test" or k % 9
        ]
        Path(f"{part}.csv").write_text("\n".join(["url,tactile,caption", *lines]))
    status, data = run("audit train.csv test.csv")
    assert (status, answers(data)[0]) == (3, ("cannot tell", "ids"))
    notes = {note["code"]: note["params"] for note in data["notes"]}
    assert notes["numbers-next"] == {"count": 23, "of": 23}
    stated = "--tactile images_tac/image_{frame}_tac.jpg --near-frames 1"
    status, data = run(f"audit train.csv test.csv {stated}")
    assert (status, data["leaking_samples"], data["gap_max"]) == (1, 23, 1)


def test_what_cannot_be_read_is_never_reported_as_fine(run):
    for k in range(48):
        picture(f"{'ab'[k >= 40]}/v{k // 4}_{k}.png", k)
    for part in "ab":
        assert run(f"import {part} --as vision -o m{part}")[0] == 0
    assert answers(run("audit ma mb")[1])[2] == ("no leak found", "")
    for k in range(41, 48):
        Path(f"b/v{k // 4}_{k}.png").unlink()
    status, data = run("audit ma mb")
    assert (status, data["verdict"], answers(data)[2][1]) == (3, "cannot tell", "unreadable")
    for path in [*Path("a").glob("*.png"), *Path("b").glob("*.png")]:
        path.write_bytes(b"")
    status, data = run("audit ma mb")
    assert (status, data["verdict"], answers(data)[2][1]) == (3, "cannot tell", "unreadable")
    shutil.rmtree("b")  # images of one side, and none of those that the other's table names
    for part, many in (("a", 40), ("b", 8)):
        names = (f"{part}/v{k // 4}_{k}.png,{part}{k // 4}" for k in range(many))
        Path(f"{part}.csv").write_text("path,video\n" + "\n".join(names))
    status, data = run("audit a.csv b.csv --map vision=path")
    assert (status, answers(data)[2]) == (3, ("cannot tell", "unreadable"))
    assert run("audit a.csv b.csv --map vision=path --no-images")[0] == 0
    Path("a.csv").write_text("id,video\n" + "\n".join(f"{k},v{k}" for k in range(9)))
    Path("b.csv").write_text("id,video,frame\nx,w,1\ny,w,x\n")
    status, data = run("audit a.csv b.csv --skip-bad")
    assert (status, answers(data)[0]) == (3, ("cannot tell", "skipped"))


def test_leaks_that_are_allowed_pass_and_what_cannot_be_told_does_not(run):
    lines = [f"v{k % 40}/{k}.jpg,0" for k in range(400)]
    Path("a.txt").write_text("\n".join(lines))
    Path("b.txt").write_text("\n".join([*(f"w{k}/{k}.jpg,0" for k in range(99)), "v1/999.jpg,0"]))
    assert [run(f"audit a.txt b.txt --fail-over {s}")[0] for s in (0, 0.009, 0.01)] == [1, 1, 0]
    paths = [f"images_tac/image_{7 * k}_tac.jpg" for k in range(100)]
    for name, some in (("a", paths), ("b", [*(p[:-5] + "0.jpg" for p in paths[1:]), paths[0]])):
        Path(f"{name}.csv").write_text("\n".join(["tactile", *some]))
    status, data = run("audit a.csv b.csv")
    assert (status, data["leaking_samples"], answers(data)[0]) == (1, 1, ("leaks", "ids"))
    assert run("audit a.csv b.csv --fail-over 0.5")[0] == 3


def one_video_a_material():
    rows = [
        {"id": f"v{k // 20}/{k}", "video": f"v{k // 20}", "frame": k, "material": f"m{k // 20}"}
        | {"contact": f"v{k // 20}#{k // 5}"}
        for k in range(100)
    ]
    return Manifest.from_rows(rows, ".")


def test_a_split_whose_own_audit_leaks_is_not_called_noleak(run):
    samples = one_video_a_material()
    made = split(samples, val=0.1)
    assert (made.rule["name"], made.rule["audit"]) == ("by contact: videos shared", "leaks")
    assert audit(samples, split=made).verdict == "leaks"
    assert [note.code for note in made.notes][-1] == "not-noleak"
    samples.save(Path("m/manifest.parquet"))
    status, _ = run("split m --val 0.1 -o s.json")
    assert (status, Split.load("s.json").rule["name"]) == (0, "by contact: videos shared")
    status, data = run("audit m --split s.json")
    assert (status, len(data["commands"])) == (1, 2)
    for command in data["commands"]:  # as they are: the last is the audit of what the first makes
        status, data = run(command.removeprefix("palpate "))
    assert (status, data["verdict"], data["commands"]) == (0, "no leak found", [])
    assert Split.load("noleak.json").rule["name"] == "NoLeak"
    one = Manifest(samples.table.with_columns(video=pl.lit("v0")), Path())
    one.save(Path("one/manifest.parquet"))
    run("split one --by contact -o one.json")
    status, data = run("audit one --split one.json")
    assert (status, data["commands"]) == (1, [])  # nothing can keep the only video whole


def test_the_next_command_reads_what_the_audit_read(run):
    for part, first in (("train", 0), ("test", 5)):
        frames = [(v, first + 10 * k) for v in range(4) for k in range(10)]
        lines = [f"v{v}/{k}.jpg,{v % 2}\n" for v, k in frames]
        Path(f"{part}.txt").write_text("".join([*lines, "no line\n"]))
    status, data = run("audit train.txt test.txt --skip-bad")
    assert (status, data["commands"]) == (
        1,
        ["palpate split train.txt test.txt --skip-bad --by video -o noleak.json"],
    )
    status, data = run(data["commands"][0].removeprefix("palpate "))
    assert (status, data["audit"]) == (0, "no leak found")


NAMES = ("{k:04d}.png", "cup_{k}.png", "rec{v}/{k:04d}.png", "v{v}_{k:05d}.png", "a{v}/b_{k}.jpg")


def unrelated_pairs(count):
    """Tiny sets of two roots with equal names, as lists, tables and paths."""
    for k in range(count):
        rng = np.random.default_rng(k)
        form, size = NAMES[k % len(NAMES)], int(rng.integers(3, 30))
        names = [form.format(k=j, v=j % 3) for j in rng.permutation(40)[:size]]
        same = names[: max(1, size // 2)]
        yield k, names, [*same, *(form.format(k=100 + j, v=j % 4) for j in range(size // 2))]


@pytest.mark.parametrize("count", [10, pytest.param(200, marks=pytest.mark.nightly)])
def test_equal_names_of_unrelated_sets_are_neither_a_leak_nor_none(count, tmp_path):
    for k, a, b in unrelated_pairs(count):
        lists = [tmp_path / str(k) / root / f"l.{'csv' if k % 2 else 'json'}" for root in "ab"]
        for path, names in zip(lists, (a, b), strict=True):
            path.parent.mkdir(parents=True)
            path.write_text("\n".join(["gel", *names]) if k % 2 else json.dumps(names))
        assert audit(*lists).verdict == "cannot tell", (a, b)


PATHS = {
    "v{v:02d}_{k:04d}.png": ["video", "frame"],
    "rig/cup{v}/touch/{k:04d}.png": ["video", "frame"],
    "trial_{v}/{r:x}z.png": ["video"],  # a word names it
    "{v}/{r:x}z.png": [],  # nothing runs
    "item_{r:05d}.png": [],
    "img{k}.png": [],
    "train/c{v}_{k}.png": ["video", "frame"],
    "wood{v}_{r:06d}.png": [],  # numbers that do not run
}


@pytest.mark.parametrize("form", PATHS)
def test_names_are_read_only_with_evidence(form):
    paths = [form.format(k=k, v=k // 10, r=k * 7919 % 100003) for k in range(40)]
    rows = [{"id": path, "tactile": path} for path in paths]
    samples = Manifest.from_rows(rows, ".", {"format": "pairs", "layout": "table csv"})
    (named,) = name_recordings([samples])
    assert [level for level, _ in groups_of(named)] == PATHS[form]
    declared = Manifest(samples.table.with_columns(video="id"), samples.root)
    assert name_recordings([declared]) == [declared]


def test_frames_that_are_counted_anew_in_each_part_are_of_other_recordings(tmp_path):
    rows = [{"id": f"c{k // 9}/{k % 9}", "video": f"c{k // 9}", "frame": k % 9} for k in range(27)]
    anew = [Manifest.from_rows(rows, tmp_path / part) for part in ("train", "test")]
    files = [Manifest(m.table, m.root, {"source": "l.txt"}) for m in anew]
    assert same_names(*files) == ()
    later = Manifest(files[1].table.with_columns(frame=files[1].table["frame"] + 9), files[1].root)
    assert "video" in same_names(files[0], later)


def table_of(path, rows):
    """A table of contacts of 10 frames, six a video, in videos of one material each."""
    columns = "id,video,frame,contact,object,material"
    lines = [
        f"{k},v{k // 60},{k % 60},v{k // 60}#{k // 10},"
        f"o{k // 10 % 6 + 6 * (k // 120)},m{k // 60 % 2}"
        for k in range(rows)
    ]
    Path(path).write_text("\n".join([columns, *lines]))


@pytest.mark.parametrize(
    ("rows", "by", "offered"),
    [(360, "contact", "contact video"), (360, "object", "object video"), (60, "contact", "")],
)
def test_what_is_offered_keeps_whole_what_leaks_in_time(rows, by, offered, run):
    table_of("all.csv", rows)
    run(f"split all.csv --by {by} -o s.json")
    status, data = run(f"audit all.csv --split s.json --by {by}")
    assert (status, answers(data)[1][0]) == (1, "leaks")
    first = f"palpate split all.csv --by {offered} -o noleak.json"
    assert data["commands"][:1] == [first] * bool(offered)
    for command in data["commands"]:
        status, data = run(command.removeprefix("palpate "))
    assert (status, data["commands"]) == ((0, []) if offered else (1, []))


def test_nothing_is_offered_that_fails_or_made_what_leaks(run):
    Path("a.csv").write_text("id,video\n" + "\n".join(f"{k},v{k % 9}" for k in range(90)) + "\nx,")
    Path("b.csv").write_text("id,video\n" + "\n".join(f"t{k},v{k % 9}" for k in range(20)))
    assert run("audit a.csv b.csv")[1]["commands"] == []  # no split has a sample without a video
    for k in range(48):  # a black photo in each of 8 videos, which no split keeps apart
        picture(f"d/v{k // 6}_{k:03d}.png", k)
        if k % 6 == 0:
            Image.new("RGB", (48, 48)).save(f"d/v{k // 6}_{k:03d}.png")
    run("import d --as vision -o m")
    run("split m --by video -o s.json")
    status, data = run("audit m --split s.json")
    assert (status, data["commands"]) == (1, [])
    for k in range(0, 48, 6):
        picture(f"d/v{k // 6}_{k:03d}.png", 99)
    with pytest.raises(PalpateError, match=r"near-duplicates group.* Leave near out"):
        split("m", by="video", near="vision")


@pytest.mark.parametrize("level", ["video", "object"])
def test_a_split_is_audited_by_the_template_that_made_it(level, tmp_path):
    """Names suggest v{video}_...; it was stated that the number behind is the recording."""
    paths = [f"v{k % 4}_{k // 40}_{k:03d}.png" for k in range(400)]
    Path(tmp_path / "l.csv").write_text("\n".join(["gel", *paths]))
    text = f"v*_{{{level}}}_{{frame}}.png"
    made = split(tmp_path / "l.csv", reading={"tactile": text})
    assert (made.rule["group"], made.rule["groups"], made.rule["name"]) == (level, 10, "NoLeak")
    (levels,) = [note.params["levels"] for note in made.notes if note.code == "recordings"]
    assert [level, f"file names `{text}`"] in levels
    own = audit(tmp_path / "l.csv", split=made, reading={"tactile": text})
    assert (own.verdict, own.group) == ("no leak found", level)
    assert audit(tmp_path / "l.csv", split=made).verdict == "leaks"  # by what names suggest

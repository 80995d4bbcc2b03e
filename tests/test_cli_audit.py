"""``palpate audit`` from the outside: every kind of input, every output, bad input in a line."""

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import torch
from PIL import Image

from forge.formats import TREES
from palpate.cli import main
from palpate.core import Split
from palpate.data.manifest import Manifest


def run(capsys, *args):
    words = [word for arg in args for word in shlex.split(str(arg))]
    status = main(["audit", *words, "--json"])
    out, err = capsys.readouterr()
    return status, json.loads(out) if out else {}, err


def texture(seed, size=96):
    """Smooth colored noise: every seed another picture."""
    rng = np.random.default_rng(seed)
    small = Image.fromarray(rng.integers(0, 255, (12, 12, 3)).astype(np.uint8))
    return small.resize((size, size), Image.Resampling.BICUBIC)


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Two folders of 30 pairs without metadata, here: test 3 is train 5 brighter and moved."""
    monkeypatch.chdir(tmp_path)
    for part, first in (("a", 0), ("b", 1000)):
        for k in range(30):
            for side, shift in (("vision", 0), ("tactile", 5000)):
                path = tmp_path / part / side / f"{part}{k}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                texture(first + shift + k).save(path)
    copy = texture(5).point(lambda v: min(255, int(v * 1.05)))
    copy.transform(copy.size, Image.Transform.AFFINE, (1, 0, 3, 0, 1, -2)).save(
        tmp_path / "b" / "vision" / "b3.png"
    )
    shutil.copy(tmp_path / "a" / "tactile" / "a7.png", tmp_path / "b" / "tactile" / "b9.png")
    return tmp_path


def test_folders_without_metadata_are_compared_by_their_pictures(folders, capsys):
    status, data, _ = run(capsys, "a b -o t.parquet --fail-over 0.01")
    assert status == 1
    kinds = {s["kind"]: s for s in data["signals"]}
    modalities = {"near-duplicate vision", "near-duplicate tactile"}
    assert set(kinds) == {"identical sample", "identical bytes"} | modalities
    assert data["group"] == "none"
    assert kinds["identical bytes"]["flagged"] == 1
    # Without videos nothing is known to be unrelated: images are ranked, copied files flagged.
    vision = kinds["near-duplicate vision"]
    assert (vision["verdict"], vision["flagged"]) == ("cannot tell", 0)
    assert (vision["worst"][0]["test"]["id"], vision["worst"][0]["train"]["id"]) == ("3", "5")
    table = pl.read_parquet(folders / "t.parquet")
    assert table.filter("leaking")["id"].to_list() == ["9"]
    assert table.sort("near_duplicate_vision_score")["id"][-1] == "3"
    assert data["leaking_samples"] == 1


@pytest.mark.parametrize("layout", ["folders", "imported", "tables"])
def test_equal_file_names_of_two_roots_are_no_leak_and_a_copied_file_is(layout, tmp_path, capsys):
    a, b = (tmp_path / part / "tactile" for part in "ab")
    for seed, root in enumerate((a, b)):
        names = [f"video{k % 3}/{k:04d}.jpg" for k in range(12)]
        for k, name in enumerate(names):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            texture(100 * seed + k, 32).save(root / name)
        (root / "all.csv").write_text("\n".join(["tactile", *names]))

    def sources():
        for folder in (a, b) if layout == "imported" else ():
            where = ("--as", "tactile", "-o", str(folder.parent / "m"), "-q", "--overwrite")
            assert main(["import", str(folder), *where]) == 0
            capsys.readouterr()
        return [
            root / {"imported": "../m", "tables": "all.csv", "folders": ""}[layout]
            for root in (a, b)
        ]

    status, data, _ = run(capsys, *sources())
    assert (status, data["leaking_samples"], data["identical_samples"]) == (3, 0, 0)
    assert data["questions"][0]["reason"] == "names"
    (note,) = [note["params"] for note in data["notes"] if note["code"] == "equal-names"]
    assert note["equal"]["id"] == 12
    status, data, _ = run(capsys, *sources(), "--identity", "names", "--no-images")
    assert (status, data["leaking_samples"], data["identical_samples"]) == (1, 12, 12)
    shutil.copy(a / "video1" / "0001.jpg", b / "video2" / "0011.jpg")
    status, data, _ = run(capsys, *sources())
    assert (status, data["leaking_samples"]) == (1, 1)


@pytest.mark.parametrize("folder", ["plain", pytest.param("with", marks=pytest.mark.nightly)])
def test_the_next_commands_of_tactile_data_work_on_it(tmp_path, capsys, monkeypatch, folder):
    """With videos, and without any: near-duplicates are then all that can be kept together."""
    monkeypatch.chdir(tmp_path)
    for k in range(60):
        path = tmp_path / "own" / f"rec{k % 12}" / f"{k}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        texture(k if k != 59 else 3, 64).save(path)
    assert main(["import", "own", "--as", "tactile", "-o", "with", "-q"]) == 0
    assert main(["import", "own", "--as", "tactile", "-o", "plain", "-q"]) == 0
    whole = Manifest.load("plain")
    none = {c: pl.lit(None, whole.table[c].dtype) for c in ("video", "frame", "object", "contact")}
    replace(whole, table=whole.table.with_columns(**none)).save(Path("plain/manifest.parquet"))
    Split({i: "test" if int(i.split("/")[-1]) % 5 == 4 else "train" for i in whole.ids}).save(
        "s.json"
    )
    capsys.readouterr()
    status, data, _ = run(capsys, folder, "--split", "s.json")
    assert (status, len(data["commands"])) == (1, 2)
    by = " --by video" * (folder == "with")
    assert data["commands"][0] == f"palpate split {folder}{by} --near tactile -o noleak.json"
    for command in data["commands"]:
        assert main([*shlex.split(command)[1:], "--json"]) in (0, 3), command
        answer = json.loads(capsys.readouterr().out)
    assert answer["leaking_samples"] == 0


def test_a_damaged_picture_is_named_and_the_others_are_compared(folders, capsys):
    of_a, of_b = Path("a/vision"), Path("b/vision")
    (of_b / "b1.png").write_bytes(b"")
    (of_b / "b2.png").write_bytes((of_b / "b2.png").read_bytes()[:-40])
    Image.open(of_b / "b4.png").convert("L").resize((200, 50)).save(of_b / "b4.png")
    Image.open(of_a / "a4.png").convert("RGBA").save(of_a / "a4.png")
    status, data, _ = run(capsys, of_a, of_b)
    assert status == 3
    vision = next(s for s in data["signals"] if s["kind"] == "near-duplicate vision")
    assert vision["checked"] == 28
    assert vision["worst"][0]["test"]["id"] == "3"
    unreadable = [n["params"] for n in vision["notes"] if n["code"] == "images-unreadable"]
    assert [params["count"] for params in unreadable] == [2]


def test_a_page_a_table_and_json_are_written_whole(folders, capsys):
    status, data, _ = run(capsys, "a/vision b/vision --page p.html -o p.json")
    assert status == run(capsys, "a b --no-images -o t.csv")[0] == 3
    page = Path("p.html").read_text()
    assert "near-duplicate vision" in page
    assert len(page) < 10_000_000
    assert json.loads(Path("p.json").read_text())["leaking_samples"] == data["leaking_samples"]
    assert Path("t.csv").read_text().startswith("id,video,frame,material,leaking")
    assert not list(folders.glob(".*.work"))
    # A page never replaces what lies beside it.
    Path("q.json").write_text('{"a": 1}')
    for flags in ("-o a/vision/a1.png", "-o q.json", "--page q.html"):
        assert run(capsys, "a", "b", flags)[0] == 2, flags
    assert run(capsys, "a b --page r.html -o r.md")[0] == 2
    assert Path("q.json").read_text() == '{"a": 1}'


def test_test_samples_that_an_encoder_has_seen_are_told_apart_from_train(tmp_path, capsys):
    (tmp_path / "train.txt").write_text("a/1.jpg,0\na/2.jpg,0\n")
    (tmp_path / "test.txt").write_text("b/1.jpg,0\nb/90.jpg,1\n")
    (tmp_path / "pre.txt").write_text("b/1.jpg,0\nc/5.jpg,0\n")
    args = (tmp_path / "train.txt", tmp_path / "test.txt", "--pretrain", tmp_path / "pre.txt")
    status, data, _ = run(capsys, *args)
    assert (status, data["leaking_samples"], data["against"]) == (1, 0, "train")
    (other,) = data["others"]
    names = ("against", "identical_samples", "leaking_samples")
    assert [other[name] for name in names] == ["pretraining", 1, 2]
    assert [run(capsys, *args, "--fail-over", limit)[0] for limit in (0.5, 1)] == [1, 0]


def test_lists_of_windows_with_a_mark_odd_names_and_no_last_line_end(tmp_path, capsys):
    (tmp_path / "train.txt").write_bytes("\ufeffmy video, 1/5.jpg,0\r\nküche/7.jpg,1\r\n".encode())
    (tmp_path / "test.txt").write_bytes("my video, 1/9.jpg,0\r\nküche/7.jpg,1".encode())
    status, data, _ = run(capsys, tmp_path / "train.txt", tmp_path / "test.txt")
    names = ("groups_shared", "gap_min", "gap_max", "identical_samples")
    assert (status, [data[name] for name in names]) == (1, [2, 0, 4, 1])


def test_frames_that_are_time_stamps_do_not_overflow(tmp_path, capsys):
    first, gap = 1_700_000_000_000_000_000 // 10, 1_234_567
    rows = [(f"v{k}", first + k * 10**15) for k in range(40)]
    (tmp_path / "a.txt").write_text("".join(f"{v}/{f}.jpg,0\n" for v, f in rows))
    (tmp_path / "b.txt").write_text("".join(f"{v}/{f + gap}.jpg,0\n" for v, f in rows))
    _, data, _ = run(capsys, tmp_path / "a.txt", tmp_path / "b.txt")
    assert (data["gap_min"], data["gap_median"], data["gap_max"]) == (gap, gap, gap)


def test_an_impact_that_cannot_be_measured_does_not_lose_the_audit(
    small_manifest, tmp_path, capsys
):
    small_manifest.save(tmp_path / "m" / "manifest.parquet")
    videos = dict(zip(small_manifest.ids, small_manifest.column("video"), strict=True))
    parts = {i: "test" if v in ("v4", "v5") else "train" for i, v in videos.items()}
    one = {i: p for i, p in parts.items() if videos[i] in ("v0", "v4")}  # a material in one video
    Split(one).save(tmp_path / "s.json")
    files = ("--split", tmp_path / "s.json", "-o", tmp_path / "a.json")
    status, data, _ = run(capsys, tmp_path / "m", "--impact", *files)
    assert status == 3  # photos of few videos show no chance
    assert "impact-failed" in [note["code"] for note in data["notes"]]
    assert json.loads((tmp_path / "a.json").read_text())["test_samples"] == 8
    assert not list(tmp_path.glob(".*.work"))


def test_mistakes_are_one_line_each(tmp_path, small_manifest, capsys):
    small_manifest.save(tmp_path / "m" / "manifest.parquet")
    Split.from_ids(train=small_manifest.ids[:8], test=small_manifest.ids[8:]).save(
        tmp_path / "s.json"
    )
    (tmp_path / "l.txt").write_text("v/1.jpg,0\n")
    (tmp_path / "bad.txt").write_text("v1\n")
    one, split, lines = tmp_path / "m", tmp_path / "s.json", tmp_path / "l.txt"
    torch.jit.script(torch.nn.ReLU()).save(script := tmp_path / "ruler.pt")
    for args, words in [
        ([one], "neither test samples nor a split"),
        ([one, one, "--split", split], "TRAIN and TEST"),
        ([lines, tmp_path / "gone.txt"], "nothing at"),
        ([lines, lines, "--impact"], "--impact needs all samples and a split"),
        ([one, "--split", split, "--near-frames", "-1"], "--near-frames"),
        ([one, "--split", split, "--encoder", tmp_path / "none"], "must come with the impact"),
        ([one, "--split", split, "--impact", "--encoder", script], "weights and nothing"),
        ([lines, tmp_path / "bad.txt"], "1 problem"),
        ([one, "--split", split, "--by", "object", "--no-images"], "object"),
    ]:
        status, _, err = run(capsys, *args)
        assert status == 2, args
        said = [line for line in err.splitlines() if not line.startswith("  loading ")]
        assert words in said[0], (args, err)


def test_plain_folders_of_pictures_are_photos(folders, capsys):
    status, data, _ = run(capsys, "a/vision", "b/vision")
    assert (status, data["verdict"]) == (3, "cannot tell")
    (worst,) = (s["worst"] for s in data["signals"] if s["kind"] == "near-duplicate vision")
    assert (worst[0]["test"]["id"], worst[0]["train"]["id"]) == ("3", "5")
    shutil.rmtree("b/tactile")
    status, data, _ = run(capsys, "a", "b")
    assert (status, data["leaking_samples"]) == (3, 0)
    assert {"code": "images-of-one-part", "params": {"modality": "tactile"}} in data["notes"]
    Path("empty").mkdir()
    assert run(capsys, "a", "empty")[0] == 2


def test_a_small_tree_whose_backgrounds_are_all_unlike_is_audited(tmp_path, capsys):
    source = TREES["touch-and-go"](tmp_path / "forged").source
    assert main(["import", str(source), "-o", str(tmp_path / "m"), "-q"]) == 0
    capsys.readouterr()
    split = tmp_path / "m" / "splits" / "Orig.json"
    status, found, err = run(capsys, tmp_path / "m", "--split", split)
    assert "Traceback" not in err
    assert status == (found["leaked_fraction"] > 0)


@pytest.fixture
def tables(tmp_path):
    """Two tables of paths below d/, in another folder; b/2.png is a copy of a/0.png."""
    for part, first in (("a", 0), ("b", 100)):
        for k in range(3):
            path = tmp_path / "d" / part / f"{k}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            texture(first + k).save(path)
        rows = [f"{part}/{k}.png" for k in range(3)]
        (tmp_path / f"{part}.csv").write_text("\n".join(["tactile", *rows]))
    shutil.copy(tmp_path / "d" / "a" / "0.png", tmp_path / "d" / "b" / "2.png")
    return tmp_path


def test_images_of_tables_are_compared_below_the_given_root(tables, capsys):
    status, data, _ = run(capsys, tables / "a.csv", tables / "b.csv", "--root", tables / "d")
    assert (status, data["leaking_samples"]) == (1, 1)
    assert {s["kind"]: s["flagged"] for s in data["signals"]}["identical bytes"] == 1


def test_a_list_of_bad_rows_alone_is_a_mistake_of_the_user(tables, capsys):
    for cell in ("nan", "3.5"):
        (tables / "bad.csv").write_text(f"tactile,frame\na.png,{cell}\n")
        status, _, err = run(capsys, tables / "bad.csv", tables / "b.csv")
        assert status == 2
        assert "bad-frame" in err


def test_near_both_takes_the_modality_that_there_is(tables, tmp_path, capsys):
    source = ["--root", str(tables / "d"), "-o", str(tmp_path / "s.json")]
    assert main(["split", str(tables / "a.csv"), "--near", "both", *source]) in (0, 2)
    assert "Near-duplicates need" not in capsys.readouterr().err

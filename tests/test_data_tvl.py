"""HCT and SSVTP: the official test rows with their measured facts, and every dialect of lists."""

import json
import shutil
from collections import Counter
from itertools import pairwise
from pathlib import Path, PurePosixPath

import numpy as np
import polars as pl
import pytest

from forge.errors import fails
from forge.formats import TVL_COLUMNS as COLUMNS
from forge.formats import kinds, make_hct, make_ssvtp
from forge.pictures import gel, photo, put, write_csv
from palpate.core import Split
from palpate.data.formats import ssvtp, tvl
from palpate.data.importing import import_dataset as read
from palpate.data.importing import write_lists
from palpate.data.scanning import Scan

SSVTP_COLUMNS = ("url", "tactile", "caption")


@pytest.fixture
def tree(tmp_path):
    return make_hct(tmp_path / "in").source


@pytest.fixture
def ssvtp_tree(tmp_path):
    return make_ssvtp(tmp_path / "in").source


# --- The official test rows


@pytest.fixture(scope="module")
def official(real_data, tmp_path_factory):
    """The 402 official test rows at their real paths, with small images; and what was listed."""
    items = json.loads((real_data / "tvl" / "test_items.json").read_text())
    root, sample = tmp_path_factory.mktemp("tvl"), tmp_path_factory.mktemp("bytes") / "x.jpg"
    images = {"image_fp": photo(1), "tactile_fp": gel(1)}
    content = {side: put(sample, image).read_bytes() for side, image in images.items()}
    lists: dict[Path, list[list[str]]] = {}
    for item in items:
        for side, data in content.items():
            (root / item[side]).parent.mkdir(parents=True, exist_ok=True)
            (root / item[side]).write_bytes(data)
        is_hct = item["image_fp"].startswith("hct/")
        base = PurePosixPath(*PurePosixPath(item["image_fp"]).parts[: 1 + is_hct])
        paths = [str(PurePosixPath(item[side]).relative_to(base)) for side in content]
        row = [*paths, *[""] * is_hct, item["label"]]
        lists.setdefault(root / base, []).append(row)
    for base, rows in lists.items():
        columns = COLUMNS if base.parent.name == "hct" else SSVTP_COLUMNS
        write_csv(base / "test.csv", columns, rows)
    return root, items


def test_the_official_hct_rows_have_their_measured_facts(official, tmp_path):
    root, items = official
    result = read(root, tmp_path / "out", check="none")
    table = result.manifest.table
    assert result.facts["format"] == "hct"
    assert len(result.manifest) == 356
    listed = {(i["image_fp"][4:], i["tactile_fp"][4:]) for i in items if "hct/" in i["image_fp"]}
    assert set(table.select("vision", "tactile").rows()) == listed
    assert Counter(table["domain"]) == {"data1": 9, "data2": 148, "data3": 199}
    videos = table.group_by("video").agg("frame", texts=pl.col("text").n_unique())
    assert Counter(videos["frame"].list.len()) == {1: 214, 2: 53, 3: 12}
    assert videos.height == 279
    assert (table["frame"].min(), table["frame"].max()) == (28, 1409)
    gaps = [b - a for frames in videos["frame"] for a, b in pairwise(frames)]
    assert (min(gaps), np.median(gaps)) == (1, 19), "sorted by number, not by name"
    prefixes = Counter(video.split("-")[0] for video in videos["video"])
    several = sum(n > 1 for n in prefixes.values())
    assert (len(prefixes), several, max(prefixes.values())) == (71, 43, 63)
    assert table["text"].n_unique() == 336
    adjectives = Counter(table["text"].str.count_matches(",") + 1)
    assert adjectives == {1: 3, 2: 55, 3: 145, 4: 135, 5: 17, 6: 1}
    worded = videos.filter(pl.col("frame").list.len() > 1)
    assert ((worded["texts"] > 1).sum(), worded.height) == (63, 65)
    assert result.splits["Orig"].counts() == {"test": 356}
    assert {p.kind for p in result.suspicious} == {"no-background", "other-half"}


def test_the_official_folders_join_into_sessions(official, tmp_path):
    """Of neighboring folders 82 % start less than a minute apart in data2, 34 % in data3."""
    table = read(official[0], tmp_path / "out", check="none").manifest.table
    for rig, expected in (("data2", 0.82), ("data3", 0.34)):
        rows = table.filter(table["domain"] == rig)
        folders = rows["video"].n_unique()
        joined = (folders - rows["session"].n_unique()) / (folders - 1)
        starts = sorted(float(v.rpartition("-")[2]) for v in rows["video"].unique())
        assert joined == pytest.approx(np.mean(np.diff(starts) < 60))
        assert round(joined, 2) == expected


def test_the_official_ssvtp_rows_and_all_adjectives(official, tmp_path):
    root, _ = official
    result = read(root, tmp_path / "out", format="ssvtp", check="none")
    assert len(result.manifest) == 46
    assert set(result.manifest.column("video")) == {None}
    assert result.facts["text_source"] == "column caption"
    of_hct = read(root, tmp_path / "hct", check="none").manifest.column("text")
    words = {word for text in result.manifest.column("text") + of_hct for word in text.split(", ")}
    assert len(words) == 70  # 71 with the empty one at the end of 'textured, stiff, rigid,'
    assert all(word == word.strip().lower() and "." not in word and word for word in words)


# --- Lists in every dialect


def rewrite(root: Path, dialect: str) -> None:
    """Write the lists of an HCT tree again."""
    for path in sorted(root.glob("data*/*.csv")):
        listed = tvl.read_list(Scan(path.parent), path)
        rows = [[cells[name] for name in COLUMNS] for _, cells in listed]
        header = list(COLUMNS)
        if dialect == "index":
            header, rows = ["", *COLUMNS], [[str(k), *row] for k, row in enumerate(rows)]
        elif dialect == "other order":
            header, rows = list(COLUMNS[::-1]), [row[::-1] for row in rows]
        elif dialect == "url is the index":
            header = ["", *COLUMNS[1:]]
        elif dialect in ("from hct", "from above"):
            prefix = f"{'hct/' * (dialect == 'from above')}{path.parent.name}"
            rows = [[*(f"{prefix}/{cell}" for cell in row[:3]), row[3]] for row in rows]
        elif dialect == "dots":
            dots = lambda cell: f"./{cell}".replace("/vision/", "//vision/")
            rows = [[*map(dots, row[:3]), row[3]] for row in rows]
        write_csv(path, header, rows)
        text = path.read_bytes().replace(b"\r\n", b"\n")
        if dialect == "windows":
            text = b"\xef\xbb\xbf" + text.replace(b"\n", b"\r\n")
        elif dialect == "no last newline":
            text = text.rstrip(b"\n")
        elif dialect == "capitals and blank lines":
            text = text.replace(b"url,tactile", b"URL, Tactile").replace(b"\n", b"\n\n")
        path.write_bytes(text)


FORMS = ["index", "other order", "url is the index", "from hct", "from above", "dots"]
FORMS += ["windows", "no last newline", "capitals and blank lines"]


@pytest.mark.parametrize("dialect", FORMS)
def test_lists_of_every_dialect_say_the_same(tree, tmp_path, dialect):
    expected = read(tree, tmp_path / "before")
    rewrite(tree, dialect)
    result = read(tree, tmp_path / "after")
    assert result.manifest.digest == expected.manifest.digest
    assert result.splits["Orig"].digest == expected.splits["Orig"].digest
    assert result.suspicious == []


def test_the_source_may_be_any_of_three_folders(tree, tmp_path, monkeypatch):
    whole = read(tree, tmp_path / "a").manifest
    above = read(tree.parent, tmp_path / "b").manifest
    assert above.digest == whole.digest
    data2 = read(tree / "data2", tmp_path / "c")
    assert data2.manifest.table.equals(whole.table.filter(whole.table["domain"] == "data2"))
    assert data2.splits["Orig"].counts() == {"train": 9, "test": 3}
    monkeypatch.chdir(tree / "data2")
    assert read(Path(), tmp_path / "d").manifest.digest == data2.manifest.digest
    make_ssvtp(tree.parent)
    assert ssvtp.detect(tree.parent) is False  # it holds hct/, which is taken
    both = read(tree.parent, tmp_path / "e")
    assert (both.facts["format"], [p.kind for p in both.suspicious]) == ("hct", ["other-half"])
    assert len(read(tree.parent, tmp_path / "f", format="ssvtp").manifest) == 9
    shutil.rmtree(tree)
    assert read(tree.parent, tmp_path / "g").facts["format"] == "ssvtp"
    for name in ("hct", "ssvtp"):
        fails("none of these", read, tmp_path, tmp_path / "out", format=name)


# --- Writing lists


@pytest.mark.parametrize("seed", range(3))
def test_written_lists_read_back_as_the_same_split(tmp_path, seed):
    root = make_hct(tmp_path / "in").source
    # one trajectory with a background above dataN, one without
    videos = sorted({p.parent for p in root.glob("data*/*/vision")})
    (videos[0] / "background.png").rename(root / "digit_background.png")
    before = read(root, tmp_path / "before").manifest
    order = np.random.default_rng(seed).permutation(before.ids)
    split = Split({str(i): ("train", "train", "val", "test")[k % 4] for k, i in enumerate(order)})
    files = write_lists(before, split, tmp_path / "lists")
    for file in files:
        shutil.copy(file, root / file.relative_to(tmp_path / "lists"))
    after = read(root, tmp_path / "after")
    assert after.splits["Orig"].parts == split.parts
    assert after.manifest.digest == before.digest
    assert after.suspicious == []


# --- SSVTP


def test_ssvtp_finds_files_and_text_by_the_id(ssvtp_tree, tmp_path):
    whole = read(ssvtp_tree, tmp_path / "whole").manifest
    vision, tactile = "images_rgb/image_{}_rgb.jpg", "images_tac/image_{}_tac.jpg"
    caption = "Fabric, coarse, deformable."
    rows = [
        [vision.format(3), tactile.format(12), "x"],  # 2: another's tactile image, other words
        [f"ssvtp/{vision.format(12)}", f"ssvtp/{tactile.format(12)}", caption],
        [tactile.format(21), "", ""],  # 4: the tactile image for the photo
        ["images_rgb/image_437.jpg", "images_tac/image_437_rgb.jpg", ""],  # 5: suffixes wrong
        ["images_rgb/image_438_rgb.png", "images_tac/image_438_tac.png", ""],  # 6: other suffixes
        [f"./{vision.format(1000)}", "images_tac//image_1000_tac.jpg", ""],
        [vision.format(1001), "", ""],
    ]
    write_csv(ssvtp_tree / "train.csv", SSVTP_COLUMNS, rows)
    result = read(ssvtp_tree, tmp_path / "result")
    assert result.manifest.digest == whole.digest
    assert result.suspicious == []
    assert "text/labels_<id>.txt" in result.facts["text_source"]


@pytest.mark.parametrize(
    "columns", [None, ("url", "caption"), ("", "tactile", "caption"), ("url",)]
)
def test_ssvtp_lists_of_every_width(ssvtp_tree, tmp_path, columns):
    whole = read(ssvtp_tree, tmp_path / "whole").manifest
    pairs = whole.table.select("vision", "tactile").rows()
    (ssvtp_tree / "test.csv").unlink()
    path = ssvtp_tree / "train.csv"
    if columns is None:  # no list at all
        path.unlink()
    else:
        cells = [{"": v, "url": v, "tactile": t, "caption": ""} for v, t in pairs]
        write_csv(path, columns, [[row[name] for name in columns] for row in cells])
    result = read(ssvtp_tree, tmp_path / "result")
    assert result.manifest.digest == whole.digest
    counts = {name: split.counts() for name, split in result.splits.items()}
    assert counts == ({} if columns is None else {"Orig": {"train": 9}})


def test_ssvtp_counts_its_losses(ssvtp_tree, tmp_path):
    (ssvtp_tree / "images_tac" / "image_12_tac.jpg").unlink()
    (ssvtp_tree / "images_rgb" / "image_21_rgb.jpg").unlink()
    (ssvtp_tree / "images_rgb" / "image_437_rgb.jpg").write_bytes(b"")
    (ssvtp_tree / "text" / "labels_4210.txt").unlink()
    lines = ["images_rgb/photo.jpg,x,y", "../image_1_rgb.jpg,x,y", ",x,y"]
    with (ssvtp_tree / "train.csv").open("a") as file:
        file.write("\n".join([*lines, "images_rgb/image_3_rgb.jpg,,again\n"]))
    error = fails("", read, ssvtp_tree, tmp_path / "out")
    wrong = ("bad-image", "bad-path", "outside-root", "duplicate-id", "empty-cell")
    assert kinds(error.problems) == {"missing-file": 2, **dict.fromkeys(wrong, 1)}
    result = read(ssvtp_tree, tmp_path / "out", skip_bad=True)
    assert len(result.manifest) == 6
    assert result.suspicious == []
    (text,) = result.manifest.take(["ssvtp/4210"]).column("text")
    assert text == "fabric, coarse, deformable"
    for name in ("train", "test"):
        (ssvtp_tree / f"{name}.csv").unlink()
    error = fails("", read, ssvtp_tree, tmp_path / "out2")
    assert kinds(error.problems) == {"unpaired": 2, "bad-image": 1}


def test_an_ssvtp_sample_of_two_lists_is_reported_and_is_in_no_part(ssvtp_tree, tmp_path):
    whole = read(ssvtp_tree, tmp_path / "whole")
    with (ssvtp_tree / "test.csv").open("a") as file:
        file.write("images_rgb/image_3_rgb.jpg,x\n")
    result = read(ssvtp_tree, tmp_path / "out", skip_bad=True)
    assert kinds(result.skipped) == {"two-parts": 1}
    assert result.manifest.ids == whole.manifest.ids
    parts = dict(whole.splits["Orig"].parts)
    assert parts.pop("ssvtp/3") == "train"
    assert result.splits["Orig"].parts == parts


def test_ssvtp_reports_unlisted_photos_absent_words_and_the_background(ssvtp_tree, tmp_path):
    write_csv(ssvtp_tree / "train.csv", ("url", "caption"), [["images_rgb/image_3_rgb.jpg", ""]])
    (ssvtp_tree / "text" / "labels_3.txt").write_text("\n")
    put(ssvtp_tree / "tac_background.png", gel(0, pressed=False))
    result = read(ssvtp_tree, tmp_path / "out")
    assert set(result.manifest.column("background")) == {"tac_background.png"}
    assert kinds(result.suspicious) == {"unlisted": 1, "no-text": 1}
    assert result.manifest.column("text")[0] is None


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (" Soft ,  FUZZY.", "soft, fuzzy"),
        ("textured, stiff, rigid,", "textured, stiff, rigid"),
        ("a.b", "ab"),
        (" . , ", None),
        ("", None),
        (None, None),
        ("two  words\n, x", "two words, x"),
    ],
)
def test_captions_are_cleaned(given, expected):
    assert tvl.clean_caption(given) == expected

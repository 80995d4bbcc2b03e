"""VisGel: both kinds of lists, recordings without lists, the contact of a frame, all problems."""

from forge.formats import (
    drawn,
    imported,
    kinds,
    make_visgel,
    make_visgel_recordings,
    of_kind,
    row,
    visgel_line,
)
from palpate.core import Split
from palpate.data.importing import import_dataset, validate, write_lists

BOM = b"\xef\xbb\xbf"


def test_lists_name_vision_touch_and_reference(tmp_path):
    result = imported(make_visgel, tmp_path)
    assert result.facts["layout"] == "lists"
    domains = {"data/data_seen/1/rec_a": "seen", "data/data_seen/10/rec_a": "seen"}
    domains |= {"data/data_unseen/2/rec_b": "unseen"}
    assert result.manifest.ids == [f"{video}/{k}" for video in domains for k in (2, 3, 4)]
    assert result.manifest.column("domain") == [d for d in domains.values() for _ in range(3)]
    assert row(result, "data/data_unseen/2/rec_b/4") == {
        "id": "data/data_unseen/2/rec_b/4",
        "video": "data/data_unseen/2/rec_b",
        "frame": 4,
        "sensor": "GelSight",
        "domain": "unseen",
        "vision": "data/data_unseen/vision/2/rec_b/frame0004.jpg",
        "tactile": "data/data_unseen/touch/2/rec_b/frame0004.jpg",
        "background": "data/data_unseen/touch/2/rec_b/frame0000.jpg",
    }
    # six folders of seven images each: touch, then vision, of the three recordings
    assert drawn(result, "tactile") == [first + k for first in (1, 15, 29) for k in (2, 3, 4)]
    assert drawn(result, "vision") == [first + k for first in (8, 22, 36) for k in (2, 3, 4)]
    assert drawn(result, "background") == [first for first in (1, 15, 29) for _ in range(3)]
    assert {n: s.counts() for n, s in result.splits.items()} == {"Orig": {"train": 6, "test": 3}}


def test_bad_lines(tmp_path):
    root = make_visgel(tmp_path / "data").source
    path = root / "data_lst" / "train_vision2touch.txt"
    line = lambda *args: visgel_line(*args, "vision2touch")
    seen = "data/data_seen"
    good = [line(seen, "1/rec_a", k) for k in (2, 3, 5)]
    lines = [
        *good,  # 1 to 3
        good[0],  # 4: again
        good[1].rpartition(" ")[0],  # 5: seven paths
        good[1].replace("frame0003", "last"),  # 6
        good[1].replace("data/", "../data/").replace("0003", "0006"),  # 7
        line(seen, "77/gone", 1),  # 8 and 9: a recording that is not there
        line(seen, "77/gone", 2),
        line(seen, "10/rec_a", 66),  # 10: no tactile and no vision image of that number
        line("data/data_unseen", "2/rec_b", 2),  # 11: also in eval
        "",
        "caf\xe9",
    ]
    path.write_bytes(BOM + "\r\n".join(lines).encode("latin-1"))
    result = validate(root)
    assert {(p.where, p.kind) for p in [*result.missing, *result.invalid]} == {
        (f"{path}:4", "duplicate-row"),
        (f"{path}:5", "bad-line"),
        (f"{path}:6", "bad-frame"),
        (f"{path}:7", "outside-root"),
        (f"{path}:8", "missing-folder"),
        (f"{path}:10", "missing-file"),
        (f"{path}:13", "bad-encoding"),
        (f"{root / 'data_lst' / 'eval_vision2touch.txt'}:1", "two-parts"),
    }
    assert of_kind(result.missing, "missing-folder").text.startswith("2 rows: no folder")
    result = import_dataset(root, tmp_path / "out", skip_bad=True)
    # the nine of the other direction, and frame 5 of the first recording
    assert len(result.manifest) == 10
    assert {name: split.counts() for name, split in result.splits.items()} == {
        "Orig-vision2touch": {"train": 3, "test": 2},
        "Orig-touch2vision": {"train": 6, "test": 3},
    }
    files = {
        way: result.splits[f"Orig-{way}"].rule["files"] for way in ("vision2touch", "touch2vision")
    }
    assert all(
        len(names) == 2 and all(way in name for name in names) for way, names in files.items()
    )


def test_lists_in_another_folder(tmp_path):
    root = make_visgel(tmp_path / "data").source
    for path in (root / "data_lst").iterdir():
        path.write_text(path.read_text().replace("data/data_", "data_"))
    lists = (root / "data_lst").rename(tmp_path / "elsewhere")
    options = {"format": "visgel", "root": root / "data"}
    result = import_dataset(lists, tmp_path / "out", **options)
    assert result.manifest.ids[0] == "data_seen/1/rec_a/2"
    assert result.manifest.require_valid().root == (root / "data").resolve()


def test_recordings_without_lists(tmp_path):
    result = imported(make_visgel_recordings, tmp_path)
    assert result.facts["layout"] == "recordings"
    assert result.manifest.ids == [f"{n}/rec/{k}" for n in (2, 10) for k in (1, 2, 3)]
    assert result.manifest.column("vision") == [None] * 6
    assert drawn(result, "tactile") == [2, 3, 4, 6, 7, 8]
    assert drawn(result, "background") == [1] * 3 + [5] * 3
    assert result.splits == {}
    split = Split(dict.fromkeys(result.manifest.ids, "train"))
    assert [p.name for p in write_lists(result.manifest, split, tmp_path / "l")] == ["train.csv"]
    root = tmp_path / "data" / "data_seen"
    (root / "2" / "rec" / "frame0000.jpg").unlink()
    (root / "10" / "rec" / "frame0002.jpg").unlink()
    report = validate(root, format="visgel")
    assert (report.ok, report.samples) == (True, 5)
    assert kinds(report.suspicious) == {"no-background": 1}


def test_recordings_of_both_sides(tmp_path):
    root = make_visgel(tmp_path / "data").source
    for path in (root / "data_lst").iterdir():
        path.unlink()
    result = import_dataset(root, tmp_path / "out")
    assert len(result.manifest) == 18
    assert result.manifest.ids[0] == "data/data_seen/1/rec_a/1"
    assert drawn(result, "vision")[:6] == list(range(9, 15))
    assert result.manifest.column("domain")[-1] == "unseen"
    (root / "data/data_seen/vision/1/rec_a/frame0002.jpg").unlink()
    for path in (root / "data/data_seen/vision/10/rec_a").iterdir():
        path.unlink()
    report = validate(root, format="visgel")
    assert kinds(report.missing) == {"unpaired": 1, "missing-folder": 1}
    assert report.samples == 5 + 6

"""VisGel: both kinds of lists, recordings without lists, the contact of a frame; every row known by hand, everything bad told."""

import numpy as np
import pytest

from data_forge import write_image
from formats_forge import (
    drawn,
    forge_visgel,
    forge_visgel_recordings,
    imported,
    kinds,
    of_kind,
    row,
    visgel_line,
)
from palpate.core import PalpateError, Split
from palpate.data.formats import visgel
from palpate.data.importing import import_dataset, validate_dataset, write_lists

BOM = b"\xef\xbb\xbf"


def test_visgel_lists_name_vision_touch_and_reference(tmp_path):
    found = imported(forge_visgel, tmp_path)
    assert found.facts["format"] == "visgel"
    assert found.facts["layout"] == "lists"
    videos = [
        ("data/data_seen/1/rec_a", "seen"),
        ("data/data_seen/10/rec_a", "seen"),
        ("data/data_unseen/2/rec_b", "unseen"),
    ]
    assert found.manifest.ids == [f"{video}/{k}" for video, _ in videos for k in (2, 3, 4)]
    assert found.manifest.column("domain") == [domain for _, domain in videos for _ in range(3)]
    assert row(found, "data/data_unseen/2/rec_b/4") == {
        "id": "data/data_unseen/2/rec_b/4",
        "video": "data/data_unseen/2/rec_b",
        "frame": 4,
        "sensor": "GelSight",
        "domain": "unseen",
        "vision": "data/data_unseen/vision/2/rec_b/frame0004.jpg",
        "tactile": "data/data_unseen/touch/2/rec_b/frame0004.jpg",
        "background": "data/data_unseen/touch/2/rec_b/frame0000.jpg",
    }
    # six folders of seven pictures each: touch, then vision, of the three recordings
    assert drawn(found, "tactile") == [first + k for first in (1, 15, 29) for k in (2, 3, 4)]
    assert drawn(found, "vision") == [first + k for first in (8, 22, 36) for k in (2, 3, 4)]
    assert drawn(found, "background") == [first for first in (1, 15, 29) for _ in range(3)]
    assert {name: split.counts() for name, split in found.splits.items()} == {
        "Orig": {"train": 6, "test": 3}
    }


def test_visgel_lists_are_written_with_the_lines_of_the_set(tmp_path):
    found = imported(forge_visgel, tmp_path)
    lists = tmp_path / "data" / "visgel" / "data_lst"
    written = write_lists(found.manifest, found.splits["Orig"], tmp_path / "lists")
    assert {p.name: p.read_text() for p in written} == {
        p.name: p.read_text() + "\n" for p in lists.iterdir()
    }
    ids = found.manifest.ids
    other = write_lists(found.manifest, Split({ids[0]: "test", ids[-1]: "val"}), tmp_path / "other")
    assert sorted(p.name for p in other) == [
        "eval_touch2vision.txt",
        "eval_vision2touch.txt",
        "val_touch2vision.txt",
        "val_vision2touch.txt",
    ]
    assert (tmp_path / "other" / "eval_touch2vision.txt").read_text() == visgel_line(
        "data/data_seen", "1/rec_a", 2, "touch2vision"
    ) + "\n"
    (lists / "train_touch2vision.txt").unlink()
    (lists / "train_vision2touch.txt").unlink()
    with pytest.raises(PalpateError, match="Every sample must stand in one of the lists"):
        write_lists(found.manifest, found.splits["Orig"], tmp_path / "gone")


def test_visgel_bad_lines(tmp_path):
    root = forge_visgel(tmp_path / "data").source
    path = root / "data_lst" / "train_vision2touch.txt"
    good = [visgel_line("data/data_seen", "1/rec_a", k, "vision2touch") for k in (2, 3, 5)]
    lines = [
        *good,  # 1 to 3
        good[0],  # 4: again
        good[1].rpartition(" ")[0],  # 5: seven paths
        good[1].replace("frame0003", "last"),  # 6
        good[1].replace("data/", "../data/"),  # 7
        visgel_line(
            "data/data_seen", "77/gone", 1, "vision2touch"
        ),  # 8 and 9: a recording that is not there
        visgel_line("data/data_seen", "77/gone", 2, "vision2touch"),
        visgel_line(
            "data/data_seen", "10/rec_a", 66, "vision2touch"
        ),  # 10: no touch and no vision of that number
        visgel_line("data/data_unseen", "2/rec_b", 2, "vision2touch"),  # 11: stands in eval
        "",
        "caf\xe9",
    ]
    path.write_bytes(BOM + "\r\n".join(lines).encode("latin-1"))
    looked = validate_dataset(root)
    told = {(p.where.removeprefix(f"{path}:"), p.kind) for p in [*looked.missing, *looked.invalid]}
    assert told == {
        ("4", "duplicate-row"),
        ("5", "bad-line"),
        ("6", "bad-frame"),
        ("7", "outside-root"),
        ("10", "missing-file"),
        ("13", "bad-encoding"),
        ("data/data_seen/touch/77/gone", "missing-folder"),
        (f"{root / 'data_lst' / 'eval_vision2touch.txt'}:1", "two-parts"),
    }
    assert "2 listed samples" in of_kind(looked.missing, "missing-folder").text
    found = import_dataset(root, tmp_path / "out", skip_bad=True)
    assert (
        len(found.manifest) == 10
    )  # the nine of the other direction, and frame 5 of the first recording
    assert {name: split.counts() for name, split in found.splits.items()} == {
        "Orig-vision2touch": {"train": 3, "test": 2},
        "Orig-touch2vision": {"train": 6, "test": 3},
    }


def test_visgel_lists_of_another_disk(tmp_path):
    root = forge_visgel(tmp_path / "data").source
    for path in (root / "data_lst").iterdir():
        path.write_text(
            "\n".join(
                " ".join(f"/mit/{p}" for p in line.split())
                for line in path.read_text().splitlines()
            )
        )
    assert kinds(validate_dataset(root).invalid) == {"outside-root": 18}
    (root / "data_lst").rename(tmp_path / "elsewhere")
    found = import_dataset(
        tmp_path / "elsewhere",
        tmp_path / "out",
        format="visgel",
        root=root / "data",
        prefix="/mit/data/",
    )
    assert found.manifest.ids[0] == "data_seen/1/rec_a/2"
    assert found.manifest.require_valid().root == (root / "data").resolve()
    assert len(write_lists(found.manifest, found.splits["Orig"], tmp_path / "lists")) == 4


def test_visgel_recordings_without_lists(tmp_path):
    found = imported(forge_visgel_recordings, tmp_path)
    assert found.facts["format"] == "visgel"
    assert found.facts["layout"] == "recordings"
    assert found.manifest.ids == [f"{n}/rec/{k}" for n in (2, 10) for k in (1, 2, 3)]
    assert found.manifest.column("vision") == [None] * 6
    assert drawn(found, "tactile") == [2, 3, 4, 6, 7, 8]
    assert drawn(found, "background") == [1] * 3 + [5] * 3
    assert found.splits == {}
    written = write_lists(
        found.manifest, Split(dict.fromkeys(found.manifest.ids, "train")), tmp_path / "lists"
    )
    assert [p.name for p in written] == ["train.csv"]
    root = tmp_path / "data" / "data_seen"
    (root / "2" / "rec" / "frame0000.jpg").unlink()
    (root / "10" / "rec" / "frame0002.jpg").unlink()
    looked = validate_dataset(root, format="visgel")
    assert looked.ok
    assert looked.samples == 5
    assert kinds(looked.suspicious) == {"no-background": 1, "frame-gap": 1}


def test_visgel_recordings_of_both_sides(tmp_path):
    root = forge_visgel(tmp_path / "data").source
    for path in (root / "data_lst").iterdir():
        path.unlink()
    (root / "data_lst").rmdir()
    found = import_dataset(root, tmp_path / "out")
    assert len(found.manifest) == 18
    assert found.manifest.ids[0] == "data/data_seen/1/rec_a/1"
    assert drawn(found, "vision")[:6] == list(range(9, 15))
    assert found.manifest.column("domain")[-1] == "unseen"
    (root / "data/data_seen/vision/1/rec_a/frame0002.jpg").unlink()
    for path in (root / "data/data_seen/vision/10/rec_a").iterdir():
        path.unlink()
    looked = validate_dataset(root, format="visgel")
    assert kinds(looked.missing) == {"unpaired": 2}
    assert looked.samples == 5 + 6


def test_visgel_contact_is_the_variance_of_the_laplacian(tmp_path):
    frame, reference = np.full((9, 9), 100.0), np.full((9, 9), 90.0)
    assert visgel.contact(frame, reference) == 0  # a brighter gel is no contact
    frame[4, 4] += 9
    # one pixel of 9: -36 there and 9 at each of 4 neighbors; mean 0, so the variance is (36² + 4·9²) / 81
    assert visgel.contact(frame, reference) == pytest.approx((36**2 + 4 * 9**2) / 81)
    root = forge_visgel_recordings(tmp_path / "data").source
    for k in (1, 2):
        write_image(
            root / "2" / "rec" / f"frame{k:04d}.jpg", 1
        )  # like the reference, which carries 1
    found = import_dataset(root, tmp_path / "out", format="visgel", min_contact=18.0)
    assert found.manifest.ids == ["2/rec/3", "10/rec/1", "10/rec/2", "10/rec/3"]
    assert found.facts["min_contact"] == "18; 2 of 6 frames left out"
    for k in (1, 2):
        write_image(root / "10" / "rec" / f"frame{k:04d}.jpg", 5)
    looked = validate_dataset(root, format="visgel")
    assert "4 of 6 frames looked at touch nothing" in of_kind(looked.suspicious, "flat-frames").text
    assert validate_dataset(root, format="visgel", check="header").suspicious == []


@pytest.mark.parametrize(("values", "flat"), [((17.9, 18.0, 18.1), 2), ((18.0, 18.1, 18.1), None)])
def test_visgel_contact_of_18_or_less_is_flat(tmp_path, monkeypatch, values, flat):
    root = forge_visgel_recordings(tmp_path / "data").source
    monkeypatch.setattr(visgel, "_contacts", lambda *_: dict(enumerate(values)))
    told = [p.text for p in validate_dataset(root, format="visgel").suspicious]
    assert told == (
        [
            f"{flat} of 3 frames looked at touch nothing (contact of 18 or less); min_contact=18 leaves such out"
        ]
        if flat
        else []
    )

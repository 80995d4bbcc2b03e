"""What lies in a folder is read, counted or named; a pair is made only where names say so."""

import io
import pickle
import re
import shlex
import zipfile

import numpy as np
import pytest

from forge.errors import fails
from forge.pictures import write_images
from palpate.cli import main
from palpate.data.detection import detect_layout
from palpate.data.importing import import_dataset
from palpate.data.manifest import Manifest
from palpate.data.reading import load


def zipped() -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("a/1.png", b"x")
    return data.getvalue()


def saved(array) -> bytes:
    data = io.BytesIO()
    np.save(data, array, allow_pickle=True)
    return data.getvalue()


FILES = {
    "set.zip": (zipped(), "zip archive.* Unpack it first: unzip set.zip"),
    "set.dat": (zipped(), "zip archive"),  # by its bytes
    "shard-000.tar.gz": (b"\x1f\x8b\x08", "tar archive.* tar -xf"),
    "log.hdf5": (b"\x89HDF\r\n\x1a\n", "HDF5"),
    "split.pkl": (pickle.dumps({"train": []}), "a pickle.* JSON"),
    "split.npy": (saved(np.array({"train": ["a"]}, dtype=object)), "pickle.* JSON"),
    "list.npy": (saved(np.arange(3)), "array of int64"),
    "table.xlsx": (b"PK\x03\x04", "spreadsheet.*fill each row.* CSV"),
}


@pytest.mark.parametrize("name", FILES)
def test_files_of_other_programs_are_named_with_the_way_in(tmp_path, name):
    data, words = FILES[name]
    (tmp_path / name).write_bytes(data)
    error = fails(words, import_dataset, tmp_path / name, tmp_path / "out")
    assert len(str(error)) < 600
    fails(words, load, tmp_path / name)
    if not name.endswith(("npy", "dat")):  # a stack of frames, or known by its bytes alone
        fails(words, import_dataset, tmp_path, tmp_path / "out")


def test_folders_of_other_programs_are_named(tmp_path):
    for mark, word in (("meta/info.json", "LeRobot"), (".zgroup", "Zarr")):
        root = tmp_path / word
        (root / mark).parent.mkdir(parents=True)
        (root / mark).write_text("{}")
        write_images(root, ["videos/touch/1.png", "videos/rgb/1.png"])
        fails(word, import_dataset, root, tmp_path / "out")


def test_links_are_followed_and_circles_cut(tmp_path):
    for k in range(2):
        names = [f"s{k}/{side}/{n}.png" for side in ("photo", "touch") for n in range(2)]
        write_images(tmp_path / "store", names, 8 * k + 1)
    root = tmp_path / "own"
    root.mkdir()
    for k in range(2):
        (root / f"s{k}").symlink_to(tmp_path / "store" / f"s{k}")
    (root / "s0" / "again").symlink_to(root)
    (root / "s2").symlink_to(tmp_path / "unmounted")
    result = import_dataset(root, tmp_path / "out")
    assert len(Manifest.load(tmp_path / "out").require_valid()) == 4
    assert [p.kind for p in result.suspicious] == ["linked-twice", "dead-link"]


def test_links_that_a_copy_turned_into_files_are_named(tmp_path):
    write_images(tmp_path / "store", ["touch/1.png"])
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "s0").write_text("../store")
    fails("links to folders.*s0", import_dataset, tmp_path / "own", tmp_path / "out")


def test_what_is_not_read_next_to_images_is_counted(tmp_path):
    write_images(tmp_path / "own", ["photo/1.png", "touch/1.png"])
    (tmp_path / "own" / "more.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    (unread,) = import_dataset(tmp_path / "own", tmp_path / "out").suspicious
    assert (unread.kind, "1 x an HDF5 file" in unread.text) == ("unread", True)


CUP, BOTH = ("cup",), ("cup", "mug")
#: Paths of photos and of tactile images with an object {o} and a number {k}.
SIDES = [
    ("{o}/photo/{k}.jpg", "{o}/touch/{k}.png"),
    ("photo/{o}/{k}.jpg", "touch/{o}/{k}.png"),
    ("{o}_{k}_rgb.jpg", "{o}_{k}_tac.png"),
    ("{o}_{k}.png", "{o}_{k}_touch.png"),  # one side without a word
    ("day_1/{o}/rgb/{k}.png", "day_1/{o}/gelsight/{k}.png"),
    ("{o}/run_1/rgb/{k}.png", "{o}/run_1/gelsight/{k}.png"),
    ("{o}_rgb/{k}.png", "{o}_tac/{k}.png"),
]


@pytest.mark.parametrize("photo", SIDES)
@pytest.mark.parametrize("alone", ["photos", "touches"])
def test_an_object_without_partners_gets_none_of_another(tmp_path, photo, alone):
    objects = (CUP, BOTH) if alone == "touches" else (BOTH, CUP)
    for n, (text, names) in enumerate(zip(photo, objects, strict=True)):
        paths = [text.format(o=o, k=k) for o in names for k in range(3)]
        write_images(tmp_path / "own", paths, 32 * n + 1)
    error = fails("", import_dataset, tmp_path / "own", tmp_path / "out")
    assert {p.kind for p in error.problems} == {"unpaired"}
    assert len(error.problems) == 3
    result = import_dataset(tmp_path / "own", tmp_path / "out", skip_bad=True)
    table = result.manifest.table
    assert len(table) == 3
    assert table["vision"].str.contains("cup").all()
    assert table["tactile"].str.contains("cup").all()


@pytest.mark.parametrize(
    ("photo", "touch"),
    [
        *(
            ([a.format(o="cup", k=k) for k in (1, 2)], [b.format(o="mug", k=k) for k in (1, 2)])
            for a, b in SIDES
        ),
        (["photo/1.jpg", "photo/2.jpg"], [f"touch/{o}/{k}.png" for o in BOTH for k in (1, 2)]),
        (["photo_1.jpg", "photo_2.jpg"], [f"{o}_touch_{k}.png" for o in BOTH for k in (1, 2)]),
    ],
)
def test_photos_that_nothing_ties_to_touches_are_not_paired(tmp_path, photo, touch, capsys):
    """What is offered then takes one side, and works."""
    write_images(tmp_path / "own", [*photo, *touch])
    command = ["import", str(tmp_path / "own"), "-o", str(tmp_path / "out")]
    assert main(command) == 2
    text = capsys.readouterr().err
    assert "few share their names" in text
    answers = re.findall("(?m)^  palpate .*$", text)
    assert len(answers) == 2
    for answer in answers:
        assert main([*shlex.split(answer)[1:], "--overwrite"]) == 0
        assert len(Manifest.load(tmp_path / "out")) in (len(photo), len(touch))


@pytest.mark.parametrize(
    "last", [("rgb", "gelsight"), ("photo", "gelsight"), ("camera", "touch"), ("rgb_1", "gel_1")]
)
def test_a_session_with_other_words_for_its_sides_is_read_or_named(tmp_path, last):
    words = {"s1": ("photo", "touch"), "s2": ("photo", "touch"), "s3": last}
    for n in range(2):
        paths = [f"{s}/{own[n]}/{k}.png" for s, own in words.items() for k in range(4)]
        write_images(tmp_path / "own", paths, 32 * n + 1)
    result = import_dataset(tmp_path / "own", tmp_path / "out")
    table = result.manifest.table.select("vision", "tactile")
    folders = {(a.rpartition("/")[0], b.rpartition("/")[0]) for a, b in table.iter_rows()}
    assert folders == {(f"{s}/{a}", f"{s}/{b}") for s, (a, b) in words.items()}
    assert len(table) == 12


@pytest.mark.parametrize(
    ("photo", "touch"),
    [
        ("{o}/photo.jpg", "{o}/touch/{k}.png"),
        ("photo/{o}.jpg", "touch/{o}/{k}.png"),
        ("{o}_photo.jpg", "{o}_{k}_touch.png"),
    ],
)
def test_one_photo_of_an_object_is_that_of_its_touches_alone(tmp_path, photo, touch):
    names = [photo.format(o="cup"), *(touch.format(o=o, k=k) for o in BOTH for k in range(3))]
    write_images(tmp_path / "own", names)
    result = import_dataset(tmp_path / "own", tmp_path / "out", skip_bad=True)
    assert [p.kind for p in result.skipped] == ["unpaired"] * 3
    assert result.manifest.table["tactile"].str.contains("cup").to_list() == [True] * 3


def test_one_side_of_a_folder_of_both_is_taken_by_its_template(tmp_path):
    write_images(tmp_path / "own", [f"{s}/{k}.png" for s in ("photo", "touch") for k in range(3)])
    own, out = tmp_path / "own", tmp_path / "out"
    error = fails("names say both sides", import_dataset, own, out, side="vision")
    assert [*error.choices] == [{"vision": "photo/{frame:d}.png"}]


def test_one_background_is_not_that_of_another_object():
    files = [
        "cup/bg.png",
        *(f"{o}/{k}_{s}.png" for o in BOTH for k in (1, 2) for s in ("rgb", "tac")),
    ]
    assert detect_layout(files, "own")["background"] == "{video}/bg.png"


@pytest.mark.parametrize("stamp", ["{:.3f}", "{:.0f}000000"])
@pytest.mark.parametrize("side", ["{o}/rgb/{t}.png", "rgb/{o}/cam_{t}.png"])
def test_images_with_time_stamps_are_paired_by_the_nearest(tmp_path, stamp, side):
    start = 1.7e12 if stamp.endswith("0") else 1.7e9
    step = 40 if stamp.endswith("0") else 0.04
    times = {"rgb": [start + 1.7 * step * k for k in range(12)]}  # the slower camera
    times["gelsight"] = [start + step * (k + 0.25) for k in range(20)]
    paths = {
        word: [
            side.replace("rgb", word)
            .replace("cam", "gel" * (word != "rgb") or "cam")
            .format(o=o, t=stamp.format(t))
            for o in BOTH
            for t in some
        ]
        for word, some in times.items()
    }
    write_images(tmp_path / "own", [*paths["rgb"], *paths["gelsight"]])
    result = import_dataset(tmp_path / "own", tmp_path / "out", skip_bad=True)
    assert "paired-by-time" in {p.kind for p in result.suspicious}
    assert all("of its time; the nearest is" in p.text for p in result.skipped)
    near = {}
    for n, t in enumerate(times["gelsight"]):
        k = min(range(12), key=lambda k: abs(times["rgb"][k] - t))
        if abs(times["rgb"][k] - t) <= 0.85 * step:
            near |= {paths["gelsight"][n + 20 * i]: paths["rgb"][k + 12 * i] for i in range(2)}
    table = result.manifest.table
    assert dict(zip(table["tactile"], table["vision"], strict=True)) == near

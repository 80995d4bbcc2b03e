"""Files and folders of other programs, which are not read: what they are, and the way in.

They are recognized by their suffix or by the bytes that they begin with, never opened.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from palpate.core import PalpateError, few

_UNPACK = "Unpack it first: {} {name}; then name the folder"
_FILES = "Write its images as files, or as stacks with numpy.save, next to a table that names them"
_PLAIN = (
    "It may run code when it is opened. Where you trust it, save what it holds as JSON, such "
    'as {{"train": [..], "test": [..]}}, as CSV, or its images as files'
)
_SHEET = "Unmerge its cells, fill each row, as only the first keeps the value, and save it as CSV"
#: (what it is, suffixes, bytes that it may begin with, the way in).
KINDS: tuple[tuple[str, tuple[str, ...], tuple[bytes, ...], str], ...] = (
    ("a spreadsheet", (".xlsx", ".xls", ".ods"), (), _SHEET),
    ("a pickle", (".pkl", ".pickle", ".pt", ".pth", ".joblib", ".ckpt"), (), _PLAIN),
    ("a pickle", (), (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"), _PLAIN),
    ("an archive of arrays", (".npz",), (), _FILES),
    ("a zip archive", (".zip",), (b"PK\x03\x04",), _UNPACK.replace("{}", "unzip")),
    (
        "a tar archive",
        (".tar", ".tgz", ".tar.gz", ".tar.xz", ".tar.bz2", ".tar.zst"),
        (),
        _UNPACK.replace("{}", "tar -xf"),
    ),
    ("a compressed file", (".gz",), (b"\x1f\x8b",), _UNPACK.replace("{}", "gunzip")),
    ("a compressed file", (".bz2", ".xz", ".zst"), (), _UNPACK.replace("{}", "7z x")),
    ("a 7z archive", (".7z",), (b"7z\xbc\xaf\x27\x1c",), _UNPACK.replace("{}", "7z x")),
    ("a RAR archive", (".rar",), (b"Rar!",), _UNPACK.replace("{}", "unrar x")),
    ("an HDF5 file", (".h5", ".hdf5", ".hdf"), (b"\x89HDF\r\n\x1a\n",), _FILES),
    ("a MATLAB file", (".mat",), (b"MATLAB",), _FILES),
    ("a robot log", (".bag", ".mcap", ".db3"), (b"#ROSBAG",), _FILES),
    ("a TFRecord file", (".tfrecord", ".tfrecords"), (), _FILES),
    ("a database", (".sqlite", ".mdb", ".lmdb"), (b"SQLite format 3",), _FILES),
)
_EPISODES = (
    "Cut each episode into a folder of its own, such as episode_0/camera.mp4 and "
    "episode_0/touch.mp4, and import the folder that holds them"
)
#: A link that a copy turned into a file holds at most so many bytes.
LONGEST_LINK = 255
#: (what a folder is, the file that says so, the way in).
FOLDERS = (
    ("a LeRobot data set", "meta/info.json", _EPISODES),
    ("a Zarr store", ".zgroup", _FILES),
    ("a Zarr store", "zarr.json", _FILES),
)


def foreign(path: Path) -> tuple[str, str] | None:
    """What a file or folder is that is not read, and the way in; None for all others."""
    if path.is_dir():
        return next(((kind, fix) for kind, mark, fix in FOLDERS if (path / mark).is_file()), None)
    if not path.is_file():
        return None
    with open(path, "rb") as file:
        head = file.read(16)
    name = path.name.lower()
    if head.startswith(b"\x93NUMPY"):
        return _array(path)
    for kind, suffixes, marks, fix in KINDS:
        if name.endswith(suffixes) or head.startswith(marks):
            return kind, fix.format(name=path.name)
    return None


def _array(path: Path) -> tuple[str, str]:
    """What a ``.npy`` file holds; a stack of frames is read as one file of a folder."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        kind = f"a NumPy array of {array.dtype} and shape {array.shape}"
        return kind, "Name the folder of the stacks; write a list as CSV or JSON"
    except Exception:  # of another version, damaged, or of Python's objects
        return "a NumPy file that holds a pickle", _PLAIN.format()


def require_native(source: Path) -> None:
    """Raise if a source is of another program.

    Raises:
        PalpateError: with what it is and the way in.
    """
    if found := foreign(source):
        must = "must be images, videos, tables or lists"
        raise PalpateError(must, f"{source.name}, {found[0]}", found[1], argument="source")


def counted(files: Iterable[str]) -> list[str]:
    """What is not read of some files, by their suffixes: ``"2 of a zip archive (.zip)"``."""
    counts: Counter[str] = Counter()
    for name in files:
        lower = name.lower()
        kind = next((k for k, ends, _, _ in KINDS if lower.endswith(ends)), None)
        counts.update([f"{kind} ({Path(lower).suffix})"] if kind else [])
    return [f"{count} x {kind}" for kind, count in counts.most_common()]


def copied_links(folder: Path) -> str:
    """Names of small files that hold the path of another folder: links that a copy did not keep."""
    names: list[str] = []
    for path in sorted(folder.iterdir()):
        if path.is_file() and 0 < path.stat().st_size <= LONGEST_LINK:
            text = path.read_bytes().decode("utf-8", "replace").strip()
            if text.isprintable() and (folder / text).is_dir():
                names.append(path.name)
    return few(names) if names else ""

"""Embeddings from files: every kind gives the same set, and what is no such file is refused with a reason."""

import datetime
import json
import pickle
import zipfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from palpate.core import FeatureSet, PalpateError
from palpate.evaluation.embeddings import (
    Columns,
    is_embeddings,
    read_columns,
    read_embeddings,
    read_together,
)

IDS = ["v0/1", "007", 'odd "name", [x]', "grün"]
LABELS, GROUPS = ["Wood", "Wood", "Brick", ""], ["v0", "v0", "v1", "v1"]
X = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)


def safe(
    path: Path, x: np.ndarray, kind: str, metadata: dict[str, str], header: dict | None = None
) -> Path:
    """A .safetensors file by its specification, written independently of the reader."""
    data = x.tobytes()
    entry = {
        "features": {"dtype": kind, "shape": list(x.shape), "data_offsets": [0, len(data)]},
        "__metadata__": metadata,
    }
    text = json.dumps(entry | (header or {})).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)
    return path


def write(path: Path, kind: str) -> Path:
    path = path / f"x.{kind.split('-')[0]}"
    if kind == "npz":
        FeatureSet(IDS, X, LABELS, GROUPS, "e" * 64).save(path)
    elif kind == "safetensors":
        columns = {
            "ids": json.dumps(IDS),
            "labels": json.dumps(LABELS),
            "groups": json.dumps(GROUPS),
            "encoder": "e" * 64,
        }
        safe(path, X, "F32", columns)
    else:
        names = (
            {"material": LABELS, "video": GROUPS}
            if kind == "parquet-list"
            else {"label": LABELS, "group": GROUPS}
        )
        features = (
            {"features": X.tolist()}
            if kind == "parquet-list"
            else {f"f{k}": X[:, k] for k in (2, 0, 1)}
        )
        schema = {"features": pl.List(pl.Float32)} if kind == "parquet-list" else {}
        table = pl.DataFrame({"id": IDS, **names, **features}, schema_overrides=schema)
        table.write_parquet(path, metadata={"encoder": "e" * 64})
    return path


@pytest.mark.parametrize("kind", ["npz", "safetensors", "parquet-list", "parquet-columns"])
def test_every_kind_of_file_gives_the_same_set(tmp_path, kind):
    found = read_embeddings(write(tmp_path, kind)).feature_set()
    assert (found.ids, found.labels, found.groups, found.encoder) == (IDS, LABELS, GROUPS, "e" * 64)
    assert found.features.dtype == np.float32
    assert np.array_equal(found.features, X)


def test_a_fixed_width_column_and_what_the_safetensors_package_writes(tmp_path):
    array = pl.Series("features", X, dtype=pl.Array(pl.Float32, 3))
    pl.DataFrame({"id": IDS, "features": array}).write_parquet(tmp_path / "a.parquet")
    assert np.array_equal(read_embeddings(tmp_path / "a.parquet").features, X)
    numpy = pytest.importorskip("safetensors.numpy")
    numpy.save_file(
        {"other": np.ones(5), "features": X.astype(np.float64)},
        tmp_path / "b.safetensors",
        {"ids": json.dumps(IDS)},
    )
    found = read_embeddings(tmp_path / "b.safetensors")
    assert (found.ids, found.labels) == (IDS, None)
    assert np.array_equal(found.features, X.astype(np.float64))


def test_bfloat16_is_widened_bit_for_bit(tmp_path):
    high = (X.view(np.uint32) >> 16).astype(
        np.uint16
    )  # truncated to the upper half: what bfloat16 is
    with pytest.warns(
        UserWarning,
        match=r"features in .*x\.safetensors: bfloat16 features were widened to float32; their rounding stays",
    ):
        found = read_embeddings(safe(tmp_path / "x.safetensors", high, "BF16", {})).features
    assert found.dtype == np.float32
    assert np.array_equal(found.view(np.uint32), X.view(np.uint32) & 0xFFFF0000)


def test_npy_is_mapped_and_its_rows_numbered(tmp_path):
    np.save(tmp_path / "x.npy", X)
    found = read_embeddings(tmp_path / "x.npy")
    assert isinstance(found.features, np.memmap)
    assert (found.ids, found.labels, found.groups) == (None, None, None)
    assert found.feature_set("row ").ids == ["row 0", "row 1", "row 2", "row 3"]


def test_columns_complete_what_a_file_lacks(tmp_path):
    (tmp_path / "c.csv").write_text(
        "id,material,video\n" + "\n".join(f"{k:03d},m{k % 2},v{k // 2}" for k in (3, 2, 1, 0))
    )
    columns = read_columns(tmp_path / "c.csv")
    names = ["id", "material", "video"]
    want = Columns(
        tmp_path / "c.csv",
        ["003", "002", "001", "000"],
        ["m1", "m0", "m1", "m0"],
        ["v1", "v1", "v0", "v0"],
        "video",
        False,
        names,
    )
    assert columns == want
    np.savez(
        tmp_path / "x.npz",
        features=X,
        ids=np.array(["000", "001", "002", "003"]),
        labels=np.array(list("abcd")),
    )
    found = read_embeddings(tmp_path / "x.npz", columns)
    assert (found.labels, found.groups) == (
        ["a", "b", "c", "d"],
        ["v0", "v0", "v1", "v1"],
    )  # its own labels stay
    np.save(tmp_path / "y.npy", X)
    assert read_embeddings(tmp_path / "y.npy", columns).ids == ["003", "002", "001", "000"]
    np.save(tmp_path / "z.npy", X[:3])
    with pytest.raises(PalpateError, match=r"as many rows as .*c\.csv. Got 3 and 4"):
        read_embeddings(tmp_path / "z.npy", columns)
    np.savez(tmp_path / "w.npz", features=X, ids=np.array(["000", "001", "002", "other"]))
    with pytest.raises(PalpateError, match="1 of 4 that are not, first 'other'"):
        read_embeddings(tmp_path / "w.npz", columns)


def test_a_column_of_groups_that_was_asked_for_is_never_another_one(tmp_path):
    (tmp_path / "c.csv").write_text(
        "id,material,video,object\n" + "".join(f"{k},m,v{k},o\n" for k in range(4))
    )
    read = lambda *how, **more: read_columns(tmp_path / "c.csv", *how, **more)  # noqa: E731
    assert (read("touch").groups, read("touch").group) == (["v0", "v1", "v2", "v3"], "video")
    assert (read("touch", asked=True).groups, read("touch", asked=True).group) == (None, None)
    np.savez(
        tmp_path / "x.npz", features=X, ids=np.array(list("0123")), groups=np.array(list("abcd"))
    )
    assert read_embeddings(tmp_path / "x.npz", read("object")).groups == list(
        "abcd"
    )  # its own stay
    assert read_embeddings(tmp_path / "x.npz", read("object", asked=True)).groups == ["o"] * 4
    assert read_embeddings(tmp_path / "x.npz", read("touch", asked=True)).groups == list("abcd")


def test_files_that_are_read_together_have_groups_of_one_kind_and_know_which(tmp_path):
    (tmp_path / "c.csv").write_text("id,group\n" + "".join(f"{k},t{k}\n" for k in range(4)))
    columns, ids = read_columns(tmp_path / "c.csv"), np.array(list("0123"))
    np.savez(tmp_path / "own.npz", features=X, ids=ids, groups=np.array(list("abcd")))
    np.savez(tmp_path / "bare.npz", features=X, ids=ids)
    np.save(tmp_path / "none.npy", X)

    def read(*names, how=columns):
        found = read_together({name: next(tmp_path.glob(f"{name}.np*")) for name in names}, how)
        return [(one.groups and "".join(one.groups), one.column) for one in found.values()]

    assert read("own") == read("own", how=None) == [("abcd", None)]
    assert read("own", "bare", "none") == [("t0t1t2t3", "group")] * 3
    assert read("own", "bare", how=None) == [("abcd", None), (None, None)]


def test_half_precision_is_widened_once_and_said(tmp_path):
    np.save(tmp_path / "x.npy", X.astype(np.float16))
    with pytest.warns(
        UserWarning,
        match=r"features in .*x\.npy: float16 features were widened to float32; their rounding stays",
    ):
        found = read_embeddings(tmp_path / "x.npy").feature_set()
    assert found.features.dtype == np.float32
    assert np.array_equal(found.features, X.astype(np.float16))


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("material,video\na,b\n", "must have a column id"),
        ("id,color\na,b\n", "must have a column id, and material or video"),
        ("id,material\na,b\na,c\n", "1 that do not, first 'a'"),
        ("id,material\n,b\n", "none in row 1"),
        ("", "must be a CSV"),
    ],
)
def test_bad_columns_are_told(tmp_path, text, word):
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(PalpateError, match=word):
        read_columns(tmp_path / "c.csv")


def test_no_pickle_is_ever_loaded(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "exploded",))

    np.save(tmp_path / "x.npy", np.array([Bomb()], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "x.npz", features=np.array([Bomb()], dtype=object))
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(Bomb()))
    (tmp_path / "raw.npy").write_bytes(pickle.dumps(Bomb()))
    for name in ("x.npy", "x.npz", "x.pkl", "raw.npy"):
        with pytest.raises(PalpateError, match="pickle"):
            read_embeddings(tmp_path / name)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize(
    ("array", "word"),
    [
        (np.arange(6).reshape(2, 3), "must be floating-point. Got dtype int64"),
        (np.zeros(4, np.float32), r"must have shape \(n, d\). Got shape \(4,\)"),
        (np.zeros((2, 3, 4)), "must have shape"),
        (np.zeros((3, 0)), "must have shape"),
        (np.zeros((0, 3), np.float32), "at least one row|without pickles"),
    ],
)
def test_arrays_of_another_form_are_refused(tmp_path, array, word):
    np.save(tmp_path / "x.npy", array)
    with pytest.raises(PalpateError, match=word):
        read_embeddings(tmp_path / "x.npy")


def test_nan_is_named_by_id_and_file(tmp_path):
    bad = X.copy()
    bad[2, 1] = np.nan
    np.savez(tmp_path / "x.npz", features=bad, ids=np.array(IDS))
    with pytest.raises(
        PalpateError,
        match=r"x\.npz: Features must be finite. Got NaN or infinity in 1 row \(\d+: 'odd",
    ):
        read_embeddings(tmp_path / "x.npz").feature_set()


def test_damaged_and_lying_files_are_refused(tmp_path):
    header = lambda **entry: {
        "features": {"dtype": "F32", "shape": [4, 3], "data_offsets": [0, 48], **entry}
    }
    cases = {
        "short.safetensors": b"\x00\x01",
        "huge.safetensors": (1 << 60).to_bytes(8, "little") + b"{}",
        "text.safetensors": (4).to_bytes(8, "little") + b"oops",
        "cut.npz": b"PK\x03\x04 cut",
        "cut.npy": b"\x93NUMPY\x01\x00",
        "no.parquet": b"PAR1 nothing",
        "empty.npy": b"",
        "empty.npz": b"",
    }
    for name, data in cases.items():
        (tmp_path / name).write_bytes(data)
    wrong = {
        "beyond": header(data_offsets=[0, 4800], shape=[400, 3]),
        "size": header(shape=[4, 4]),
        "negative": header(shape=[-4, -3]),
        "start": header(data_offsets=[-8, 40]),
        "none": {"features": None},
        "ids": {"__metadata__": {"ids": '{"a": 1}'}},
        "numbers": {"__metadata__": {"ids": "[1, 2, 3, 4]"}},
        "kind": header(dtype="I32"),
        "about": {"__metadata__": [1]},
        "encoder": {"__metadata__": {"encoder": 5}},
        "encoders": {"__metadata__": {"encoder": ["q"]}},
        "half": header(shape=[4.5, 3]),
        "endless": header(shape=[float("inf"), 3]),
        "offset": header(data_offsets=[0.0, 48.0]),
    }
    for name, entry in wrong.items():
        cases[f"{name}.safetensors"] = b""
        safe(tmp_path / f"{name}.safetensors", X, "F32", {}, entry)
    np.savez(tmp_path / "foreign.npz", x=X)
    np.savez(tmp_path / "double.npz", features=X, ids=np.array(["a", "a", "b", "c"]))
    np.savez(tmp_path / "length.npz", features=X, ids=np.array(["a", "b"]))
    pl.DataFrame({"id": IDS, "f0": X[:, 0], "f2": X[:, 1]}).write_parquet(tmp_path / "gap.parquet")
    pl.DataFrame({"id": ["a", "b"], "features": [[1.0, 2.0], [1.0]]}).write_parquet(
        tmp_path / "ragged.parquet"
    )
    pl.DataFrame({"id": ["a", "b"], "features": [[1.0, 2.0], None]}).write_parquet(
        tmp_path / "null.parquet"
    )
    pl.DataFrame({"features": [[1.0, 2.0]]}).write_parquet(tmp_path / "noid.parquet")
    more = (
        "foreign.npz",
        "double.npz",
        "length.npz",
        "gap.parquet",
        "ragged.parquet",
        "null.parquet",
        "noid.parquet",
        "absent.npy",
        "x.txt",
    )
    np.savez_compressed(tmp_path / "deflated.npz", features=X)
    for name, at, byte in (
        ("coding.npz", 8, 99),
        ("secret.npz", 6, 1),
        ("stream.npz", None, 255),
    ):  # of the zip: method, flags, data
        data = bytearray((tmp_path / "deflated.npz").read_bytes())
        with zipfile.ZipFile(tmp_path / "deflated.npz") as file:
            start = 30 + len(file.infolist()[0].filename) + int.from_bytes(data[28:30], "little")
        index = data.index(b"PK\x01\x02")
        for k in [start, start + 1] if at is None else [at, index + at + 2]:
            data[k] = byte
        (tmp_path / name).write_bytes(data)
    more = (*more, "coding.npz", "secret.npz", "stream.npz")
    (tmp_path / "x.txt").write_text("1 2 3")
    for name in (*cases, *more):
        with pytest.raises(PalpateError, match=name.replace(".", r"\.")):
            read_embeddings(tmp_path / name)


@pytest.mark.parametrize("features", [{"features": [[1.0, 0.0]]}, {"f0": [1.0], "f1": [0.0]}])
def test_a_file_without_rows_says_so(tmp_path, features):
    pl.DataFrame({"id": ["a"], **features}).head(0).write_parquet(tmp_path / "x.parquet")
    safe(tmp_path / "x.safetensors", X[:0], "F32", {})
    np.savez(tmp_path / "x.npz", features=X[:0])
    for name in ("x.parquet", "x.safetensors", "x.npz"):
        with pytest.raises(PalpateError, match=rf"{name} must hold at least one row\. Got none"):
            read_embeddings(tmp_path / name)


@pytest.mark.parametrize(
    "column", [[["a"], ["b"]], [b"\xff", b"a"], [datetime.timedelta(1), datetime.timedelta(2)]]
)
@pytest.mark.parametrize("name", ["id", "material", "video"])
def test_names_that_are_no_text_are_refused(tmp_path, column, name):
    path = tmp_path / "x.parquet"
    pl.DataFrame(
        {"id": ["a", "b"], "material": ["a", "b"], "features": [[1.0], [1.0]]} | {name: column}
    ).write_parquet(path)
    for read in (read_embeddings, read_columns):
        with pytest.raises(
            PalpateError, match=rf"The column {name} in .*x\.parquet must be text, or numbers\. Got"
        ):
            read(path)


def test_a_panic_of_polars_is_told_as_a_damaged_file(tmp_path, monkeypatch):
    def panic(*_, **__):
        raise pl.exceptions.PanicException("capacity overflow")

    pl.DataFrame({"id": ["a"], "material": ["a"], "features": [[1.0]]}).write_parquet(
        tmp_path / "x.parquet"
    )
    monkeypatch.setattr(pl, "read_parquet", panic)
    for read in (read_embeddings, read_columns):
        with pytest.raises(PalpateError, match=r"x\.parquet must be .*Got capacity overflow"):
            read(tmp_path / "x.parquet")
    monkeypatch.setattr(pl, "read_parquet_metadata", panic)
    assert is_embeddings(tmp_path / "x.parquet")

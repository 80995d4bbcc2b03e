"""What can be scored: every kind of source gives the same samples, aligned by id on a bench."""

import json
import pickle
import zipfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from PIL import Image

from forge.pictures import paint
from palpate.core import FeatureSet, PalpateError, Split, quiet
from palpate.data.manifest import Manifest
from palpate.data.samples import named_sources, read_samples
from palpate.evaluation.scorers import Bench
from palpate.evaluation.scoring import aligned as aligned_on

N = 4
ROWS = ["v0/1", "007", 'odd "name", [x]', "grün"]
MATERIALS, VIDEO = ["Wood", "Wood", "Brick", ""], ["v0", "v0", "v1", "v1"]
X = np.random.default_rng(0).normal(size=(N, 3)).astype(np.float32)


def test_a_file_of_features_gives_its_columns(tmp_path):
    FeatureSet(ROWS, X, MATERIALS, VIDEO, "e" * 64).save(tmp_path / "x.npz")
    samples = read_samples(tmp_path / "x.npz", "x")
    assert (samples.ids, samples.labels, samples.groups) == (ROWS, MATERIALS, VIDEO)
    assert (samples.encoder, samples.numbered, samples.rows.dtype) == ("e" * 64, False, "f4")
    assert np.array_equal(samples.rows, X)


@pytest.mark.parametrize("kind", ["tensor", "list", "FeatureSet"])
def test_every_kind_of_object_gives_the_same_embeddings(kind):
    if kind == "tensor":
        source = pytest.importorskip("torch").from_numpy(X).requires_grad_()
    elif kind == "list":
        source = [list(map(float, row)) for row in X]
    else:
        source = FeatureSet(ROWS, X, MATERIALS, VIDEO)
    samples = read_samples(source, "x")
    assert np.allclose(samples.rows, X, atol=1e-7)
    known = (ROWS, MATERIALS, VIDEO) if kind == "FeatureSet" else (list("0123"), None, None)
    assert (samples.ids, samples.labels, samples.groups) == known


@pytest.mark.parametrize("kind", ["folder", "files", "PIL", "uint8", "tensor", "manifest", "table"])
def test_every_kind_of_source_gives_the_same_images(tmp_path, kind):
    folder = tmp_path / "real"
    images = np.stack([*paint(folder, ["a", "b", "c"], 0).values()])
    paths = [folder / f"{n}.png" for n in "abc"]
    rows = [{"id": n, "tactile": f"{n}.png"} for n in "abc"]
    pl.DataFrame(rows).write_csv(folder / "t.csv")
    source = {
        "folder": lambda: folder,
        "files": lambda: paths,
        "PIL": lambda: [Image.open(p) for p in paths],
        "uint8": lambda: images,
        "tensor": lambda: pytest.importorskip("torch").from_numpy(images / 255).permute(0, 3, 1, 2),
        "manifest": lambda: Manifest.from_rows(rows, folder),
        "table": lambda: folder / "t.csv",
    }[kind]()
    samples = read_samples(source, "x")
    assert samples.numbered == (kind in ("PIL", "uint8", "tensor"))
    assert samples.ids == (list("012") if samples.numbered else list("abc"))
    assert samples.side == 32
    assert np.array_equal(samples.pixels(32, tmp_path, lambda *_: None), images)


def test_half_precision_is_widened_and_files_are_mapped(tmp_path):
    np.save(tmp_path / "x.npy", X.astype(np.float16))
    assert read_samples(tmp_path / "x.npy", "x").rows.dtype == np.float32
    np.save(tmp_path / "y.npy", X)
    assert isinstance(read_samples(tmp_path / "y.npy", "y").rows, np.memmap)


def test_no_pickle_is_ever_loaded(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "exploded",))

    np.save(tmp_path / "x.npy", np.array([Bomb()], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "x.npz", features=np.array([Bomb()], dtype=object))
    for name in ("x.pkl", "raw.npy"):
        (tmp_path / name).write_bytes(pickle.dumps(Bomb()))
    for name in ("x.npy", "x.npz", "x.pkl", "raw.npy"):
        with pytest.raises(PalpateError, match="pickle"):
            read_samples(tmp_path / name, "x")
    assert not (tmp_path / "exploded").exists()


def damaged(folder: Path) -> list[str]:
    """Files that are no embeddings; their names."""
    contents = {
        "cut.npz": b"PK\x03\x04 cut",
        "cut.npy": b"\x93NUMPY\x01\x00",
        "empty.npy": b"",
        "x.txt": b"1 2 3",
    }
    for name, data in contents.items():
        (folder / name).write_bytes(data)
    np.savez(folder / "foreign.npz", x=X)
    np.savez(folder / "repeated.npz", features=X, ids=np.array(["a", "a", "b", "c"]))
    np.savez(folder / "length.npz", features=X, ids=np.array(["a", "b"]))
    np.savez_compressed(folder / "secret.npz", features=X)
    data = bytearray((folder / "secret.npz").read_bytes())
    data[6] = data[data.index(b"PK\x01\x02") + 8] = 1  # marked as encrypted
    (folder / "secret.npz").write_bytes(data)
    assert zipfile.is_zipfile(folder / "secret.npz")
    arrays = {"integers": np.arange(6).reshape(2, 3), "flat": np.zeros(4, np.float32)}
    arrays |= {"none": np.zeros((0, 3), np.float32), "wide": np.zeros((3, 0), np.float32)}
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    names = [*contents, *(f"{n}.npz" for n in ("foreign", "repeated", "length", "secret"))]
    return names + [f"{n}.npy" for n in arrays]


def test_damaged_and_foreign_files_are_named(tmp_path):
    for name in [*damaged(tmp_path), "absent.npy"]:
        with pytest.raises(PalpateError, match=name.replace(".", r"\.")):
            read_samples(tmp_path / name, "x")


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (np.zeros((2, 3), int), "floats"),
        (np.full((2, 4, 4, 3), 2.0), r"floats in \[0, 1\]"),
        (["a", "b"], "nothing at a"),
        (3, "shape"),
        (np.zeros((6, 6, 3), np.uint8), "must be several images"),
        (np.zeros((6, 6, 4), np.uint8), "must be several images"),
        (np.zeros((0, 4, 4, 3), np.uint8), "There must be samples"),
    ],
)
def test_other_objects_are_rejected(source, words):
    with pytest.raises(PalpateError, match=words):
        aligned(source, X)


def aligned(generated, reference, *, names=None, labels=None, split=None, group="auto"):
    sources = named_sources(generated, names, ("reference",))
    made = {name: read_samples(source, name) for name, source in sources.items()}
    real = read_samples(reference, "reference")
    bench = Bench(generators=made, reference=real, progress=quiet)
    return aligned_on(bench, labels, split, group)


def sets(ids=ROWS, labels=None, groups=None) -> FeatureSet:
    return FeatureSet(ids, X[: len(ids)], labels, groups)


TABLE = pl.DataFrame(
    {"id": ROWS, "material": list("abab"), "video": list("wwxx"), "contact": list("0123")}
)


CONTACTS, OWN = TABLE.select("id", "contact"), list("abcd")


@pytest.mark.parametrize(
    ("keywords", "labels", "groups", "kind"),
    [
        ({"labels": TABLE}, list("abab"), list("wwxx"), "video"),
        ({"labels": TABLE, "group": "contact"}, list("abab"), list("0123"), "contact"),
        ({"labels": dict(zip(ROWS, "wxyz", strict=True))}, list("wxyz"), VIDEO, "video"),
        ({}, MATERIALS, VIDEO, "video"),
    ],
)
def test_labels_and_groups_come_from_the_keywords_then_the_source_then_the_reference(
    keywords, labels, groups, kind
):
    inputs = aligned(sets(), sets(ROWS, MATERIALS, VIDEO), **keywords)
    for samples in (inputs.reference, *inputs.generators.values()):
        assert (samples.labels, samples.groups) == (labels, groups)
    assert inputs.reference.group == kind


def test_files_of_labels_give_ids_to_rows_without(tmp_path):
    TABLE.write_csv(tmp_path / "c.csv")
    TABLE.write_parquet(tmp_path / "c.parquet")
    for file in ("c.csv", "c.parquet"):
        inputs = aligned(X, X, labels=tmp_path / file)
        assert inputs.generators["generated"].ids == inputs.reference.ids == ROWS
        assert inputs.reference.groups == list("wwxx")
    assert aligned(X, X, labels=list("abab")).reference.labels == list("abab")


@pytest.mark.parametrize(
    ("generated", "keywords", "words"),
    [
        (sets(), {"group": "contact"}, "`group` must be known for every input\\. Got 'contact'"),
        (sets([*ROWS[:3], "x"]), {}, "gives material and video by id. Got 1 of 4 without"),
        (sets(), {"labels": TABLE[:3]}, "the labels, .* Got 1 of 4 without, first 'grün'"),
        (sets(), {"labels": TABLE.with_columns(id=pl.lit("z"))}, "must occur once"),
        (sets(), {"labels": {"z": "m"}}, "The labels must hold ids of these samples"),
        (sets(), {"labels": TABLE[:0]}, "Got none instead of 'v0/1'"),
        (sets(), {"labels": []}, "Got an empty list"),
        (sets(), {"labels": TABLE.select("material")}, "must have a column id"),
        (sets(), {"labels": "absent.csv"}, "must be a file. Got no file absent.csv"),
        (X[:3], {"labels": TABLE}, "as many rows"),
        (sets(OWN, None, VIDEO), {"labels": CONTACTS, "group": "contact"}, "known for every"),
        (np.zeros((2, 8, 8, 3), np.uint8), {}, "all be images, or all embeddings"),
        ([sets(), sets()], {"names": ["a"]}, "`names` must name every generator. Got 1 for 2"),
        ([sets(), sets()], {"names": ["a", "a"]}, "must differ"),
        ({"reference": sets()}, {}, "`names` must not be 'reference'"),
        ([], {}, "`generated` must hold something"),
    ],
)
def test_what_is_known_of_some_samples_only_is_an_error(generated, keywords, words):
    reference = FeatureSet(ROWS, X, MATERIALS, VIDEO, "e" * 64)
    with pytest.raises(PalpateError, match=words):
        aligned(generated, reference, **keywords)


def test_a_split_selects_the_test_part_of_every_set():
    parts, rule = {"train": ROWS[:2], "test": ROWS[2:]}, {"group": "contact"}
    split = Split.from_ids(**parts, rule=rule, manifest="m" * 64)
    inputs = aligned({"all": sets(), "own": sets(list("abcd"))}, sets(ROWS, MATERIALS), split=split)
    assert inputs.reference.ids == inputs.generators["all"].ids == ROWS[2:]
    assert (inputs.train.ids, inputs.reference.group) == (ROWS[:2], "frame")  # contacts: unknown
    assert inputs.generators["own"].ids == list("abcd")  # ids of its own cannot be parted
    note = inputs.notes[0]
    assert (note.code, note.params["skipped"]) == ("outside-test-part", 2)
    words = r"every sample of the split's test part\. Got 1 of 2 missing"
    with pytest.raises(PalpateError, match=words):
        aligned({"some": sets(ROWS[:3])}, sets(), split=split)
    with pytest.raises(PalpateError, match="must go with a reference that has ids"):
        aligned(X, X, split=split)


def test_images_pair_by_relative_name_whatever_the_suffix(tmp_path):
    names = ["a/1", "b [x]/1", "grün/\n1", "b/x.y"]
    paint(tmp_path / "real", names, 0, ".bmp")
    paint(tmp_path / "made", [*reversed(names)], 1)
    paint(tmp_path / "made", [".hidden/1"], 1)
    inputs = aligned(tmp_path / "made", tmp_path / "real")
    assert sorted(inputs.generators["made"].ids) == sorted(inputs.reference.ids) == sorted(names)
    files = [f"{name}.bmp" for name in names]
    rows = [{"id": file, "tactile": file} for file in files]
    listed = Manifest.from_rows(rows, tmp_path / "real")
    inputs = aligned(tmp_path / "made", listed)
    assert sorted(inputs.generators["made"].ids) == sorted(listed.ids)
    paint(tmp_path / "made", ["a/1"], 2, ".bmp")
    words = r"differ in name, suffixes aside\. Got 'a/1\.bmp' and 'a/1\.png'"
    with pytest.raises(PalpateError, match=words):
        aligned(tmp_path / "made", listed)


def test_images_take_videos_and_materials_of_the_reference_by_id(tmp_path):
    cells = {i: {"video": i[0], "material": i[0].upper()} for i in ("c/1", "a/0", "b/1")}
    rows = [{"id": i, "tactile": "x", **more} for i, more in cells.items()]
    real = Manifest.from_rows(rows, tmp_path)
    paint(tmp_path / "made", ["a/0", "b/1"], 0)
    samples = aligned(tmp_path / "made", real).generators["made"]
    assert (samples.ids, samples.groups, samples.labels) == (["a/0", "b/1"], ["a", "b"], ["A", "B"])


@pytest.mark.parametrize("name", ["1.png", "../../real/1.png", "/etc/hostname"])
def test_a_folder_of_generate_may_not_name_files_outside_it(tmp_path, name):
    pytest.importorskip("torch")
    paint(tmp_path / "out" / "images", ["1"], 1)
    index = {"format": "palpate-generated/1", "complete": True, "settings": {"split": "s"}}
    index |= {"digest": "", "notice": "", "skipped": [], "images": {"a": name}}
    (tmp_path / "out" / "index.json").write_text(json.dumps(index))
    if name == "1.png":
        samples = read_samples(tmp_path / "out", "x")
        assert (samples.ids, samples.settings) == (["a"], {"split": "s"})
    else:
        with pytest.raises(PalpateError, match="must lie in images/"):
            read_samples(tmp_path / "out", "x")


def test_paths_that_are_not_utf8_are_rejected(tmp_path):
    odd = tmp_path / "p\udcff"
    try:
        odd.mkdir()
    except (OSError, UnicodeError):
        pytest.skip("file names of this system are UTF-8")
    with pytest.raises(PalpateError, match="Paths of images must be UTF-8"):
        read_samples(odd, "x")
    np.save(odd / "x.npy", X)
    assert aligned(odd / "x.npy", X).generators.keys() == {"x"}

"""The contract that every data-set format keeps, on a tree in its true layout."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from forge.errors import fails
from forge.formats import TREES, Tree
from forge.pictures import tree
from palpate.core import Split
from palpate.data.formats import FORMATS, touch_and_go
from palpate.data.importing import import_dataset, validate, write_lists
from palpate.data.manifest import IMAGE_COLUMNS, Manifest
from palpate.data.scanning import finished

#: Takes what no other format recognized, so it may recognize trees of others too; it must be last.
CATCH_ALL = "pairs"
#: Formats whose files are met on the disk; paths that are written in lists may not leave the root.
FOLLOWED = {"touch-and-go", "tarf", "ycb-slide", "objectfolder", "objectfolder-generation"}
FOLLOWED |= {"intervals", "pairs"}
FACTS = ("name", "citation", "license", "url", "sensor", "samples", "group")


@pytest.fixture(scope="session", params=FORMATS)
def name(request):
    return request.param


@pytest.fixture(scope="session")
def folder(name, tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("made") / "place"


@pytest.fixture(scope="session")
def made(name, folder) -> Tree:
    """The format's tree, shared by all tests: not to be changed."""
    folder.mkdir()
    return TREES[name](folder)


@pytest.fixture(scope="session")
def whole(name, made, tmp_path_factory):
    """The tree, imported."""
    out = tmp_path_factory.mktemp("whole") / "out"
    return import_dataset(made.source, out, format=name, **made.options)


def copied(made: Tree, folder: Path, copy: Path) -> Tree:
    """The same tree elsewhere; options that are paths follow."""
    shutil.copytree(folder, copy)
    there = lambda v: copy / v.relative_to(folder) if isinstance(v, Path) else v
    options = {key: there(value) for key, value in made.options.items()}
    return replace(made, source=there(made.source), options=options)


def facts_of(problems) -> set[tuple[str, str, str]]:
    return {(p.where, p.kind, p.text) for p in problems}


def test_the_size_of_an_image_is_that_of_the_published_layout():
    assert "{}x{}".format(*touch_and_go.FACTS.image_size) in touch_and_go.__doc__


def test_every_format_has_a_tree():
    assert sorted(TREES) == sorted(FORMATS)
    assert list(FORMATS)[-1] == CATCH_ALL


def test_facts_are_complete(name):
    format_, facts = FORMATS[name], FORMATS[name].facts
    assert all(getattr(facts, f).strip() == getattr(facts, f) != "" for f in FACTS)
    assert facts.url == "unknown" or facts.url.startswith("https://")
    assert format_.looks_for.strip()
    assert {"skip_bad", "check", "progress"} <= set(format_.options)


def test_a_tree_is_recognized_by_its_format_and_by_no_other(name, made, tmp_path):
    knowing = {n for n, f in FORMATS.items() if f.detect(made.source)}
    assert name in knowing <= {name, CATCH_ALL}
    result = import_dataset(made.source, tmp_path / "out", **made.options)
    assert result.facts["format"] == name


def test_detect_looks_at_anything_without_raising(name, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "note.txt").write_bytes(b"\xff\x00")
    (tmp_path / "broken.json").write_text("{")
    for source in ("empty", "note.txt", "broken.json", "absent"):
        assert FORMATS[name].detect(tmp_path / source) is False, source


def test_import_gives_a_sound_manifest(name, made, whole):
    manifest, facts = whole.manifest, whole.facts
    assert len(manifest) == made.samples >= 6
    assert whole.skipped == []
    assert manifest.problems() == []  # ids unique and not empty, paths inside the root and there
    assert None not in manifest.column("tactile")
    if "vision" not in facts:  # a layout without photos says so in a fact
        assert None not in manifest.column("vision")
    for column in manifest.table.columns:
        texts = [v for v in manifest.column(column) if isinstance(v, str)]
        assert all(v.strip() == v != "" for v in texts), f"{column}: null, not an empty string"
    assert facts["format"] == name
    assert {"dataset", "text_source"} <= set(facts)
    assert (facts["text_source"] == "none") == (set(manifest.column("text")) == {None})
    for split_name, split in whole.splits.items():
        assert set(split.parts) <= set(manifest.ids), split_name
        assert split.manifest == manifest.digest, split_name
        assert split.rule.get("method"), split_name


def test_import_is_the_same_again_and_on_a_copied_tree(name, folder, made, whole, tmp_path):
    before = tree(folder)
    again = import_dataset(made.source, tmp_path / "again", format=name, **made.options)
    copy = copied(made, folder, tmp_path / "copy")
    moved = import_dataset(copy.source, tmp_path / "moved", format=name, **copy.options)
    for result, out in ((again, tmp_path / "again"), (moved, tmp_path / "moved")):
        loaded = Manifest.load(out).require_valid()
        assert loaded.digest == result.manifest.digest == whole.manifest.digest
        assert dict(loaded.facts) == dict(result.facts) == dict(whole.facts)
        splits = {n: Split.load(out / "splits" / f"{n}.json").digest for n in result.splits}
        assert splits == {n: split.digest for n, split in whole.splits.items()}
    assert tree(folder) == before, "an import must not write into the data set"


def test_validation_of_a_whole_tree_finds_all_samples(name, made, whole):
    result = validate(made.source, format=name, **made.options)
    assert result.ok
    assert (result.format, result.facts) == (name, FORMATS[name].facts)
    assert result.samples == made.samples
    assert facts_of(result.suspicious) == facts_of(whole.suspicious)


@pytest.mark.parametrize("how", ["remove", "cut", "link"])
def test_a_bad_image_is_reported_and_skipped_alone(name, folder, made, whole, tmp_path, how):
    copy = copied(made, folder, tmp_path / "copy")
    row = whole.manifest.table.row(-1, named=True)
    if how == "link" and made.remove is not None:
        pytest.skip("its samples are not files of their own")
    if how == "remove" and name == "objectfolder":
        pytest.skip("an image without partners leaves no trace")
    if (spoil := getattr(made, how, None)) is not None:
        spoil(copy.source)
    else:
        origin = (whole.manifest.root / row["tactile"]).resolve()
        victim = tmp_path / "copy" / origin.relative_to(folder.resolve())
        if how == "remove":
            victim.unlink()
        elif how == "link":  # to a whole image, but outside the data set
            victim.rename(tmp_path / victim.name)
            victim.symlink_to(tmp_path / victim.name)
        else:
            victim.write_bytes(victim.read_bytes()[: victim.stat().st_size // 2])
    report = validate(copy.source, format=name, **copy.options)
    if how == "link" and name in FOLLOWED:  # met below the folder that the user named
        result = import_dataset(copy.source, tmp_path / "out", format=name, **copy.options)
        assert report.ok
        assert result.manifest.require_valid().ids == whole.manifest.ids
        return
    assert (bool(report.missing), bool(report.invalid)) == (how == "remove", how != "remove")
    error = fails("", import_dataset, copy.source, tmp_path / "out", format=name, **copy.options)
    assert facts_of(error.problems) == facts_of([*report.missing, *report.invalid])
    assert not (tmp_path / "out").exists(), "a failed import must leave nothing behind"
    options = copy.options | {"skip_bad": True}
    result = import_dataset(copy.source, tmp_path / "out", format=name, **options)
    assert facts_of(result.skipped) == facts_of(error.problems)
    assert result.manifest.ids == [i for i in whole.manifest.ids if i != row["id"]]
    assert report.samples == len(result.manifest)
    kept = whole.manifest.take(result.manifest.ids)
    for column in ("video", "frame", *IMAGE_COLUMNS[:2]):
        assert result.manifest.column(column) == kept.column(column), column


def test_a_doubled_id_and_a_climbing_path_are_problems(name, made):
    result = FORMATS[name].read(made.source, made.options)
    _, row = result.rows[-1]
    result.rows += [("again", dict(row)), ("outside", {**row, "id": "x", "tactile": "../x.png"})]
    assert len(finished(result, "none")) == made.samples
    kinds = {p.where: p.kind for p in result.problems}
    assert kinds.pop("again") in ("duplicate-id", "two-parts")
    assert kinds == {"outside": "outside-root"}


def test_a_random_split_is_written_in_the_form_of_the_set(whole, tmp_path):
    ids = list(np.random.default_rng(0).permutation(whole.manifest.ids))
    split = Split({str(i): ("train", "train", "test")[k % 3] for k, i in enumerate(ids)})
    files = write_lists(whole.manifest, split, tmp_path / "lists")
    assert len(set(files)) == len(files) > 0
    assert all(p.stat().st_size and p.is_relative_to(tmp_path / "lists") for p in files)
    again = write_lists(whole.manifest, split, tmp_path / "more")
    assert [p.read_bytes() for p in files] == [p.read_bytes() for p in again]

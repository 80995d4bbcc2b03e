"""The contract that every data-set format keeps, on a tree forged in its true layout (``tests/forges.py``)."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_forge import Forged, tree
from forges import FORGES
from palpate.core import ProblemsError, Split
from palpate.data.formats import FORMATS
from palpate.data.importing import import_dataset, validate_dataset, write_lists
from palpate.data.manifest import IMAGE_COLUMNS, Manifest

#: Takes what no other format recognized, so it may recognize trees of others too; it must stand last.
CATCH_ALL = "pairs"


@pytest.fixture(scope="session", params=FORMATS)
def name(request):
    return request.param


@pytest.fixture(scope="session")
def folder(name, tmp_path_factory) -> Path:
    """Where the forge wrote."""
    return tmp_path_factory.mktemp("forged") / "place"


@pytest.fixture(scope="session")
def forged(name, folder) -> Forged:
    """The format's forged tree, shared by all tests: not to be changed."""
    if name not in FORGES:
        pytest.fail(
            f"the format {name!r} has no forge: write one and add it to FORGES in tests/forges.py"
        )
    folder.mkdir()
    return FORGES[name](folder)


@pytest.fixture(scope="session")
def whole(name, forged, tmp_path_factory):
    """The forged tree, imported."""
    return import_dataset(
        forged.source, tmp_path_factory.mktemp("whole") / "out", format=name, **forged.options
    )


def copied(forged: Forged, folder: Path, copy: Path) -> Forged:
    """The same tree elsewhere; options that are paths follow."""
    shutil.copytree(folder, copy)

    def there(value):
        return copy / value.relative_to(folder) if isinstance(value, Path) else value

    return replace(
        forged,
        source=there(forged.source),
        options={k: there(v) for k, v in forged.options.items()},
    )


def told(problems) -> set[tuple[str, str, str]]:
    return {(p.where, p.kind, p.text) for p in problems}


def test_every_format_has_a_forge_and_every_forge_a_format():
    assert sorted(FORGES) == sorted(FORMATS)
    assert list(FORMATS)[-1] == CATCH_ALL


def test_facts_are_complete(name):
    facts = FORMATS[name].facts
    for word in ("name", "citation", "license", "url", "sensor", "samples", "group"):
        assert getattr(facts, word).strip() == getattr(facts, word) != "", word
    assert facts.url == "unknown" or facts.url.startswith(("https://", "http://"))
    assert facts.image_size is None or (
        len(facts.image_size) == 2 and all(isinstance(n, int) and n > 0 for n in facts.image_size)
    )
    for purpose, (mean, std) in facts.normalization.items():
        assert len(mean) == len(std) == 3, purpose
        assert all(-1 < m < 1 for m in mean), purpose
        assert all(0 < s < 1 for s in std), purpose
    assert FORMATS[name].looks_for.strip()
    assert {"skip_bad", "check", "progress"} <= set(FORMATS[name].options)


def test_a_tree_is_recognized_by_its_own_format_and_by_no_other(name, forged, tmp_path):
    knowing = [n for n, f in FORMATS.items() if f.detect(forged.source)]
    assert (name in knowing) == forged.auto
    assert set(knowing) <= {name, CATCH_ALL}
    if forged.auto:
        found = import_dataset(forged.source, tmp_path / "out", **forged.options)
        assert found.facts["format"] == name


def test_detect_looks_at_anything_without_raising(name, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "note.txt").write_bytes(b"\xff\x00")
    (tmp_path / "empty.csv").write_bytes(b"")
    (tmp_path / "broken.json").write_text("{")
    for source in (
        tmp_path / "empty",
        tmp_path / "note.txt",
        tmp_path / "broken.json",
        tmp_path / "absent",
        tmp_path / "empty.csv",
    ):
        if name == CATCH_ALL and source.suffix == ".csv":
            continue
        assert FORMATS[name].detect(source) is False, source


def test_import_gives_a_sound_manifest(name, forged, whole):
    manifest = whole.manifest
    assert len(manifest) == forged.samples >= 6
    assert whole.skipped == []
    assert manifest.problems() == []  # ids unique and not empty, paths inside the root and there
    assert all(isinstance(i, str) for i in manifest.ids)
    assert all(f is None or (isinstance(f, int) and f >= 0) for f in manifest.column("frame"))
    assert None not in manifest.column("tactile"), "every sample needs a touch image"
    if "vision" not in whole.facts:  # a layout without photos says so in a fact
        assert None not in manifest.column("vision"), "every sample needs a photo"
    for column in manifest.table.columns:
        assert not any(isinstance(v, str) and v.strip() != v for v in manifest.column(column)), (
            column
        )
        assert "" not in manifest.column(column), f"{column}: null, not an empty string"
    facts = whole.facts
    assert facts["format"] == name
    assert all(isinstance(k, str) and isinstance(v, str) for k, v in facts.items())
    assert {"dataset", "text_source"} <= set(facts)
    assert (facts["text_source"] == "none") == (set(manifest.column("text")) == {None})
    for own, split in whole.splits.items():
        assert set(split.parts) <= set(manifest.ids), own
        assert split.manifest == manifest.digest, own
        assert split.rule.get("method"), own


def test_what_was_written_is_what_was_returned(name, folder, forged, tmp_path):
    before = tree(folder)
    found = import_dataset(forged.source, tmp_path / "out", format=name, **forged.options)
    loaded = Manifest.load(tmp_path / "out").require_valid()
    assert loaded.digest == found.manifest.digest
    assert dict(loaded.facts) == dict(found.facts)
    for own, split in found.splits.items():
        assert Split.load(tmp_path / "out" / "splits" / f"{own}.json").digest == split.digest
    assert tree(folder) == before, "an import must not write into the data set"


def test_import_is_the_same_again_and_on_a_copied_tree(name, folder, forged, whole, tmp_path):
    again = import_dataset(forged.source, tmp_path / "again", format=name, **forged.options)
    copy = copied(forged, folder, tmp_path / "copy")
    moved = import_dataset(copy.source, tmp_path / "moved", format=name, **copy.options)
    assert again.manifest.digest == moved.manifest.digest == whole.manifest.digest
    assert dict(again.facts) == dict(moved.facts) == dict(whole.facts)
    for other in (again, moved):
        assert {n: s.digest for n, s in other.splits.items()} == {
            n: s.digest for n, s in whole.splits.items()
        }


def test_validation_of_a_whole_tree_finds_all_samples(name, forged, whole):
    looked = validate_dataset(forged.source, format=name, **forged.options)
    assert looked.ok
    assert (looked.format, looked.facts) == (name, FORMATS[name].facts)
    assert looked.samples == forged.samples
    assert told(looked.suspicious) == told(whole.suspicious)


@pytest.mark.parametrize("how", ["remove", "cut", "link"])
def test_a_bad_image_is_told_by_both_and_skipped_alone(name, folder, forged, whole, tmp_path, how):
    copy = copied(forged, folder, tmp_path / "copy")
    row = whole.manifest.table.row(-1, named=True)
    if how == "link" and forged.remove is not None:
        pytest.skip("its samples are no files of their own")
    if (spoil := getattr(forged, how, None)) is not None:
        spoil(copy.source)
    else:
        origin = (whole.manifest.root / row["tactile"]).resolve()
        victim = tmp_path / "copy" / origin.relative_to(folder.resolve())
        if how == "remove":
            victim.unlink()
        elif how == "link":  # to a whole picture, but outside the data set
            victim.rename(tmp_path / victim.name)
            victim.symlink_to(tmp_path / victim.name)
        else:
            victim.write_bytes(victim.read_bytes()[: victim.stat().st_size // 2])
    looked = validate_dataset(copy.source, format=name, **copy.options)
    assert (bool(looked.missing), bool(looked.invalid)) == (how == "remove", how != "remove")
    with pytest.raises(ProblemsError) as caught:
        import_dataset(copy.source, tmp_path / "out", format=name, **copy.options)
    assert told(caught.value.problems) == told([*looked.missing, *looked.invalid])
    assert not (tmp_path / "out").exists(), "a failed import must leave nothing behind"
    found = import_dataset(
        copy.source, tmp_path / "out", format=name, skip_bad=True, **copy.options
    )
    assert told(found.skipped) == told(caught.value.problems)
    assert found.manifest.ids == [i for i in whole.manifest.ids if i != row["id"]]
    assert looked.samples == len(found.manifest)
    kept = {
        c: dict(zip(whole.manifest.ids, whole.manifest.column(c), strict=True))
        for c in ("video", "frame", *IMAGE_COLUMNS[:2])
    }
    for column, values in kept.items():
        assert found.manifest.column(column) == [values[i] for i in found.manifest.ids], column


def test_a_random_split_is_written_in_the_sets_own_form(name, whole, tmp_path):
    rng = np.random.default_rng(0)
    ids = list(rng.permutation(whole.manifest.ids))
    parts = {str(i): ("train", "train", "test")[k % 3] for k, i in enumerate(ids)}
    files = write_lists(whole.manifest, Split(parts), tmp_path / "lists")
    assert len(set(files)) == len(files) > 0
    for path in files:
        assert path.stat().st_size > 0
        assert path.is_relative_to(tmp_path / "lists")
    again = write_lists(whole.manifest, Split(parts), tmp_path / "more")
    assert [p.read_bytes() for p in files] == [p.read_bytes() for p in again]
    part = Manifest(whole.manifest.table.head(3), whole.manifest.root, whole.facts)
    assert write_lists(part, Split(dict.fromkeys(part.ids, "test")), tmp_path / "few")

"""Lists and tables as people have them: other machines, encodings, repeated rows, flags."""

import json
import re
import shlex
import unicodedata

import polars as pl
import pytest

from forge.errors import fails
from forge.pictures import write_images
from palpate.cli import main
from palpate.core import files
from palpate.data import tables
from palpate.data.importing import import_dataset, validate
from palpate.data.listing import read_list
from palpate.data.manifest import Manifest
from palpate.data.mapping import compile_maps
from palpate.data.reading import load, read
from palpate.leakage import audit

IMAGES = [f"img/{o}/{k}_{side}.png" for o in ("cup", "mug") for k in (1, 2) for side in ("v", "t")]


def listed(path, paths, end="\n", encoding="utf-8", material="Wood", sign=","):
    """A table of the images of :data:`IMAGES`, each path as ``paths`` writes it."""
    rows = [sign.join(("vision", "tactile", "material"))]
    for k in range(0, len(IMAGES), 2):
        rows.append(sign.join((paths(IMAGES[k]), paths(IMAGES[k + 1]), material)))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(end.join(rows).encode(encoding))
    return path


WRITTEN = {
    "absolute": lambda p: f"/home/ann/set/{p}",
    "windows": lambda p: "D:\\data\\" + p.replace("/", "\\"),
    "backslashes": lambda p: p.replace("/", "\\"),
    "a folder above": lambda p: f"set/{p}",
    "without the folder": lambda p: p.removeprefix("img/"),
    "two machines": lambda p: f"{'/mnt/bob' if 'cup' in p else '/home/ann/data'}/{p}",
    "capitals": lambda p: p.upper(),
    "a dot": lambda p: f"./{p}",
}


@pytest.mark.parametrize("form", WRITTEN)
def test_paths_of_another_machine_are_read_by_their_end(tmp_path, form):
    write_images(tmp_path, IMAGES)
    result = import_dataset(listed(tmp_path / "t.csv", WRITTEN[form]), tmp_path / "out")
    table = result.manifest.require_valid().table
    assert [*table["vision"], *table["tactile"]] == IMAGES[::2] + IMAGES[1::2]
    said = [p.text for p in result.suspicious if p.kind == "other-paths"]
    assert len(said) == (form != "a dot")


def test_two_paths_never_become_one_file(tmp_path):
    write_images(tmp_path, ["1_v.png", "1_t.png", "2_v.png", "2_t.png"])
    fails("missing-file", import_dataset, listed(tmp_path / "t.csv", str), tmp_path / "out")


FORMS = ("NFC", "NFD")


@pytest.mark.parametrize("form", FORMS)
def test_names_in_another_form_of_letters_are_those_of_the_only_file(tmp_path, form):
    """A table written on macOS may spell the names of files on Linux in another form."""
    paths = [f"{s}/{name}.png" for name in ("Käse", "Öl", "wood") for s in ("photo", "touch")]
    spell = lambda form: [unicodedata.normalize(form, path) for path in paths]
    written, files = spell(form), spell(FORMS[form == "NFC"])
    write_images(tmp_path, files)
    rows = [*zip(written[::2], written[1::2], strict=True)]
    pl.DataFrame(rows, ["vision", "tactile"], orient="row").write_csv(tmp_path / "t.csv")
    result = import_dataset(tmp_path / "t.csv", tmp_path / "out")
    assert result.manifest.table["vision"].to_list() == files[::2]
    (said,) = (p.text for p in result.suspicious if p.kind == "other-paths")
    assert "spelling" in said
    write_images(tmp_path, [files[0].upper(), files[0].title()])  # which of the two is meant?
    (tmp_path / files[0]).unlink()
    fails("missing-file", import_dataset, tmp_path / "t.csv", tmp_path / "out2")


@pytest.mark.parametrize("twice", [False, True])
def test_paths_that_begin_in_several_folders_are_found_in_the_only_one(tmp_path, twice):
    here = {"cup": "diskA", "mug": "diskB"}
    places = [f"{here[path.split('/')[1]]}/{path}" for path in IMAGES]
    write_images(tmp_path, [*places, *(p.replace("diskA", "diskB") for p in places if twice)])
    table = listed(tmp_path / "t.csv", str)
    if twice:  # one of the two cups is a copy, or another recording
        fails("missing-file", import_dataset, table, tmp_path / "out")
    else:
        table = import_dataset(table, tmp_path / "out").manifest.table
        assert [*table["vision"], *table["tactile"]] == places[::2] + places[1::2]


def test_paths_that_climb_name_the_root(tmp_path):
    write_images(tmp_path, IMAGES)
    table = listed(tmp_path / "lists" / "t.csv", lambda p: f"../{p}")
    error = fails("leaves the root", import_dataset, table, tmp_path / "out")
    assert error.example == {"root": "FOLDER"}


@pytest.mark.parametrize("sign", [",", ";", "|"])
@pytest.mark.parametrize("material", ["Béton", "Straße"])
def test_a_table_of_windows_is_read_and_said(tmp_path, sign, material):
    write_images(tmp_path, IMAGES)
    table = listed(tmp_path / "t.csv", str, "\r\n", "cp1252", material, sign)
    result = import_dataset(table, tmp_path / "out")
    assert set(result.manifest.table["material"]) == {material}
    (said,) = (p for p in result.suspicious if p.kind == "encoding")
    assert "cp1252" in said.text


def test_a_text_of_two_encodings_is_refused_by_its_lines(tmp_path):
    rows = "vision,tactile,material\na,b,Béton\n".encode() + "c,d,Béton\n".encode("cp1252")
    (tmp_path / "t.csv").write_bytes(rows)
    error = fails("UTF-8", import_dataset, tmp_path / "t.csv", tmp_path / "out")
    assert "t.csv:3" in str(error)
    assert not tables.is_windows(b"\x89PNG\x00\xff")


def test_a_repeated_row_is_one_sample(tmp_path):
    write_images(tmp_path, IMAGES)
    table = listed(tmp_path / "t.csv", str)
    table.write_text(table.read_text() + "\n" + table.read_text().splitlines()[2] + "\n")
    error = fails("duplicate-row", import_dataset, table, tmp_path / "out")
    assert "t.csv:6" in str(error)
    assert "repeats the row" in str(error)
    assert len(import_dataset(table, tmp_path / "out", skip_bad=True).manifest) == 4


@pytest.mark.parametrize(("column", "other"), [("material", "Rock"), ("video", "x")])
def test_rows_of_the_same_images_name_the_cell_that_differs(tmp_path, column, other):
    """A column mapped to ids would count one sample twice."""
    write_images(tmp_path, IMAGES)
    row = {"vision": IMAGES[0], "tactile": IMAGES[1], "material": "Wood", "video": "a"}
    pl.DataFrame([row, row | {column: other}]).write_csv(tmp_path / "t.csv")
    error = fails("duplicate-id", import_dataset, tmp_path / "t.csv", tmp_path / "out")
    (problem,) = error.problems
    assert f"{column} ({other!r} here, {row[column]!r} there)" in problem.text
    assert "map a column" not in problem.text


@pytest.mark.parametrize("options", [{"size": 16}, {"every": 2}, {"sensor": "x"}, {"swap": "fix"}])
@pytest.mark.parametrize("folder", [False, True])
def test_options_without_use_are_refused_by_name(tmp_path, folder, options):
    write_images(tmp_path / "own", [p.replace("_v", "_rgb").replace("_t", "_tac") for p in IMAGES])
    write_images(tmp_path, IMAGES)
    source = tmp_path / "own" if folder else listed(tmp_path / "t.csv", str)
    for verb in (import_dataset, validate, load):
        into = [tmp_path / "out"] if verb is import_dataset else []
        error = fails("must be left out", verb, source, *into, **options)
        assert error.argument == next(iter(options))


PATHS = [f"v{v}/{k:04d}.jpg" for v in range(3) for k in range(0, 60, 10)]


@pytest.mark.parametrize("sign", ["\n", "\r\n"])
def test_a_flag_makes_the_parts_of_a_list_without_a_header(tmp_path, sign):
    rows = [f"{path},1,{k},{int(k % 6 > 2)}" for k, path in enumerate(PATHS)]
    (tmp_path / "all.csv").write_text(sign.join(rows))
    columns = {"split": "case when flag = 1 then 'test' else 'train' end"}
    reading = {"names": "tactile,label,index,flag", "columns": columns}
    result = audit(tmp_path / "all.csv", reading=reading)
    assert result.test_samples_in_shared_groups == 9


def test_a_frame_list_takes_the_options_of_a_table(tmp_path):
    path = tmp_path / "train.txt"
    path.write_text("".join(f"{p},3\n" for p in PATHS))
    assert load(path).table["material"].unique().to_list() == ["3"]
    named = load(path, columns={"material": "'class ' || label"})
    assert named.table["material"].unique().to_list() == ["class 3"]
    fails("must be left out", load, path, side="vision")


def test_a_frame_and_a_table_of_the_same_rows_say_the_same(tmp_path):
    frame = pl.DataFrame({"tactile": PATHS, "split": ["train"] * 9 + ["test"] * 9})
    frame.write_csv(tmp_path / "t.csv")
    ours, theirs = (read(source) for source in (frame, tmp_path / "t.csv"))
    assert ours.manifest.table.equals(theirs.manifest.table)
    assert ours.splits["Orig"].parts == theirs.splits["Orig"].parts
    answers = [audit(source) for source in (frame, tmp_path / "t.csv")]
    assert [a.test_samples_in_shared_groups for a in answers] == [3, 3]


def test_large_metadata_are_refused_before_they_are_read(tmp_path):
    for name in ("list.txt", "table.csv", "table.json"):
        with open(tmp_path / name, "wb") as file:
            file.write(b"v/1.jpg,3\n")
            file.truncate(files.LARGEST + 1)
        fails("at most 256 MiB", load, tmp_path / name)
    fails("at most 256 MiB", read_list, tmp_path / "list.txt")


def test_numbers_compare_as_numbers():
    table = pl.DataFrame({"n": ["07", "8"]})
    for expression, values in (("n > 7", ["false", "true"]), ("n", ["07", "8"])):
        cells = compile_maps({"text": expression}, ["n"], ["text"]).apply(table)
        assert cells["text"].to_list() == values


@pytest.mark.parametrize("sign", ["", " ", "   ", "\t", ";", ", ", "|"])
@pytest.mark.parametrize("suffix", [".txt", ".lst", ".csv"])
def test_lines_of_paths_with_or_without_a_label(tmp_path, sign, suffix):
    files = []
    for part, rows in (("train", PATHS[:9]), ("test", PATHS[9:])):
        lines = [f"/home/ann/set/{path}{sign}{3 if sign else ''}\n" for path in rows]
        files.append(tmp_path / f"{part}{suffix}")
        files[-1].write_text("".join(lines))
    assert audit(*files).test_samples_in_shared_groups == 3


def test_lines_of_two_paths(tmp_path):
    write_images(tmp_path, IMAGES)
    rows = [
        f"{v.replace('_v', '_v')} {t}\n" for v, t in zip(IMAGES[::2], IMAGES[1::2], strict=True)
    ]
    text = "".join(rows).replace("_v", "_rgb").replace("_t", "_tac")
    write_images(tmp_path, [p.replace("_v", "_rgb").replace("_t", "_tac") for p in IMAGES])
    (tmp_path / "pairs.csv").write_text(text)
    table = import_dataset(tmp_path / "pairs.csv", tmp_path / "out").manifest.table
    assert table["vision"].str.contains("rgb").all()
    assert table["tactile"].str.contains("tac").all()


def test_a_list_that_an_audit_reads_is_imported_with_its_labels(tmp_path):
    """No header, tabs; what most paths say decides which is the photo."""
    rows = [f"{p.replace('_t', '_touch')}\t{p.replace('_t', '_photo')}" for p in IMAGES[1::2]]
    rows[0] = "img/cup/touch_photo.png\timg/cup/1_photo.png"
    write_images(tmp_path, [path for row in rows for path in row.split("\t")])
    (tmp_path / "l.txt").write_text("".join(f"{row}\t{k % 2}\n" for k, row in enumerate(rows)))
    result = import_dataset(tmp_path / "l.txt", tmp_path / "out").manifest
    assert result.table.select("tactile", "vision").rows() == [tuple(r.split("\t")) for r in rows]
    assert result.column("material") == ["0", "1"] * 2
    assert read(tmp_path / "l.txt").manifest.digest == result.digest


def test_a_table_with_both_images_states_its_split(tmp_path):
    write_images(tmp_path, IMAGES)
    lines = listed(tmp_path / "t.csv", str).read_text().splitlines()
    parts = ("split", "train", "train", "train", "test")
    text = "\n".join(f"{line},{part}" for line, part in zip(lines, parts, strict=True))
    (tmp_path / "t.csv").write_text(text)
    result = audit(tmp_path / "t.csv")
    assert (result.train_samples, result.test_samples) == (3, 1)
    assert {s.kind for s in result.signals} >= {"near-duplicate vision", "near-duplicate tactile"}


def test_the_column_of_the_paths_is_said(tmp_path):
    rows = [f"{path},{path},note.png" for path in PATHS]
    rows[0] = "none,none,x.png"  # most of a column decides
    for part, some in (("train", rows[:9]), ("test", rows[9:])):
        (tmp_path / f"{part}.csv").write_text("\n".join(["shot,gel,remark", *some]))
    notes = {n.code: n.params for n in audit(tmp_path / "train.csv", tmp_path / "test.csv").notes}
    assert notes["path-column"] == {"column": "gel"}
    assert notes["images-not-found"] == {"root": str(tmp_path)}


def test_a_side_that_nobody_can_check_lets_no_gate_pass(tmp_path, capsys, next_commands):
    """Of both parts half of the photos are cut; then all tactile images are gone."""
    names = [
        f"{part}{v}/{k}_{side}.png"
        for part in "ab"
        for v in range(3)
        for k in range(4)
        for side in "vt"
    ]
    write_images(tmp_path, names)
    for path in names[::4]:
        (tmp_path / path).write_bytes((tmp_path / path).read_bytes()[:40])
    for part in "ab":
        own = [name for name in names if name[0] == part]
        pairs = zip(own[::2], own[1::2], strict=True)
        text = "\n".join(["vision,tactile,video", *(f"{v},{t},{v[:2]}" for v, t in pairs)])
        (tmp_path / f"{part}.csv").write_text(text)
    command = ["audit", str(tmp_path / "a.csv"), str(tmp_path / "b.csv"), "--fail-over", "1"]
    assert main(command) == 3
    assert "cannot be read" in capsys.readouterr().out
    next_commands.clear()  # they are about files that go
    for path in names[1::2]:
        (tmp_path / path).unlink()
    assert main(command) == 2
    assert "missing-file" in capsys.readouterr().err


def test_utf16_without_a_mark(tmp_path):
    write_images(tmp_path, IMAGES)
    for encoding in ("utf-16-le", "utf-16-be", "utf-16"):
        table = listed(tmp_path / "t.csv", str, encoding=encoding, material="Béton")
        result = import_dataset(table, tmp_path / "out", overwrite=True)
        assert set(result.manifest.table["material"]) == {"Béton"}


@pytest.mark.parametrize("name", ["*", "^v.*$"])
def test_a_column_that_is_a_pattern_is_refused(tmp_path, name):
    (tmp_path / "t.csv").write_text(f"{name},video\na,v\n")
    fails("must have plain names", load, tmp_path / "t.csv", columns={"id": name})


def test_a_table_that_pairs_images_of_its_folder_goes_before_their_names(tmp_path):
    for side in ("photo", "touch"):
        write_images(tmp_path, [f"{side}/{k}.png" for k in range(4)])
    rows = [f"photo/{k}.png;touch/{3 - k}.png;m{k}" for k in range(4)]
    (tmp_path / "pairs.csv").write_text("\n".join(["Photo;Touch;Label", *rows]) + "\n")
    table = load(tmp_path).table
    pairs = {(f"photo/{k}.png", f"touch/{3 - k}.png", f"m{k}") for k in range(4)}
    assert {*table.select("vision", "tactile", "material").iter_rows()} == pairs
    (tmp_path / "pairs.csv").write_text("Photo;Touch\na.png;b.png\n")  # of other images
    assert {*load(tmp_path).table.select("vision", "tactile").iter_rows()} == {
        (f"photo/{k}.png", f"touch/{k}.png") for k in range(4)
    }


PHOTOS, TOUCHES = ([f"img/{sign}{7 * k + 3}.png" for k in range(6)] for sign in "xq")
PAIRS = [*zip(PHOTOS, TOUCHES, strict=True)]
#: Name of a table -> its text; the names of its images say nothing.
TABLES = {
    "nested.json": [
        {"object": k, "pairs": [{"rgb": a, "gel": b}]} for k, (a, b) in enumerate(PAIRS)
    ],
    "keyed.json": {a: {"camera": {"path": a, "size": 9}, "touch": {"path": b}} for a, b in PAIRS},
    "lines.jsonl": "\n".join(json.dumps({"photo": {"file": a}, "gel": b}) for a, b in PAIRS),
    "lists.json": {"pairs": PAIRS},
    "images.json": [{"images": pair, "object": "cup"} for pair in PAIRS],
    "dictionary.json": dict(PAIRS),
    "Liste.csv": "Bild;Tastbild;Objekt\n" + "".join(f"{a};{b};Schlüssel\n" for a, b in PAIRS),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_that_names_two_images_a_row_pairs_them_or_asks(tmp_path, name, capsys):
    """Where nothing says which side is which, the answer is the table with a choice of columns."""
    write_images(tmp_path / "own", [*PHOTOS, *TOUCHES])
    data = TABLES[name] if isinstance(TABLES[name], str) else json.dumps(TABLES[name])
    (tmp_path / "own" / name).write_bytes(data.encode("cp1252"))
    decided = name in ("nested.json", "keyed.json", "lines.jsonl")
    for source in ("own", f"own/{name}") if not decided else ("own",):
        command = ["import", str(tmp_path / source), "-o", str(tmp_path / "out"), "--overwrite"]
        assert main(command) == (0 if decided else 2)
        answers = re.findall("(?m)^  (palpate .*)$", capsys.readouterr().err)
        assert len(answers) == 2 * (not decided)
        for answer, step in zip(
            answers or [shlex.join(["palpate", *command])], (1, -1), strict=False
        ):
            assert main(shlex.split(answer)[1:]) == 0
            table = Manifest.load(tmp_path / "out").require_valid().table
            pairs = {pair[::step] for pair in PAIRS}
            assert {*table.select("vision", "tactile").iter_rows()} == pairs
    if not decided:  # an audit does not take them for photos, either
        fails("must be read by its table", audit, tmp_path / "own", tmp_path / "own")


def test_a_refusal_names_the_tables_that_do_not_help(tmp_path, capsys):
    write_images(tmp_path / "own", [path.removeprefix("img/") for path in (*PHOTOS, *TOUCHES)])
    (tmp_path / "own" / "index.csv").write_text("Bild;Tastbild\nx03;q03\n")
    assert main(["import", str(tmp_path / "own"), "-o", str(tmp_path / "out")]) == 2
    assert "index.csv (Bild, Tastbild)" in capsys.readouterr().err


@pytest.mark.parametrize("merged", [True, False])
def test_merged_cells_of_a_spreadsheet_are_named(tmp_path, merged):
    write_images(tmp_path, [*PHOTOS, *TOUCHES])
    objects = ["cup", "", "", "mug", "", ""] if merged else ["", "cup", "cup", "", "cup", ""]
    rows = [f"{a},{b},{o}" for (a, b), o in zip(PAIRS, objects, strict=True)]
    (tmp_path / "t.csv").write_text("\n".join(["rgb,gel,object", *rows]))
    (said,) = (p.text for p in read(tmp_path).suspicious if p.kind == "null-group")
    assert ("Merged cells" in said) == merged


def test_images_in_a_list_are_pairs_only_if_they_differ_in_more_than_numbers(tmp_path):
    lists = [[f"v{k}/{n}.png" for n in range(2)] for k in range(3)]
    (tmp_path / "a.json").write_text(json.dumps({"train": lists}))
    assert len(read(tmp_path / "a.json").manifest) == 6
    talk = [{"image": PHOTOS[0], "talk": [{"from": "a", "value": "b"}] * 2}]
    (tmp_path / "a.json").write_text(json.dumps(talk))
    assert len(read(tmp_path / "a.json").manifest) == 1


def test_a_table_in_each_session_is_read_and_what_none_names_is_counted(tmp_path):
    for s in range(3):
        write_images(tmp_path / f"s{s}", [*PHOTOS, *TOUCHES], 8 * s + 1)
        rows = "".join(f"{a},{b},m{s}\n" for a, b in PAIRS)
        (tmp_path / f"s{s}" / "index.csv").write_text("rgb,gel,material\n" + rows)
    write_images(tmp_path / "s3", PHOTOS)
    result = read(tmp_path)
    wanted = {(f"s{s}/{a}", f"s{s}/{b}", f"m{s}") for s in range(3) for a, b in PAIRS}
    table = result.manifest.table
    assert {*table.select("vision", "tactile", "material").iter_rows()} == wanted
    (left,) = (p.text for p in result.suspicious if p.kind == "unmatched")
    assert "s3/img/x3.png" in left


@pytest.mark.parametrize("written", ["{p}", "/home/ann/set/{p}", "{p},3"])
def test_lists_beside_the_images_are_their_split(tmp_path, written):
    paths = [
        f"disk{d}/v{v}/{s}/{k}.png"
        for d in "AB"
        for v in range(3)
        for k in range(2)
        for s in ("rgb", "gel")
    ]
    write_images(tmp_path, paths)
    for part, videos in (("train", "01"), ("test", "2")):
        own = [p for p in paths if p.split("/")[1][1] in videos and "rgb" in p]
        (tmp_path / f"{part}.txt").write_text("".join(f"{written.format(p=p)}\n" for p in own))
    split = read(tmp_path).splits["Orig"]
    assert split.counts() == {"train": 8, "test": 4}
    assert {i for i, part in split.parts.items() if part == "test"} == {
        f"disk{d}/v2/{k}" for d in "AB" for k in range(2)
    }


def test_folders_named_as_parts_in_any_words_are_a_split(tmp_path):
    for part in ("Training", "Testing", "validate"):
        write_images(tmp_path, [f"{part}/{s}/v1_{k}.png" for s in ("rgb", "gel") for k in range(2)])
    split = read(tmp_path).splits["Orig"]
    assert split.counts() == {"train": 2, "val": 2, "test": 2}


def test_rows_that_contradict_each_other_or_name_nothing_are_named(tmp_path):
    objects = ("cup", "mug")
    write_images(tmp_path, [f"{side}/{o}/0.png" for side in ("rgb", "gel") for o in objects])
    labels = "object,material\ncup,glass\ncup,steel\nmug,clay\nteapot,clay\n"
    (tmp_path / "labels.csv").write_text(labels)
    result = read(tmp_path)
    assert {*result.manifest.table["material"]} == {"glass", "clay"}
    texts = {p.kind: p.text for p in result.suspicious}
    assert "1 cells differ" in texts["two-values"]
    assert "is glass and steel" in texts["two-values"]
    assert texts["of-no-image"].endswith("by object: teapot")

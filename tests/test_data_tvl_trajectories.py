"""Trajectories of HCT: contacts and sessions, backgrounds, swapped folders, and bad input."""

import shutil

import pytest

from forge.errors import fails
from forge.formats import TVL_COLUMNS as COLUMNS
from forge.formats import kinds, make_hct, name_of
from forge.formats import make_trajectory as trajectory
from forge.pictures import PHOTO, gel, photo, put, write_csv
from forge.pictures import TACTILE as SENSOR
from palpate.core import Split
from palpate.data.formats import hct
from palpate.data.formats.hct import TRAJECTORY
from palpate.data.importing import import_dataset as read
from palpate.data.importing import validate, write_lists


@pytest.fixture
def tree(tmp_path):
    return make_hct(tmp_path / "in").source


# --- Contacts and sessions


def test_a_row_in_both_lists_is_reported_and_is_in_no_part(tree, tmp_path):
    rows = (tree / "data1" / "train.csv").read_text().split("\n", 1)[1]
    with (tree / "data1" / "test.csv").open("a") as file:
        file.write(rows)
    result = read(tree, tmp_path / "out", skip_bad=True)
    assert kinds(result.skipped) == {"two-parts": 9}
    assert result.splits["Orig"].counts() == {"train": 9, "test": 6}
    assert len(result.manifest) == 24


def test_contacts_are_runs_and_sessions_chains(tree, tmp_path):
    table = read(tree, tmp_path / "a").manifest.table
    first = table.filter(table["video"] == table["video"][0])
    assert first["frame"].to_list() == [10, 11, 30, 31]
    assert [t.split("#")[1] for t in first["contact"]] == ["0001", "0001", "0002", "0002"]
    for gap, sessions in ((60.1, 2), (60.0, 1)):
        result = hct.sessions_of([f"data1/1-{1702596200.5}", f"data1/2-{1702596200.5 + gap}"])
        assert len(set(result.values())) == sessions
    videos = [*(f"data1/9-{100 + 50 * k}" for k in range(4)), "data2/9-120", "data2/odd name"]
    chained = hct.sessions_of(videos)
    assert set(chained.values()) == {"data1/9-100", "data2/9-120", "data2/odd name"}


# --- Backgrounds


def test_each_source_of_a_background_is_tried_in_turn_and_counted(tree, tmp_path):
    videos = sorted({p.parent for p in tree.glob("data*/*/vision")})
    for video in videos[1:]:
        (video / "background.png").unlink()
    shutil.copy(videos[0] / "background.png", tree / "data2" / "digit_background.png")
    result = read(tree, tmp_path / "out")
    counts = "as listed 4, digit_background.png 12, none 8"
    assert result.facts["backgrounds"] == counts
    backgrounds = dict(result.manifest.table.select("video", "background").rows())
    names = [v.relative_to(tree).as_posix() for v in videos]
    assert [backgrounds[name] for name in names] == [
        f"{names[0]}/background.png",
        None,
        None,
        *["data2/digit_background.png"] * 3,
    ]
    assert [(p.kind, p.text[:6]) for p in result.suspicious] == [("no-background", "8 rows")]
    (tree / "data2" / "digit_background.png").rename(tree / "digit_background.png")
    above = read(tree, tmp_path / "above")
    assert above.facts["backgrounds"] == "as listed 4, digit_background.png 20"


# --- Swapped folders


def rig_of(tmp_path, *, swapped, sizes, count=12, tactile=None):
    """One rig of ``count`` trajectories of which some are swapped, with the list of its rows."""
    rig = tmp_path / "hct" / "data1"
    sides = {"vision": lambda n: photo(n, sizes[0])}
    sides["tactile"] = tactile or (lambda n: gel(n, sizes[1]))
    rows = []
    for k in range(count):
        name = f"3-{1000 + 100 * k}.5"
        rows += trajectory(rig, name, [5, 6], swapped=k in swapped, **sides)
    write_csv(rig / "train.csv", COLUMNS, [[*row, "soft"] for row in rows])
    return rig


def place(video: str) -> int:
    """Which trajectory of :func:`rig_of` it is."""
    return int(float(TRAJECTORY.fullmatch(video.split("/")[1])[1])) // 100 - 10


def named(problems):
    return {place(p.where) for p in problems if p.kind == "exchanged-sides"}


@pytest.mark.parametrize("swapped", [set(), {2, 5, 11}])
def test_swapped_folders_are_reported_and_fixed(tmp_path, swapped):
    rig_of(tmp_path, swapped=swapped, sizes=((640, 480), (240, 320)))
    result = read(tmp_path, tmp_path / "a")
    assert named(result.suspicious) == swapped
    assert all("vision/" in p for p in result.manifest.column("vision"))
    put(tmp_path / "hct" / "digit_background.png", gel(0, pressed=False))
    fixed = read(tmp_path, tmp_path / "b", swap="fix").manifest
    columns = ("video", "vision", "tactile", "background")
    for video, vision, tactile, background in fixed.table.select(columns).iter_rows():
        right = place(video) not in swapped
        assert ("/vision/" in vision, "/tactile/" in tactile) == (right, right)
        assert background == (f"{video}/background.png" if right else "digit_background.png")
    write_lists(fixed, Split(dict.fromkeys(fixed.ids, "train")), tmp_path / "hct")
    assert named(read(tmp_path, tmp_path / "c").suspicious) == set()
    fails("must be one of report, fix", read, tmp_path, tmp_path / "out", swap="yes")


def test_sides_of_one_size_and_unreadable_ones_are_not_called_swapped(tmp_path):
    rig_of(tmp_path / "1", swapped={1}, sizes=(SENSOR, SENSOR))
    rig = rig_of(tmp_path / "2", swapped={1}, sizes=(PHOTO, SENSOR))
    for path in (rig / "3-1100.5").glob("*/*.jpg"):
        path.write_bytes(b"")
    for name in "12":
        seen = read(tmp_path / name, tmp_path / "out" / name, check="none").suspicious
        assert named(seen) == set(), name


# --- Bad input


def test_every_bad_row_of_hct_is_reported(tree, tmp_path):
    video = sorted({p.parent.name for p in tree.glob("data1/*/vision")})[0]
    gone = sorted({p.parent.name for p in tree.glob("data2/*/vision")})[1]
    shutil.rmtree(tree / "data2" / gone)
    good, cut = (f"{video}/vision/{name_of(k)}" for k in (30, 31))
    (tree / "data1" / cut).write_bytes(b"")
    rig = "data7/1-2.5"  # which is not there
    lines = [
        (f"../data2/x.jpg,{good},,a", ["outside-root"]),
        (f"/etc/x.jpg,{good},,a", ["outside-root"]),
        (f"{good},{good},,a,b", ["bad-row"]),
        (f"{good}", ["bad-row"]),
        (f"{video}/x.jpg,{good},,a", ["bad-path"]),
        (f"{video}/vision/first-0.1.jpg,{good},,a", ["bad-frame"]),
        (f",{good},,a", ["empty-cell"]),
        (
            f"{good},{good.replace('/vision/', '/tactile/')},,again",
            ["two-parts"],
        ),  # in another list of this rig
        (f"{video}/vision/99-0.1.jpg,{video}/tactile/99-0.1.jpg,,a", ["missing-file"] * 2),
        (f"{rig}/vision/1-0.1.jpg,{rig}/tactile/1-0.1.jpg,,a", ["missing-folder"]),
        (f"{good},{good},,\0", ["bad-encoding"]),
    ]
    path = tree / "data1" / "val.csv"
    text = "\n".join([",".join(COLUMNS), *(line for line, _ in lines)])
    path.write_bytes(text.encode("latin-1"))
    error = fails("", read, tree, tmp_path / "out")
    reported = error.problems
    of_list = [(p.where, p.kind) for p in reported if p.where.startswith(str(path))]
    assert of_list == [(f"{path}:{n}", k) for n, (_, some) in enumerate(lines, 2) for k in some]
    texts = {p.text for p in reported if p.kind == "missing-folder"}
    expected = {f"1 row: no folder 'data7' in {tree}"}
    assert texts == {*expected, f"4 rows: no folder 'data2/{gone}' in {tree}"}
    assert len(reported) == len(of_list) + 2  # the cut image, and the folder that is gone
    assert not (tmp_path / "out").exists()
    assert len(read(tree, tmp_path / "out", skip_bad=True).manifest) == 24 - 4 - 1
    report = validate(tree)
    assert (report.samples, kinds(report.missing) + kinds(report.invalid)) == (19, kinds(reported))
    assert kinds(report.missing) == {"missing-file": 2, "missing-folder": 2}


def test_names_with_spaces_commas_and_other_scripts(tmp_path):
    rig = tmp_path / "hct" / "data1"
    trajectory(rig, "4-100.5", [1])
    rows = []
    for folder in ("tisch, groß {n}", "机 1", "4-200.5"):
        for frame in range(2):
            sides = [f"{folder}/{side}/{frame}-né, é.jpg" for side in ("vision", "tactile")]
            for path, image in zip(sides, (photo(frame), gel(frame)), strict=True):
                put(rig / path, image)
            rows.append([*sides, "", "Weich, groß."])
    write_csv(rig / "train.csv", COLUMNS, rows)
    result = read(tmp_path, tmp_path / "out")
    assert len(result.manifest) == 6
    assert set(result.manifest.column("text")) == {"weich, groß"}
    assert {"data1/机 1", "data1/tisch, groß {n}"} < set(result.manifest.column("video"))


@pytest.mark.parametrize("text", ["", "\n\n", "a,b,c\nx,y,z\n"])
def test_lists_without_anything_usable(tree, tmp_path, text):
    (tree / "data1" / "train.csv").write_text(text)
    error = fails("", read, tree, tmp_path / "out")
    assert kinds(error.problems) == {"missing-column" if text.strip() else "empty-list": 1}


def test_pairs_across_trajectories_are_suspicious(tree, tmp_path):
    path = tree / "data1" / "train.csv"
    header, first, *others = path.read_text().splitlines()
    row = first.split(",")
    row[1] = others[-1].split(",")[1]
    path.write_text("\n".join([header, ",".join(row), *others]))
    problems = read(tree, tmp_path / "out").suspicious
    assert [(p.where, p.kind) for p in problems] == [(f"{path}:2", "unequal-names")]

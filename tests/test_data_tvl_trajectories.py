"""Trajectories of HCT: contacts and sessions, backgrounds, swapped folders, and bad input."""

import json
import shutil
from collections import Counter

import numpy as np
import pytest
from PIL import Image

from format_trees import PHOTO, gel, make_hct, name_of, photo, put, write_csv
from format_trees import TACTILE as TOUCH
from format_trees import TVL_COLUMNS as COLUMNS
from format_trees import make_trajectory as trajectory
from palpate.core import PalpateError, ProblemsError, Split, quiet
from palpate.data.formats import hct, swapped, tvl
from palpate.data.formats.base import Scan
from palpate.data.formats.hct import TRAJECTORY
from palpate.data.importing import import_dataset, validate, write_lists


@pytest.fixture
def tree(tmp_path):
    return make_hct(tmp_path / "in").source


def read_list(path):
    return tvl.read_list(Scan(path.parent), path)


def kinds(problems):
    return Counter(p.kind for p in problems)


def read(source, out, **options):
    return import_dataset(source, out, **options)


# --- Contact.json, captions, contacts, sessions


def test_without_lists_contact_json_gives_the_samples_if_requested(tree, tmp_path):
    listed = read(tree, tmp_path / "listed").manifest
    for path in tree.glob("data*/*.csv"):
        path.unlink()
    with pytest.raises(PalpateError, match="at least one usable sample"):
        read(tree, tmp_path / "none")
    result = read(tree, tmp_path / "result", contact=True)
    assert result.manifest.ids == listed.ids
    assert result.manifest.column("contact") == listed.column("contact")
    assert set(result.manifest.column("text")) == {None}
    assert (result.facts["text_source"], result.splits) == ("none", {})


def test_frames_that_only_contact_json_names_are_counted_or_taken(tree, tmp_path):
    path = tree / "data1" / "test.csv"
    path.write_text("\n".join(path.read_text().splitlines()[:-1]))
    whole = make_hct(tmp_path / "again").source
    left = read(tree, tmp_path / "a")
    (note,) = left.suspicious
    assert (note.kind, note.text.split(":")[0]) == ("unlisted-contact", "1 row")
    taken = read(tree, tmp_path / "b", contact=True)
    assert taken.manifest.ids == read(whole, tmp_path / "c").manifest.ids
    (new,) = set(taken.manifest.ids) - set(left.manifest.ids)
    assert taken.manifest.table.filter(taken.manifest.table["id"] == new)["text"].to_list() == [
        None
    ]
    assert new not in taken.splits["Orig"].parts
    assert left.manifest.column("contact") == [
        t
        for i, t in zip(taken.manifest.ids, taken.manifest.column("contact"), strict=True)
        if i != new
    ]


def test_frames_of_not_contact_json_are_no_samples(tree, tmp_path):
    data = json.loads((tree / "data1" / "not_contact.json").read_text())
    contact = json.loads((tree / "data1" / "contact.json").read_text())
    both = contact["vision"][0]  # a listed frame
    for side in data:
        data[side].append(contact[side][0])
    (tree / "data1" / "not_contact.json").write_text(json.dumps(data))
    result = read(tree, tmp_path / "a")
    assert kinds(result.suspicious) == {"contact-and-not": 1}
    assert f"data1/{both}" in result.manifest.column("vision")
    for path in tree.glob("data1/*.csv"):
        path.unlink()
    assert f"data1/{both}" not in read(tree, tmp_path / "b").manifest.column("vision")


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ('{"vision": ["a"], "tactile": []}', "unequal-lists"),
        ('{"vision": []}', "bad-json"),
        ("{", "bad-json"),
        ("", "bad-json"),
        ('{"vision": [1], "tactile": [2]}', "bad-json"),
        ("[]", "bad-json"),
        ('{"vision": [], "tactile": [], "background": ["x"]}', "unequal-lists"),
    ],
)
def test_broken_json_is_reported_once_and_its_rows_stay_out(tree, tmp_path, text, kind):
    (tree / "data1" / "contact.json").write_text(text)
    with pytest.raises(ProblemsError) as caught:
        read(tree, tmp_path / "out")
    assert [(p.where, p.kind) for p in caught.value.problems] == [
        (str(tree / "data1" / "contact.json"), kind)
    ]
    assert len(read(tree, tmp_path / "out", skip_bad=True).manifest) == 24


def test_a_contact_runs_on_through_frames_that_only_contact_json_names(tmp_path):
    rig = tmp_path / "hct" / "data1"
    rows = trajectory(rig, "4-100.5", [5, 6, 7, 10])
    write_csv(rig / "train.csv", COLUMNS, [[*rows[k], "soft"] for k in (0, 2, 3)])
    runs = {}
    for name, pairs in (("lists alone", []), ("contact", rows), ("untouched", rows[1:2])):
        lists = {"vision": [row[0] for row in pairs], "tactile": [row[1] for row in pairs]}
        (rig / ("not_contact.json" if name == "untouched" else "contact.json")).write_text(
            json.dumps(lists)
        )
        runs[name] = [t[-4:] for t in read(tmp_path, tmp_path / "out").manifest.column("contact")]
    assert runs == {
        "lists alone": ["0001", "0002", "0003"],
        "contact": ["0001", "0001", "0002"],
        "untouched": ["0001", "0002", "0003"],
    }


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
    starts = [1702596200.5, 1702596265.5, 1702596380.5]  # gaps of 65 and 115 seconds
    for gap, sessions in ((64.9, 3), (65.0, 2), (115.0, 1)):
        result = hct.sessions_of([f"data1/{k}-{t}" for k, t in enumerate(starts)], gap)
        assert len(set(result.values())) == sessions
    videos = [*(f"data1/9-{100 + 50 * k}" for k in range(4)), "data2/9-120", "data2/odd name"]
    chained = hct.sessions_of(videos, 60.0)
    assert set(chained.values()) == {"data1/9-100", "data2/9-120", "data2/odd name"}
    wide = read(tree, tmp_path / "b", session_gap=120.0).manifest
    assert sorted(set(wide.column("session"))) == ["data1/7-1702596200.5", "data2/7-1702599800.5"]
    with pytest.raises(PalpateError, match="session_gap"):
        read(tree, tmp_path / "c", session_gap=-1.0)


# --- Backgrounds


def test_each_source_of_a_background_is_tried_in_turn_and_counted(tree, tmp_path):
    videos = sorted({p.parent for p in tree.glob("data*/*/vision")})
    for video in videos[1:]:
        (video / "background.png").unlink()
    (tree / "data2" / "digit_background.png").write_bytes(
        (videos[0] / "background.png").read_bytes()
    )
    rest = videos[2]  # of data1: its untouched frames are gone too
    for frame in (8, 9):
        (rest / "tactile" / name_of(frame)).unlink()
    result = read(tree, tmp_path / "out")
    assert (
        result.facts["backgrounds"]
        == "as listed 4, digit_background.png 12, none 4, untouched frame 4"
    )
    own = {
        v: set(result.manifest.table.filter(result.manifest.table["video"] == v)["background"])
        for v in set(result.manifest.column("video"))
    }
    names = [v.relative_to(tree).as_posix() for v in videos]
    assert own[names[0]] == {f"{names[0]}/background.png"}
    assert own[names[1]] == {f"{names[1]}/tactile/{name_of(8)}"}
    assert own[names[2]] == {None}
    assert own[names[3]] == own[names[5]] == {"data2/digit_background.png"}
    assert [(p.kind, p.text[:6]) for p in result.suspicious] == [("no-background", "4 rows")]
    (tree / "data2" / "digit_background.png").rename(tree / "digit_background.png")
    above = read(tree, tmp_path / "above")
    assert above.facts["backgrounds"] == "as listed 4, digit_background.png 20"


def test_the_untouched_frame_nearest_to_the_median_is_taken(tmp_path):
    rig = tmp_path / "hct" / "data1"
    light = [90, 92, 91, 200, 10]
    rows = trajectory(rig, "4-100.5", range(20, 26), background=False)
    rest = trajectory(
        rig,
        "4-100.5",
        range(5),
        background=False,
        tactile=lambda k: Image.new("RGB", TOUCH, (light[k % 100],) * 3),
    )
    write_csv(rig / "train.csv", COLUMNS, [[*row, "soft"] for row in rows])
    (rig / "not_contact.json").write_text(
        json.dumps({"vision": [r[0] for r in rest], "tactile": [r[1] for r in rest]})
    )
    result = read(tmp_path, tmp_path / "out")
    assert set(result.manifest.column("background")) == {f"data1/4-100.5/tactile/{name_of(2)}"}
    (rig / "4-100.5" / "tactile" / name_of(3)).write_bytes(b"")  # a broken one does not count
    assert set(read(tmp_path, tmp_path / "again").manifest.column("background")) == {
        f"data1/4-100.5/tactile/{name_of(0)}"
    }
    put(rig / "4-100.5" / "tactile" / name_of(2), gel(1, size=(32, 32)))  # sizes differ: no median
    assert read(tmp_path, tmp_path / "out").facts["backgrounds"] == "none 6"


# --- Swapped folders


def rig_of(tmp_path, *, swapped, sizes, count=12, **sides):
    """One rig of ``count`` trajectories of which some are swapped, and the rows of its list."""
    rig = tmp_path / "hct" / "data1"
    rows = []
    for k in range(count):
        own = trajectory(
            rig,
            f"3-{1000 + 100 * k}.5",
            [5, 6],
            swapped=k in swapped,
            vision=sides.get("vision", lambda n: photo(n, sizes[0])),
            tactile=sides.get("tactile", lambda n: gel(n, sizes[1])),
        )
        rows += [[*row, "soft"] for row in own]
    write_csv(rig / "train.csv", COLUMNS, rows)
    return rig


def named(problems):
    return {
        int((TRAJECTORY.fullmatch(p.where.split("/")[1])[1]).split(".")[0]) // 100 - 10
        for p in problems
        if p.kind == "swapped-folders"
    }


@pytest.mark.parametrize(
    "sizes",
    [(PHOTO, TOUCH), (TOUCH, TOUCH), ((640, 480), (240, 320))],
    ids=["foreign sizes", "equal sizes", "true sizes"],
)
@pytest.mark.parametrize("swapped", [set(), {0}, {2, 5, 11}])
def test_swapped_folders_are_reported_and_fixed(tmp_path, sizes, swapped):
    rig_of(tmp_path, swapped=swapped, sizes=sizes)
    result = read(tmp_path, tmp_path / "a")
    assert named(result.suspicious) == swapped
    assert all("vision/" in p for p in result.manifest.column("vision"))
    (tmp_path / "hct" / "digit_background.png").write_bytes(
        put(tmp_path / "b.png", gel(0, pressed=False)).read_bytes()
    )
    fixed = read(tmp_path, tmp_path / "b", swap="fix").manifest
    for video, vision, tactile, background in fixed.table.select(
        "video", "vision", "tactile", "background"
    ).iter_rows():
        right = int(float(video.split("-")[1])) // 100 - 10 not in swapped
        assert ("/vision/" in vision, "/tactile/" in tactile) == (right, right)
        assert background == (f"{video}/background.png" if right else "digit_background.png")
    again = write_lists(fixed, Split(dict.fromkeys(fixed.ids, "train")), tmp_path / "lists")
    assert named(read(tmp_path, tmp_path / "c", lists=tmp_path / "lists").suspicious) == set()
    assert len(again) == 1
    with pytest.raises(PalpateError, match="must be report or fix"):
        read(tmp_path, tmp_path / "out", swap="yes")


def test_a_rig_that_is_swapped_as_a_whole_is_recognized(tmp_path):
    rig_of(tmp_path, swapped=set(range(12)) - {3}, sizes=(TOUCH, TOUCH))
    assert named(read(tmp_path, tmp_path / "a").suspicious) == set(range(12)) - {3}


def test_sides_that_look_similar_are_not_called_swapped(tmp_path):
    rig_of(tmp_path, swapped={1}, sizes=(TOUCH, TOUCH), tactile=lambda n: photo(n + 7, TOUCH))
    assert read(tmp_path, tmp_path / "a").suspicious == []
    shutil.rmtree(tmp_path / "hct")
    rig_of(
        tmp_path, swapped={1}, sizes=(TOUCH, TOUCH), count=2
    )  # two recordings tell no typical gel
    assert read(tmp_path, tmp_path / "b").suspicious == []


def test_swaps_by_color_over_many_rigs():
    """Precision and recall on 60 rigs whose gel drifts and whose photos share a tint."""
    hits = wrong = planted = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        base, tint = rng.uniform(0.2, 0.6, (8, 8, 3)), rng.uniform(0.2, 0.8, 3)
        truth = {str(k) for k in rng.permutation(30)[: rng.integers(0, 7)]}
        sides = {}
        for k in range(30):
            touch = swapped.Look(
                (240, 320), (base + rng.normal(0, 0.01) + rng.normal(0, 0.02, (8, 8, 3))).clip(0, 1)
            )
            view = swapped.Look(
                (240, 320), (0.5 * tint + 0.5 * rng.uniform(0, 1, (8, 8, 3))).clip(0, 1)
            )
            sides[str(k)] = (touch, view) if str(k) in truth else (view, touch)
        result = set(swapped.swapped(sides, (240, 320)))
        hits, wrong, planted = (
            hits + len(result & truth),
            wrong + len(result - truth),
            planted + len(truth),
        )
    assert planted > 100
    assert (hits, wrong) == (planted, 0)


def test_a_recording_with_touch_on_both_sides_is_not_called_swapped(tmp_path):
    rig = rig_of(tmp_path, swapped=set(), sizes=(TOUCH, TOUCH))
    for path in (rig / "3-1300.5" / "tactile").iterdir():
        shutil.copy(path, rig / "3-1300.5" / "vision" / path.name)
    assert read(tmp_path, tmp_path / "a").suspicious == []


def constant(*levels):
    return [swapped.Look((240, 320), np.full((8, 8, 3), level)) for level in levels]


def test_colors_that_prove_nothing_are_not_used():
    gels, views = constant(*np.linspace(0.30, 0.34, 9)), constant(*np.linspace(0.1, 0.9, 9))
    (far, further) = constant(0.6, 0.95)  # one side is nearer to the gel, but neither is one
    assert (
        swapped.swapped(
            {str(k): p for k, p in enumerate([*zip(views, gels, strict=True), (far, further)])},
            (240, 320),
        )
        == {}
    )
    for seed in range(20):  # both sides vary alike: nobody knows the gel
        levels = np.random.default_rng(seed).uniform(0, 1, (2, 25))
        pairs = zip(constant(*levels[0]), constant(*levels[1]), strict=True)
        assert swapped.swapped({str(k): p for k, p in enumerate(pairs)}, (240, 320)) == {}


def test_looks_skip_what_cannot_be_read(tmp_path):
    (tmp_path / "cut.jpg").write_bytes(b"")
    put(tmp_path / "a.jpg", gel(1))
    assert swapped.look([tmp_path / "cut.jpg", tmp_path / "none.jpg"]) is None
    seen = swapped.look([tmp_path / "cut.jpg", tmp_path / "a.jpg"])
    assert seen is not None
    assert seen.size == TOUCH
    assert (
        np.abs(seen.thumbnail - np.asarray(gel(1).resize((8, 8), Image.Resampling.BOX)) / 255).max()
        < 0.06
    )
    assert swapped.looks({"x": ([tmp_path / "cut.jpg"], [tmp_path / "a.jpg"])}, quiet) == {}


# --- Bad input


def test_every_bad_row_of_hct_is_reported(tree, tmp_path):
    video = sorted({p.parent.name for p in tree.glob("data1/*/vision")})[0]
    gone = sorted({p.parent.name for p in tree.glob("data2/*/vision")})[1]
    shutil.rmtree(tree / "data2" / gone)
    good, cut = (f"{video}/vision/{name_of(k)}" for k in (30, 31))
    (tree / "data1" / cut).write_bytes(b"")
    (tree / "data1" / "val.csv").write_bytes(
        "url,tactile,tactile_background,caption\n"
        f"../data2/x.jpg,{good},,a\n"  # 2
        f"/etc/x.jpg,{good},,a\n"  # 3
        f"{good},{good},,a,b\n"  # 4: five cells
        f"{good}\n"  # 5
        f"{video}/x.jpg,{good},,a\n"  # 6: no side
        f"{video}/vision/first-0.1.jpg,{good},,a\n"  # 7
        f",{good},,a\n"  # 8
        f"{good},{good},,again\n"  # 9: listed in a list of this rig already
        f"{video}/vision/99-0.1.jpg,{video}/tactile/99-0.1.jpg,,a\n"  # 10: neither file
        "data7/1-2.5/vision/1-0.1.jpg,data7/1-2.5/tactile/1-0.1.jpg,,a\n"  # 11: no such rig
        f"{good},{good},,\xff".encode("latin-1")  # 12: not UTF-8
    )
    expected = [
        (2, "outside-root"),
        (3, "outside-root"),
        (4, "bad-row"),
        (5, "bad-row"),
        (6, "bad-path"),
        (7, "bad-frame"),
        (8, "empty-cell"),
        (9, "two-parts"),
        (10, "missing-file"),
        (10, "missing-file"),
        (11, "missing-folder"),
        (12, "bad-encoding"),
    ]
    with pytest.raises(ProblemsError) as caught:
        read(tree, tmp_path / "out")
    reported = caught.value.problems
    assert [
        (int(p.where.rpartition(":")[2]), p.kind)
        for p in reported
        if p.where.startswith(str(tree / "data1" / "val.csv"))
    ] == expected
    assert [p.text for p in reported if p.where.endswith("val.csv:11")] == [
        f"1 row: no folder 'data7' in {tree}"
    ]
    others = [p for p in reported if not p.where.startswith(str(tree / "data1" / "val.csv"))]
    assert [p.kind for p in others] == ["bad-image", "missing-folder"]
    assert others[1].text == f"4 rows: no folder 'data2/{gone}' in {tree}"
    assert not (tmp_path / "out").exists()
    result = read(tree, tmp_path / "out", skip_bad=True)
    assert len(result.manifest) == 24 - 4 - 1
    report = validate(tree)
    assert (report.samples, kinds(report.missing) + kinds(report.invalid)) == (19, kinds(reported))
    assert kinds(report.missing) == {"missing-file": 2, "missing-folder": 2}


def test_a_rig_that_is_missing_is_one_problem(tree, tmp_path):
    shutil.copy(tree / "data2" / "train.csv", tmp_path / "keep.csv")
    shutil.rmtree(tree / "data2")
    (tree / "data2").mkdir()
    shutil.copy(tmp_path / "keep.csv", tree / "data2" / "train.csv")
    with pytest.raises(ProblemsError) as caught:
        read(tree, tmp_path / "out")
    assert [p.text.split(":")[0] for p in caught.value.problems] == ["3 rows"] * 3


def test_names_with_spaces_commas_and_other_scripts(tmp_path):
    rig = tmp_path / "hct" / "data1"
    trajectory(rig, "4-100.5", [1])
    rows = []
    for folder in ("tisch, groß {n}", "机 1", "4-200.5"):
        for frame in range(2):
            sides = {side: f"{folder}/{side}/{frame}-né, é.jpg" for side in ("vision", "tactile")}
            put(rig / sides["vision"], photo(frame))
            put(rig / sides["tactile"], gel(frame))
            rows.append([*sides.values(), "", "Weich, groß."])
    write_csv(rig / "train.csv", COLUMNS, rows)
    result = read(tmp_path, tmp_path / "out")
    assert len(result.manifest) == 6
    assert set(result.manifest.column("text")) == {"weich, groß"}
    assert {"data1/机 1", "data1/tisch, groß {n}"} < set(result.manifest.column("video"))
    shutil.rmtree(rig / "tisch, groß {n}")
    with pytest.raises(ProblemsError) as caught:
        read(tmp_path, tmp_path / "out2")
    assert (
        caught.value.problems[0].text
        == f"2 rows: no folder 'data1/tisch, groß {{n}}' in {tmp_path / 'hct'}"
    )


@pytest.mark.parametrize("text", ["", "\n\n", "a,b,c\nx,y,z\n"])
def test_lists_without_anything_usable(tree, tmp_path, text):
    (tree / "data1" / "train.csv").write_text(text)
    with pytest.raises(ProblemsError) as caught:
        read(tree, tmp_path / "out")
    assert [p.kind for p in caught.value.problems] == [
        "missing-column" if text.strip() else "empty-list"
    ]


def test_pairs_across_trajectories_are_suspicious(tree, tmp_path):
    path = tree / "data1" / "train.csv"
    lines = path.read_text().splitlines()
    row = lines[1].split(",")
    row[1] = lines[-1].split(",")[1]
    path.write_text("\n".join([lines[0], ",".join(row), *lines[2:]]))
    assert [(p.where, p.kind) for p in read(tree, tmp_path / "out").suspicious] == [
        (f"{path}:2", "unequal-names")
    ]

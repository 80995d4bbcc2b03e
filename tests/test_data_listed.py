"""Lists without images: read as they are, audited, and the next commands run on the same lists."""

import json
import shlex

import polars as pl
import pytest

from forge.errors import fails
from palpate.cli import main
from palpate.data.reading import read
from palpate.data.recordings import groups_of, name_recordings


def rows_of(kind, numbers):
    """The lines of a list of samples by number; ten numbers are a recording."""
    if kind == "ssvtp":
        lines = [f"images_rgb/image_{k}_rgb.jpg,images_tac/image_{k}_tac.jpg,soft" for k in numbers]
        return "url,tactile,caption\n" + "\n".join(lines)
    if kind == "intervals":
        return "\n".join(f"video{k // 10} {100 * k} {100 * k + 9} wood" for k in numbers)
    if kind == "interval table":
        lines = [f"wood;video{k // 10};{100 * k};{100 * k + 9}" for k in numbers]
        return "label;video;start;end\n" + "\n".join(lines)
    hct = [f"hct/data1/{k // 10}-17{k // 10:03d}.70/tactile/{k}-0.02.jpg" for k in numbers]
    if kind == "nested":
        items = [{"tactile": {"path": path, "size": [1, 2]}, "talk": [{}]} for path in hct]
        return json.dumps({"data": {"items": items}})
    if kind == "json lines":
        return "\n".join(json.dumps({"gel": path}) for path in hct)
    own = [f"rig/cup{k // 10}/touch/{k:04d}.png" for k in numbers]
    return "photo,gel\n" + "\n".join(f"{path.replace('touch', 'photo')},{path}" for path in own)


KINDS = {
    # suffix, options, video and frame of the first test sample, leaking samples of how many
    "ssvtp": (
        ".csv",
        ("--tactile", "images_tac/image_{frame}_tac.jpg", "--near-frames", "1"),
        (None, 35),
        (1, 10),
    ),
    "intervals": (".txt", (), ("video3", 3500), (50, 100)),
    "interval table": (".csv", (), ("video3", 3500), (50, 100)),
    "nested": (".json", (), ("data1/3-17003.70", 35), (5, 10)),
    "json lines": (".jsonl", (), ("data1/3-17003.70", 35), (5, 10)),
    "own": (".csv", ("--tactile", "rig/{video}/touch/{frame}.png"), ("cup3", 35), (5, 10)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_list_without_images_is_audited_and_answered(kind, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    suffix, options, (video, frame), (leaking, of) = KINDS[kind]
    for part, numbers in (("train", range(35)), ("test", range(35, 45))):
        (tmp_path / f"{part}{suffix}").write_text(rows_of(kind, numbers))
    paths = [f"train{suffix}", f"test{suffix}"]
    assert main(["audit", *paths, *options, "-o", "t.csv", "--json"]) == 1
    data = json.loads(capsys.readouterr().out)
    assert (data["leaking_samples"], data["test_samples"]) == (leaking, of)
    assert data["identical_samples"] == 0
    samples = name_recordings([read(tmp_path / f"test{suffix}").manifest])[0].table
    if kind != "own":
        assert (samples["video"][0], samples["frame"][0]) == (video, frame)
    assert bool(data["commands"]) == (kind != "ssvtp")  # nothing says what belongs together
    for command in data["commands"]:
        assert main([*shlex.split(command)[1:], "--json"]) == 0, command
        assert json.loads(capsys.readouterr().out)


def test_a_list_that_states_its_parts_is_audited_alone(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parts = {"train": range(8), "val": range(8, 9), "test": range(9, 10)}
    pairs = {part: [[obj, k] for obj in range(1, 6) for k in ks] for part, ks in parts.items()}
    (tmp_path / "split.json").write_text(json.dumps(pairs))
    assert main(["audit", "split.json", "--json"]) == 1
    data = json.loads(capsys.readouterr().out)
    numbers = data["group"], data["train_samples"], data["test_samples"], data["groups_shared"]
    assert numbers == ("object", 40, 5, 5)
    for command in data["commands"]:
        assert main([*shlex.split(command)[1:], "--json"]) == 0, command
        answer = json.loads(capsys.readouterr().out)
    assert (answer["leaking_samples"], answer["shared"]) == (0, {"object": [0, 1]})
    scenes = {part: [["office_40_30", str(k)] for k in ks] for part, ks in parts.items()}
    (tmp_path / "scenes.json").write_text(json.dumps(scenes))
    assert main(["audit", "scenes.json", "--json"]) == 1
    data = json.loads(capsys.readouterr().out)
    assert (data["group"], data["gap_min"]) == ("video", 2)
    (tmp_path / "t.csv").write_text("id,video,split\n1,a,train\n2,b,test\n3,c,\n")
    assert main(["audit", "t.csv", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["test_samples"] == 1
    (tmp_path / "t.csv").write_text("id,video\n1,a\n2,b\n")
    assert main(["audit", "t.csv"]) == 2
    assert "the source states none" in capsys.readouterr().err


@pytest.mark.parametrize("keyed", [False, True])
def test_rows_of_one_file_have_the_same_columns(tmp_path, keyed):
    """Also if some have nothing besides what they nest."""
    rows = [{"data": {"tactile": f"trial_{k}/1.jpg"}} for k in range(4)]
    rows[1] |= {"text": "x"}
    path = tmp_path / "a.json"
    path.write_text(json.dumps({f"s{k}": row for k, row in enumerate(rows)} if keyed else rows))
    manifest = read(path).manifest
    assert (manifest.table["path"].null_count(), len(manifest)) == (0, 4)


def test_rows_that_begin_with_an_image_are_no_videos_and_frames(tmp_path):
    path = tmp_path / "a.json"
    path.write_text(json.dumps([["cup/1.jpg", "7"], ["pan/2.jpg", "8"]]))
    fails("at least one of the columns", read, path)
    path.write_text(json.dumps([["cup", "7"], ["pan", "8"]]))
    assert read(path).manifest.table["video"].to_list() == ["cup", "pan"]


def test_what_one_list_hides_the_other_shows(tmp_path):
    """All test paths are of one recording, which only the train paths show to be one."""
    for part, numbers in (("train", range(35)), ("test", range(35, 38))):
        (tmp_path / f"{part}.csv").write_text(rows_of("own", numbers))
    lists = [read(tmp_path / f"{part}.csv").manifest for part in ("train", "test")]
    named = name_recordings(lists)
    source = "file names `rig/{video}/touch/{frame:d}.png`"
    assert groups_of(named[1]) == [("video", source), ("frame", source)]
    rows = named[1].table.select("video", "frame").rows()
    assert rows == [("cup3", 35), ("cup3", 36), ("cup3", 37)]


def test_a_list_of_two_published_data_sets_is_read_row_by_row(tmp_path, capsys):
    """The images of SSVTP lie in one folder, which is no video."""
    hct, ssvtp = "hct/data1/{}-17{:03d}.70/tactile/{}-0.02.jpg", "ssvtp/images_tac/image_{}_tac.jpg"
    for part, numbers in (("train", range(35)), ("test", range(35, 45))):
        rows = [{"gel": hct.format(k // 10, k // 10, k)} for k in numbers]
        rows += [{"gel": ssvtp.format(k)} for k in numbers]
        (tmp_path / f"{part}.json").write_text(json.dumps(rows))
    paths = [tmp_path / f"{part}.json" for part in ("train", "test")]
    named = name_recordings([read(path).manifest for path in paths])
    rows = named[1].table.select("video", "frame", "session").rows()
    assert named[0].facts["video_from"] == "file names of HCT, SSVTP"
    assert rows[0] == ("data1/3-17003.70", 35, "data1/0-17000.70")
    assert rows[10] == (None, 35, None)
    assert main(["audit", *map(str, paths), "--json"]) == 1
    data = json.loads(capsys.readouterr().out)
    assert (data["leaking_samples"], data["test_samples"]) == (5, 20)  # those of HCT, as above


@pytest.mark.parametrize("columns", ["photo,gel", "url,tactile"])
def test_a_template_of_the_photos_is_held_against_the_photos(columns, tmp_path):
    table = tmp_path / "t.csv"
    lines = [f"rig/cup{k // 10}/photo/{k}.png,gel/{k}.png" for k in range(8, 12)]
    table.write_text("\n".join([columns, *lines]))
    for side, template, column, values in (
        ("vision", "rig/{video}/photo/{frame}.png", "video", ["cup0", "cup0", "cup1", "cup1"]),
        ("tactile", "gel/{frame}.png", "frame", [8, 9, 10, 11]),
    ):
        (named,) = name_recordings([read(table, **{side: template}).manifest], template)
        assert named.column(column) == values


def test_frames_that_begin_anew_in_every_contact_make_no_sample_of_two(tmp_path, capsys):
    """wood/1_0003.png and wood/2_0003.png are two images, whatever the list they are in."""
    paths = {
        part: [f"{o}/{c}_{f:04}.png" for o, c in places for f in range(6)]
        for part, places in (
            ("train", (("wood", 1), ("wool", 2))),
            ("test", (("wood", 2), ("wool", 1))),
        )
    }
    (tmp_path / "all.json").write_text(json.dumps(paths))
    for part, some in paths.items():
        (tmp_path / f"{part}.csv").write_text("\n".join(["gel", *some]))

    def audited(*words):
        status = main(["audit", *map(str, words), "--json"])
        data = json.loads(capsys.readouterr().out)
        codes = {note["code"] for note in data["notes"]}
        assert "split-of-other-manifest" not in codes
        return status, data["group"], data["groups_shared"], data["identical_samples"]

    lists = (tmp_path / "train.csv", tmp_path / "test.csv")
    assert audited(tmp_path / "all.json") == (1, "video", 2, 0)
    assert audited(*lists) == (1, "video", 2, 0)
    for field in ("video", "contact"):
        template = f"{{material}}/{{{field}}}_{{frame:d}}.png"
        given = ("--tactile", template, "--by", field)
        assert audited(*lists, *given) == (0, field, 0, 0)


def test_bad_lines_and_wrong_options_are_named(tmp_path, capsys):
    path = tmp_path / "l.txt"
    path.write_text("v 1 5\nv 9 7\nv one 3\n\nv 20 22 wood\n")
    result = read(path, skip_bad=True)
    assert (len(result.manifest), [p.where[-2:] for p in result.skipped]) == (8, [":2", ":3"])
    path.write_text("v 0 999999999\n")
    fails("at most 20,000,000 frames", read, path)
    table = tmp_path / "t.csv"
    table.write_text(rows_of("own", range(3)) + "\nelse/where.png,else/where.png")
    fails("no-match", read, table, tactile="rig/{video}/touch/{frame}.png")
    table.write_text("id,tactile\n1,a/1.png\n1,a/2.png\n")
    fails("duplicate-id", read, table)
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "1.png").write_bytes(b"")
    fails("missing-file", read, table)  # one of its images is there
    assert main(["audit", str(table), str(table), "--map", "nothing"]) == 2
    assert "COLUMN=EXPRESSION" in capsys.readouterr().err


def test_columns_of_lists_and_bytes_are_left_alone(tmp_path):
    frame = pl.DataFrame(
        {"gel": ["a/1.png", "a/2.png"], "emb": [[1.0], [2.0]], "raw": [b"x", b"y"]}
    )
    frame.write_parquet(tmp_path / "t.parquet")
    for source in (frame, tmp_path / "t.parquet"):
        assert read(source).manifest.ids == ["a/1", "a/2"]

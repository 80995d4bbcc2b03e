"""The exact signals against double loops, on rows and files planted by hand."""

import dataclasses
import json
import shutil

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from palpate.core import PalpateError, Split
from palpate.data.manifest import Manifest
from palpate.leakage import signals
from palpate.leakage.audit import (
    audit_parts,
    inspect_parts,
    inspect_split,
    known_group,
    nearest_in_video,
)
from palpate.report.results import Audit

cells = st.fixed_dictionaries(
    {
        "video": st.sampled_from(["a", "b", None]),
        "frame": st.one_of(st.none(), st.integers(0, 90)),
        "object": st.sampled_from(["cup", "mug", None]),
        "session": st.sampled_from(["s", None]),
    }
)
rows = st.lists(cells, min_size=1, max_size=14)


def manifest(rows, prefix):
    return Manifest.from_rows([{"id": f"{prefix}{k}", **row} for k, row in enumerate(rows)], ".")


@settings(max_examples=150, deadline=None)
@given(rows, rows, st.integers(0, 40))
def test_the_signals_equal_double_loops(train_rows, test_rows, near):
    train, test = manifest(train_rows, "r"), manifest(test_rows, "t")
    row, gap = nearest_in_video(train.table, test.table)
    for column in ("video", "object", "session"):
        flags = signals.shared_group(train, test, column, counts=True)
        there = {r[column] for r in train_rows} - {None}
        asked = [r[column] for r in test_rows]
        if not there or set(asked) == {None}:
            assert flags is None
            continue
        assert flags.flag.tolist() == [v in there for v in asked]
        assert np.isnan(flags.score).tolist() == [v is None for v in asked]
    gaps = [
        min(
            (
                abs(r["frame"] - t["frame"])
                for r in train_rows
                if None not in (r["frame"], r["video"]) and r["video"] == t["video"]
            ),
            default=None,
        )
        if None not in (t["frame"], t["video"])
        else None
        for t in test_rows
    ]
    timed = signals.time_gap(gap, row, near)
    if timed is None:
        assert set(gaps) == {None}
    else:
        assert timed.flag.tolist() == [g is not None and g <= near for g in gaps]
        assert timed.score == pytest.approx(
            [0 if g is None else 0.5 ** (g / max(near, 1)) for g in gaps], abs=1e-6
        )
        assert (timed.score[timed.flag] >= timed.threshold).all()
    same = signals.identical_samples(train, test, gap, row)
    assert same.flag.tolist() == [g == 0 for g in gaps]


def picture(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((8, 8, 3), value, np.uint8)).save(path)
    return path


def test_equal_bytes_are_found_under_other_names_and_bad_files_are_no_match(tmp_path):
    for k in range(4):
        picture(tmp_path / "v" / f"{k}.png", 10 * k)
        picture(tmp_path / "t" / f"{k}.png", 100 + 10 * k)
    shutil.copy(tmp_path / "v" / "0.png", tmp_path / "v" / "copy of 0.png")
    shutil.copy(tmp_path / "t" / "1.png", tmp_path / "t" / "again.png")
    (tmp_path / "v" / "empty1.png").write_bytes(b"")
    (tmp_path / "v" / "empty2.png").write_bytes(b"")
    train = Manifest.from_rows(
        [{"id": f"r{k}", "vision": f"v/{k}.png", "tactile": f"t/{k}.png"} for k in range(2)]
        + [{"id": "r2", "vision": "v/empty1.png"}],
        tmp_path,
    )
    test = Manifest.from_rows(
        [
            {"id": "t0", "vision": "v/copy of 0.png", "tactile": "t/2.png"},
            {"id": "t1", "vision": "v/3.png", "tactile": "t/again.png"},
            {"id": "t2", "vision": "v/2.png", "tactile": "t/3.png"},
            {"id": "t3", "vision": "v/empty2.png"},
            {"id": "t4", "vision": "v/gone.png"},
            {"id": "t5"},
        ],
        tmp_path,
    )
    found = signals.identical_bytes(train, test)
    assert found.flag.tolist() == [True, True, False, False, False, False]
    assert found.nearest.tolist() == [0, 1, -1, -1, -1, -1]
    assert np.isnan(found.score).tolist() == [False, False, False, False, True, True]
    assert "2 files are empty" in found.notes[0]
    assert signals.identical_bytes(train, Manifest.from_rows([{"id": "x"}], tmp_path)) is None


def test_only_the_group_asked_for_counts_and_the_table_holds_every_signal():
    train = Manifest.from_rows(
        [
            {"id": "1", "video": "a", "frame": 0, "object": "cup"},
            {"id": "2", "video": "a", "frame": 9, "object": "cup"},
        ],
        ".",
    )
    test = Manifest.from_rows(
        [
            {"id": "3", "video": "b", "frame": 0, "object": "cup"},
            {"id": "4", "video": "a", "frame": 300, "object": "mug"},
        ],
        ".",
    )
    by_video = inspect_parts(train, test)
    assert by_video.audit.leaking_samples == 1
    kinds = {s.kind: s for s in by_video.audit.signals}
    assert list(kinds) == ["identical sample", "shared video", "shared object", "time gap"]
    assert (
        kinds["shared object"].flagged,
        kinds["time gap"].flagged,
        kinds["time gap"].checked,
    ) == (1, 0, 2)
    assert "not counted" in kinds["shared object"].notes[0]
    table = by_video.table
    assert table["leaking"].to_list() == [False, True]
    assert table["gap"].to_list() == [None, 291]
    assert table["time_gap_nearest"].to_list() == [None, "2"]
    assert {"shared_video_flag", "shared_object_score", "identical_sample_flag"} <= set(
        table.columns
    )
    by_object = audit_parts(train, test, group="object")
    assert (by_object.leaking_samples, by_object.groups_shared) == (1, 1)
    assert (
        Audit.from_json(json.loads(json.dumps(dataclasses.asdict(by_object)))).signals[1].flagged
        == 1
    )


def test_the_matrix_puts_shared_groups_first():
    rows = [
        ("a", "train", 5),
        ("b", "train", 1),
        ("b", "test", 3),
        ("c", "val", 2),
        ("c", "test", 4),
        ("d", "test", 9),
    ]
    manifest_rows = [
        {"id": f"{v}{p}{k}", "video": v, "frame": 1000 * len(p) + 40 * k}
        for v, p, n in rows
        for k in range(n)
    ]
    whole = Manifest.from_rows(manifest_rows, ".")
    parts = {f"{v}{p}{k}": p for v, p, n in rows for k in range(n)}
    audit = inspect_split(whole, Split(parts)).audit
    assert list(audit.matrix) == [
        {"group": "b", "train": 1, "val": 0, "test": 3, "leaking": 3},
        {"group": "d", "train": 0, "val": 0, "test": 9, "leaking": 0},
        {"group": "c", "train": 0, "val": 2, "test": 4, "leaking": 0},
        {"group": "a", "train": 5, "val": 0, "test": 0, "leaking": 0},
    ]
    assert audit.groups_in_all == 4


def test_the_group_is_chosen_by_what_both_sides_know():
    one = lambda **cells: Manifest.from_rows([{"id": str(cells), **cells}], ".")  # noqa: E731
    assert known_group(one(video="v", object="o"), one(video="w", object="o")) == "video"
    assert known_group(one(object="o", video="v"), one(object="o")) == "object"
    assert known_group(one(session="s"), one(session="s")) == "session"
    assert known_group(one(), one(video="v")) == "none"
    with pytest.raises(PalpateError, match="column of nulls"):
        audit_parts(one(), one(video="v"), group="auto")


def test_the_worst_pairs_come_from_different_videos_first():
    test = manifest([{"video": v} for v in ["a", "a", "a", "b"]], "t")
    train = manifest([{"video": "c"}], "r")
    flags = signals.Flags(
        "x", np.array([0.9, 0.8, 1.0, 0.7], np.float32), np.ones(4, bool), np.zeros(4, np.int64)
    )
    gaps = np.full(4, -1)
    worst = flags.summary(train, test, gaps, gaps, 3).worst
    assert [p.test.id for p in worst] == ["t2", "t3", "t0"]
    assert isinstance(signals.signal_table(test, train, [flags], gaps), pl.DataFrame)

"""Leak-free splits: against brute force over all assignments, on the published lists, folds, groups, records, and what cannot be split."""

import dataclasses
import itertools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.cli import main
from palpate.core import PalpateError, Split, digest_file
from palpate.data.listing import read_lists
from palpate.data.manifest import Manifest
from palpate.leakage import audit_split
from palpate.leakage.splits import (
    choose_group,
    components,
    describe,
    leak_free_folds,
    leak_free_split,
    leak_free_splits,
)
from palpate.leakage.splits.assign import RESOLUTION, column_bound, draw, optimize, repair
from palpate.leakage.splits.noleak import (
    RATIOS,
    entry,
    hct_noleak,
    load_record,
    make_record,
    record_split,
    verify_record,
)
from palpate.leakage.splits.polish import Problem, Search, greedy, start
from palpate.leakage.splits.program import EXACT
from palpate.leakage.splits.recheck import recheck

TOP = Path(__file__).resolve().parents[1]


def manifest_of(rows, **facts):
    """Rows (video, frame, material) as a manifest; ten frames are a touch."""
    return Manifest.from_rows(
        [
            {"id": f"{v}/{f}", "video": v, "frame": f, "material": m, "contact": f"{v}#{f // 10}"}
            for v, f, m in rows
        ],
        ".",
        facts,
    )


def filled(counts):
    """A manifest with so many samples by video and material: ``{"a": {"Wood": 3}}``."""
    return manifest_of(
        [
            (v, 1000 * k + j, m)
            for v, row in counts.items()
            for k, (m, n) in enumerate(row.items())
            for j in range(n)
        ]
    )


@pytest.fixture(scope="module")
def published(real_data):
    lists = real_data / "touch_and_go" / "lists"
    return read_lists([lists / "train.txt", lists / "test.txt"], root=lists).manifest


def brute(counts, target):
    """(fewest missing, smallest largest deviation among those) over all assignments, by the definition."""
    totals, parts = counts.sum(0), len(target)
    use = [m for m in range(counts.shape[1] - 1) if (counts[:, m] > 0).sum() >= parts] + [
        counts.shape[1] - 1
    ]
    best = (10**9, 9.0)
    for assignment in itertools.product(range(parts), repeat=len(counts)):
        a = np.array(assignment)
        sums = np.array([[counts[a == p, m].sum() for m in use] for p in range(parts)])
        missing = int((sums == 0).sum())
        best = min(
            best, (missing, float(np.abs(sums / totals[use] - np.array(target)[:, None]).max()))
        )
    return best


matrices = st.lists(
    st.lists(st.sampled_from([0, 0, 1, 2, 3, 5, 9, 20]), min_size=3, max_size=3).filter(any),
    min_size=4,
    max_size=8,
)
targets = st.sampled_from(
    [(0.8, 0.2), (0.7, 0.3), (0.5, 0.5), (0.6, 0.2, 0.2), (1 / 3, 1 / 3, 1 / 3)]
)


@settings(max_examples=60, deadline=None)
@given(matrices, targets, st.integers(0, 5))
def test_the_optimum_is_that_of_brute_force_and_every_seed_reaches_it(rows, target, seed):
    rows = rows[:6] if len(target) == 3 else rows
    counts = np.array([[*row, sum(row)] for row in rows])
    problem = Problem(counts, np.array(target))
    missing, deviation = brute(counts, target)
    found = optimize(problem)
    assert found.missing == missing
    assert found.deviation == pytest.approx(
        deviation, abs=RESOLUTION + EXACT
    )  # below the resolution all count as equal
    assert found.bound <= deviation + EXACT
    if deviation > RESOLUTION:
        assert found.deviation == pytest.approx(deviation, abs=EXACT)
        assert found.bound == pytest.approx(deviation, abs=EXACT)  # proven
    drawn = draw(problem, found, seed)
    assert problem.missing(drawn) == missing
    assert problem.worst(drawn) <= found.limit + EXACT
    assert problem.worst(draw(problem, found, seed, 0.05)) <= found.limit + 0.05 + EXACT
    assert max(column_bound(problem, m) for m in np.flatnonzero(problem.used)) <= deviation + 1e-12


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 1000),
    st.sampled_from([(0.8, 0.2), (0.7, 0.2, 0.1), (0.25, 0.25, 0.25, 0.25)]),
    st.sampled_from([2, 8]),
)
def test_moves_and_swaps_lower_the_cost_and_count_right(seed, target, power):
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 9, (14, 4)) * (rng.random((14, 4)) < 0.5)
    counts[:, -1] = counts[:, :-1].sum(1) + 1
    problem = Problem(counts, np.array(target))

    def cost(a):
        total = 0.0
        for p, share in enumerate(target):
            for m in range(4):
                held = counts[a == p, m].sum()
                total += problem.weight[m] * abs(held / max(1, counts[:, m].sum()) - share) ** power
                total += 1000 * (problem.possible[m] and (counts[a == p, m] > 0).sum() == 0)
        return total

    first = greedy(problem, rng)
    search = Search(problem, first, power)
    last = cost(first)
    for _ in range(20):
        if not (search.move(rng.permutation(14)) or search.swap(*rng.integers(0, 14, (2, 60)))):
            break
        now = cost(search.assignment)
        assert now < last
        assert search.rows.sum() + 1000 * search.gone.sum() == pytest.approx(now, rel=1e-9)
        last = now
    limited = Search(problem, first, 2, limit=problem.worst(first)).run(np.random.default_rng(1))
    assert problem.worst(limited) <= problem.worst(first) + 1e-12


def test_small_programs_press_the_deviation_of_many_groups_down():
    rng = np.random.default_rng(3)
    counts = rng.integers(1, 60, (150, 7)) * (
        rng.random((150, 7)) < np.array([0.9, 0.5, 0.2, 0.1, 0.06, 0.04, 1.0])
    )
    counts[:, -1] = counts[:, :-1].sum(1) + 1
    problem = Problem(counts, np.array([0.8, 0.2]))
    first = start(problem, np.random.default_rng(0))
    better = repair(problem, first, RESOLUTION, np.random.default_rng(0))
    assert problem.missing(better) == 0
    assert problem.worst(better) < 0.5 * problem.worst(first)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 14), st.integers(0, 3), st.integers(1, 30)),
        min_size=8,
        max_size=60,
    ),
    st.integers(0, 3),
)
def test_no_group_stands_in_two_parts_and_the_same_seed_gives_the_same_split(rows, seed):
    m = manifest_of(
        [(f"v{v}", 100 * k + j, f"m{c}") for k, (v, c, n) in enumerate(rows) for j in range(n)]
    )
    sizes = m.table["video"].value_counts()["count"]
    if len(sizes) < 2 or 1 - sizes.max() / len(m) < 0.05:
        with pytest.raises(PalpateError, match=r"cannot be split|at least as many groups"):
            leak_free_split(m, group="video", seed=seed)
        return
    plan = leak_free_split(m, group="video", seed=seed)
    assert audit_split(m, plan.split).groups_shared == 0
    assert set(plan.split.parts) == set(m.ids)
    assert plan.split.digest == leak_free_split(m, group="video", seed=seed).split.digest
    assert {"train", "test"} == set(plan.split.counts())
    share = pl.DataFrame(
        {"m": m.table["material"], "v": m.table["video"], "p": [plan.split.parts[i] for i in m.ids]}
    )
    for material, of in share.group_by("m"):
        if of["v"].n_unique() >= 2 and not plan.missing:
            assert of["p"].n_unique() == 2, material
            assert abs((of["p"] == "train").mean() - 0.8) <= plan.deviation + 1e-9
    assert all(c.ok for c in recheck(m, plan.split))


def test_touch_and_go_at_80_20_is_proven_optimal(published):
    assert (
        len(published),
        published.table["video"].n_unique(),
        published.table["material"].n_unique(),
    ) == (121861, 126, 19)
    one, two = leak_free_splits(published, [0, 1])
    assert (one.group, one.reason, one.rare, one.status) == ("video", "", [], "proven optimal")
    audit = audit_split(published, one.split)
    assert audit.groups_shared == 0
    assert all(row["train"] and row["test"] for row in audit.materials)
    assert len(audit.materials) == 19
    off = max(abs(row["test"] / (row["train"] + row["test"]) - 0.2) for row in audit.materials)
    assert off == pytest.approx(one.deviation, abs=1e-9)
    # Soil and Others share a video, which is what holds the optimum up; the heuristic before this one reached 0.07 to 0.11.
    assert one.deviation == pytest.approx(0.039332, abs=1e-6)
    assert one.gap <= EXACT
    assert two.split.digest != one.split.digest
    assert two.deviation == pytest.approx(one.deviation, abs=1e-6)


@pytest.mark.slow
def test_touch_and_go_in_folds_and_three_parts(published):
    plans = leak_free_folds(published, 5, val=True)
    tests = [i for plan in plans for i in plan.split.ids("test")]
    assert sorted(tests) == sorted(published.ids)
    for k, plan in enumerate(plans):
        assert set(plan.split.ids("val")) == set(plans[(k + 1) % 5].split.ids("test"))
        assert audit_split(published, plan.split).groups_shared == 0
        assert plan.status == "proven optimal"
    three = leak_free_split(published, train=0.8, val=0.1)
    assert all(
        set(published.part(three.split, p).column("material")) == set(published.column("material"))
        for p in ("train", "val", "test")
    )
    assert three.deviation == pytest.approx(0.096129, abs=1e-6)


def test_folds_cover_every_sample_once_and_name_what_is_rare():
    counts = {f"v{k}": {"Wood": 10, **({"Sand": 4} if k < 2 else {})} for k in range(9)}
    m = filled(counts)
    plans = leak_free_folds(m, 3)
    assert sorted(i for p in plans for i in p.split.ids("test")) == sorted(m.ids)
    assert all(set(p.split.counts()) == {"train", "test"} for p in plans)
    assert plans[0].rare == ["Sand"]
    assert "Sand" in " ".join(plans[0].notes)
    assert plans[0].split.rule["shares"] == {
        "train": pytest.approx(2 / 3),
        "test": pytest.approx(1 / 3),
    }
    assert all(c.ok for p in plans for c in recheck(m, p.split))
    with pytest.raises(PalpateError, match="at least 3 folds"):
        leak_free_folds(m, 2, val=True)
    with pytest.raises(PalpateError, match="at least as many groups"):
        leak_free_folds(m, 10, by=["video"])


def test_groups_are_components_of_a_union_find():
    rng = np.random.default_rng(5)
    rows = [
        {
            "id": str(k),
            "video": f"v{rng.integers(9)}",
            "object": f"o{rng.integers(30)}" if rng.random() < 0.5 else None,
        }
        for k in range(60)
    ]
    m = Manifest.from_rows(rows, ".")
    near = rng.integers(-1, 40, 60)
    near[rng.random(60) < 0.7] = -1
    found = components(m, ["video", "object"], [near], nulls="own")
    parent = list(range(60))

    def root(k):
        return k if parent[k] == k else root(parent[k])

    for i, j in itertools.combinations(range(60), 2):
        a, b = rows[i], rows[j]
        if (
            a["video"] == b["video"]
            or (a["object"] and a["object"] == b["object"])
            or (near[i] >= 0 and near[i] == near[j])
        ):
            parent[root(i)] = root(j)
    for i, j in itertools.combinations(range(60), 2):
        assert (found[i] == found[j]) == (root(i) == root(j))
    for k in range(60):
        assert found[k] == min(r["video"] for i, r in enumerate(rows) if root(i) == root(k))


def test_samples_without_a_group_are_refused_or_stand_alone():
    rows = [
        {"id": f"{k}", "video": f"Straße, {k % 4}" if k < 8 else None, "material": "Wood"}
        for k in range(12)
    ]
    m = Manifest.from_rows(rows, ".")
    with pytest.raises(PalpateError, match="4 of 12 samples without"):
        leak_free_split(m, by=["video"])
    plan = leak_free_split(m, by=["video"], nulls="own", train=0.75)
    assert len(plan.where) == 8
    assert {"Straße, 0", "sample:8"} <= set(plan.where)
    assert "4 samples have no video" in plan.notes[0]
    near = np.array([-1] * 8 + [0, 0, 1, 1])
    assert components(m, ["video"], [near], nulls="own")[8:] == [
        "sample:10" if k > 1 else "sample:8" for k in range(4)
    ]
    linked = leak_free_split(
        m, by=["video"], links=[np.array([-1] * 7 + [0, 0] + [-1] * 3)], nulls="own", train=0.5
    )
    assert linked.split.parts["7"] == linked.split.parts["8"] == linked.split.parts["3"]
    with pytest.raises(PalpateError, match="Links must be 12 integers"):
        components(m, [], [np.zeros(3, int)])
    with pytest.raises(PalpateError, match="12 of 12 samples without"):
        leak_free_split(m, by=["object"], nulls="own")


def test_near_duplicates_alone_make_groups_where_nothing_else_is_known():
    m = Manifest.from_rows([{"id": f"{k}", "material": "soft"} for k in range(20)], ".")
    plan = leak_free_split(m, links=[np.arange(20) // 2], link_facts={"modalities": ["tactile"]})
    assert (plan.group, plan.by, len(plan.where)) == ("near-duplicates", (), 10)
    assert plan.split.rule["near"] == {"modalities": ["tactile"]}
    assert all(plan.split.parts[str(k)] == plan.split.parts[str(k + 1)] for k in range(0, 20, 2))
    assert all(c.ok for c in recheck(m, plan.split, links=[np.arange(20) // 2]))
    failed = [c.name for c in recheck(m, plan.split, links=[np.arange(20) // 3]) if not c.ok]
    assert any(name.startswith("one part for each cluster") for name in failed)


def test_too_few_videos_fall_back_to_touches_and_say_so():
    m = manifest_of([(v, 20 * k + j, f"m{v}") for v in "abc" for k in range(4) for j in range(5)])
    group, reason = choose_group(m)
    assert group == "contact"
    assert "0 of 3 materials" in reason
    plan = leak_free_split(m, train=0.7)
    assert audit_split(m, plan.split, group="contact").groups_shared == 0
    assert audit_split(m, plan.split, group="video").leaked_fraction == 1.0
    one = Manifest.from_rows(
        [{"id": f"v/{f}", "video": "v", "frame": f, "contact": f"v#{f // 10}"} for f in range(40)],
        ".",
    )
    plan = leak_free_split(one)
    assert plan.group == "contact"
    assert "fewer than 2 videos" in plan.reason
    assert any("No sample has a material" in note for note in plan.notes)


def test_the_data_sets_own_group_is_taken():
    rows = [
        {"id": f"{v}/{f}", "video": f"{v}", "object": f"o{v // 2}", "frame": f, "material": "Wood"}
        for v in range(12)
        for f in range(3)
    ]
    assert choose_group(Manifest.from_rows(rows, ".", {"group": "object"}))[0] == "object"
    assert leak_free_split(Manifest.from_rows(rows, ".", {"group": "object"})).group == "object"
    assert choose_group(Manifest.from_rows(rows, "."))[0] == "video"


def test_what_cannot_be_split_says_why():
    m = manifest_of([("a", 1, "Wood"), ("a", 2, "Wood")])
    for options, word in (
        ({"group": "video"}, "at least as many groups"),
        ({"train": 0.9, "val": 0.2}, "leave room for test"),
        ({"group": "object"}, "2 of 2 samples without"),
        ({"by": ["color"]}, "must be among"),
        ({"tolerance": -1.0}, "tolerance must lie"),
    ):
        with pytest.raises(PalpateError, match=word):
            leak_free_split(m, **options)
    big = filled({"huge": {"Wood": 990}, "b": {"Wood": 5}, "c": {"Wood": 5}})
    with pytest.raises(
        PalpateError, match=r"cannot be split.*'huge' with 99\.0% of all samples.*1\.00% at best"
    ):
        leak_free_split(big, by=["video"])
    leak_free_split(big, by=["video"], train=0.97)
    with pytest.raises(PalpateError, match="needs samples"):
        leak_free_split(Manifest.from_rows([], "."))


def test_a_class_in_one_video_is_named_and_the_others_are_split():
    m = filled({f"v{k}": {"Wood": 10, **({"Sand": 7} if k == 3 else {})} for k in range(10)})
    plan = leak_free_split(m)
    assert plan.rare == describe(plan)["materials_in_too_few_groups"] == ["Sand"]
    assert "Sand" in " ".join(plan.notes)
    wood = audit_split(m, plan.split).materials[1]
    assert (wood["train"], wood["test"]) == (80, 20)


def test_materials_that_cannot_all_be_everywhere_are_named():
    # Both materials live in the same two videos and one of them in a third part's only place: three parts, each needs a video.
    m = filled(
        {
            "a": {"Wood": 5, "Sand": 1},
            "b": {"Wood": 5},
            "c": {"Wood": 1, "Sand": 5},
            "d": {"Sand": 5, "Wood": 5},
        }
    )
    plan = leak_free_split(m, train=0.6, val=0.2, by=["video"])
    counts = np.array([[1, 5, 6], [0, 5, 5], [5, 1, 6], [5, 5, 10]])
    assert len(plan.missing) == brute(counts, (0.6, 0.2, 0.2))[0]
    clash = filled({"a": {"A": 1, "B": 1}, "b": {"A": 1, "C": 1}, "c": {"B": 1, "C": 1}})
    plan = leak_free_split(clash, train=0.5, by=["video"])
    assert len(plan.missing) == 1
    assert any("not together with the others" in note for note in plan.notes)


def test_seeds_differ_as_much_as_the_tolerance_allows():
    m = filled({f"v{k:02}": {"Wood": 10 + k % 3, "Brick": 5} for k in range(30)})
    plans = leak_free_splits(m, range(6))
    assert len({p.split.digest for p in plans}) == 6
    assert (
        max(p.deviation for p in plans) <= max(plans[0].bound, RESOLUTION) + 1e-6
        or plans[0].status == "proven optimal"
    )
    loose = leak_free_splits(m, range(3), tolerance=0.03)
    assert all(p.deviation <= p.bound + 0.03 + RESOLUTION + EXACT for p in loose)


def test_a_recheck_finds_what_was_tampered_with():
    m = filled({f"v{k}": {"Wood": 6, "Brick": 2} for k in range(10)})
    plan = leak_free_split(m, by=["video"])
    assert all(c.ok for c in recheck(m, plan.split))
    moved = {
        **plan.split.parts,
        m.ids[0]: "test" if plan.split.parts[m.ids[0]] == "train" else "train",
    }
    failed = {c.name for c in recheck(m, Split(moved, plan.split.rule, m.digest)) if not c.ok}
    assert failed == {"one part for each video", "the rule's largest deviation"}
    fewer = {i: p for i, p in plan.split.parts.items() if i != m.ids[-1]}
    assert "every sample is in a part" in {
        c.name for c in recheck(m, Split(fewer, plan.split.rule, m.digest)) if not c.ok
    }
    other = filled({f"v{k}": {"Wood": 6} for k in range(10)})
    names = {c.name for c in recheck(other, plan.split) if not c.ok}
    assert {"manifest", "ids of the split are samples"} <= names


def test_the_record_is_whole_small_and_leak_free(published):
    record = load_record("touch-and-go")
    assert (TOP / "src/palpate/leakage/splits/records/tag_noleak.json").stat().st_size < 100_000
    videos, classes = set(published.column("video")), set(published.column("material"))
    for ratio in RATIOS:
        for seed in range(5):
            chosen = entry(record, ratio, seed)
            assert set(chosen.parts) == videos
            split, absent = record_split(chosen, published)
            assert absent == []
            stated = record["splits"][ratio][str(seed)]
            assert split.counts() == stated["samples"]
            if seed == 0:
                assert all(
                    set(published.part(split, p).column("material")) == classes
                    for p in split.counts()
                )
                assert all(c.ok for c in recheck(published, split))
            assert stated["deviation"] - stated["bound"] <= 2e-6


def test_a_changed_record_and_unknown_videos_are_refused():
    record = load_record("touch-and-go")
    for change in ({"frames": 1}, {"sha256": "0" * 64}):
        with pytest.raises(PalpateError, match="match its checksum"):
            verify_record({**record, **change})
    chosen = entry(record, "80/20", 0)
    known = sorted(chosen.parts)[:3]
    some = manifest_of([(v, 1, "Wood") for v in known])
    split, absent = record_split(chosen, some)
    assert [split.parts[f"{v}/1"] for v in known] == [chosen.parts[v] for v in known]
    assert len(absent) == 123
    with pytest.raises(PalpateError, match="1 of 2 that are not: 'mine'"):
        record_split(chosen, manifest_of([(known[0], 1, "Wood"), ("mine", 1, "Wood")]))
    with pytest.raises(PalpateError, match="seeds are 0, 1"):
        entry(record, "80/20", 99)
    with pytest.raises(PalpateError, match="record for touch-and-go"):
        load_record("visgel")


@pytest.mark.slow
def test_the_recipe_writes_the_shipped_record_again(real_data):
    lists = real_data / "touch_and_go" / "lists"
    assert make_record([lists / "train.txt", lists / "test.txt"]) == load_record("touch-and-go")
    done = subprocess.run(
        [
            sys.executable,
            TOP / "recipes" / "tag_noleak.py",
            lists / "train.txt",
            lists / "test.txt",
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, "is the same" in done.stdout) == (0, True), done.stderr


def test_hct_noleak_keeps_sittings_whole():
    rows = [
        {"id": f"{v}/{f}", "video": f"{v}", "session": f"s{v // 3}", "frame": f, "text": "soft"}
        for v in range(30)
        for f in range(2)
    ]
    m = Manifest.from_rows(rows, ".", {"format": "hct", "session_gap": "60 s"})
    plan = hct_noleak(m)[0]
    assert audit_split(m, plan.split, group="session").groups_shared == 0
    assert plan.split.counts() == {"train": 48, "test": 12}
    assert (plan.split.rule["name"], plan.split.rule["by"], plan.split.rule["session_gap"]) == (
        "HCT-NoLeak",
        ["video", "session"],
        "60 s",
    )
    with pytest.raises(PalpateError, match="joined within 5 s"):
        hct_noleak(Manifest(m.table, m.root, {"session_gap": "5 s"}))
    with pytest.raises(PalpateError, match="session of every sample"):
        hct_noleak(manifest_of([("a", 1, "Wood"), ("b", 1, "Wood")]))


def call(capsys, *args):
    status = main([str(a) for a in args])
    said = capsys.readouterr()
    return status, said.out, said.err


@pytest.fixture
def lists(tmp_path):
    """Two lists of eight videos that share some, one with Windows line ends and a byte-order mark; names with commas and spaces."""
    names = ["a, b", "Straße", "c", "d", "e", "f", "g", "h"]
    rows = [f"{v}/{f:010d}.jpg,{k % 2 + 3}" for k, v in enumerate(names) for f in range(10)]
    (tmp_path / "train.txt").write_bytes(b"\xef\xbb\xbf" + "\r\n".join(rows[::2]).encode())
    (tmp_path / "test.txt").write_text("\n".join(rows[1::2]))
    return tmp_path / "train.txt", tmp_path / "test.txt"


def test_lists_become_a_split_with_lists_of_their_own_and_are_verified(capsys, lists, tmp_path):
    out, own = tmp_path / "s.json", tmp_path / "own"
    status, said, _ = call(
        capsys, "split", *lists, "--train", "0.75", "-o", out, "--lists", own, "--json"
    )
    facts = json.loads(said)
    assert (status, facts["groups"], facts["status"], facts["counts"]) == (
        0,
        8,
        "proven optimal",
        {"train": 60, "test": 20},
    )
    assert (
        sorted(p.name for p in own.iterdir())
        == ["SHA256SUMS", "test.txt", "train.txt"]
        == sorted(facts["lists"])
    )
    assert dict(
        line.split("  ")[::-1] for line in (own / "SHA256SUMS").read_text().splitlines()
    ) == {name: digest_file(own / name) for name in ("test.txt", "train.txt")}
    again = read_lists([own / "train.txt", own / "test.txt"], root=own).manifest
    joined = read_lists(lists, root=tmp_path).manifest
    assert again.table.sort("id").equals(joined.table.sort("id"))
    assert call(capsys, "audit", own / "train.txt", own / "test.txt", "--fail-over", "0")[0] == 0
    assert call(capsys, "split", *lists, "--verify", out)[0] == 0
    status, said, _ = call(
        capsys, "split", *lists, "--verify", out, "--by", "video", "contact", "--json"
    )
    assert (status, json.loads(said)["failed"]) == (0, [])
    leaking = Split(
        {i: "train" if k % 3 else "test" for k, i in enumerate(joined.ids)},
        {"name": "Orig"},
        joined.digest,
    )
    leaking.save(tmp_path / "orig.json")
    status, said, _ = call(capsys, "split", *lists, "--verify", tmp_path / "orig.json", "--json")
    assert (status, json.loads(said)["failed"]) == (
        1,
        ["one part for each video", "no signal of the audit flags a test sample"],
    )
    assert call(capsys, "split", lists[0], "--verify", out)[0] == 1


def test_seeds_and_folds_make_folders(capsys, lists, tmp_path):
    status, said, _ = call(
        capsys, "split", *lists, "--seeds", "3", "-o", tmp_path / "many", "--json"
    )
    assert status == 0
    assert (
        json.loads(said)["splits"][2]["digest"]
        == Split.load(tmp_path / "many" / "seed-2.json").digest
    )
    assert (
        call(capsys, "split", *lists, "--folds", "4", "--val", "0.25", "-o", tmp_path / "folds")[0]
        == 0
    )
    folds = [Split.load(tmp_path / "folds" / f"fold-{k}.json") for k in range(4)]
    assert [f.counts() for f in folds] == [{"train": 40, "val": 20, "test": 20}] * 4
    assert call(capsys, "split", *lists, "--verify", tmp_path / "folds" / "fold-1.json")[0] == 0
    status, _, err = call(capsys, "split", *lists, "--seeds", "2", "-o", tmp_path / "folds")
    assert (status, "something there" in err) == (2, True)


def test_the_published_split_by_command(capsys, tmp_path, real_data):
    place = real_data / "touch_and_go" / "lists"
    status, said, _ = call(
        capsys, "split", "touch-and-go", "--noleak", "-o", tmp_path / "videos.json", "--json"
    )
    videos = json.loads((tmp_path / "videos.json").read_text())["videos"]
    assert (status, len(videos), json.loads(said)["rule"]["name"]) == (0, 126, "TaG-NoLeak")
    status, said, _ = call(
        capsys,
        "split",
        "touch-and-go",
        "--noleak",
        place / "test.txt",
        "-o",
        tmp_path / "s.json",
        "--json",
    )
    split = Split.load(tmp_path / "s.json")
    assert all(videos[i.split("/")[0]] == part for i, part in split.parts.items())
    assert len(json.loads(said)["videos_without_samples"]) == 20
    assert call(capsys, "split", place / "test.txt", "--verify", tmp_path / "s.json")[0] == 0
    edited = Split(
        {i: "train" if p == "test" else "test" for i, p in split.parts.items()},
        split.rule,
        split.manifest,
    )
    edited.save(tmp_path / "edited.json")
    status, said, _ = call(
        capsys, "split", place / "test.txt", "--verify", tmp_path / "edited.json", "--json"
    )
    assert (status, json.loads(said)["failed"]) == (1, ["the published record"])


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (["LISTS"], "no -o"),
        (["LISTS", "-o", "x", "--seeds", "2", "--folds", "3"], "exclude each other"),
        (["LISTS", "-o", "x", "--seeds", "0"], "at least 1"),
        (["LISTS", "-o", "x", "--folds", "1"], "at least 2 folds"),
        (["LISTS", "-o", "x", "--by", "object"], "80 of 80 samples without"),
        (["LISTS", "-o", "x", "--near", "tactile"], "needs tactile pictures"),
        (["LISTS", "nowhere", "-o", "x"], "no file nowhere"),
        (["touch-and-go", "--noleak", "-o", "x", "--train", "0.9"], "80/20"),
        (["visgel", "--noleak", "-o", "x"], "record for touch-and-go"),
        (["touch-and-go", "--noleak", "LISTS", "-o", "x"], "8 of 8 that are not"),
        (["hct", "--noleak", "-o", "x"], "rule for your own tree"),
        (["touch-and-go", "--noleak", "-o", "x", "--by", "video"], "its own rule"),
        (["LISTS", "-o", "x", "--by", "video", "--group", "contact"], "Leave out --group"),
        (["touch-and-go", "--noleak", "-o", "x", "--lists", "l"], "needs samples"),
        (["-o", "x"], "no path"),
        (["LISTS", "-o", "TRAIN"], "must not replace"),
    ],
)
def test_a_users_mistake_is_one_line(capsys, lists, tmp_path, monkeypatch, args, word):
    monkeypatch.chdir(tmp_path)
    full = [
        b
        for a in args
        for b in (map(str, lists) if a == "LISTS" else [str(lists[0]) if a == "TRAIN" else a])
    ]
    status, out, err = call(capsys, "split", *full)
    assert (status, out) == (2, ""), err
    assert word in err
    assert "Traceback" not in err
    assert not (tmp_path / "x").exists()


def test_a_bound_above_what_was_reached_is_never_called_a_proof(monkeypatch):
    from palpate.leakage import splits

    m = Manifest.from_rows(
        [{"id": str(k), "video": f"v{k}", "material": "ab"[k % 2]} for k in range(40)], "."
    )
    real = splits.optimize
    monkeypatch.setattr(
        splits, "optimize", lambda *a, **k: dataclasses.replace(real(*a, **k), bound=0.3)
    )
    with pytest.raises(RuntimeError, match="lower bound"):
        leak_free_split(m)


def test_verify_fails_where_a_signal_flags_a_test_sample(tmp_path, capsys):
    (tmp_path / "l.txt").write_text("".join(f"v/{k}.jpg,0\n" for k in (1, 2, 9, 10)))
    assert (
        main(
            [
                "split",
                str(tmp_path / "l.txt"),
                "--by",
                "contact",
                "--train",
                "0.5",
                "-o",
                str(tmp_path / "s.json"),
                "-q",
            ]
        )
        == 0
    )
    assert (
        main(["split", str(tmp_path / "l.txt"), "--verify", str(tmp_path / "s.json"), "--json"])
        == 1
    )
    assert "no signal of the audit flags a test sample" in capsys.readouterr().out

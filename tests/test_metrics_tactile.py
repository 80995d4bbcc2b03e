"""TMMD, I-, CI-, D-TMMD against loops over pairs, their jackknife, and every undefined case."""

import itertools
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forge.scores import jackknife, without_each
from palpate.core import FeatureSet, PalpateError, Score, require_comparable
from palpate.metrics import PRESETS, ci_tmmd, d_tmmd, four_scores, i_tmmd, tmmd
from palpate.metrics.mmd import build_table, half_of, sample_units
from palpate.metrics.tactile import i_tmmd_of
from palpate.report.notes import sentence
from test_metrics_mmd import loop_mmd, mmd2, unit_rows

#: Sets without pairs to average over are not divided by 0.
pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def world(seed, classes=3, videos=4, frames=3, d=6, draw=None, prefix="", encoder="e" * 64):
    """Features with class, video and frame effects; tuples of sizes are cycled over classes."""
    fixed = np.random.default_rng(seed)
    rng = np.random.default_rng([seed, 7 if draw is None else draw])
    cycle = lambda v, k: v[k % len(v)] if isinstance(v, tuple) else v
    rows, ids, labels, groups = [], [], [], []
    for c in range(classes):
        of_class = fixed.normal(size=d)
        for v in range(cycle(videos, c)):
            of_video = 0.5 * fixed.normal(size=d)
            for f in range(cycle(frames, v)):
                rows.append(2 + of_class + of_video + 0.3 * rng.normal(size=d))
                ids.append(f"{prefix}c{c}v{v}/{f:03d}")
                labels.append(f"m{c}")
                groups.append(f"c{c}v{v}")
    x = np.array(rows)
    return FeatureSet(ids, x / np.linalg.norm(x, axis=1, keepdims=True), labels, groups, encoder)


def codes(score):
    """The notes: code, and reason where there is one."""
    return [":".join(filter(None, [n.code, n.params.get("reason")])) for n in score.notes]


def change(s, **fields):
    return replace(s, **fields)


def close(value):
    """Equal within 1e-9; None is None."""
    return value if value is None else pytest.approx(value, abs=1e-9)


def keep(s, mask):
    return s.take([i for i, k in zip(s.ids, mask, strict=True) if k])


def without_groups(s):
    return change(s, groups=None)


def average_over_group_halvings(s, estimator):
    """Eq. 3 by drawing every halving of the groups into equally many, with the double loop."""
    names, groups = sorted(set(s.groups)), np.array(s.groups)
    values = []
    for half in itertools.combinations(names, len(names) // 2):
        a = np.isin(groups, half)
        values.append(loop_mmd(s.features[a], s.features[~a], estimator))
    return np.mean(values)


@given(
    seed=st.integers(0, 10**5),
    m=st.integers(2, 5),
    n=st.integers(2, 5),
    frames=st.sampled_from([1, 3, (1, 2, 4)]),
)
@settings(max_examples=30)
def test_tmmd_equals_the_double_loop(seed, m, n, frames):
    g = world(seed, classes=1, videos=m, frames=frames)
    r = world(seed, classes=1, videos=n, frames=frames, draw=1)
    if m + n > 4:  # two videos in both sets, all shared, is a case of its own
        grouped, want = tmmd(g, r), loop_mmd(g.features, r.features, "grouped", g.groups, r.groups)
        assert (grouped.estimator, grouped.value) == ("grouped", close(want))
    paper = tmmd(without_groups(g), without_groups(change(r, ids=[f"r {i}" for i in r.ids])))
    assert (paper.estimator, paper.settings["preset"]) == ("unbiased", "paper")
    assert paper.value == close(loop_mmd(g.features, r.features, "unbiased"))
    assert tmmd(g, r, preset="cmmd").value == close(loop_mmd(g.features, r.features, "biased"))


def test_pairs_of_one_scene_are_excluded_where_ids_are_shared(monkeypatch):
    g, r = (without_groups(world(3, videos=6, frames=1, draw=k)) for k in (None, 1))
    score = tmmd(g, r)
    assert (score.settings["preset"], score.details["unit"]) == ("grouped", "sample")
    want = loop_mmd(g.features, r.features, "grouped", g.ids, r.ids)
    assert score.value == close(want)
    assert "dependent-pairs" not in codes(score)
    paper = tmmd(g, r, preset="paper")
    assert paper.value == close(loop_mmd(g.features, r.features, "unbiased"))
    [note] = [n for n in paper.notes if n.code == "dependent-pairs"]
    assert note.params == {"count": 18}
    first, *others = four_scores(g, r)  # no scene is twice in one set: the others are as they were
    assert first.value == score.value
    assert [s.settings["preset"] for s in others] == ["paper"] * 3
    monkeypatch.setattr("palpate.metrics.mmd.BLOCKS", 6)  # many ids: blocks of them
    assert tmmd(g, r).details["unit"] == "random-block"
    units = dict(zip(g.ids, sample_units(g.ids, 0)[0], strict=True))
    blocks = [[units[i] for i in s.ids] for s in (g, r)]
    want = loop_mmd(g.features, r.features, "grouped", *blocks)
    assert tmmd(g, r).value == close(want)


@pytest.mark.parametrize("estimator", ["unbiased", "biased"])
@pytest.mark.parametrize(("videos", "frames"), [(4, 3), (6, 2)])
def test_group_halves_are_the_average_over_all_halvings(estimator, videos, frames):
    s = world(1, classes=1, videos=videos, frames=frames)
    got = i_tmmd(s, estimator=estimator)
    assert got.value == close(average_over_group_halvings(s, estimator))
    assert got.seed is None


@pytest.mark.parametrize("backend", ["blocked", "moments", "rows"])
@given(seed=st.integers(0, 10**5), frames=st.sampled_from([(2, 3), (1, 4, 2), (5, 3, 1)]))
@settings(max_examples=10)
def test_the_excess_is_within_minus_between_where_videos_weigh_the_same(backend, seed, frames):
    with pytest.MonkeyPatch.context() as patch:
        if backend == "rows":  # more items than sums of items with items are kept for
            patch.setattr("palpate.metrics.kernels.MOST_ITEMS", 0)
        check_excess("blocked" if backend == "rows" else backend, seed, frames)


def check_excess(backend, seed, frames):
    s = world(seed, classes=1, videos=5, frames=frames)
    within, between, size = [], [], {g: s.groups.count(g) for g in s.groups}
    for i, j in itertools.permutations(range(len(s.ids)), 2):
        k = np.exp(-((s.features[i] - s.features[j]) ** 2).sum() / 200)
        weight = 1 / size[s.groups[i]] / size[s.groups[j]]
        (within if s.groups[i] == s.groups[j] else between).append((k, weight))
    score = i_tmmd(s, backend=backend)
    w, b = (np.prod(p, axis=1).sum() / np.sum(p, axis=0)[1] for p in (within, between))
    excess, bound = score.details["E"], 1e-3 if backend == "moments" else 0
    assert excess == pytest.approx(1000 * (w - b), abs=1e-9 + bound)
    half = len(s.ids) / 2
    assert score.value == pytest.approx(excess * len(within) / (half * (half - 1)), abs=1e-9)
    # Every leave-one-out value has the same weights.
    one = s.groups[0]
    rest = i_tmmd(s.take([i for i, g in zip(s.ids, s.groups, strict=True) if g != one]))
    first = i_tmmd_of(build_table(s, None, {"backend": backend})).excess[0]
    assert first == pytest.approx(rest.details["E"], abs=1e-9 + bound)


@pytest.mark.parametrize("halves", ["random", "ordered"])
@pytest.mark.parametrize("estimator", ["unbiased", "biased"])
def test_i_ci_d_equal_the_double_loop(halves, estimator):
    s = world(2, classes=3, videos=2, frames=(3, 4))
    options = {"preset": "paper", "halves": halves, "estimator": estimator, "seed": 5}
    plan = type("P", (), {"halves": halves, "seed": 5})
    number, x, cs = np.array([int(v[1:]) for v in s.labels]), s.features, range(3)
    half = half_of(s.ids, np.zeros_like(number), plan)
    assert i_tmmd(s, **options).value == close(loop_mmd(x[half == 0], x[half == 1], estimator))
    half = half_of(s.ids, number, plan)
    cells = [[(number == c) & (half == h) for h in (0, 1)] for c in cs]
    assert all(abs(first.sum() - second.sum()) <= 1 for first, second in cells)
    own = [loop_mmd(x[first], x[second], estimator) for first, second in cells]
    ci = ci_tmmd(s, **options)
    assert ci.value == close(np.mean(own))
    assert [v["value"] for v in ci.details["per_class"].values()] == close(own)
    between = lambda a, b: loop_mmd(x[number == a], x[number == b], estimator)
    matrix = [[own[a] if a == b else between(a, b) for b in cs] for a in cs]
    d = d_tmmd(s, **options)
    assert d.value == close(np.mean([own[c] / sum(matrix[c]) for c in cs]))  # Eq. 7
    np.testing.assert_allclose(d.details["matrix"], matrix, atol=1e-9)
    off = [(sum(matrix[c]) - own[c]) / 2 for c in cs]
    v = d.details["variants"]
    assert v["mean/mean_of_ratios"] == pytest.approx(3 * d.value)
    assert v["mean_off_diagonal/mean_of_ratios"] == pytest.approx(np.mean(np.divide(own, off)))
    assert v["mean_off_diagonal/ratio_of_means"] == pytest.approx(np.mean(own) / np.mean(off))
    options |= {"denominator": "mean_off_diagonal", "aggregate": "ratio_of_means"}
    assert d_tmmd(s, **options).value == v["mean_off_diagonal/ratio_of_means"]


def test_grouped_matrix_leaves_out_pairs_of_one_video():
    s = world(3, classes=3, videos=2, frames=3)
    shared = ["shared" if g in ("c0v0", "c1v0") else g for g in s.groups]  # shows two materials
    s, groups = change(s, groups=shared), np.array(shared)
    matrix = d_tmmd(s).details["matrix"]
    a, b = np.array(s.labels) == "m0", np.array(s.labels) == "m1"
    want = loop_mmd(s.features[a], s.features[b], "grouped", groups[a], groups[b])
    assert matrix[0][1] == close(want)
    assert matrix[0][0] == close(average_over_group_halvings(keep(s, a), "unbiased"))


@pytest.mark.parametrize("preset", ["grouped", "paper"])
@pytest.mark.parametrize("shared", [True, False])
def test_tmmd_jackknife_equals_leaving_each_group_out(preset, shared):
    g = world(4, classes=1, videos=5, frames=(2, 4, 3))
    r = world(4, classes=1, videos=4, frames=(3, 2), draw=1)
    if not shared:
        r = change(r, groups=[f"real-{v}" for v in r.groups])
    score = tmmd(g, r, preset=preset)
    names = sorted({*g.groups, *r.groups})
    out = [[keep(s, np.array(s.groups) != v) for s in (g, r)] for v in names]
    replicates = [tmmd(*sets, preset=preset).value for sets in out]
    assert score.interval == jackknife(score.value, replicates)[1]
    assert score.interval_method == f"leave-one-group-out jackknife, t, {len(names) - 1} df"


def share(of, name=None):
    """What E is multiplied by in halves of whole groups, from the sizes of the groups."""
    groups = [v for v, c in zip(of.groups, of.labels, strict=True) if name in (None, c)]
    sizes = np.unique(groups, return_counts=True)[1]
    m = sizes.sum() / 2
    return (sizes * (sizes - 1)).sum() / (m * (m - 1))


def test_free_jackknife_equals_leaving_each_group_out():
    """E without each group is computed anew; the group sizes stay those of the whole set."""
    s = world(5, classes=3, videos=(3, 4), frames=(2, 4, 3))
    out = [keep(s, np.array(s.groups) != v) for v in sorted(set(s.groups))]
    names = ["m0", "m1", "m2"]

    def ci(of):
        return np.mean([share(s, c) * e["E"] for c, e in ci_tmmd(of).details["per_class"].items()])

    def d(of):
        matrix, each = np.array(d_tmmd(of).details["matrix"]), ci_tmmd(of).details["per_class"]
        np.fill_diagonal(matrix, [share(s, c) * each[c]["E"] for c in names])
        return np.diagonal(matrix).mean() / matrix.sum(axis=1).mean()

    for metric, value in (
        (i_tmmd, lambda of: share(s) * i_tmmd(of).details["E"]),
        (ci_tmmd, ci),
        (d_tmmd, d),
    ):
        score = metric(s)
        assert value(s) == close(score.value)
        assert score.interval == jackknife(score.value, [value(of) for of in out])[1]
        assert "leave-one-group-out" in score.interval_method


@pytest.mark.parametrize("metric", [i_tmmd, ci_tmmd])
def test_intervals_of_halves_and_of_their_excess_are_one(metric):
    score = metric(world(5, classes=3, videos=4, frames=3))
    factor = score.value / score.details["E"]  # groups of one size: the same in all classes
    assert score.interval == close([factor * v for v in score.details["E_interval"]])


def test_jackknife_of_random_halves_keeps_the_halves():
    s = world(6, classes=1, videos=6, frames=3)
    score = i_tmmd(s, preset="paper", seed=3)
    plan, groups = type("P", (), {"halves": "random", "seed": 3}), np.array(s.groups)
    half = half_of(s.ids, np.zeros(18, dtype=int), plan)
    out = [[(half == h) & (groups != v) for h in (0, 1)] for v in sorted(set(groups))]
    replicates = [mmd2(s.features[first], s.features[second]) for first, second in out]
    assert score.interval == jackknife(score.value, replicates)[1]
    assert "random-halves" in codes(score)
    assert score.seed == 3


def test_without_groups_the_interval_leaves_out_samples_and_says_so():
    g = without_groups(world(7, classes=1, videos=3))
    r = without_groups(world(7, classes=1, videos=3, draw=1, prefix="r"))
    score = tmmd(g, r)
    everyone = [(s, i) for s in (g, r) for i in s.ids]
    out = [
        tmmd(*(s.take([j for j in s.ids if not (t is s and j == i)]) for s in (g, r))).value
        for t, i in everyone
    ]
    assert score.interval == jackknife(score.value, out)[1]
    assert "samples taken as independent" in score.interval_method
    same_ids = tmmd(g, change(r, ids=g.ids))  # a generated touch and its reference are one unit
    assert same_ids.details["units"] == 9


def test_many_samples_are_left_out_in_blocks(monkeypatch):
    g = without_groups(world(8, classes=1, videos=8, frames=10))
    r = without_groups(world(8, classes=1, videos=8, frames=10, prefix="r"))
    exact = tmmd(g, r)
    monkeypatch.setattr("palpate.metrics.mmd.BLOCKS", 40)
    blocks = tmmd(g, r)
    assert blocks.value == pytest.approx(exact.value, rel=1e-12)
    assert "leave-one-random-block-out" in blocks.interval_method
    width = lambda s: s.interval[1] - s.interval[0]
    assert width(blocks) == pytest.approx(width(exact), rel=0.35)


def test_two_groups_a_class_give_an_interval_over_classes():
    s = world(9, classes=5, videos=2, frames=3)
    score = ci_tmmd(s)
    each = np.array([v["value"] for v in score.details["per_class"].values()])
    assert "leave-one-class-out" in score.interval_method
    assert score.interval == jackknife(each.mean(), without_each(each))[1]
    assert d_tmmd(s).interval is not None


@pytest.mark.parametrize("seed", range(4))
def test_literal_ratio_with_the_biased_form_is_at_most_one(seed):
    score = d_tmmd(world(seed, classes=4), preset="cmmd")
    assert 0 <= score.value <= 1


def test_group_halves_see_what_random_halves_cannot():
    s = world(10, classes=1, videos=12, frames=8)
    by_video, random = i_tmmd(s), i_tmmd(s, preset="paper")
    assert by_video.value > by_video.null[1]
    assert by_video.details["z"] > 5
    assert abs(random.details["z"]) < 4
    assert random.details["E"] == pytest.approx(by_video.details["E"])


def test_the_biased_null_is_centered_on_the_dispersion():
    s = world(11, classes=2, videos=4, frames=6)
    values = [ci_tmmd(s, preset="cmmd", seed=k).value for k in range(60)]
    score = ci_tmmd(s, preset="cmmd")
    near = pytest.approx(score.details["dispersion"], abs=3 * np.std(values) / np.sqrt(60))
    assert np.mean(values) == near
    assert np.mean([score.null[0] < v < score.null[1] for v in values]) > 0.85


def test_scores_do_not_depend_on_row_order_or_block_size():
    g, r = world(12), world(12, draw=1)
    p = np.random.default_rng(0).permutation(len(g.ids))
    shuffled = g.take([g.ids[i] for i in p])
    for preset in PRESETS:
        one, two = (four_scores(s, r, preset=preset, floor=r) for s in (g, shuffled))
        for a, b in zip(one, two, strict=True):
            assert a.value == close(b.value)
            assert a.interval == pytest.approx(b.interval, abs=1e-8)
            assert a.null == (b.null and pytest.approx(b.null, abs=1e-8))


@pytest.mark.parametrize("preset", [None, *PRESETS])
def test_four_scores_equal_the_single_metrics_and_carry_their_settings(preset):
    g, r = world(13, videos=(3, 4)), world(13, videos=(3, 4), draw=1)
    scores = four_scores(g, r, preset=preset, split="s" * 64, floor=r, subject="mini")
    assert [s.metric for s in scores] == ["TMMD", "I-TMMD", "CI-TMMD", "D-TMMD"]
    singles = [tmmd(g, r, preset=preset), *(f(g, preset=preset) for f in (i_tmmd, ci_tmmd, d_tmmd))]
    for score, single in zip(scores, singles, strict=True):
        assert (score.value, score.interval) == (close(single.value), close(single.interval))
        assert (score.encoder, score.split) == ("e" * 64, "s" * 64)
        assert (score.a, score.n, score.bandwidth, score.scale) == ("mini", len(g.ids), 10, 1000)
        assert score.higher_is_better == {"TMMD": False}.get(score.metric)
        assert score.settings["preset"] == (preset or "grouped")
        text = json.dumps(score.to_json(), allow_nan=False)
        assert Score.from_json(json.loads(text)).value == score.value
    assert scores[0].m == len(r.ids)
    assert scores[0].floor is None
    assert scores[1].floor == close(i_tmmd(r, preset=preset).value)
    require_comparable([singles[1], i_tmmd(r, preset=preset)])
    with pytest.raises(PalpateError, match="settings"):
        require_comparable([i_tmmd(g, preset="paper"), i_tmmd(g, preset="paper", halves="ordered")])


@pytest.mark.parametrize(
    ("classes", "videos", "frames"),
    [(5, (2, 3), 6), (20, (1, 2), 8), (3, 1, 5), (1, 1, 6), (4, 3, 1), (1, 2, 2)],
)
@pytest.mark.parametrize("preset", [None, "paper", "paper-tables"])
def test_small_sets_give_a_score_or_a_note(classes, videos, frames, preset, recwarn):
    g, r = world(14, classes, videos, frames), world(14, classes, videos, frames, draw=1)
    for s in four_scores(g, r, preset=preset, floor=r):
        text = json.dumps(s.to_json(), allow_nan=False)
        assert "NaN" not in text
        if s.value is None:
            assert codes(s)[0].startswith("undefined:")
            assert s.interval is None
        elif s.interval is None:
            assert "no-interval:too-few" in codes(s)
        else:
            assert s.interval[0] <= s.value <= s.interval[1]
            assert s.interval_method
    assert not recwarn.list


def test_classes_left_out_are_listed_with_reasons():
    s = world(15, classes=6, videos=4, frames=3)
    label, group = np.array(s.labels, dtype=object), np.array(s.groups, dtype=object)
    label[label == "m0"] = None
    few = [i for i, v in zip(s.ids, label, strict=True) if v == "m1"][:3]
    group[label == "m2"] = "one"
    single = label == "m3"
    group[single] = [f"g{k}" for k in range(single.sum())]
    s = FeatureSet(s.ids, s.features, list(label), list(group), s.encoder)
    s = s.take([i for i, v in zip(s.ids, label, strict=True) if v != "m1" or i in few])
    excluded = {"(no label)": "no-label", "m1": "few-samples"}
    excluded |= {"m2": "one-group", "m3": "single-samples"}
    for score in (ci_tmmd(s), d_tmmd(s)):
        assert score.details["classes"] == ["m4", "m5"]
        assert score.details["excluded"] == excluded
    kept = keep(s, np.isin(np.array(s.labels, dtype=str), ["m4", "m5"]))
    assert ci_tmmd(s).value == close(ci_tmmd(kept).value)
    assert list(ci_tmmd(s, preset="paper").details["excluded"]) == ["(no label)", "m1"]


def test_undefined_scores_have_a_reason():
    s = world(16, classes=2, videos=2, frames=3)
    one = change(s, groups=["v"] * 12)
    for score, reason, text in (
        (ci_tmmd(change(s, labels=None)), "no-class", "no labels"),
        (d_tmmd(change(s, labels=None)), "one-class", "no labels"),
        (d_tmmd(change(s, labels=["a"] * 12)), "one-class", "needs two classes.*has 1"),
        (i_tmmd(one), "one-group", "all samples are of one group"),
        (i_tmmd(change(s, groups=s.ids)), "single-samples", "no group has two samples"),
        (i_tmmd(s.take(s.ids[:3])), "few-samples", "fewer than 4 samples .n = 3"),
        (tmmd(one, one), "few-groups", "two groups"),
        (tmmd(s.features[:1], s.features), "one-sample", "two samples"),
    ):
        assert (score.value, codes(score)[0]) == (None, f"undefined:{reason}")
        assert (score.interval, score.null) == (None, None)
        assert {score.details.get(name) for name in ("p_value", "z")} == {None}
        assert re.match(f"Undefined: .*{text}", sentence(score.notes[0]))


def test_names_with_stops_and_commas_are_names():
    """A material called "Sandpaper No. 5" in every place that names a class or a group."""
    names = {"m0": "Sandpaper No. 5", "m1": "Undefined: wool. 50 %", "m2": "a, b: {c}"}
    s = world(15, classes=3, videos=4, frames=3)
    labels = [names[v] for v in s.labels]
    renamed = change(s, labels=labels, groups=[f"No. {g}. x" for g in s.groups])
    for function in (i_tmmd, ci_tmmd, d_tmmd):
        assert function(renamed).value == pytest.approx(function(s).value, abs=1e-12)
    assert set(ci_tmmd(renamed).details["per_class"]) == set(names.values())
    bare = without_groups(world(18, classes=1, videos=40, frames=1))
    few = [list(names.values())[k % 3] for k in range(37)] + ["Rare No. 1"] * 3
    score = d_tmmd(change(bare, labels=few))
    assert score.details["excluded"] == {"Rare No. 1": "few-samples"}
    note = next(n for n in score.notes if n.code == "unstable-denominators")
    assert all(name in sentence(note) for name in score.details["unstable"])
    assert Score.from_json(json.loads(json.dumps(score.to_json()))).notes == score.notes


def test_collapse_is_named():
    s = world(17)
    s = change(s, features=np.tile(unit_rows(0, 1, 6), (len(s.ids), 1)))
    for score in (i_tmmd(s), ci_tmmd(s)):
        assert score.value == 0
        assert codes(score)[0] == "collapse"
    assert d_tmmd(s).value is None
    assert codes(d_tmmd(s)) == ["undefined:not-separate"]


def test_unstable_classes_are_flagged():
    s = without_groups(world(18, classes=1, videos=40, frames=1))
    # labels without meaning: no class differs from another
    score = d_tmmd(change(s, labels=[f"m{k % 4}" for k in range(40)]))
    assert score.details["unstable"]
    assert codes(score)[0] == "unstable-denominators"
    assert "unreliable: m" in sentence(score.notes[0])

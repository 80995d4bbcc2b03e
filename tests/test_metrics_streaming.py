"""Streaming classes against the functions and against loops over pairs; merged, pickled, from two processes, and everything they refuse."""

import multiprocessing
import pickle
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.core import PalpateError, require_comparable, seed_for
from palpate.metrics import Gaussian, Linear, Polynomial, ci_tmmd, d_tmmd, four_scores, i_tmmd, tmmd
from palpate.metrics.streaming import CITMMD, DTMMD, ITMMD, TMMD
from palpate.metrics.streaming_states import Batch
from test_metrics_mmd import loop_mmd
from test_metrics_tactile import change, world

ALL = (TMMD, ITMMD, CITMMD, DTMMD)
FUNCTIONS = {ITMMD: i_tmmd, CITMMD: ci_tmmd, DTMMD: d_tmmd}
CLASSES = ["m0", "m1", "m2"]
#: Settings of the two modes, for features of six numbers.
MODES = {
    "features": {},
    "sums": {"keep": "sums", "classes": CLASSES, "center": np.full(6, 0.4), "floor": True},
}


def sets(seed=0, **shape):
    shape = {"classes": 3, "videos": 6, "frames": (4, 7, 5)} | shape
    return world(seed, **shape), world(seed, draw=1, **shape)


def feed(metric, s, real=False, step=7, order=None, **drop):
    order = np.arange(len(s.ids)) if order is None else order
    pick = lambda column, at: None if column is None else [column[k] for k in at]  # noqa: E731
    for k in range(0, len(order), step):
        at = order[k : k + step]
        columns = {
            "ids": pick(s.ids, at),
            "labels": pick(s.labels, at),
            "groups": pick(s.groups, at),
        } | drop
        metric.update(s.features[at], real=real, **columns)
    return metric


def both(metric, g, r, **options):
    return feed(feed(metric, g, **options), r, real=True, **options)


def close(a, b, tolerance=1e-9):
    """Equal scores, floats within a tolerance."""
    if isinstance(a, dict):
        return set(a) == set(b) and all(close(a[k], b[k], tolerance) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(close, a, b, [tolerance] * len(a)))
    return a == pytest.approx(b, abs=tolerance) if isinstance(a, float) else a == b


@pytest.mark.parametrize("groups", [True, False])
@pytest.mark.parametrize("step", [1, 7, 1000])
def test_features_give_exactly_what_the_functions_give(groups, step):
    g, r = sets()
    g, r = (g, r) if groups else (change(g, groups=None), change(r, groups=None))
    assert both(TMMD(encoder=g.encoder), g, r, step=step).compute() == tmmd(g, r)
    for cls, function in FUNCTIONS.items():
        alone = function(g)
        assert feed(cls(encoder=g.encoder), g, step=step).compute() == alone
        with_floor = both(cls(encoder=g.encoder), g, r, step=step).compute()
        assert with_floor.floor == function(r).value
        assert with_floor.value == alone.value
        assert with_floor.interval == alone.interval


@pytest.mark.parametrize("sigma", ["median", "multi", (1.0, 10.0)])
def test_bandwidths_of_the_reference_and_the_floor_are_those_of_four_scores(sigma):
    g, r = sets()
    want = four_scores(g, r, floor=r, sigma=sigma)
    for cls, score in zip(ALL, want, strict=True):
        got = both(cls(encoder=g.encoder, sigma=sigma), g, r).compute()
        assert close(got.to_json(), score.to_json())


@given(
    seed=st.integers(0, 10**5),
    step=st.integers(1, 40),
    preset=st.sampled_from(["grouped", "paper", "paper-tables", "cmmd"]),
)
@settings(max_examples=15, deadline=None)
def test_neither_order_nor_batches_matter(seed, step, preset):
    g, r = sets(seed % 5)
    order = np.random.default_rng(seed).permutation(len(g.ids))
    for cls in ALL:
        straight, mixed = (
            both(cls(preset=preset), g, r),
            both(cls(preset=preset), g, r, step=step, order=order),
        )
        assert close(straight.compute().to_json(), mixed.compute().to_json())


def test_ids_that_nobody_gave_depend_on_the_rows_alone():
    g, _ = sets()
    g = change(g, features=np.concatenate([g.features[:-2], g.features[:2]]))  # with repeated rows
    order = np.random.default_rng(0).permutation(len(g.ids))
    bare = {"ids": None, "groups": None}
    a, b = (
        feed(ITMMD(), g, **bare).compute(),
        feed(ITMMD(), g, order=order, step=3, **bare).compute(),
    )
    assert close(a.to_json(), b.to_json())
    assert a.details["units"] == len(g.ids)


def half_by_hash(names, seed=0):
    return np.array([seed_for(seed, "half", n) & 1 for n in names], dtype=bool)


@pytest.mark.parametrize("by", ["group", "sample"])
@pytest.mark.parametrize("preset", ["paper", "cmmd"])
def test_sums_are_within_their_bound_of_loops_over_pairs(by, preset):
    g, r = sets(videos=8)
    kind = {"paper": "unbiased", "cmmd": "biased"}[preset]
    drop = {} if by == "group" else {"groups": None}
    half, label = half_by_hash(g.groups if by == "group" else g.ids), np.array(g.labels)
    x = [g.features[label == c] for c in CLASSES]
    h = [half[label == c] for c in CLASSES]
    own = np.array([loop_mmd(a[~b], a[b], kind) for a, b in zip(x, h, strict=True)])
    matrix = np.array(
        [[own[a] if a == b else loop_mmd(x[a], x[b], kind) for b in range(3)] for a in range(3)]
    )
    want = {
        TMMD: loop_mmd(g.features, r.features, kind),
        ITMMD: loop_mmd(g.features[~half], g.features[half], kind),
        CITMMD: own.mean(),
        DTMMD: (own / matrix.sum(axis=1)).mean(),
    }
    for cls in ALL:
        got = both(
            cls(keep="sums", classes=CLASSES, floor=cls is not TMMD, preset=preset), g, r, **drop
        ).compute()
        assert got.details["backend"] == "moments"
        assert 0 < got.details["bound"] < 1e-4
        assert abs(got.value - want[cls]) <= got.details["bound"] + 1e-12
        assert (got.interval, got.n) == (None, len(g.ids))
        assert "no interval" in got.note
        if cls is not TMMD:
            assert got.settings["halves"] == f"hashed by {by}"
            assert got.floor is not None
            alone = feed(
                cls(keep="sums", classes=CLASSES, preset=preset, center=np.zeros(6)), r, **drop
            ).compute()
            assert got.floor == pytest.approx(alone.value, abs=1e-4)
    assert np.allclose(got.details["matrix"], matrix, atol=1e-5)


def test_sums_may_stand_beside_the_function_only_where_they_are_the_same():
    g, r = sets()
    require_comparable(
        [both(TMMD(keep="sums", encoder=g.encoder), g, r).compute(), tmmd(g, r, preset="paper")]
    )
    with pytest.raises(PalpateError, match="settings"):
        require_comparable(
            [
                feed(ITMMD(keep="sums", encoder=g.encoder), g, groups=None).compute(),
                i_tmmd(g, preset="paper"),
            ]
        )


def test_the_null_of_sums_is_the_spread_over_random_halves():
    s = world(0, classes=1, videos=10, frames=6)
    found = [
        feed(ITMMD(keep="sums", seed=k), s, groups=None, step=60).compute() for k in range(300)
    ]
    spread = np.std([f.value for f in found])
    claimed = np.mean([f.null[1] for f in found]) / 1.96
    assert claimed == pytest.approx(spread, rel=0.2)


def test_sums_never_grow_and_keep_nothing():
    g, _ = sets()
    metric = CITMMD(keep="sums", classes=CLASSES)
    feed(metric, g)
    once = len(pickle.dumps(metric))
    for _ in range(5):
        feed(metric, g)
    assert len(pickle.dumps(metric)) == once
    assert metric.compute().n == 6 * len(g.ids)


def test_a_class_without_two_samples_in_a_half_is_excluded_and_named():
    g, _ = sets()
    half, label, group = half_by_hash(g.groups), np.array(g.labels), np.array(g.groups)
    last = np.flatnonzero((label == "m2") & half)[1:]
    s = change(
        g,
        features=np.delete(g.features, last, 0),
        **{c: list(np.delete(getattr(g, c), last)) for c in ("ids", "labels", "groups")},
    )
    got = feed(CITMMD(keep="sums", classes=CLASSES), s).compute()
    assert got.details["excluded"] == {"m2": "fewer than two samples in a half"}
    assert got.details["classes"] == ["m0", "m1"]
    assert len(set(group[label == "m2"])) > 1
    rest = feed(
        CITMMD(keep="sums", classes=CLASSES[:2], center=np.zeros(6)), keep_classes(s, CLASSES[:2])
    ).compute()
    assert got.value == pytest.approx(rest.value, abs=1e-4)


def keep_classes(s, classes):
    return s.take([i for i, c in zip(s.ids, s.labels, strict=True) if c in classes])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("cls", ALL)
def test_merged_and_pickled_in_the_middle(cls, mode):
    g, r = sets()
    make = lambda: cls(encoder=g.encoder, **MODES[mode])  # noqa: E731
    whole = both(make(), g, r).compute()
    first, second = np.arange(0, 41), np.arange(41, len(g.ids))
    a = pickle.loads(pickle.dumps(both(make(), g, r, order=first)))
    b = pickle.loads(pickle.dumps(both(make(), g, r, order=second)))
    merged = a.merge(b)
    assert close(merged.compute().to_json(), whole.to_json())
    a.merge_state(b)
    assert close(a.compute().to_json(), whole.to_json())
    assert close(
        make().merge(b, both(make(), g, r, order=first)).compute().to_json(), whole.to_json()
    )
    continued = pickle.loads(pickle.dumps(both(make(), g, r, order=first)))
    assert close(both(continued, g, r, order=second).compute().to_json(), whole.to_json())


def work(job):
    """One process: its share of the rows, back as a pickle."""
    cls, mode, share, of = job
    g, r = sets()
    return pickle.dumps(
        both(
            cls(encoder=g.encoder, **MODES[mode]),
            g,
            r,
            order=np.arange(share, len(g.ids), of),
            step=5,
        )
    )


def test_two_processes_give_what_one_gives():
    g, r = sets()
    jobs = [(cls, mode, share, 2) for cls in ALL for mode in MODES for share in range(2)]
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        found = [pickle.loads(p) for p in pool.map(work, jobs)]
    for k in range(0, len(found), 2):
        cls, mode, _, _ = jobs[k]
        one = both(cls(encoder=g.encoder, **MODES[mode]), g, r).compute()
        assert close(found[k].merge(found[k + 1]).compute().to_json(), one.to_json())


def test_merging_refuses_other_settings():
    g, r = sets()
    for other in (ITMMD(), TMMD(keep="sums"), TMMD(encoder="f" * 64)):
        with pytest.raises(PalpateError, match="same settings"):
            TMMD().merge_state(other)
    a, b = both(TMMD(keep="sums"), g, r), both(TMMD(keep="sums"), r, g)
    with pytest.raises(PalpateError, match="center"):  # each the mean of its own first batch
        a.merge_state(b)
    with pytest.raises(PalpateError, match="same width"):
        feed(TMMD(), g).merge_state(feed(TMMD(), world(0, d=5)))


@pytest.mark.parametrize("mode", MODES)
def test_reset_forgets_and_may_keep_the_real_touches(mode):
    g, r = sets()
    for cls in ALL:
        for keeps in (False, True):
            metric = both(cls(reset_real_features=not keeps, **MODES[mode]), world(3, videos=6), r)
            metric.reset()
            with pytest.raises(
                PalpateError, match=f"0 generated and {len(r.ids) if keeps else 0} real"
            ):
                metric.compute()
            feed(metric, g)
            if not keeps:
                feed(metric, r, real=True)
            whole = both(cls(**MODES[mode]), g, r).compute()
            assert close(
                metric.compute().to_json() | {"details": 0}, whole.to_json() | {"details": 0}
            )


@pytest.mark.parametrize("mode", MODES)
def test_empty_batches_change_nothing(mode):
    g, r = sets()
    metric, plain = TMMD(**MODES[mode]), both(TMMD(**MODES[mode]), g, r)
    metric.update(np.zeros((0, 6)))
    both(metric, g, r)
    metric.update(np.zeros((0, 6)), real=True, ids=[], groups=[])
    assert metric.compute() == plain.compute()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("cls", ALL)
def test_bad_batches_are_named_at_once_and_change_nothing(cls, mode):
    g, r = sets()
    metric = both(cls(**MODES[mode]), g, r)
    before = metric.compute()
    bad = g.features[:9].copy()
    bad[[3, 7], 0] = np.nan
    columns = {"ids": g.ids[:9], "labels": g.labels[:9], "groups": g.groups[:9]}
    for features, match in [
        (bad, r"generated features of this update must be finite.*2 rows \(3, 7\)"),
        (2 * g.features[:9], "L2-normalized"),
        (np.ones((9, 5)) / np.sqrt(5), "same width"),
        (np.arange(54).reshape(9, 6), "floating-point"),
        (g.features[0], "shape"),
    ]:
        with pytest.raises(PalpateError, match=match):
            metric.update(features, **columns)
    if mode == "features" or cls is not TMMD:
        with pytest.raises(PalpateError, match="one entry a row"):
            metric.update(g.features[:8], **columns)
        with pytest.raises(PalpateError, match=r"Give (each|groups)"):
            metric.update(g.features[:9], **columns | {"groups": None})
    assert metric.compute() == before


def test_what_sums_refuse():
    g, _ = sets()
    for options, match in [
        ({"preset": "grouped"}, "one group"),
        ({"estimator": "grouped"}, "one group"),
        ({"sigma": "median"}, "one bandwidth"),
        ({"sigma": (1.0, 2.0)}, "one bandwidth"),
        ({"preset": "paper-tables"}, "hash"),
        ({"center": np.zeros((2, 2))}, "finite vector"),
    ]:
        with pytest.raises(PalpateError, match=match):
            ITMMD(keep="sums", **options)
    for classes in (None, [], ["a", "a"], ["a", ""]):
        with pytest.raises(PalpateError, match="classes"):
            CITMMD(keep="sums", classes=classes)
    with pytest.raises(PalpateError, match="keep must be"):
        TMMD(keep="everything")
    with pytest.raises(PalpateError, match="floor=True"):
        feed(ITMMD(keep="sums"), g, real=True)
    with pytest.raises(PalpateError, match="id or the group"):
        feed(ITMMD(keep="sums"), g, ids=None, groups=None)
    with pytest.raises(PalpateError, match="'m2'"):
        feed(DTMMD(keep="sums", classes=CLASSES[:2]), g)
    with pytest.raises(PalpateError, match="no labels"):
        feed(DTMMD(keep="sums", classes=CLASSES), g, labels=None)


@pytest.mark.parametrize("cls", ALL)
@pytest.mark.parametrize("mode", MODES)
def test_compute_before_update(cls, mode):
    with pytest.raises(PalpateError, match="must have seen generated"):
        cls(**MODES[mode]).compute()


def test_one_set_without_the_other():
    g, _ = sets()
    with pytest.raises(PalpateError, match="0 real"):
        feed(TMMD(), g).compute()
    assert feed(ITMMD(), g).compute().floor is None
    with pytest.raises(PalpateError, match="floor"):
        feed(feed(ITMMD(), g), change(sets()[1], groups=None), real=True).compute()


def one_by_one(s):
    """Without groups: halves are dealt by id."""
    return change(s, groups=None)


@pytest.mark.parametrize("cls", [ITMMD, CITMMD, DTMMD])
def test_sums_have_the_floor_of_the_same_groups_classes_and_numbers_alone(cls):
    """A biased value falls as 1 / n, and halves of whole groups depend on the groups; features say so as well."""
    g, drawn_again = (
        world(0, classes=3, videos=4, frames=10),
        world(0, classes=3, videos=4, frames=10, draw=1),
    )
    more, fewer_classes = (
        world(0, classes=3, videos=4, frames=40, draw=1),
        world(0, classes=2, videos=6, frames=10, draw=1),
    )
    others = change(drawn_again, groups=[f"other {v}" for v in g.groups])
    swapped = change(
        drawn_again, groups=[v if k else "c0v1" for k, v in enumerate(g.groups)]
    )  # a frame in another video
    for preset, made, real, known in (
        ("cmmd", g, drawn_again, True),
        ("paper", g, drawn_again, True),
        ("cmmd", g, more, False),
        ("paper", g, more, False),
        ("paper", g, others, False),
        ("paper", g, swapped, False),
        ("cmmd", g, fewer_classes, False),
        ("cmmd", one_by_one(g), one_by_one(drawn_again), True),
        ("cmmd", one_by_one(g), one_by_one(more), False),
        ("paper", one_by_one(g), one_by_one(more), True),
        ("paper", one_by_one(g), one_by_one(fewer_classes), cls is ITMMD),
    ):
        score = both(cls(preset=preset, **MODES["sums"]), made, real).compute()
        assert score.value is not None
        assert (score.floor is not None) == known, (preset, score.note)
        assert ("No floor" in score.note) != known
        assert not {
            k: v
            for k, v in score.details.items()
            if k == "left_out" or (k.endswith("_interval") and v is not None)
        }
        assert all(v.get("interval") is None for v in score.details.values() if isinstance(v, dict))


def test_groups_of_sums_are_known_after_a_reset_and_a_merge():
    g, r = (
        world(0, classes=3, videos=4, frames=10),
        world(0, classes=3, videos=4, frames=10, draw=1),
    )
    options = {"preset": "paper", "reset_real_features": False, **MODES["sums"]}
    metric = both(ITMMD(**options), g, r)
    want = metric.compute()
    metric.reset()
    assert feed(metric, g).compute() == want
    halves = [g.take(g.ids[:50]), g.take(g.ids[50:])]
    first, second = (feed(ITMMD(**options), part) for part in halves)
    assert feed(first, r, real=True).compute().floor is None  # not all groups yet
    assert first.merge(second).compute().floor == pytest.approx(want.floor, abs=1e-9)


def test_sums_take_no_other_kernel():
    for kernel in (Linear(), Polynomial(), Gaussian((5.0,))):
        with pytest.raises(PalpateError, match=r"has the Gaussian kernel.*Pass sigma"):
            TMMD(keep="sums", center=np.full(6, 0.4), kernel=kernel)


@pytest.mark.parametrize("mode", MODES)
def test_buffers_may_be_used_again(mode):
    g, r = sets()
    buffer, metric = np.empty((10, 6)), TMMD(**MODES[mode])
    for s, real in ((g, False), (r, True)):
        for k in range(0, 80, 10):
            buffer[:] = s.features[k : k + 10]
            metric.update(buffer, real=real)
    bare = {"ids": None, "labels": None, "groups": None}
    assert close(
        metric.compute().to_json(),
        both(TMMD(**MODES[mode]), g, r, order=np.arange(80), step=10, **bare).compute().to_json(),
    )


@pytest.mark.parametrize("mode", MODES)
def test_half_precision_is_widened_and_said(mode):
    g, r = sets()
    metric = TMMD(normalize=True, **MODES[mode])
    with pytest.warns(UserWarning, match="float16 features were widened"):
        metric.update(g.features.astype(np.float16))
    with pytest.warns(UserWarning, match="float16 features were widened"):
        metric.update(r.features.astype(np.float16), real=True)
    assert metric.compute().value == pytest.approx(tmmd(g, r, preset="paper").value, abs=0.05)


@pytest.mark.parametrize("mode", MODES)
def test_tensors_and_integer_names(mode):
    torch = pytest.importorskip("torch")
    g, _ = sets()
    number = {name: k for k, name in enumerate(sorted(set(g.groups)))}
    options = MODES[mode] | ({"classes": [0, 1, 2]} if mode == "sums" else {})
    metric, plain = CITMMD(**options), CITMMD(**options)
    x = torch.tensor(g.features, dtype=torch.float32, requires_grad=True)
    labels, groups = [int(c[1]) for c in g.labels], [number[v] for v in g.groups]
    metric.update(
        x, ids=torch.arange(len(x)), labels=torch.tensor(labels), groups=torch.tensor(groups)
    )
    plain.update(
        g.features.astype(np.float32),
        ids=list(range(len(x))),
        labels=[str(c) for c in labels],
        groups=np.array(groups),
    )
    assert metric.compute() == plain.compute()
    assert set(metric.compute().details["per_class"]) == {"0", "1", "2"}
    with torch.no_grad():
        x.zero_()
    assert metric.compute() == plain.compute()


def test_bfloat16_tensors_are_widened():
    torch = pytest.importorskip("torch")
    g, _ = sets()
    metric = ITMMD(normalize=True)
    with pytest.warns(UserWarning, match="bfloat16"):
        metric.update(torch.tensor(g.features).bfloat16(), groups=g.groups)
    assert metric.compute().value == pytest.approx(i_tmmd(g).value, rel=0.1)


def test_repeated_ids_are_said():
    g, _ = sets()
    metric = feed(ITMMD(), g)
    feed(metric, g, order=np.arange(3))
    assert "3 rows have the id of another" in metric.compute().note


@given(
    n=st.integers(0, 4),
    d=st.integers(1, 5),
    wide=st.booleans(),
    real=st.booleans(),
    names=st.lists(st.text(), min_size=4, max_size=4),
    given_=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    copies=st.integers(1, 3),
)
@settings(max_examples=60, deadline=None)
def test_records_tell_everything(n, d, wide, real, names, given_, copies):
    x = np.random.default_rng(n).normal(size=(n, d)).astype(np.float64 if wide else np.float32)
    batch = Batch(x, real, *(names[:n] if there else None for there in given_))
    found = list(Batch.read(np.concatenate([batch.to_bytes()] * copies)))
    assert len(found) == copies
    for b in found:
        assert (b.real, b.ids, b.labels, b.groups) == (
            batch.real,
            batch.ids,
            batch.labels,
            batch.groups,
        )
        assert b.features.dtype == x.dtype
        assert np.array_equal(b.features, x)


def test_contract_of_torchmetrics_and_no_torch():
    for cls in ALL:
        assert (cls.higher_is_better, cls.is_differentiable, cls.full_state_update) == (
            False if cls is TMMD else None,
            False,
            False,
        )
    code = "import sys, palpate.metrics.streaming as s; s.TMMD(); sys.exit('torch' in sys.modules or 'torchmetrics' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

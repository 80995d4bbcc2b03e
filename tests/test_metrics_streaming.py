"""Streaming classes against the functions: batches, merging, pickles, processes, bad input."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.core import Note, PalpateError, PalpateWarning
from palpate.metrics import ci_tmmd, d_tmmd, four_scores, i_tmmd, tmmd
from palpate.metrics.streaming import CITMMD, DTMMD, ITMMD, TMMD, Batch
from test_metrics_tactile import change, world

ALL = (TMMD, ITMMD, CITMMD, DTMMD)
FUNCTIONS = {ITMMD: i_tmmd, CITMMD: ci_tmmd, DTMMD: d_tmmd}
every_class = pytest.mark.parametrize("cls", ALL)


def sets(seed=0, **shape):
    shape = {"classes": 3, "videos": 6, "frames": (4, 7, 5)} | shape
    return world(seed, **shape), world(seed, draw=1, **shape)


def feed(metric, s, real=False, step=7, order=None, **drop):
    order = np.arange(len(s.ids)) if order is None else order
    pick = lambda column, at: None if column is None else [column[k] for k in at]
    for k in range(0, len(order), step):
        at = order[k : k + step]
        columns = {name: pick(getattr(s, name), at) for name in ("ids", "labels", "groups")}
        metric.update(s.features[at], real=real, **columns | drop)
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


def same(a, b):
    return close(a.to_json(), b.to_json())


@pytest.mark.parametrize("groups", [True, False])
@pytest.mark.parametrize("step", [1, 7, 1000])
def test_streaming_gives_what_the_functions_give(groups, step):
    g, r = sets()
    g, r = (g, r) if groups else (change(g, groups=None), change(r, groups=None))
    assert both(TMMD(encoder=g.encoder), g, r, step=step).compute() == tmmd(g, r)
    for cls, function in FUNCTIONS.items():
        assert feed(cls(encoder=g.encoder), g, step=step).compute() == function(g)
        with_floor = both(cls(encoder=g.encoder), g, r, step=step).compute()
        assert with_floor.floor == function(r).value
        assert with_floor.interval == function(g).interval


@pytest.mark.parametrize("sigma", ["median", "multi", (1.0, 10.0)])
def test_bandwidths_of_the_reference_and_the_floor_are_those_of_four_scores(sigma):
    g, r = sets()
    for cls, score in zip(ALL, four_scores(g, r, floor=r, sigma=sigma), strict=True):
        assert same(both(cls(encoder=g.encoder, sigma=sigma), g, r).compute(), score)


@given(
    seed=st.integers(0, 10**5),
    step=st.integers(1, 40),
    preset=st.sampled_from(["grouped", "paper", "paper-tables", "cmmd"]),
)
@settings(max_examples=10)
def test_neither_order_nor_batches_matter(seed, step, preset):
    g, r = sets(seed % 5)
    order = np.random.default_rng(seed).permutation(len(g.ids))
    for cls in ALL:
        straight = both(cls(preset=preset), g, r).compute()
        assert same(straight, both(cls(preset=preset), g, r, step=step, order=order).compute())


@every_class
def test_real_is_the_second_argument_as_in_torchmetrics(cls):
    g, r = sets()
    metric, named = cls(), cls()
    metric.update(g.features, False)
    metric.update(r.features, True)
    named.update(g.features)
    named.update(r.features, real=True)
    assert same(metric.compute(), named.compute())


def test_ids_that_are_not_given_depend_on_the_rows_alone():
    g, _ = sets()
    g = change(g, features=np.concatenate([g.features[:-2], g.features[:2]]))  # with repeated rows
    order = np.random.default_rng(0).permutation(len(g.ids))
    bare = {"ids": None, "groups": None}
    a = feed(ITMMD(), g, **bare).compute()
    assert same(a, feed(ITMMD(), g, order=order, step=3, **bare).compute())
    assert a.details["units"] == len(g.ids)


@every_class
def test_merged_and_pickled_in_the_middle(cls):
    g, r = sets()
    make = lambda: cls(encoder=g.encoder)
    whole = both(make(), g, r).compute()
    first, second = np.arange(0, 41), np.arange(41, len(g.ids))
    a = pickle.loads(pickle.dumps(both(make(), g, r, order=first)))
    b = pickle.loads(pickle.dumps(both(make(), g, r, order=second)))
    assert same(both(pickle.loads(pickle.dumps(a)), g, r, order=second).compute(), whole)
    a.merge_state(b)
    assert same(a.compute(), whole)
    c = make()
    c.merge_state(b)
    c.merge_state(both(make(), g, r, order=first))
    assert same(c.compute(), whole)


@pytest.mark.parametrize(
    ("mine", "other"),
    [
        ({}, {"sigma": 5.0}),
        ({"sigma": np.array([5.0, 10.0])}, {"sigma": np.array([5.0, 20.0])}),
        ({}, {"scale": 1.0}),
        ({}, {"preset": "paper"}),
        ({}, {"encoder": "f" * 64}),
    ],
)
def test_metrics_of_other_settings_are_not_merged(mine, other):
    g, r = sets()
    a, b, equal = (both(TMMD(**options), g, r) for options in (mine, other, mine))
    before = a.compute()
    with pytest.raises(PalpateError, match="same settings"):
        a.merge_state(b)
    with pytest.raises(PalpateError, match="itself"):
        a.merge_state(a)
    with pytest.raises(PalpateError, match="one class"):
        a.merge_state(ITMMD())
    assert a.compute() == before
    a.merge_state(equal)
    assert a.compute().n == 2 * len(g.ids)


def test_features_of_another_width_are_not_merged():
    with pytest.raises(PalpateError, match="same width"):
        feed(TMMD(), sets()[0]).merge_state(feed(TMMD(), world(0, d=5)))


@every_class
@pytest.mark.parametrize("keeps", [False, True])
def test_reset_forgets_and_may_keep_real_samples(cls, keeps):
    g, r = sets()
    metric = both(cls(reset_real_features=not keeps), world(3, videos=6), r)
    metric.reset()
    with pytest.raises(PalpateError, match=f"0 generated and {len(r.ids) if keeps else 0} real"):
        metric.compute()
    feed(metric, g)
    if not keeps:
        feed(metric, r, real=True)
    whole = both(cls(), g, r).compute()
    assert metric.compute().value == pytest.approx(whole.value, abs=1e-9)
    assert metric.compute().floor == whole.floor


@every_class
def test_bad_batches_are_named_at_once_and_change_nothing(cls):
    g, r = sets()
    metric = both(cls(), g, r)
    metric.update(np.zeros((0, 6)), real=True)
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
        (g.features[:8], "one entry a row"),
    ]:
        with pytest.raises(PalpateError, match=match):
            metric.update(features, **columns)
    with pytest.raises(PalpateError, match="Give each always, or never"):
        metric.update(g.features[:9], **columns | {"groups": None})
    assert metric.compute() == before


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: ITMMD(preset="best"), "`preset`"),
        (lambda: ITMMD(keeep="sums"), "keeep"),
        (lambda: ITMMD().compute(), "must have generated samples"),
        (lambda: feed(TMMD(), sets()[0]).compute(), "0 real"),
        (
            lambda: both(ITMMD(), sets()[0], change(sets()[1], groups=None)).compute(),
            "floor must be scored like",
        ),
    ],
)
def test_what_is_rejected(call, match):
    with pytest.raises(PalpateError, match=match):
        call()


@every_class
def test_buffers_may_be_used_again(cls):
    g, r = sets()
    buffer, metric = np.empty((10, 6)), cls()
    for s, real in ((g, False), (r, True)):
        for k in range(0, 80, 10):
            buffer[:] = s.features[k : k + 10]
            metric.update(buffer, real=real, labels=s.labels[k : k + 10])
    bare = {"ids": None, "groups": None}
    again = both(cls(), g, r, order=np.arange(80), step=10, **bare)
    assert same(metric.compute(), again.compute())


def test_tensors_half_precision_and_integer_names():
    torch = pytest.importorskip("torch")
    g, _ = sets()
    number = {name: k for k, name in enumerate(sorted(set(g.groups)))}
    x = torch.tensor(g.features, dtype=torch.float32, requires_grad=True)
    labels, groups = [int(c[1]) for c in g.labels], [number[v] for v in g.groups]
    metric, plain = CITMMD(), CITMMD()
    names = {"labels": torch.tensor(labels), "groups": torch.tensor(groups)}
    metric.update(x, ids=torch.arange(len(x)), **names)
    names = {"labels": [str(c) for c in labels], "groups": np.array(groups)}
    plain.update(g.features.astype(np.float32), ids=list(range(len(x))), **names)
    with torch.no_grad():
        x.zero_()
    assert metric.compute() == plain.compute()
    assert set(metric.compute().details["per_class"]) == {"0", "1", "2"}
    for half in (torch.tensor(g.features).bfloat16(), g.features.astype(np.float16)):
        metric = ITMMD(normalize=True)
        with pytest.warns(PalpateWarning, match="float16 features were widened"):
            metric.update(half, groups=g.groups)
        assert metric.compute().value == pytest.approx(i_tmmd(g).value, rel=0.1)


def test_repeated_ids_are_noted():
    g, _ = sets()
    metric = feed(feed(ITMMD(), g), g, order=np.arange(3))
    assert metric.compute().notes[-1] == Note("repeated-ids", {"count": 3})


@given(
    n=st.integers(0, 4),
    dtype=st.sampled_from([np.float32, np.float64]),
    names=st.lists(st.text(st.characters(exclude_characters="\0")), min_size=4, max_size=4),
    given_=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    copies=st.integers(1, 3),
)
@settings(max_examples=40)
def test_batches_survive_as_bytes(n, dtype, names, given_, copies):
    x = np.random.default_rng(n).normal(size=(n, 3)).astype(dtype)
    batch = Batch(x, n > 2, *(names[:n] if there else None for there in given_))
    for read in Batch.read(np.concatenate([batch.to_bytes()] * copies)):
        assert (read.real, read.ids, read.labels, read.groups) == (
            batch.real,
            batch.ids,
            batch.labels,
            batch.groups,
        )
        assert read.features.dtype == x.dtype
        np.testing.assert_array_equal(read.features, x)

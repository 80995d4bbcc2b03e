"""The streaming class against the function: batches, pickles, bad input."""

import io
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forge.errors import fails
from palpate.core import Note, PalpateWarning
from palpate.metrics import tmmd
from palpate.metrics.streaming import TMMD, Batch
from test_metrics_tactile import change, world


def sets(seed=0, **shape):
    shape = {"classes": 3, "videos": 6, "frames": (4, 7, 5)} | shape
    return world(seed, **shape), world(seed, draw=1, **shape)


def feed(metric, s, real=False, step=7, order=None, **drop):
    order = np.arange(len(s.ids)) if order is None else order
    pick = lambda column, at: None if column is None else [column[k] for k in at]
    for k in range(0, len(order), step):
        at = order[k : k + step]
        columns = {name: pick(getattr(s, name), at) for name in ("ids", "groups")}
        metric.update(s.features[at], real, **columns | drop)  # as in torchmetrics
    return metric


def both(metric, g, r, **options):
    return feed(feed(metric, g, **options), r, real=True, **options)


def close(a, b):
    """Equal scores, floats within 1e-9."""
    if isinstance(a, dict):
        return set(a) == set(b) and all(close(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(close, a, b))
    return a == pytest.approx(b, abs=1e-9) if isinstance(a, float) else a == b


def same(a, b):
    return close(a.to_json(), b.to_json())


@pytest.mark.parametrize("groups", [True, False])
@pytest.mark.parametrize("step", [1, 7, 1000])
def test_streaming_gives_what_the_functions_give(groups, step):
    g, r = sets()
    g, r = (g, r) if groups else (change(g, groups=None), change(r, groups=None))
    assert same(both(TMMD(encoder=g.encoder), g, r, step=step).compute(), tmmd(g, r))


@given(
    seed=st.integers(0, 10**5),
    step=st.integers(1, 40),
    preset=st.sampled_from(["grouped", "paper", "paper-tables", "cmmd"]),
)
@settings(max_examples=10)
def test_neither_order_nor_batches_matter(seed, step, preset):
    g, r = sets(seed % 5)
    order = np.random.default_rng(seed).permutation(len(g.ids))
    straight = both(TMMD(preset=preset), g, r).compute()
    assert same(straight, both(TMMD(preset=preset), g, r, step=step, order=order).compute())


def test_ids_that_are_not_given_depend_on_the_rows_alone():
    g, r = sets()
    g = change(g, features=np.concatenate([g.features[:-2], g.features[:2]]))  # with repeated rows
    order = np.random.default_rng(0).permutation(len(g.ids))
    bare = {"ids": None, "groups": None}
    a = both(TMMD(), g, r, **bare).compute()
    b = feed(feed(TMMD(), g, order=order, step=3, **bare), r, real=True, **bare).compute()
    assert same(a, b)
    assert a.details["units"] == len(g.ids) + len(r.ids)


def test_pickled_in_the_middle():
    g, r = sets()
    make = lambda: TMMD(encoder=g.encoder)
    whole = both(make(), g, r).compute()
    first, second = np.arange(0, 41), np.arange(41, len(g.ids))
    a = pickle.loads(pickle.dumps(both(make(), g, r, order=first)))
    assert same(both(pickle.loads(pickle.dumps(a)), g, r, order=second).compute(), whole)


def test_bytes_of_another_process_unpickle_nothing():
    buffer = io.BytesIO()
    np.savez(buffer, features=np.array([{}], dtype=object))
    head = np.array([buffer.getbuffer().nbytes, 0], "<i8").view(np.uint8)
    with pytest.raises(ValueError, match="allow_pickle"):
        next(Batch.read(np.concatenate([head, np.frombuffer(buffer.getvalue(), np.uint8)])))


@pytest.mark.parametrize("keeps", [False, True])
def test_reset_forgets_and_may_keep_real_samples(keeps):
    g, r = sets()
    metric = both(TMMD(reset_real_features=not keeps), world(3, videos=6), r)
    metric.reset()
    fails(f"0 generated and {len(r.ids) if keeps else 0} real", metric.compute)
    feed(metric, g)
    if not keeps:
        feed(metric, r, real=True)
    whole = both(TMMD(), g, r).compute()
    assert metric.compute().value == pytest.approx(whole.value, abs=1e-9)


def test_bad_batches_are_named_at_once_and_change_nothing():
    g, r = sets()
    metric = both(TMMD(), g, r)
    metric.update(np.zeros((0, 6)), real=True)
    before = metric.compute()
    bad = g.features[:9].copy()
    bad[[3, 7], 0] = np.nan
    columns = {"ids": g.ids[:9], "groups": g.groups[:9]}
    for features, match in [
        (bad, r"generated features of this update must be finite.*2 rows \(3, 7\)"),
        (2 * g.features[:9], "L2-normalized"),
        (np.ones((9, 5)) / np.sqrt(5), "same width"),
        (np.arange(54).reshape(9, 6), "floating-point"),
        (g.features[0], "shape"),
        (g.features[:8], "one entry a row"),
    ]:
        fails(match, metric.update, features, **columns)
    fails("Give each always, or never", metric.update, g.features[:9], **columns | {"groups": None})
    assert metric.compute() == before


def test_buffers_may_be_used_again():
    g, r = sets()
    buffer, metric = np.empty((10, 6)), TMMD()
    for s, real in ((g, False), (r, True)):
        for k in range(0, 80, 10):
            buffer[:] = s.features[k : k + 10]
            metric.update(buffer, real=real)
    bare = {"ids": None, "groups": None}
    again = both(TMMD(), g, r, order=np.arange(80), step=10, **bare)
    assert same(metric.compute(), again.compute())


def test_tensors_half_precision_and_integer_names():
    torch = pytest.importorskip("torch")
    g, r = sets()
    number = {name: k for k, name in enumerate(sorted(set(g.groups)))}
    x = torch.tensor(g.features, dtype=torch.float32, requires_grad=True)
    groups = [number[v] for v in g.groups]
    metric, plain = feed(TMMD(), r, real=True), feed(TMMD(), r, real=True)
    metric.update(x, ids=torch.arange(len(x)), groups=torch.tensor(groups))
    plain.update(g.features.astype(np.float32), ids=list(range(len(x))), groups=np.array(groups))
    with torch.no_grad():
        x.zero_()
    assert metric.compute() == plain.compute()
    for half in (torch.tensor(g.features).bfloat16(), g.features.astype(np.float16)):
        metric = feed(TMMD(normalize=True), r, real=True)
        with pytest.warns(PalpateWarning, match="float16 features were widened"):
            metric.update(half, groups=g.groups)
        assert metric.compute().value == pytest.approx(tmmd(g, r).value, rel=0.1)


def test_repeated_ids_are_noted():
    g, r = sets()
    metric = feed(both(TMMD(), g, r), g, order=np.arange(3))
    assert metric.compute().notes[-1] == Note("repeated-ids", {"count": 3})


@given(
    n=st.integers(0, 4),
    dtype=st.sampled_from([np.float32, np.float64]),
    names=st.lists(st.text(st.characters(exclude_characters="\0")), min_size=4, max_size=4),
    given_=st.tuples(st.booleans(), st.booleans()),
    copies=st.integers(1, 3),
)
@settings(max_examples=40)
def test_batches_survive_as_bytes(n, dtype, names, given_, copies):
    arrays = {"features": np.random.default_rng(n).normal(size=(n, 3)).astype(dtype)}
    for column, there in zip(("ids", "groups"), given_, strict=True):
        arrays |= {column: np.array(names[:n], dtype=str)} if there else {}
    batch = Batch(arrays, n > 2)
    for read in Batch.read(np.concatenate([batch.to_bytes()] * copies)):
        assert (read.real, [*read.arrays]) == (batch.real, [*arrays])
        assert read.features.dtype == dtype
        for name, values in arrays.items():
            np.testing.assert_array_equal(read.arrays[name], values)

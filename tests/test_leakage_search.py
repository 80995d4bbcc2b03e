"""The search engine against brute force in float64."""

import builtins
import subprocess
import sys
from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.core import MissingExtraError, PalpateError
from palpate.leakage import search
from palpate.leakage.search import clusters_within, nearest, pairs_within
from palpate.leakage.search import exact as search_exact
from palpate.leakage.search import pairs as search_pairs
from palpate.leakage.search import threads as search_threads
from palpate.leakage.search.space import Space, base_side, identical_rows, query_side


def squared(x, y):
    """Brute force, a difference at a time, summed as float64."""
    out = np.empty((len(x), len(y)))
    for i, row in enumerate(x):
        gap = row.astype(np.float64) - y
        out[i] = np.einsum("ij,ij->i", gap, gap)
    return out


def brute(x, y, k, xg=None, yg=None, self_join=False, radius=None):
    d2 = squared(x, y)
    if xg is not None:
        d2[(np.asarray(xg)[:, None] == np.asarray(yg)[None]) & (np.asarray(yg)[None] >= 0)] = np.inf
    if self_join:
        np.fill_diagonal(d2, np.inf)
    if radius is not None:
        d2[d2 > radius**2] = np.inf
    d2 = np.c_[d2, np.full((len(x), k), np.inf)]
    index = np.argsort(d2, axis=1, kind="stable")[:, :k]
    best = np.take_along_axis(d2, index, axis=1)
    return np.where(np.isfinite(best), index, -1), np.sqrt(best).astype(np.float32)


def same(found, wanted):
    np.testing.assert_array_equal(found.index, wanted[0])
    np.testing.assert_array_equal(found.distance, wanted[1])


def smooth(rng, n, d=48, decay=1.2, steps=1):
    """Unit vectors with a decaying spectrum; steps > 1: that many drifting frames from each start."""
    starts = rng.normal(size=(-(-n // steps), 1, d))
    walk = np.cumsum(0.03 * rng.normal(size=(len(starts), steps, d)), axis=1) if steps > 1 else 0
    x = (starts + walk).reshape(-1, d)[:n] / np.arange(1, d + 1) ** decay
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def kinds(rng):
    """Inputs that have hurt searches: drift, no structure, lattices full of ties, tiny differences on a large offset, outliers, few dimensions."""
    grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 4), -1).reshape(-1, 4)
    outlier = smooth(rng, 700)
    outlier[5] *= 1e12
    return {
        "drift": smooth(rng, 900, steps=30),
        "isotropic": rng.normal(size=(700, 20)).astype(np.float32),
        "lattice": grid.astype(np.float32),
        "offset": (1e4 + rng.integers(0, 5, size=(600, 12)) * np.float32(2**-10)).astype(
            np.float32
        ),
        "outlier": outlier,
        "line": rng.integers(0, 300, size=(900, 1)).astype(np.float32),
        "tiny": (smooth(rng, 500) * np.float32(1e-25)).astype(np.float32),
        "huge": (smooth(rng, 500) * np.float32(1e25)).astype(np.float32),
        "wide": rng.normal(size=(300, 200)).astype(np.float32),
        "pairs": np.repeat(smooth(rng, 300), 2, axis=0)
        + (rng.normal(size=(600, 48)) * 1e-7).astype(np.float32),
    }


KINDS = sorted(kinds(np.random.default_rng(0)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", [1, 5])
def test_self_join_equals_brute_force(kind, k):
    x = kinds(np.random.default_rng(1))[kind]
    same(nearest(x, x, k, self_join=True), brute(x, x, k, self_join=True))


@pytest.mark.parametrize("kind", KINDS)
def test_queries_in_base_with_groups_and_radius(kind):
    rng = np.random.default_rng(2)
    x = kinds(rng)[kind]
    cut = len(x) // 3
    group = rng.integers(-1, 6, size=len(x))
    d2 = squared(x[:cut], x[cut:])
    radius = float(np.sqrt(np.quantile(d2, 0.05)))
    for options in ({}, {"radius": radius}):
        found = nearest(
            x[:cut], x[cut:], 3, query_groups=group[:cut], base_groups=group[cut:], **options
        )
        same(found, brute(x[:cut], x[cut:], 3, group[:cut], group[cut:], **options))


@pytest.mark.parametrize("kind", KINDS)
def test_pairs_and_clusters_equal_brute_force(kind):
    x = kinds(np.random.default_rng(3))[kind]
    d2 = squared(x, x)
    upper = np.triu(np.ones(d2.shape, dtype=bool), 1)
    for share in (0.0, 0.002, 0.05):
        radius = float(np.sqrt(np.quantile(d2[upper], share)))
        wanted = np.argwhere(upper & (d2 <= radius**2))
        blocks = list(pairs_within(x, radius, max_pairs_per_block=100))
        assert all(0 < len(i) <= 100 for i, _, _ in blocks)
        i, j, distance = (
            (np.concatenate(part) for part in zip(*blocks, strict=True))
            if blocks
            else (np.empty(0, int),) * 3
        )
        order = np.lexsort((j, i))
        np.testing.assert_array_equal(np.c_[i, j][order], wanted)
        np.testing.assert_array_equal(
            distance[order], np.sqrt(d2[tuple(wanted.T)]).astype(np.float32)
        )
        np.testing.assert_array_equal(clusters_within(x, radius), components(len(x), wanted))


def components(n, pairs):
    """The lowest row of each component, by spreading labels until nothing changes."""
    label = np.arange(n)
    while True:
        before = label.copy()
        for i, j in pairs:
            label[i] = label[j] = min(label[i], label[j])
        if (label == before).all():
            return label


def test_a_threshold_exactly_at_the_distance_keeps_the_pair():
    x = np.array([[0, 0], [3, 4], [6, 8]], dtype=np.float32)
    assert [(int(i[0]), int(j[0])) for i, j, _ in pairs_within(x, 5.0, max_pairs_per_block=1)] == [
        (0, 1),
        (1, 2),
    ]
    assert not list(pairs_within(x, np.nextafter(5.0, 0)))
    assert clusters_within(x, 5.0).tolist() == [0, 0, 0]


def test_nearest_within_a_radius_keeps_what_lies_on_it():
    x = np.array([[0, 0], [3, 4], [6, 8], [20, 0]], dtype=np.float32)
    assert nearest(x, x, 2, self_join=True, radius=5.0).index.tolist() == [
        [1, -1],
        [0, 2],
        [1, -1],
        [-1, -1],
    ]
    found = nearest(x, x, 2, self_join=True, radius=4.99)
    assert (found.index == -1).all()
    assert np.isinf(found.distance).all()


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5])
def test_one_video_that_holds_nearly_everything(share):
    rng = np.random.default_rng(13)
    x = smooth(rng, 1500, steps=30)
    group = np.where(rng.random(1500) < share, rng.integers(1, 5, size=1500), 0)
    same(
        nearest(x, x, 2, query_groups=group, base_groups=group, self_join=True),
        brute(x, x, 2, group, group, self_join=True),
    )


def test_near_ties_are_decided_by_exact_distances():
    # 400 base rows whose distances from the query differ in the ninth digit, far below what |x|^2 + |y|^2 - 2xy resolves in float32.
    rng = np.random.default_rng(4)
    direction = rng.normal(size=(400, 64))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    query = smooth(rng, 1, 64)
    base = (query + 1e-2 * direction).astype(np.float32)
    found = nearest(query, base, 400)
    same(found, brute(query, base, 400))
    truth = np.sort(np.sqrt(squared(query, base)[0]))
    assert np.ptp(truth) / truth[0] < 1e-4
    assert len(np.unique(truth)) > 300


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**31), st.integers(1, 40), st.integers(1, 12), st.integers(1, 4), st.booleans()
)
def test_any_small_lattice(seed, n, d, k, grouped):
    rng = np.random.default_rng(seed)
    x = rng.integers(-1, 2, size=(n, d)).astype(np.float32)
    group = rng.integers(-1, 3, size=n) if grouped else None
    same(
        nearest(x, x, k, query_groups=group, base_groups=group, self_join=True),
        brute(x, x, k, group, group, self_join=True),
    )


def test_the_bound_never_exceeds_the_truth():
    rng = np.random.default_rng(5)
    for x in kinds(rng).values():
        space = Space.of(x)
        z = space.rotate(x)
        d2 = squared(x, x)
        for p in (1, 3, 13, 29):
            # With the true distance as the threshold every pair must pass: one left factor a pair.
            for i in range(0, len(x), 37):
                left = query_side(np.repeat(z[i : i + 1], len(x), axis=0), p, d2[i] / space.norm**2)
                assert (np.einsum("ij,ij->i", left, base_side(z, p)) <= 0).all()


@pytest.mark.parametrize(("queries", "rows"), [(3, 7), (128, 64)])
def test_results_do_not_depend_on_block_sizes(monkeypatch, queries, rows):
    x = smooth(np.random.default_rng(6), 400, steps=20)
    plain, pairs = (
        nearest(x, x, 3, self_join=True),
        {(int(a), int(b)) for i, j, _ in pairs_within(x, 0.1) for a, b in zip(i, j, strict=True)},
    )
    for module in (search_exact, search_pairs):
        monkeypatch.setattr(module, "QUERIES", queries)
        monkeypatch.setattr(module, "PENDING", 50)
    monkeypatch.setattr(search_exact, "ROWS", rows)
    monkeypatch.setattr(search_exact, "GUESS_ROWS", 5)
    again = nearest(x, x, 3, self_join=True)
    same(again, (plain.index, plain.distance))
    assert {
        (int(a), int(b)) for i, j, _ in pairs_within(x, 0.1) for a, b in zip(i, j, strict=True)
    } == pairs
    assert len(pairs) > 100


@pytest.mark.parametrize("workers", [None, 1, 4])
def test_results_do_not_depend_on_threads(monkeypatch, workers):
    x = smooth(np.random.default_rng(14), 800, steps=20)
    plain = nearest(x, x, 3, self_join=True)

    class Controller:
        def info(self):
            return [{"num_threads": workers}]

        def limit(self, limits):
            assert limits == 1
            return nullcontext()

    monkeypatch.setattr(search_threads, "_controller", lambda: workers and Controller())
    same(nearest(x, x, 3, self_join=True), (plain.index, plain.distance))
    same(plain, brute(x, x, 3, self_join=True))


def test_the_order_of_rows_does_not_change_what_is_found():
    rng = np.random.default_rng(7)
    x = smooth(rng, 600, steps=20)
    order = rng.permutation(len(x))
    plain, shuffled = nearest(x, x, self_join=True), nearest(x[order], x[order], self_join=True)
    np.testing.assert_array_equal(plain.distance[order], shuffled.distance)
    np.testing.assert_array_equal(plain.index[order], order[shuffled.index])


def test_identical_rows():
    rng = np.random.default_rng(8)
    few = smooth(rng, 5, 8)
    which = rng.integers(0, 5, size=500)
    x = few[which]
    first, rank = identical_rows(x)
    np.testing.assert_array_equal(first, [np.flatnonzero(which == w)[0] for w in which])
    np.testing.assert_array_equal(rank, [(which[:i] == w).sum() for i, w in enumerate(which)])
    group = rng.integers(-1, 4, size=500)
    for k in (1, 3):
        same(nearest(x, x, k, self_join=True), brute(x, x, k, self_join=True))
        same(nearest(x, x, k, query_groups=group, base_groups=group), brute(x, x, k, group, group))
    assert sum(len(i) for i, _, _ in pairs_within(x, 0.0)) == sum(
        n * (n - 1) // 2 for n in np.bincount(which)
    )
    np.testing.assert_array_equal(clusters_within(x, 0.0), first)


def test_minus_zero_is_zero():
    x = np.array([[0.0, 1.0], [-0.0, 1.0], [5.0, 1.0]], dtype=np.float32)
    assert identical_rows(x)[0].tolist() == [0, 0, 2]


def test_fewer_candidates_than_asked_for():
    x = np.eye(3, dtype=np.float32)
    found = nearest(x, x, 5, self_join=True)
    assert (found.index[:, :2] >= 0).all()
    assert (found.index[:, 2:] == -1).all()
    assert np.isinf(found.distance[:, 2:]).all()
    alone = nearest(x, x, 2, query_groups=[1, 1, 2], base_groups=[1, 1, 2], self_join=True)
    assert alone.index.tolist() == [[2, -1], [2, -1], [0, 1]]
    assert nearest(x, x, query_groups=[1] * 3, base_groups=[1] * 3).index.tolist() == [[-1]] * 3
    unknown = nearest(x, x, 2, query_groups=[-1] * 3, base_groups=[-1] * 3, self_join=True)
    assert (unknown.index >= 0).all()


@pytest.mark.parametrize(("n", "m"), [(0, 4), (4, 0), (0, 0), (1, 1)])
def test_no_rows_and_one_row(n, m):
    found = nearest(np.ones((n, 3)), np.ones((m, 3)), 2)
    assert found.index.shape == found.distance.shape == (n, 2)
    assert (found.index >= 0).sum() == (n and m)
    assert not list(pairs_within(np.ones((n, 3)), 1.0)) or n > 1
    assert clusters_within(np.ones((n, 3)), 1.0).tolist() == [0] * n


def test_bad_input_is_refused_with_its_row():
    good = np.ones((5, 3), dtype=np.float32)
    for value in (np.nan, np.inf, 1e39):
        bad = good.astype(np.float64)
        bad[3, 1] = value
        for call in (
            lambda b=bad: nearest(b, good),
            lambda b=bad: nearest(good, b),
            lambda b=bad: pairs_within(b, 1.0),
            lambda b=bad: clusters_within(b, 1.0),
        ):
            with pytest.raises(PalpateError, match="row 3, column 1"):
                call()
    wrong = [
        ((good, np.ones((5, 4))), {}),
        ((good[0], good), {}),
        ((np.array([["a"]]), good), {}),
        ((good, good[:2]), {"self_join": True}),
        ((good, good, 0), {}),
        ((good, good), {"backend": "annoy"}),
        ((good, good), {"radius": -1.0}),
        ((good, good), {"radius": float("nan")}),
        ((good, good), {"query_groups": [0] * 5}),
        ((good, good), {"query_groups": [0] * 4, "base_groups": [0] * 5}),
        ((good, good), {"query_groups": [0.5] * 5, "base_groups": [0.5] * 5}),
    ]
    for args, options in wrong:
        with pytest.raises(PalpateError):
            nearest(*args, **options)
    with pytest.raises(PalpateError, match="radius"):
        pairs_within(good, -0.5)
    with pytest.raises(PalpateError, match="max_pairs_per_block"):
        pairs_within(good, 0.5, max_pairs_per_block=0)


def test_a_long_chain_is_one_cluster():
    rng = np.random.default_rng(9)
    steps = rng.normal(size=(3000, 16))
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    x = np.cumsum(steps, axis=0).astype(np.float32)[rng.permutation(3000)]
    assert not clusters_within(x, 1.001).any()


def test_nearly_identical_rows_are_joined_without_listing_their_pairs(monkeypatch):
    rng = np.random.default_rng(10)
    clump = (np.ones(16) + 1e-4 * rng.normal(size=(20_000, 16))).astype(np.float32)
    x = np.concatenate([clump, clump[:300] + np.float32(1.0), [np.full(16, 9.0, np.float32)]])
    seen = []
    real = search_pairs.squared_distances
    monkeypatch.setattr(
        search_pairs, "squared_distances", lambda *a: seen.append(len(a[1])) or real(*a)
    )
    labels = clusters_within(x, 0.01)
    assert np.bincount(labels)[[0, 20_000, 20_300]].tolist() == [20_000, 300, 1]
    assert sum(seen) < 40 * len(x)  # of 2e8 pairs


@pytest.mark.slow
def test_two_million_frames_of_an_untouched_gel():
    code = """
import resource
import numpy as np
from palpate.leakage.search import clusters_within, nearest
x = np.broadcast_to(np.linspace(0, 1, 32, dtype=np.float32), (2_000_000, 32)).copy()
x[-1] += 3
found = nearest(x, x, 2, self_join=True)
assert found.index[0].tolist() == [1, 2] and found.index[1].tolist() == [0, 2] and found.index[7].tolist() == [0, 1] and found.index[-1].tolist() == [0, 1]
assert np.bincount(clusters_within(x, 0.1)).tolist()[0] == 1_999_999
x += 1e-5 * np.random.default_rng(0).random(x.shape, dtype=np.float32)
assert np.bincount(clusters_within(x, 0.1)).tolist()[0] == 1_999_999
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 2.5 * 2**20  # KiB; the rows alone are 0.25 GiB


def test_faiss_finds_nearly_all_and_measures_exactly(monkeypatch):
    pytest.importorskip("faiss")
    x = smooth(np.random.default_rng(11), 6000, steps=20)
    group = np.arange(6000) // 20
    for options in ({}, {"query_groups": group, "base_groups": group}):
        exact = nearest(x, x, 2, self_join=True, backend="exact", **options)
        again = [nearest(x, x, 2, self_join=True, backend="faiss", **options) for _ in range(2)]
        assert again[0].backend.startswith("faiss")
        np.testing.assert_array_equal(again[0].index, again[1].index)
        assert (again[0].index == exact.index).mean() > 0.95
        hit = again[0].index == exact.index
        np.testing.assert_array_equal(again[0].distance[hit], exact.distance[hit])
        if options:
            assert (group[again[0].index] != group[:, None]).all()
    monkeypatch.setattr(search, "EXACT_LIMIT", 100)
    assert nearest(x[:50], x, 1).backend.startswith("faiss")
    assert nearest(x, x[:50], 1).backend == "exact"


def test_faiss_reaches_across_a_video_that_fills_its_lists():
    pytest.importorskip("faiss")
    rng = np.random.default_rng(12)
    x = np.concatenate([rng.normal(size=(5000, 8)) * 1e-3, rng.normal(size=(5, 8)) + 50]).astype(
        np.float32
    )
    group = np.r_[np.zeros(5000, int), np.ones(5, int)]
    same(
        nearest(x, x, 2, query_groups=group, base_groups=group, backend="faiss"),
        brute(x, x, 2, group, group),
    )
    found = nearest(x, x, 6, query_groups=group, base_groups=group, backend="faiss")
    assert (found.index[:5000] >= 0).sum(axis=1).tolist() == [5] * 5000


def test_without_faiss_the_error_says_what_to_install(monkeypatch):
    real = builtins.__import__

    def missing(name, *rest, **options):
        if name == "faiss":
            raise ImportError(name)
        return real(name, *rest, **options)

    monkeypatch.setattr(builtins, "__import__", missing)
    x = np.eye(4, dtype=np.float32)
    with pytest.raises(MissingExtraError, match=r"palpate\[faiss\]"):
        nearest(x, x, backend="faiss")
    assert nearest(x, x).backend == "exact"

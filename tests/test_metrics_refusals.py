"""What every metric takes and refuses alike: tensors, names that are missing, and options that are no numbers or out of range."""

import numpy as np
import pytest

from palpate.core import FeatureSet, PalpateError
from palpate.metrics import (
    CITMMD,
    ITMMD,
    Polynomial,
    ci_tmmd,
    contact_scores,
    d_tmmd,
    distance,
    fid,
    four_scores,
    i_tmmd,
    mmd2,
    prdc,
    psnr,
    ssim,
    tmmd,
)
from test_metrics_mmd import unit_rows
from test_metrics_tactile import change, keep, world


@pytest.mark.parametrize("length", [0.5, 0.998, 1.002, 2.0])
def test_rows_too_short_are_refused_as_those_too_long(length):
    x = unit_rows(0, 8, 3)
    x[[2, 5]] *= length
    with pytest.raises(
        PalpateError, match=rf"`x` must be L2-normalized. Got norm {length:.4g} in 2 rows \(2, 5\)"
    ):
        mmd2(x, unit_rows(1, 8, 3))
    with pytest.raises(PalpateError, match=r"L2-normalized.*2 rows \(2, 5\)"):
        i_tmmd(FeatureSet(list("abcdefgh"), x))
    near = unit_rows(0, 8, 3)
    near[[2, 5]] *= 1 + np.sign(length - 1) * 9e-4
    assert np.isfinite(mmd2(near, unit_rows(1, 8, 3)))


def test_features_may_be_tensors_with_a_graph():
    torch = pytest.importorskip("torch")
    g, r = world(0), world(0, draw=1)
    made, real = (
        change(s, features=torch.tensor(s.features, requires_grad=True) * 1.0) for s in (g, r)
    )
    assert made.features.dtype == np.float64
    np.testing.assert_array_equal(made.features, g.features)
    for a, b in zip(four_scores(made, real, floor=real), four_scores(g, r, floor=r), strict=True):
        assert a == b
    assert made.digest == g.digest
    assert [s.value for s in prdc(made, real, 2)] == [s.value for s in prdc(g, r, 2)]
    assert fid(made, real).value == fid(g, r).value


def test_features_may_be_of_bfloat16():
    torch = pytest.importorskip("torch")
    g, r = world(0), world(0, draw=1)
    made, real = (
        change(s, features=torch.tensor(s.features, requires_grad=True).bfloat16()) for s in (g, r)
    )
    bits = np.ascontiguousarray(g.features, dtype=np.float32).view(np.uint32)
    rounded = (
        ((bits + 0x7FFF + ((bits >> 16) & 1)) & 0xFFFF0000).astype(np.uint32).view(np.float32)
    )  # to the nearest even 16 bits
    assert made.features.dtype == np.float32
    np.testing.assert_array_equal(made.features, rounded)
    by_hand = [change(s, features=v.features) for s, v in ((g, made), (r, real))]
    for one, other in zip(
        four_scores(made, real, normalize=True), four_scores(*by_hand, normalize=True), strict=True
    ):
        assert one == other
    for f in (i_tmmd, ci_tmmd, d_tmmd):
        assert f(made, normalize=True).value == pytest.approx(f(g).value, rel=0.1)
    assert tmmd(made, real, normalize=True).value == pytest.approx(tmmd(g, r).value, abs=0.2)


class NAType:
    """What pandas has for a missing value: no comparison of it is true or false."""

    def __eq__(self, other):
        return self

    __ne__ = __eq__
    __hash__ = object.__hash__

    def __bool__(self):
        raise TypeError("boolean value of NA is ambiguous")

    def __str__(self):
        return "<NA>"


MISSING = {
    "None": None,
    "NaN": float("nan"),
    "NumPy's NaN": np.float32("nan"),
    "empty": "",
    "NA": NAType(),
    "NaT": np.datetime64("NaT"),
}


@pytest.mark.parametrize("kind", MISSING)
def test_a_label_that_is_missing_is_no_label(kind):
    s = world(1)
    label = np.array(s.labels, dtype=object)
    label[label == "m1"] = MISSING[kind]
    s = change(s, labels=list(label))
    rest = keep(world(1), np.array(world(1).labels) != "m1")
    for function in (ci_tmmd, d_tmmd):
        score = function(s)
        assert (score.details["classes"], score.details["excluded"]) == (
            ["m0", "m2"],
            {"(no label)": "no label"},
        )
        assert score.value == pytest.approx(function(rest).value, abs=1e-9)
    metric = CITMMD()
    metric.update(s.features, ids=s.ids, labels=list(label), groups=s.groups)
    assert metric.compute().details["classes"] == ["m0", "m2"]


@pytest.mark.parametrize("kind", MISSING)
def test_a_group_that_is_missing_is_refused(kind):
    s = world(1)
    groups = [s.groups[0], MISSING[kind], *s.groups[2:]]
    bad, x = change(s, groups=groups), np.full((len(groups), 8, 8, 3), 0.5)
    for call in (
        lambda: i_tmmd(bad),
        lambda: tmmd(s, bad),
        lambda: mmd2(
            s.features,
            unit_rows(0, 9, 6),
            estimator="grouped",
            groups_x=groups,
            groups_y=s.groups[:9],
        ),
        lambda: fid(bad, s),
        lambda: prdc(s, bad, 2),
        lambda: psnr(x, x + 0.1, groups=groups),
        lambda: ITMMD().update(s.features, groups=groups),
    ):
        with pytest.raises(
            PalpateError, match=r"groups.* must be known for every row. Got none in 1 row \(1\)"
        ):
            call()


def images():
    return np.full((3, 16, 16, 3), 0.5), np.full((3, 16, 16, 3), 0.6)


X, Y, G = unit_rows(0, 8, 3), unit_rows(1, 8, 3), world(2)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda: Polynomial(degree=0),
            "degree of a polynomial kernel must be a whole number from 1 on. Got 0",
        ),
        (
            lambda: Polynomial(degree=2.5),
            "degree of a polynomial kernel must be a whole number from 1 on. Got 2.5",
        ),
        (lambda: Polynomial(degree=True), "whole number from 1 on. Got True"),
        (
            lambda: distance(X, Y, kernel="linear"),
            r"kernel must be a kernel.*Linear\(\). Got 'linear'",
        ),
        (lambda: i_tmmd(G, kernel="linear"), "kernel must be a kernel.*Got 'linear'"),
        (
            lambda: ssim(*images(), level=95),
            r"`level` must lie in \(0, 1\). Got 95. Choose a coverage. E.g. level=0.95",
        ),
        (lambda: psnr(*images(), level=95), "level.*Got 95"),
        (lambda: psnr(*images(), level=95), "level.*Got 95"),
        (lambda: fid(G, G, level=2), "level.*Got 2"),
        (lambda: fid(G, G, blocks=2.5), "`blocks` must be a whole number of at least 2. Got 2.5"),
        (lambda: fid(G, G, blocks=1), "blocks.*at least 2. Got 1"),
        (lambda: prdc(G, G, k=2.5), "`k` must be a whole number of at least 1. Got 2.5"),
        (lambda: prdc(G, G, level=95), "level.*Got 95"),
        (lambda: contact_scores(*images(), images()[0], level=3), "level.*Got 3"),
        (
            lambda: tmmd(G, G, seed=2**70),
            f"`seed` must be a whole number of at least 0. Got {2**70}",
        ),
        (lambda: tmmd(G, G, seed=1.5), "seed.*Got 1.5"),
        (lambda: fid(G, G, seed=-1), "seed.*Got -1"),
        (lambda: tmmd(G, G, level="a"), "level.*Got 'a'"),
        (lambda: ITMMD(level="a"), "level.*Got 'a'"),
        (
            lambda: distance(
                X,
                Y,
                estimator="grouped",
                groups_x=np.array(["a"] * 8),
                groups_y=np.array(["b"] * 8),
            ),
            "Each set must have at least two groups, not all shared. Got 1 and 1 groups. Use estimator",
        ),
    ],
)
def test_options_are_refused_in_words(call, words):
    with pytest.raises(PalpateError, match=words):
        call()


def test_groups_may_be_an_array():
    x, y, gx, gy = X, Y[:6], np.arange(8) % 3, np.arange(6) % 2 + 2
    named = mmd2(
        x, y, estimator="grouped", groups_x=[str(v) for v in gx], groups_y=[str(v) for v in gy]
    )
    assert mmd2(x, y, estimator="grouped", groups_x=gx, groups_y=gy) == named

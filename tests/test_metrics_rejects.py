"""What the metrics reject: a call, and words of its error."""

import math

import numpy as np
import pytest

from palpate.core import FeatureSet, PalpateError
from palpate.metrics import (
    Gaussian,
    Polynomial,
    cmmd,
    compare,
    compare_fid,
    contact_scores,
    d_tmmd,
    fid,
    four_scores,
    i_tmmd,
    kid,
    ms_ssim,
    prdc,
    psnr,
    require_same_ids,
    ssim,
    tmmd,
)
from palpate.metrics.probe import material_accuracy
from palpate.metrics.retrieval import retrieval, unit_rows
from palpate.metrics.streaming import TMMD
from test_metrics_contact import pressed
from test_metrics_images import images
from test_metrics_mmd import LINEAR, mmd2
from test_metrics_mmd import unit_rows as drawn
from test_metrics_tactile import change, without_groups, world

X, Y = drawn(0, 8, 3), drawn(1, 8, 3)
GROUPS = {"estimator": "grouped", "groups": ["a"] * 8, "reference_groups": ["b"] * 8}
G = world(19)
ROWS = np.random.default_rng(7).normal(size=(9, 4))
LETTERS = list("abcdefghi")
A, B = images(4)
EMPTY, REAL = pressed(12)
MADE = pressed(13)[1]
EYE = np.eye(4)


def changed(x, value, *rows):
    """A copy with these rows, of images their first pixel, replaced."""
    x = x.astype(float)
    for row in rows:
        x[(row, 0, 0, 0) if x.ndim == 4 else row] = value
    return x


def rows(x, groups=None, encoder=None, labels=None, start=0):
    """A set of features with numbers for ids."""
    x = np.asarray(x)
    return FeatureSet([str(start + k) for k in range(len(x))], x, labels, groups, encoder)


def labeled(n, classes=3, **columns):
    return rows(np.arange(6.0 * n).reshape(n, 6) % 7, labels=[f"m{k % classes}" for k in range(n)])


DISTANCE = [
    (lambda: mmd2(changed(X, np.nan, 3), X), ["`generated` must be finite", "1 row (3)"]),
    (lambda: mmd2(X, changed(X, np.inf, 1, 6)), ["`reference`", "finite", "2 rows (1, 6)"]),
    (lambda: mmd2(X[:1], X), ["at least 2 rows", "1"]),
    (lambda: mmd2(X[:0], X, estimator="biased"), ["at least 1 rows"]),
    (lambda: mmd2(X, X[:, :2]), ["same width", "3 and 2"]),
    (lambda: mmd2(np.ones((5, 3), int), X), ["floating-point", "int64"]),
    (lambda: mmd2(X[0], X), ["shape (n, d)", "(3,)"]),
    (lambda: mmd2(changed(X, 0.0, 2), X), ["zero vector", "1 row (2)"]),
    (lambda: mmd2(changed(X, 0.0, 2), X, normalize=True), ["zero vector"]),
    (lambda: mmd2(2 * X, X), ["L2-normalized", "norm 2", "8 rows", "normalize=True"]),
    (lambda: mmd2(0.998 * X, X), ["L2-normalized", "norm 0.998"]),
    (lambda: mmd2([[1.0, 0.0], [1.0]], X), ["`generated` must turn into an array"]),
    (lambda: mmd2(X, X, normalize="yes"), ["`normalize`", "'yes'"]),
    (lambda: mmd2(X, X, **{**GROUPS, "groups": None}), ["`groups`", "estimator='grouped'"]),
    (lambda: mmd2(X, Y, **GROUPS), ["two groups", "1 and 1"]),
    (lambda: mmd2(X, Y, **{**GROUPS, "groups": ["a"] * 7}), ["`groups`", "8", "7"]),
    (lambda: mmd2(X, Y, **{**GROUPS, "groups": ["a"] * 7 + [None]}), ["1 row (7)"]),
    (lambda: mmd2(X, X, estimator="best"), ["`estimator`", "best"]),
    (lambda: mmd2(X, X, backend="best"), ["`backend`", "best"]),
    (lambda: mmd2(X, X, scale=math.nan), ["`scale`", "positive"]),
    (lambda: mmd2(X, X, block=1.5), ["`block`", "1.5"]),
    *(
        (lambda s=s: mmd2(X, Y, sigma=s), ["`sigma`", "positive"])
        for s in (0.0, -1, None, "mean", (), (1.0, -1.0), True, math.inf, "10")
    ),
    (lambda: mmd2(X, np.tile(Y[:1], (8, 1)), sigma="median"), ["rows that differ"]),
    (lambda: mmd2(X, Y, kernel="linear"), ["`kernel` must be a kernel", "'linear'"]),
    (lambda: mmd2(X, Y, kernel=Gaussian), ["`kernel` must be a kernel"]),
    (lambda: mmd2(X, Y, backend="moments", kernel=LINEAR), ["one Gaussian", "polynomial"]),
    (lambda: mmd2(X, Y, backend="moments", sigma=(1.0, 2.0)), ["one Gaussian"]),
    (
        lambda: mmd2(X * 1e152, Y * 1e152, kernel=Polynomial(), normalize=False),
        ["Kernel values must be finite", "Normalize the rows"],
    ),
]
TACTILE = [
    (lambda: tmmd(X, Y[:, :2]), ["`generated` and `reference`", "3 and 2"]),
    (lambda: tmmd(2 * X, Y), ["`generated` must be L2-normalized"]),
    (lambda: tmmd(X, "abc"), ["`reference`", "shape"]),
    *(
        (lambda m=m: m(X, Y, groups=["a"] * 3), ["`groups`", "8", "3"])
        for m in (tmmd, kid, cmmd, fid, prdc)
    ),
    (lambda: tmmd(X, Y, labels="a"), ["`labels`", "8", "1"]),
    (lambda: tmmd(X, Y, labels=np.array(8)), ["`labels`", "8"]),
    (lambda: tmmd(X, Y, seed=2**70), ["`seed`", "whole number", str(2**70)]),
    (lambda: i_tmmd(X, sigmaa=3), ["sigmaa", "spelling"]),
    (lambda: i_tmmd(X, permutations=1.5), ["`permutations`"]),
    (lambda: i_tmmd(X, halves="group"), ["`groups`", "halves='group'"]),
    (lambda: tmmd(G, change(G, encoder="f" * 64)), ["one encoder", "e" * 12, "f" * 12]),
    (lambda: four_scores(G, G, floor=change(G, encoder="f" * 64)), ["floor", "one encoder"]),
    (lambda: four_scores(G, G, floor=without_groups(G)), ["floor", "groups"]),
    (lambda: i_tmmd(without_groups(G), halves="group"), ["halves='group'"]),
    (lambda: i_tmmd(without_groups(G), preset="grouped"), ["grouped"]),
    (lambda: tmmd(G, G.features, estimator="grouped"), ["grouped"]),
    (lambda: i_tmmd(change(G, groups=[None, *G.groups[1:]])), ["groups", "1 row (0)"]),
    (lambda: i_tmmd(change(G, features=3 * G.features)), ["L2-normalized", "norm 3"]),
    (lambda: i_tmmd(G, preset="best"), ["preset", "paper-tables"]),
    (lambda: i_tmmd(G, halves="thirds"), ["halves", "ordered"]),
    (lambda: d_tmmd(G, denominator="none"), ["denominator"]),
    (lambda: d_tmmd(G, aggregate="none"), ["aggregate"]),
    (lambda: i_tmmd(G, seed=-1), ["seed"]),
    (lambda: i_tmmd(G, sigma=-1.0), ["sigma"]),
    (lambda: TMMD(preset="best"), ["`preset`"]),
    (lambda: TMMD(keeep="sums"), ["keeep"]),
    (lambda: TMMD().compute(), ["must have generated and real samples", "0 real"]),
]
COMPARED = [
    (lambda: compare({}, Y), ["must hold a generator"]),
    (lambda: compare_fid({}, rows(Y)), ["must hold a generator"]),
    (
        lambda: compare({"a": G, "b": G.take(list(G.ids)[1:])}, G),
        ["ids of 'a' and 'b' must be the same", "1 not in 'b': 'c0v0/000'"],
    ),
    (
        lambda: compare({"a": G, "b": change(G, groups=list(G.groups)[::-1])}, G),
        ["must have the same groups"],
    ),
    (lambda: compare({"a": G, "b": change(G, labels=None)}, G), ["must have the same labels"]),
    (lambda: compare({"a": G, "b": change(G, encoder="f" * 64)}, G), ["one encoder"]),
    (lambda: compare_fid({"a": rows(X), "b": rows(X[:-1])}, rows(Y)), ["1 not in 'b': '7'"]),
    (
        lambda: compare_fid({"a": rows(X, LETTERS[:8]), "b": rows(X, LETTERS[7::-1])}, rows(Y)),
        ["same groups"],
    ),
]
DISTRIBUTIONS = [
    *(
        row
        for m, least in ((fid, 2), (prdc, 6))
        for row in (
            (lambda m=m: m(rows(ROWS), rows(ROWS[:1])), [f"at least {least} rows"]),
            (lambda m=m: m(rows(ROWS[:0]), rows(ROWS)), [f"at least {least} rows"]),
            (
                lambda m=m: m(rows(ROWS), rows(ROWS[:, :3])),
                ["`generated` and `reference` must have the same width"],
            ),
            (lambda m=m: m(rows(ROWS), rows((ROWS * 10).astype(int))), ["floating-point"]),
            (
                lambda m=m: m(rows(ROWS, encoder="a" * 64), rows(ROWS, encoder="b" * 64)),
                ["one encoder"],
            ),
            (
                lambda m=m: m(rows(ROWS, ["v", *[None] * 8]), rows(ROWS, ["v"] * 9)),
                ["known for every row"],
            ),
            (lambda m=m: m(rows(ROWS), rows(changed(ROWS, np.nan, 5))), ["1 row (5: '5')"]),
        )
    ),
    (lambda: prdc(rows(ROWS), rows(ROWS[:5])), ["at least 6 rows"]),
    (lambda: prdc(rows(ROWS), rows(ROWS), 0), ["`k` must be a whole number of at least 1"]),
    (
        lambda: prdc(rows(ROWS, LETTERS), rows(ROWS), grouped=True),
        ["`grouped` must be False without groups"],
    ),
    (
        lambda: prdc(rows(ROWS, LETTERS), rows(ROWS, list("aaaaabcde"))),
        ["5 real rows outside it", "Got 4 outside group 'a'"],
    ),
]
IMAGES = [
    *(
        (lambda m=m, pair=pair, options=options: m(*pair, **options), words)
        for m in (ssim, psnr)
        for pair, options, words in [
            ((A[0], B[0]), {}, ["`generated`", "(n, h, w, 3 or 1)"]),
            ((A[:0], B[:0]), {}, ["n >= 1"]),
            ((A[:5], B), {}, ["pair one to one"]),
            ((A, B[:, :, :20]), {}, ["pair one to one"]),
            ((A.transpose(0, 3, 1, 2), B.transpose(0, 3, 1, 2)), {}, ["channels last"]),
            ((A.astype(int), B), {}, ["uint8", "int64"]),
            ((A, B.astype(np.float32)), {}, ["`reference`", "[0, 1]", "image 0"]),
            ((changed(A / 255, np.nan, 3), B), {}, ["`generated`", "nan", "image 3"]),
            ((changed(A / 255, -0.5, 3), B), {}, ["`generated`", "-0.5", "image 3"]),
            ((A, B), {"groups": ["g"] * 5}, ["groups", "6", "5"]),
            ((A, B), {"ids": ["g"] * 5}, ["ids", "6", "5"]),
            ((A / 127.5 - 1, B / 127.5 - 1), {}, ["[0, 1]", "image 0"]),
            ((A > 0, B), {}, ["uint8", "bool"]),
            (([[1], [1, 2]], B), {}, ["`generated`", "array"]),
        ]
    ),
    (lambda: ssim(A[:, :10], B[:, :10]), ["11 x 11"]),
    (lambda: ms_ssim(A[:, :10], B[:, :10]), ["11 x 11"]),
    *(
        (lambda sets=sets: contact_scores(*sets), words)
        for sets, words in [
            ((changed(MADE, np.nan, 2), REAL, EMPTY), ["`generated`", "image 2"]),
            ((MADE, changed(REAL, np.nan, 2), EMPTY), ["`reference`", "image 2"]),
            ((MADE, REAL, changed(EMPTY, 1.5, 2)), ["`background`", "1.5", "image 2"]),
            ((MADE, REAL, EMPTY[:2]), ["`reference` and `background`", "one to one"]),
            ((MADE[:2], REAL, EMPTY), ["one to one"]),
            ((MADE[:, :40], REAL[:, :40], EMPTY), ["one to one"]),
            ((MADE[:0], REAL[:0], EMPTY[:0]), ["n >= 1"]),
            ((MADE[0], REAL[0], EMPTY[0]), ["shape (n, h, w, 3 or 1)"]),
            ((MADE[:, :10], REAL[:, :10], EMPTY[:, :10]), ["11 x 11", "10 x 48"]),
            (([[1], [1, 2]], REAL, EMPTY), ["`generated`", "array"]),
        ]
    ),
    *(
        (lambda ids=ids: require_same_ids(*ids), words)
        for ids, words in [
            (("ab", "abcdefgh"), ["6 not in generated: 'c', 'd', ", ", 'g' and 1 more"]),
            (("axb", "ab"), ["1 not in reference: 'x'"]),
            (("ax", "ab"), ["1 not in generated: 'b'; 1 not in reference: 'x'"]),
            (("aab", "ab"), ["generated id must be unique. Got 1 repeated: 'a'"]),
            (("ab", "abb"), ["reference id must be unique. Got 1 repeated: 'b'"]),
            (("", "a"), ["1 not in generated: 'a'"]),
            (("", ""), ["Got none"]),
        ]
    ),
]
EMBEDDINGS = [
    (lambda: material_accuracy(labeled(9, 1), labeled(9)), ["two classes"]),
    (
        lambda: material_accuracy(labeled(9), rows(np.ones((9, 6)))),
        ["test features must have rows"],
    ),
    (
        lambda: material_accuracy(labeled(9), rows(np.ones((9, 6)), labels=[""] * 9)),
        ["rows with a label"],
    ),
    (
        lambda: material_accuracy(
            change(labeled(9), encoder="e"), change(labeled(9), encoder="other")
        ),
        ["one encoder"],
    ),
    (lambda: retrieval(rows(EYE), rows(EYE, start=1)), ["same ids"]),
    (lambda: retrieval(rows(EYE), rows(EYE), pool=5), ["`pool` must lie in 2 to 4"]),
    (lambda: retrieval(rows(np.eye(1)), rows(np.eye(1))), ["two samples"]),
    (lambda: retrieval(rows(EYE), rows(np.ones((4, 2)))), ["common space"]),
    *(
        row
        for bad in (changed(EYE, np.nan, 2), changed(EYE, np.inf, 2))
        for row in (
            (lambda x=bad: unit_rows(x), ["features must be finite", "1 row (2)"]),
            (
                lambda x=bad: retrieval(rows(EYE), rows(EYE), texts=x),
                ["texts must be finite", "1 row (2)"],
            ),
        )
    ),
    (lambda: unit_rows(np.full((3, 2), 1e300)), ["finite"]),  # but not in float32
]


@pytest.mark.parametrize(
    ("call", "words"), DISTANCE + TACTILE + COMPARED + DISTRIBUTIONS + IMAGES + EMBEDDINGS
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_bad_input_is_rejected_and_named(call, words):
    with pytest.raises(PalpateError) as caught:
        call()
    assert [word for word in words if word not in str(caught.value)] == []


def test_what_is_nearly_bad_is_taken():
    far = mmd2(X * 1e30, Y * 1e30, kernel=Polynomial(), normalize=False)
    assert math.isfinite(far)
    assert psnr(A[:, :10], B[:, :10]).value is not None
    require_same_ids(reversed("abc"), "abc")

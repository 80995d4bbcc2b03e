"""The public face of palpate.metrics: names, signatures, and what every function takes."""

import inspect
from dataclasses import fields

import numpy as np
import pytest

from palpate import metrics
from palpate.core import FeatureSet
from palpate.metrics import Options, cmmd, fid, kid, prdc, tmmd
from palpate.metrics.mmd import Settings

TWO_SETS, ONE_SET = "generated, reference, **options", "generated, **options"
IMAGES = "generated, reference"

FUNCTIONS = {
    "background_digest": "images",
    "ci_tmmd": ONE_SET,
    "cmmd": TWO_SETS,
    "compare": "generators, reference, *, floor=None, **options",
    "compare_fid": "generators, reference, *, seed=0, split=None",
    "compare_mind": "generators, reference, *, seed=0, split=None",
    "compare_vendi": "generators, reference, *, seed=0, split=None",
    "compare_tmmd": "generators, reference, **options",
    "contact_mask": "tactile, background",
    "contact_scores": f"{IMAGES}, background, **options",
    "d_tmmd": ONE_SET,
    "distance": (
        "generated, reference, *, groups=None, reference_groups=None, block=1024, **options"
    ),
    "fid": TWO_SETS,
    "four_scores": "generated, reference, *, floor=None, **options",
    "i_tmmd": ONE_SET,
    "kid": TWO_SETS,
    "marker_scores": f"{IMAGES}, background, **options",
    "mind": TWO_SETS,
    "ms_ssim": TWO_SETS,
    "per_image": f"metric, {IMAGES}, means=None",
    "prdc": "generated, reference, k=5, **options",
    "psnr": TWO_SETS,
    "require_same_ids": "a, b, names=('generated', 'reference')",
    "ssim": TWO_SETS,
    "tmmd": TWO_SETS,
    "vendi": "features, **options",
}
CLASSES = {"TMMD", "Comparison", "Options", "PerImage"}
KERNELS = {"Gaussian", "Polynomial"}


def signature(function):
    """Names and defaults, without annotations."""
    found = inspect.signature(function)
    bare = [p.replace(annotation=p.empty) for p in found.parameters.values()]
    return str(found.replace(parameters=bare, return_annotation=found.empty))[1:-1]


def test_public_names():
    assert set(metrics.__all__) == {*FUNCTIONS, *CLASSES, *KERNELS, "PRESETS"}
    assert sorted(metrics.__all__) == list(dict.fromkeys(sorted(metrics.__all__)))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_public_signatures(name):
    assert signature(getattr(metrics, name)) == FUNCTIONS[name]


def sets(n=60, m=50, d=6):
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(n, d)) + 0.3, rng.normal(size=(m, d))
    return [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (x, y)]


@pytest.mark.parametrize("metric", [tmmd, kid, cmmd, fid, prdc])
def test_arrays_tensors_lists_and_feature_sets_give_the_same_scores(metric):
    torch = pytest.importorskip("torch")
    x, y = sets()
    groups = [f"v{k // 6}" for k in range(len(x))]
    columns = {"groups": groups, "reference_groups": groups[: len(y)]}

    def values(*pair, **options):
        scores = metric(*pair, **options)
        scores = scores if isinstance(scores, list) else [scores]
        return np.array([(s.value, *(s.interval or (0, 0))) for s in scores])

    rows = [FeatureSet([str(k) for k in range(len(v))], v, None, groups[: len(v)]) for v in (x, y)]
    expected = values(x, y, **columns)
    same = pytest.approx(expected, rel=1e-9)
    assert values(*rows) == same
    assert values(x.tolist(), y.tolist(), **columns) == same
    assert values(torch.tensor(x, requires_grad=True), torch.tensor(y), **columns) == same
    assert values(x, y) != same  # without groups other intervals, at least


def test_kid_is_the_unbiased_polynomial_mmd_of_float32_features_to_many_digits():
    x, y = np.random.default_rng(0).normal(size=(2, 600, 64)).astype(np.float32)
    kernel = lambda a, b: (a.astype(float) @ b.T / 64 + 1) ** 3
    off = lambda k: (k.sum() - np.trace(k)) / (len(k) * (len(k) - 1))
    expected = off(kernel(x, x)) + off(kernel(y, y)) - 2 * kernel(x, y).mean()
    score = kid(x, y)
    assert score.value == pytest.approx(1000 * expected, rel=1e-9)
    assert kid(x, y, scale=1).value == pytest.approx(expected, rel=1e-9)
    assert (score.metric, score.higher_is_better) == ("KID", False)


def test_cmmd_is_the_biased_gaussian_mmd():
    x, y = sets()
    kernel = lambda a, b: np.exp(-((a[:, None] - b[None]) ** 2).sum(-1) / 200)
    expected = kernel(x, x).mean() + kernel(y, y).mean() - 2 * kernel(x, y).mean()
    score = cmmd(x, y)
    assert score.value == pytest.approx(1000 * expected, rel=1e-6)
    assert (score.metric, score.estimator) == ("CMMD", "biased")


def test_an_editor_completes_what_options_are() -> None:
    """The typed keywords of metrics are the fields of the record that holds them."""
    assert [*Settings.__annotations__] == [field.name for field in fields(Options)]

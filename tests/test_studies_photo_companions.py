"""Companions on a photo encoder: named after it, zero for the same images, worse for worse ones."""

import numpy as np
import pytest
import torch

from mini_fixtures import make_encoders
from palpate.encoders.embed import embed_images
from palpate.metrics import fid
from palpate.studies.photo_companions import photo_companions


@pytest.fixture(scope="module")
def encoders():
    return make_encoders()


def test_scores_are_of_the_photo_encoder_and_order_by_noise(encoders):
    rng = np.random.default_rng(0)
    ids, groups = [str(k) for k in range(24)], [f"v{k // 4}" for k in range(24)]
    real = rng.integers(0, 256, (24, 16, 16, 3), dtype=np.uint8)
    near = np.clip(real.astype(int) + rng.integers(-4, 5, real.shape), 0, 255).astype(np.uint8)
    far = np.full_like(real, 90)
    scores = photo_companions(
        {"near": near, "far": far, "same": real}, real, encoders, ids=ids, groups=groups, name="x"
    )
    by = {(s.metric, s.subject): s for s in scores}
    for metric in ("FID (x vision)", "CMMD (x vision)", "patch distance (x vision)"):
        assert by[metric, "same"].value == pytest.approx(0, abs=1e-4), metric
        assert by[metric, "near"].value < by[metric, "far"].value, metric
        assert by[f"{metric} difference", "near - far"].details["better"] == "near"
        assert by[metric, "far"].encoder == encoders.digest("vision")
    x, y = (embed_images(images, encoders, "vision") for images in (far, real))
    assert by["FID (x vision)", "far"].value == pytest.approx(fid(x, y).value, rel=1e-3, abs=1e-4)


def test_the_distance_of_patches_is_that_of_states_one_by_one(encoders):
    rng = np.random.default_rng(1)
    x, y = rng.integers(0, 256, (2, 3, 16, 16, 3), dtype=np.uint8)
    scores = photo_companions({"x": x}, y, encoders, ids=["a", "b", "c"], groups=None, name="x")
    made = next(s for s in scores if s.metric.startswith("patch"))

    def states(image):
        pixels = torch.from_numpy(image[None]).permute(0, 3, 1, 2).float() / 255
        with torch.inference_mode():
            rows = encoders.states("vision", encoders.preprocess("vision")(pixels), 16)[0]
        return (rows / rows.norm(dim=1, keepdim=True)).numpy()

    want = [((states(a) - states(b)) ** 2).sum(axis=1).mean() for a, b in zip(x, y, strict=True)]
    assert made.value == pytest.approx(np.mean(want), rel=1e-4)

"""Zero-shot classification against a class-by-class loop."""

import numpy as np
import pytest
from mini_scores import zero_shot_accuracy

from forge.models import make_encoders
from palpate.core import FeatureSet

PROMPTS = {
    "Cloth": ["a soft cloth"],
    "Metal": ["smooth cold metal", "cold"],
    "Wall": ["a rough wall", "rough", "wall"],
}


@pytest.fixture(scope="module")
def encoders():
    return make_encoders()


def features(labels, seed=0, groups=None):
    rows = np.random.default_rng(seed).standard_normal((len(labels), 8)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return FeatureSet([f"s{k}" for k in range(len(labels))], rows, labels, groups, "encoder")


def slow_accuracy(images, encoders):
    right = 0
    for row, label in zip(images.features, images.labels, strict=True):
        best, chosen = -2.0, None
        for name, texts in PROMPTS.items():
            mean = sum(encoders.encode("text", [text])[0].double().numpy() for text in texts) / len(
                texts
            )
            cosine = float(row @ mean / np.sqrt((mean**2).sum()))
            if cosine > best:
                best, chosen = cosine, name
        right += chosen == label
    return right / len(images.labels)


def test_it_equals_a_loop_over_images_classes_and_texts(encoders):
    labels = [sorted(PROMPTS)[k % 3] for k in range(60)]
    images = features(labels, groups=[f"v{k // 6}" for k in range(60)])
    score = zero_shot_accuracy(images, PROMPTS, encoders)
    assert score.value == pytest.approx(slow_accuracy(images, encoders))
    assert 0.1 < score.value < 0.9
    assert score.details["chance"] == pytest.approx(1 / 3)
    assert score.interval[0] < score.value < score.interval[1]


def test_images_that_are_their_text_are_all_named(encoders):
    rows = np.stack([encoders.encode("text", PROMPTS[name])[0].numpy() for name in sorted(PROMPTS)])
    images = FeatureSet(["a", "b", "c"], rows, sorted(PROMPTS), None, "encoder")
    prompts = {name: texts[:1] for name, texts in PROMPTS.items()}
    assert zero_shot_accuracy(images, prompts, encoders).value == 1.0
    moved = FeatureSet(["a", "b", "c"], rows[[1, 2, 0]], sorted(PROMPTS), None, "encoder")
    assert zero_shot_accuracy(moved, prompts, encoders).value == 0.0

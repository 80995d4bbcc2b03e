"""Zero-shot classification: the class whose texts are nearest (Radford et al. 2021, 3.1).

Each class has a few texts ("this is gravel", ...). Their embeddings t, each of length 1, make its
prototype p_c = mean(t) / ||mean(t)||; the image embedding v gets the class with the largest v.p_c.
Nothing is trained.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from palpate.core import FeatureSet, PalpateError, Score
from palpate.encoders.embed import embed_texts
from palpate.encoders.encoder_set import EncoderSet
from palpate.metrics.means import mean_of
from palpate.metrics.probe import recall_by_class


def zero_shot_accuracy(
    images: FeatureSet,
    prompts: Mapping[str, Sequence[str]],
    encoders: EncoderSet,
    *,
    subject: str = "real",
    split: str | None = None,
) -> Score:
    """Accuracy of naming the class of images by text alone.

    Args:
        images: embeddings of one encoder (n, d) with labels, and groups for the interval.
        prompts: class -> at least one text; every label must be a class.
        encoders: whose text encoder embeds the prompts.
        subject: what is scored, for the score.
        split: digest, for the score.

    Returns:
        A score in [0, 1]; ``details`` holds chance (1 / classes) and recall by class, ``settings``
        the prompts.

    Raises:
        PalpateError: on an image without label, a label without prompts, or fewer than two classes
            with texts.
    """
    labels, classes = [str(label) for label in images.labels or ()], sorted(prompts)
    if not labels or "" in labels:
        must, got = "Zero-shot classification needs a label for every image", "images without"
        raise PalpateError(must, got, "Skip these")
    if len(classes) < 2 or not all(prompts.values()):
        must, got = "must hold at least two classes, each with a text", f"{len(classes)} classes"
        raise PalpateError(must, got, "Pass more prompts", argument="prompts")
    if unknown := sorted(set(labels) - set(classes)):
        must, got = "must hold every label", f"{len(unknown)} labels missing, first {unknown[0]!r}"
        raise PalpateError(must, got, "Add its texts", argument="prompts")
    embedded = (embed_texts(prompts[c], encoders).astype(np.float64) for c in classes)
    means = np.stack([rows.mean(axis=0) for rows in embedded])
    prototypes = means / np.linalg.norm(means, axis=1, keepdims=True)
    chosen = (images.features.astype(np.float64) @ prototypes.T).argmax(axis=1)
    hit = np.array([classes[k] == label for k, label in zip(chosen, labels, strict=True)], float)
    return mean_of(
        "zero-shot accuracy",
        hit,
        list(images.groups if images.groups is not None else images.ids),
        estimator="mean",
        subject=subject,
        split=split,
        encoder=images.encoder,
        settings={
            "prompts": {c: list(prompts[c]) for c in classes},
            "text": encoders.digest("text"),
        },
        details={"chance": 1 / len(classes), "recall": recall_by_class(hit, labels)},
    ).score

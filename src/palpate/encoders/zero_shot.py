"""Zero-shot classification: an image takes the class whose texts lie nearest to it (Radford et al. 2021, section 3.1).

Each class has a few texts ("this is gravel", ...). Their embeddings t, each of length 1, make its prototype p_c = mean(t) / ||mean(t)||; the image
embedding v gets the class with the largest v.p_c. Nothing is trained.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from palpate.core import FeatureSet, PalpateError, Score
from palpate.encoders.embed import embed_texts
from palpate.encoders.encoder_set import EncoderSet
from palpate.metrics.probe import mean_over_groups, recall_by_class


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
        A score in [0, 1]; ``details`` holds chance (1 / classes), recall by class, and the prompts' number.

    Raises:
        PalpateError: without labels, on a label without prompts, a class without a text, or fewer than two classes.
    """
    labels = list(images.labels or ())
    if not labels or "" in labels:
        raise PalpateError(
            "Zero-shot classification needs a label for every image",
            f"{labels.count('') or 'all'} without",
            "Leave these out",
        )
    classes = sorted(prompts)
    if len(classes) < 2 or any(not prompts[name] for name in classes):
        raise PalpateError(
            "There must be at least two classes, each with a text",
            f"{len(classes)} classes",
            "Pass more prompts",
        )
    if unknown := sorted({str(label) for label in labels} - set(classes)):
        raise PalpateError(
            "Every label must be a class with prompts",
            f"{len(unknown)} that are not, first {unknown[0]!r}",
            "Add its texts",
        )
    prototypes = np.stack(
        [
            _unit(embed_texts(prompts[name], encoders).astype(np.float64).mean(axis=0))
            for name in classes
        ]
    )
    named = [classes[k] for k in (images.features.astype(np.float64) @ prototypes.T).argmax(axis=1)]
    hit = np.array([a == b for a, b in zip(named, labels, strict=True)], dtype=float)
    groups = list(images.groups) if images.groups is not None else list(images.ids)
    return mean_over_groups(
        "zero-shot accuracy",
        hit,
        groups,
        estimator="mean",
        subject=subject,
        split=split,
        encoder=images.encoder,
        settings={
            "prompts": {name: list(prompts[name]) for name in classes},
            "text": encoders.digest("text"),
        },
        details={"chance": 1 / len(classes), "recall": recall_by_class(hit, labels)},
    )


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x)

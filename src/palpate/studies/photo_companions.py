"""FID, CMMD and a distance of patches on the photo encoder of a set: stand-ins that say so.

The paper's FID, CMMD and LPIPS are of networks trained on photos (Inception, CLIP, AlexNet), whose
weights are not always there. On the world the vision encoder of ``palpate/mini`` takes their place:
it, too, was trained on photos and never on touch. Names say it: ``FID (palpate/mini vision)``,
``CMMD (palpate/mini vision)`` and, in place of LPIPS, ``patch distance (palpate/mini vision)``, the
mean over patches p of ``||a_p - b_p||^2`` of last states of unit length (as LPIPS, unweighted).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, Progress, Score, quiet
from palpate.encoders.embed import embed_images, exact
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.preprocess import to_unit
from palpate.evaluation.companions import Features, score_features
from palpate.metrics import mean_score
from palpate.metrics.paired import mean_differences

Images = NDArray[np.uint8]
#: Patches of the distance, of which a row and a column hold the root.
PATCHES = 16


def photo_companions(
    generators: Mapping[str, Images],
    reference: Images,
    encoders: EncoderSet,
    *,
    ids: Sequence[str],
    groups: Sequence[str] | None,
    name: str = "palpate/mini",
    split: str | None = None,
    progress: Progress = quiet,
) -> list[Score]:
    """Scores of each generator, and their paired differences.

    Args:
        generators: name -> (n, h, w, 3), in the order of the reference.
        reference: (n, h, w, 3) real tactile images.
        encoders: whose vision encoder gives the features.
        ids: of the n samples.
        groups: their videos, or None.
        name: of the encoders, in the metrics' names.
        split: digest of the split, kept in the scores.
        progress: progress callback.

    Raises:
        PalpateError: on other shapes, or encoders without vision.
    """
    digest = encoders.digest("vision")

    def features_of(images: Images) -> FeatureSet:
        x = embed_images(images, encoders, "vision", progress=progress)
        return FeatureSet(list(ids), x, None, None if groups is None else list(groups), digest)

    options = {"backend": "auto", "permutations": 0, "normalize": "check"}
    features = Features(
        {method: features_of(images) for method, images in generators.items()},
        {},
        features_of(reference),
        True,
        f"{name} vision",
        {"seed": 0, "split": split},
        options,
    )
    outcome = score_features(["fid", "cmmd"], features, False, progress)
    values = {n: patch_distances(x, reference, encoders) for n, x in generators.items()}
    common: dict[str, Any] = {"higher_is_better": False, "encoder": digest, "split": split}
    scores = {
        method: mean_score(
            f"patch distance ({name} vision)", v, ids=ids, groups=groups, subject=method, **common
        )
        for method, v in values.items()
    }
    between = mean_differences(scores, values, groups) if len(scores) > 1 else []
    return [*outcome.scores, *scores.values(), *outcome.differences, *between]


def patch_distances(images: Images, reference: Images, encoders: EncoderSet) -> NDArray[np.float64]:
    """The distance of patches (n,) of each pair of images (n, h, w, 3); 0: equal."""
    x, y = (_patches(pair, encoders).astype(np.float64) for pair in (images, reference))
    return ((x - y) ** 2).sum(axis=2).mean(axis=1)


def _patches(images: Images, encoders: EncoderSet, batch: int = 128) -> NDArray[np.float32]:
    """States (n, PATCHES, width) of unit length."""
    preprocess, states = encoders.preprocess("vision"), list[NDArray[np.float32]]()
    for start in range(0, len(images), batch):
        squares = preprocess.fit(images[start : start + batch])
        with exact():
            pixels = preprocess(to_unit(squares, encoders.device))
            states.append(encoders.states("vision", pixels, PATCHES).float().cpu().numpy())
    x = np.concatenate(states)
    return x / np.maximum(np.linalg.norm(x, axis=2, keepdims=True), 1e-12)

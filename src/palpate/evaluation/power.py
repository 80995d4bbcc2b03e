"""How often TMMD tells two classes apart, by the number of recordings on each side.

For two classes of a label, n recordings are drawn from each, and the permutation test of TMMD over
whole recordings compares them; its power is the share of draws with p <= .05. Each class must have
2 n recordings, or the draws would be one and the same; the interval is over draws, of these
recordings. All encoders see the same draws, so that their difference is paired. A recording with
both classes is in neither.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from palpate.core import FeatureSet, Progress, rng_for
from palpate.metrics import tmmd
from palpate.metrics.means import Mean, mean_of
from palpate.metrics.retrieval import standardized

#: Recordings on each side.
SIZES = (5, 10, 20, 40)
#: Draws of each size, over all pairs of classes in turn.
DRAWS = 60
#: Relabelings of a test, and the p from which classes count as told apart.
PERMUTATIONS, ALPHA = 199, 0.05


def power(
    sets: Mapping[str, FeatureSet],
    label: str,
    *,
    rulers: Sequence[str] = (),
    seed: int = 0,
    progress: Progress,
    **fields: Any,
) -> dict[str, list[Mean]]:
    """Power of TMMD between the classes of a label.

    Args:
        sets: encoder -> features (n, d) of the same samples, with labels ('' where unknown) and
            groups, the recordings.
        label: the column of the labels.
        rulers: encoders whose features are standardized by one side, as in ``score``.
        seed: of the draws.
        progress: called with each draw.
        **fields: further fields of the scores.

    Returns:
        Encoder -> power for each of :data:`SIZES` that some two classes have twice.
    """
    first = next(iter(sets.values()))
    labels, groups = np.array(first.labels), np.array(first.groups or first.ids)
    units = {name: np.unique(groups[labels == name]) for name in np.unique(labels) if name}
    pairs = [
        (np.setdiff1d(units[a], units[b]), np.setdiff1d(units[b], units[a]))
        for a, b in combinations(units, 2)
    ]
    result: dict[str, list[Mean]] = {name: [] for name in sets}
    for size in SIZES:
        enough = [pair for pair in pairs if min(map(len, pair)) >= 2 * size]
        hits: dict[str, list[bool]] = {name: [] for name in sets}
        for draw in range(DRAWS if enough else 0):
            rng = rng_for(seed, "power", f"{label} {size} {draw}")
            pair = enough[draw % len(enough)]
            sides = [np.isin(groups, rng.choice(side, size, replace=False)) for side in pair]
            for name, features in sets.items():
                x, y = (features.features[side] for side in sides)
                x, y = standardized([x, y], y)[0] if name in rulers else (x, y)
                test = tmmd(
                    x,
                    y,
                    groups=groups[sides[0]].tolist(),
                    reference_groups=groups[sides[1]].tolist(),
                    preset="grouped",
                    permutations=PERMUTATIONS,
                    seed=draw,
                )
                hits[name].append(test.details["p_value"] <= ALPHA)
            progress(f"power, {label}, {size} recordings", draw + 1, DRAWS)
        for name, hit in hits.items() if enough else ():
            mean = mean_of(
                f"power of TMMD, {size} recordings a side",
                np.array(hit),
                [f"draw {k}" for k in range(DRAWS)],
                subject=name,
                features=label,
                encoder=sets[name].encoder,
                seed=seed,
                details={"pairs of classes": len(enough), "chance": ALPHA},
                **fields,
            )
            result[name].append(mean)
    return result

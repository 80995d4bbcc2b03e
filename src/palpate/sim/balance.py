"""How many objects each material has.

``balance="uniform"``: the same number each. ``balance="touch-and-go"``: classes as unequal as the frames of Touch and Go, whose official lists
``train.txt`` and ``test.txt`` (Yang et al., 2022; github.com/fredfyyang/Touch-and-Go) hold 121,861 frames: 23 % of them are synthetic fabric, 0.2 % sand. A
material has max(2, total * its share) objects, the total being ``objects_per_material`` times the number of materials; what the least of two adds
is taken from the others in proportion.
"""

from __future__ import annotations

from palpate.sim.options import WorldOptions

#: Frames of each class in both official lists together. Natural fabric has none there.
TOUCH_AND_GO_FRAMES = {
    "Concrete": 18_047,
    "Plastic": 6_001,
    "Glass": 1_458,
    "Wood": 21_846,
    "Metal": 10_633,
    "Brick": 7_337,
    "Tile": 3_068,
    "Leather": 2_730,
    "Synthetic Fabric": 28_010,
    "Natural Fabric": 0,
    "Rubber": 330,
    "Paper": 2_389,
    "Tree": 1_782,
    "Grass": 5_837,
    "Soil": 1_628,
    "Rock": 7_787,
    "Gravel": 775,
    "Sand": 223,
    "Plants": 1_441,
    "Others": 539,
}
#: Objects that a material has at least, so that train and test can both have one.
LEAST = 2


def objects_of(options: WorldOptions) -> dict[str, int]:
    """Material -> number of objects with videos of their own, in the order of ``options.names``.

    A material that Touch and Go does not know (a user's) has the mean share.
    """
    names = options.names
    known = [TOUCH_AND_GO_FRAMES[name] for name in names if name in TOUCH_AND_GO_FRAMES]
    if options.balance == "uniform" or not sum(known):
        return dict.fromkeys(names, options.objects_per_material)
    mean = sum(known) / len(known)
    frames = {name: float(TOUCH_AND_GO_FRAMES.get(name, mean)) for name in names}
    return _shared(frames, options.objects_per_material * len(names))


def _shared(weights: dict[str, float], total: int) -> dict[str, int]:
    """Whole numbers of at least ``LEAST`` in proportion to ``weights`` that sum to ``total`` >= LEAST * len(weights)."""
    small: set[str] = set()
    while True:
        rest = total - LEAST * len(small)
        scale = rest / (
            sum(w for name, w in weights.items() if name not in small) or 1.0
        )  # 1.0: all are small
        more = {name for name, w in weights.items() if name not in small and w * scale < LEAST}
        if not more:
            break
        small |= more
    exact = {name: float(LEAST) if name in small else w * scale for name, w in weights.items()}
    counts = {name: int(value) for name, value in exact.items()}
    by_remainder = sorted(
        exact, key=lambda name: counts[name] - exact[name]
    )  # the largest remainder first, ties in the given order
    for name in by_remainder[: total - sum(counts.values())]:
        counts[name] += 1
    return counts

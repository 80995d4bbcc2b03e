"""Captions made from the name of a material, or of what else is known, for data without words.

``caption`` draws three adjectives of the material and a template from (seed, sample id), so a
sample has one caption whatever the order. The words are about touch alone: no color, no light. Such
captions say no more than the label does; a score that uses them measures the label.
"""

from __future__ import annotations

from palpate.core import rng_for

#: Column -> what a caption is of, for a sample without a text: the first of these that it has.
NAMED = ("material", "object", "video", "id")
#: What each of the Touch and Go materials feels like.
ADJECTIVES: dict[str, tuple[str, ...]] = {
    "Concrete": ("hard", "rough", "gritty", "abrasive", "cold", "solid"),
    "Plastic": ("smooth", "firm", "slick", "even", "lightly textured"),
    "Glass": ("hard", "smooth", "slippery", "flat", "cold"),
    "Wood": ("firm", "grained", "dry", "ridged", "slightly rough"),
    "Metal": ("hard", "cold", "smooth", "rigid", "dense"),
    "Brick": ("hard", "coarse", "gritty", "porous", "abrasive"),
    "Tile": ("hard", "smooth", "flat", "cold", "evenly grooved"),
    "Leather": ("supple", "finely grained", "smooth", "pliable", "slightly tacky"),
    "Synthetic Fabric": ("soft", "woven", "even", "slightly slick", "flexible"),
    "Natural Fabric": ("soft", "fibrous", "woven", "yielding", "slightly fuzzy"),
    "Rubber": ("elastic", "grippy", "yielding", "tacky", "dense"),
    "Paper": ("thin", "smooth", "dry", "flat", "crisp"),
    "Tree": ("rough", "craggy", "ridged", "furrowed", "hard"),
    "Grass": ("soft", "bladed", "springy", "thin", "moist"),
    "Soil": ("crumbly", "soft", "loose", "grainy", "moist"),
    "Rock": ("hard", "rugged", "uneven", "cold", "rough"),
    "Gravel": ("lumpy", "loose", "hard", "pebbly", "uneven"),
    "Sand": ("grainy", "loose", "fine", "gritty", "yielding"),
    "Plants": ("soft", "leafy", "flexible", "veined", "delicate"),
    "Others": ("irregular", "mixed", "uneven", "textured"),
}
TEMPLATES = (
    "{0}, {1} and {2} to the touch",
    "something that feels {0}, {1} and {2}",
    "it feels {0} and {1}, and rather {2}",
    "pressing on it feels {0}, {1}, {2}",
    "{a} {0}, {1}, {2} surface",
)
#: Templates for materials without adjectives.
UNKNOWN = (
    "{} to the touch",
    "something that feels like {}",
    "it feels like {}",
    "pressing on {}",
    "a surface of {}",
)


def caption(material: str, sample_id: str, seed: int = 0) -> str:
    """Write a caption of how a sample of a material feels.

    Args:
        material: any name; the 20 Touch and Go materials (in any case) have adjectives, others are
            named.
        sample_id: the sample; equal ids get equal captions.
        seed: of the draw.
    """
    name = next((n for n in ADJECTIVES if n.lower() == material.strip().lower()), None)
    rng = rng_for(seed, "caption", sample_id)
    if name is None:
        return UNKNOWN[int(rng.integers(len(UNKNOWN)))].format(" ".join(material.split()))
    words = [ADJECTIVES[name][k] for k in rng.permutation(len(ADJECTIVES[name]))[:3]]
    template = TEMPLATES[int(rng.integers(len(TEMPLATES)))]
    return template.format(*words, a="an" if words[0][0] in "aeiou" else "a")

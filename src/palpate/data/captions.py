"""Captions made from a material's name, for data that has labels but no words.

``caption`` draws three adjectives of the material and a sentence form from (seed, sample id), so a sample has one caption
whatever the order. The words are about touch alone: no color, no light. Such captions carry nothing but the label; a
score that uses them measures the label, which :data:`TEXT_FROM_TEMPLATE` says for reports.
"""

from __future__ import annotations

from palpate.core import PalpateError, rng_for

TEXT_FROM_TEMPLATE = (
    "The captions were made from material labels by fixed templates: they say no more than the label does, and two samples of "
    "one material may carry the same words."
)

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
NAMED = (
    "{name}: {0}, {1} and {2} to the touch",
    "{name} that feels {0}, {1} and {2}",
    "touching {name}, which feels {0} and {1}, and rather {2}",
    "pressing on {name} feels {0}, {1}, {2}",
    "the {0}, {1}, {2} surface of {name}",
)


def caption(material: str, sample_id: str, seed: int = 0, with_name: bool = False) -> str:
    """A touch caption for a sample of a material.

    Args:
        material: one of the 20 Touch and Go materials, in any case.
        sample_id: the sample; equal ids get equal captions.
        seed: of the draw.
        with_name: name the material too.

    Raises:
        PalpateError: for a material without words.
    """
    known = {name.lower(): name for name in ADJECTIVES}
    name = known.get(material.strip().lower())
    if name is None:
        raise PalpateError(
            "A caption can be made for these materials: " + ", ".join(ADJECTIVES),
            repr(material),
            "Give the samples a text column instead",
        )
    rng = rng_for(seed, "caption", sample_id)
    words = [ADJECTIVES[name][k] for k in rng.permutation(len(ADJECTIVES[name]))[:3]]
    forms = NAMED if with_name else TEMPLATES
    article = "an" if words[0][0] in "aeiou" else "a"
    return forms[int(rng.integers(len(forms)))].format(
        *words, a=article, name="another material" if name == "Others" else name.lower()
    )

"""Names in the tables of a study (splits, methods, controls, metrics), and of its stages."""

import re

#: The data set's own split, and ours.
ORIG, NOLEAK = "Orig", "NoLeak"
SPLITS = (ORIG, NOLEAK)

#: The paper's training, driven at test time by the photo in the place of the text.
OURS = "Ours"
GVST, BEST = "GVST", "best"
#: Behind the paper's kind of autoencoder, which is not given the gel; with it and without.
VQ, BACKGROUND = "Ours, VQ", "Ours w/ BG"
#: What ``palpate generate`` uses without a model.
SHIPPED = "palpate/mini"

#: Real images of other videos: the score that no generator needs to beat.
FLOOR = "real, other videos"
#: The control that retrieves instead of generating.
NEAREST = "real, nearest photo"
EMPTY, MEAN, WRONG = "empty background", "mean image", "real, wrong material"
CEILING, ONE, MEMORIZED = "reconstruction", "one image for all", "one video a material"
#: One half of a generator's images against the other half.
HALVES = "halves of Ours"
#: Real test images, named by the probes that name the images of the nearest photos.
HALF_PROBES = "real, by half probes"

MATERIAL = "material accuracy"

#: Materials that feel different: with all twenty, minutes of training stay close to chance.
TEN = (
    *("Wood", "Brick", "Tile", "Leather", "Synthetic Fabric"),
    *("Rubber", "Tree", "Grass", "Gravel", "Sand"),
)


def slug(name: str) -> str:
    """A name as part of a folder's name: ``Ours w/ BG`` -> ``ours-w-bg``."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def images_node(method: str, split: str, seed: int | None = None) -> str:
    """The stage of a method's images; those of another system have no seed."""
    return f"images-{slug(method)}-{split}" + ("" if seed is None else f"-{seed}")


def scores_node(split: str, judge: str, seed: int) -> str:
    """The stage of what the encoder of ``judge`` says of the images of ``split``."""
    return f"scores-{split}-by-{judge}-{seed}"

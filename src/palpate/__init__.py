"""palpate: tactile images from photos, splits that do not leak, scores with intervals.

::

    import palpate as pp

    pp.audit("train.txt", "test.txt")                        # does this split leak?
    pp.split(pp.load("tag/"), by="video")                    # one that does not
    pp.score("generated/", "real/", encoder="palpate/mini")  # how good are these tactile images?
    pp.TactilePipeline.from_pretrained("palpate/mini")(photo).images[0]

Every name is imported on first use: ``import palpate`` itself loads neither torch nor polars.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from palpate._lazy import import_name
from palpate._version import __version__ as __version__

if TYPE_CHECKING:
    from palpate.captions import caption
    from palpate.core import Score, Split
    from palpate.data import Manifest, load, validate
    from palpate.diffusion import TactilePipeline, generate, train_autoencoder, train_generator
    from palpate.encoders import Encoder, train_encoder
    from palpate.evaluation import audit, probe, score
    from palpate.leakage import split
    from palpate.report import Results
    from palpate.sim import World

#: Public name -> the room that holds it.
_MODULES = {
    "Encoder": "encoders",
    "Manifest": "data",
    "Results": "report",
    "Score": "core",
    "Split": "core",
    "TactilePipeline": "diffusion",
    "World": "sim",
    "audit": "evaluation",
    "caption": "captions",
    "generate": "diffusion",
    "load": "data",
    "probe": "evaluation",
    "score": "evaluation",
    "split": "leakage",
    "train_encoder": "encoders",
    "train_autoencoder": "diffusion",
    "train_generator": "diffusion",
    "validate": "data",
}

__all__ = [
    "Encoder",
    "Manifest",
    "Results",
    "Score",
    "Split",
    "TactilePipeline",
    "World",
    "audit",
    "caption",
    "generate",
    "load",
    "probe",
    "score",
    "split",
    "train_autoencoder",
    "train_encoder",
    "train_generator",
    "validate",
]

__getattr__ = partial(import_name, __name__, _MODULES)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]

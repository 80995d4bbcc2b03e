"""Controls: images that no generator made, scored as if one had.

=====================  ===========================================================================
control                for each test sample
=====================  ===========================================================================
real, other videos     an image of the train video that stands for its own: the floor of TMMD
real, wrong material   the same of a train video of another material
empty background       its no-contact image (paper, section 1: scores of pixels reward it)
mean image             the mean of all train images
real, nearest photo    the real image of the train photo most similar to its photo
reconstruction         its real image through the autoencoder: the ceiling
one image for all      one real train image: a generator that collapsed
one video a material   images of one train video of its material: memorized
=====================  ===========================================================================

Each test video and material has *one* train video of this material, with as many frames of it
(:func:`palpate.evaluation.controls.matched_rows`): such images are of videos, as real ones are, so
that I-, CI- and D-TMMD have something to find. Without materials any other video will do, there is
no wrong material, and one video stands for all. A control that the data do not allow is left out,
as are these two where a split leaks all videos.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import rng_for
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import BackgroundAutoencoder, load_autoencoder
from palpate.encoders.embed import embed
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.evaluation.controls import matched_rows
from palpate.studies.graph import Work
from palpate.studies.methods import Images, Make, Rows, Setting
from palpate.studies.names import CEILING, EMPTY, FLOOR, MEAN, MEMORIZED, NEAREST, ONE, WRONG


def _columns(setting: Setting, name: str) -> tuple[NDArray[Any], NDArray[Any]]:
    """A column of train and of test, '' where unknown."""
    parts = (setting.train.column(name), setting.test.column(name))
    train, test = (np.array(["" if v is None else str(v) for v in part]) for part in parts)
    return train, test


def _matched(setting: Setting, wanted: Sequence[str] | None = None) -> Rows | None:
    """Whole train videos of the materials of the test videos, or of those that are wanted."""
    (materials, own), (videos, video) = (_columns(setting, c) for c in ("material", "video"))
    test = own if wanted is None else wanted, video
    return matched_rows((materials, videos), test, setting.seed)


def other_videos(setting: Setting) -> Rows | None:
    """Whole train videos in the place of the test videos; None if train lacks a material."""
    return _matched(setting)


def wrong_material(setting: Setting) -> Rows | None:
    """Whole train videos of another material than the test video's; None without two materials."""
    materials, own = _columns(setting, "material")
    names = sorted({*materials} - {""})
    if len(names) < 2:
        return None
    wrong: list[str] = []
    for m, video in zip(own, _columns(setting, "video")[1], strict=True):
        rng = rng_for(setting.seed, "control", "wrong", m, video)
        wrong.append(_drawn(rng, [name for name in names if name != m]))
    return _matched(setting, wrong)


def empty_background(setting: Setting) -> Images:
    """The no-contact images."""
    return setting.pixels(setting.test, "background")


def mean_image(setting: Setting) -> Images:
    """The mean of the train images, for all."""
    mean = setting.pixels(setting.train).mean(axis=0, dtype=np.float64).round().astype(np.uint8)
    return np.broadcast_to(mean, (len(setting.test), *mean.shape))


def nearest_photo(setting: Setting) -> Rows:
    """The real tactile images of the train photos most similar to the test photos."""
    encoders = load_clip(setting.clip, device=setting.work.device)
    return nearest_rows(setting.train, setting.test, encoders, setting.work)


def nearest_rows(
    train: Manifest, test: Manifest, encoders: EncoderSet, work: Work
) -> NDArray[np.intp]:
    """For each test sample the row of the train photo most similar to its photo (cosine)."""
    photos, queries = (
        np.asarray(
            embed(
                part, encoders, "vision", cache=work.cache, still=True, progress=work.progress
            ).features
        )
        for part in (train, test)
    )
    return (queries @ photos.T).argmax(axis=1)


def reconstruction(setting: Setting) -> Images:
    """The real test images through the autoencoder."""
    assert setting.autoencoder is not None
    model, real = load_autoencoder(setting.autoencoder), np.asarray(setting.pixels(setting.test))
    if isinstance(model, BackgroundAutoencoder):
        gels = setting.pixels(setting.test, "background")
        return model.decode(model.encode(real, gels), gels)
    return model.decode(model.encode(real))


def one_image(setting: Setting) -> Rows:
    """One real train image, for all."""
    row = int(rng_for(setting.seed, "control", "one").integers(len(setting.train)))
    return np.full(len(setting.test), row)


def memorized(setting: Setting) -> Rows | None:
    """Images of one train video of the sample's material; None if train lacks a material."""
    (materials, material), (videos, video) = (_columns(setting, c) for c in ("material", "video"))
    frames: dict[str, NDArray[np.intp]] = {}
    for name in sorted({*material}):
        choice = {*videos[materials == name]}
        if not choice:
            return None
        rng = rng_for(setting.seed, "control", "one video", name)
        one = _drawn(rng, sorted(choice - {*video} or choice))
        frames[name] = np.flatnonzero((materials == name) & (videos == one))
    rows: list[int] = []
    for i, m in zip(setting.test.ids, material, strict=True):
        rng = rng_for(setting.seed, "control", "memorized", i)
        rows.append(int(rng.choice(frames[m])))
    return np.array(rows)


def _drawn(rng: np.random.Generator, names: Sequence[str]) -> str:
    return names[int(rng.integers(len(names)))]


CONTROLS: Mapping[str, Make] = {
    FLOOR: other_videos,
    WRONG: wrong_material,
    EMPTY: empty_background,
    MEAN: mean_image,
    NEAREST: nearest_photo,
    CEILING: reconstruction,
    ONE: one_image,
    MEMORIZED: memorized,
}

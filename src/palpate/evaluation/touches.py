"""Scoring pictures of touches without a split: whatever a user has generated, against whatever real touches there are.

The TMMD family needs an encoder and no pairs. Scores of pairs need equal ids on both sides: where no id at all is shared there are no pairs,
and they are left out with a remark; where some are missing it is taken for a mistake.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from palpate.core import FeatureSet, PalpateError, Progress, digest_json, quiet, short
from palpate.data.images import cached_images, load_images, read_image
from palpate.data.manifest import Manifest
from palpate.evaluation.companions import (
    NO_GEL,
    ON_GEL,
    ON_PAIRS,
    Weights,
    picture_companions,
    standard_companions,
)
from palpate.evaluation.comparing import (
    ON_FEATURES,
    Asked,
    Outcome,
    against,
    compare_features,
    feature_companions,
)
from palpate.metrics import paired_by_id

if TYPE_CHECKING:
    from palpate.encoders.encoder_set import EncoderSet

Images = NDArray[np.uint8]
#: What a companion's features are called where the tactile encoder made them.
TOUCH = "tactile"
#: Decoded pictures of more bytes than this lie in a temporary file.
HELD = 1 << 30


@dataclass(frozen=True)
class Wanted:
    """Companions, by what they need.

    Attributes:
        default: nobody named them.
        features: those on the tactile encoder's features.
        standard: those on features of Inception and CLIP.
        pairs: those on pairs of pictures.
    """

    default: bool
    features: Sequence[str]
    standard: Sequence[str]
    pairs: Sequence[str]

    @classmethod
    def of(
        cls, companions: Sequence[str] | None, weights: Weights, *, encoder: bool, background: bool
    ) -> Wanted:
        """Sorts the companions; None is all that need nothing that is not there.

        Args:
            companions: names among ``ON_FEATURES`` and ``ON_PAIRS``, or ``none``.
            weights: what was given; with weights of Inception, FID and KID are of its features, with those of CLIP CMMD is.
            encoder: whether there is a tactile encoder.
            background: whether the real touches have their gel without contact.

        Raises:
            PalpateError: for a companion that nothing given can compute.
        """
        has = {"fid": weights.inception, "kid": weights.inception, "cmmd": weights.clip}
        if companions is None:
            kinds = [k for k in ON_FEATURES if has.get(k) is not None or (encoder and k != "cmmd")]
            kinds += [
                k
                for k in ON_PAIRS
                if (k != "contact" or background) and (k != "lpips" or weights.lpips is not None)
            ]
        else:
            kinds = [k for k in companions if k != "none"]
            weights.require(kinds)
        standard = [k for k in kinds if has.get(k) is not None]
        features = [k for k in kinds if k in ON_FEATURES and k not in standard]
        if features and not encoder:
            missing_weights(features[0])
        return cls(companions is None, features, standard, [k for k in kinds if k in ON_PAIRS])


def missing_weights(kind: str) -> None:
    """Says what a companion on features could be computed with.

    Raises:
        PalpateError: always.
    """
    from palpate.encoders.standard import CLIP_FIX, INCEPTION_FIX

    own = {
        "fid": f", or --inception FILE. {INCEPTION_FIX}",
        "kid": f", or --inception FILE. {INCEPTION_FIX}",
        "cmmd": f", or --clip. {CLIP_FIX}",
    }
    raise PalpateError(
        f"{kind} must have features",
        "pictures without an encoder",
        f"Pass --encoder NAME{own.get(kind, '')}",
    )


def compare_touches(
    generators: Mapping[str, Manifest],
    reference: Manifest,
    encoders: EncoderSet | None,
    asked: Asked,
    *,
    group: str = "video",
    companions: Sequence[str] | None = None,
    weights: Weights | None = None,
    train: Manifest | None = None,
    cache: Path | None = None,
    progress: Progress = quiet,
) -> Outcome:
    """Scores of one or several generators, from pictures.

    Args:
        generators: name -> touches (column ``tactile``), all with the same ids.
        reference: real touches.
        encoders: their tactile encoder gives the features; None: scores of pictures only.
        asked: presets, bandwidths, seed, split.
        group: column whose values stay together in halves and intervals.
        companions: see :meth:`Wanted.of`.
        weights: of encoders that are not ours.
        train: other real touches; their TMMD to the reference is the floor of TMMD.
        cache: folder for embeddings and decoded pictures, which a run that was stopped finds again.
        progress: told what is being done.

    Raises:
        PalpateError: if ids differ where pairs are needed, pictures are unreadable, there is no tactile encoder, or weights are missing.
    """
    weights = weights or Weights()
    background = not reference.table["background"].null_count()
    wanted = Wanted.of(companions, weights, encoder=encoders is not None, background=background)
    pairs = _paired(generators, reference, wanted)
    if "contact" in wanted.pairs and pairs and not background:
        raise PalpateError(*NO_GEL)
    sets = {name: _set(made, encoders, group, cache, progress) for name, made in generators.items()}
    real = _set(reference, encoders, group, cache, progress)
    out = Outcome()
    if encoders is not None:
        others = (
            _set(train, encoders, group, cache, progress)
            if train is not None and len(train)
            else None
        )
        out.add(compare_features(sets, real, asked, train=others, progress=progress))
        out.add(
            feature_companions(
                wanted.features,
                sets,
                real,
                asked,
                what=TOUCH,
                default=wanted.default,
                progress=progress,
            )
        )
    if wanted.standard or (wanted.pairs and pairs):
        with tempfile.TemporaryDirectory() if cache is None else nullcontext(cache) as folder:
            out.add(
                _of_pictures(
                    generators,
                    reference,
                    (sets, real),
                    wanted,
                    pairs,
                    weights,
                    asked,
                    Path(folder),
                    progress,
                )
            )
    if wanted.pairs and not pairs:
        out.remarks.append(
            "Scores of pairs of pictures left out: generated and real touches share no id"
        )
    return against(out, files_digest(reference.ids, reference.paths("tactile")))


def files_digest(ids: Sequence[str], paths: Sequence[Path]) -> str:
    """SHA-256 over id and bytes of every picture, in whatever order.

    The same for a copied folder, and free of the rounding of embeddings, which another machine rounds otherwise.
    """
    return digest_json(
        sorted(
            [i, _bytes_digest(path, path.stat().st_ctime_ns)]
            for i, path in zip(ids, paths, strict=True)
        )
    )


@lru_cache(maxsize=1 << 20)
def _bytes_digest(path: Path, _changed: int) -> str:
    """SHA-256 of a file, read once a run: several digests and caches ask for it. The time of its last change cannot be set back."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _set(
    touches: Manifest,
    encoders: EncoderSet | None,
    group: str,
    cache: Path | None,
    progress: Progress,
) -> FeatureSet:
    """Features of touches; without an encoder a set with ids, labels and groups alone."""
    if encoders is not None:
        from palpate.encoders.embed import embed

        return embed(
            touches,
            encoders,
            "tactile",
            groups=group,
            cache=cache and own_cache(cache, touches),
            keep_pixels=False,
            progress=progress,
        )
    column = lambda name: (
        None
        if touches.table[name].null_count() == len(touches)
        else [v or "" for v in touches.column(name)]
    )
    return FeatureSet(
        touches.ids, np.zeros((len(touches), 1), np.float32), column("material"), column(group)
    )


def own_cache(cache: Path, *sources: Manifest, column: str = "tactile") -> Path:
    """A folder for the bytes of one source of pictures: two generators, or the same one a day later, may have files of one name, size and time."""
    return cache / short(
        digest_json([files_digest(touches.ids, touches.paths(column)) for touches in sources])
    )


def _paired(generators: Mapping[str, Manifest], reference: Manifest, wanted: Wanted) -> bool:
    """Whether there are pairs; some ids without a partner are a mistake."""
    if not wanted.pairs:
        return False
    shared = [bool(set(made.ids) & set(reference.ids)) for made in generators.values()]
    if wanted.default and not any(shared):
        return False
    for name, made in generators.items():
        try:
            paired_by_id(made.ids, reference.ids)
        except PalpateError as error:
            fix = "Score the same samples on both sides, or leave scores of pairs out: --companions fid kid prdc, or none"
            raise PalpateError(f"{name}: {error.must}", error.got, fix) from None
    return True


def _of_pictures(
    generators: Mapping[str, Manifest],
    reference: Manifest,
    features: tuple[Mapping[str, FeatureSet], FeatureSet],
    wanted: Wanted,
    pairs: bool,
    weights: Weights,
    asked: Asked,
    folder: Path,
    progress: Progress,
) -> Outcome:
    """Everything that looks at pixels, all at the generators' size."""
    size = _size(generators)
    if pairs:
        generators = {name: made.take(reference.ids) for name, made in generators.items()}
    pictures = {
        name: _load(made, "tactile", size, folder, progress) for name, made in generators.items()
    }
    real, compared = _load(reference, "tactile", size, folder, progress), list(generators)
    sets, like = features
    if pairs:
        sets = {name: one.take(reference.ids) for name, one in sets.items()}
    out = Outcome()
    whole = min(read_image(reference.paths("tactile")[0]).size)
    if whole != size:
        out.remarks.append(
            f"Pixels are compared at {size} x {size}, the generators' size: the reference's {whole} px were resized, and smaller pictures score higher"
        )
    if wanted.standard:
        out.add(
            standard_companions(
                wanted.standard,
                sets,
                pictures,
                like,
                real,
                weights,
                asked,
                compared=compared,
                progress=progress,
            )
        )
    if pairs:
        gel = (
            _load(reference, "background", size, folder, progress)
            if ON_GEL & set(wanted.pairs) and _has_gel(reference)
            else None
        )
        groups = None if like.groups is None or "" in like.groups else list(like.groups)
        out.add(
            picture_companions(
                wanted.pairs,
                pictures,
                real,
                ids=reference.ids,
                groups=groups,
                compared=compared,
                background=gel,
                weights=weights,
                split=asked.split,
                default=wanted.default,
                progress=progress,
            )
        )
    return out


def _has_gel(reference: Manifest) -> bool:
    return not reference.table["background"].null_count()


def _size(generators: Mapping[str, Manifest]) -> int:
    """The shorter side of the generated pictures.

    Raises:
        PalpateError: if generators differ in it: scores of pixels at different sizes are not comparable.
    """
    sizes: dict[str, int] = {}
    for name, made in generators.items():
        shapes = {path: _shape(path) for path in made.paths("tactile")}
        first, *others = shapes.items()
        if other := next((item for item in others if item[1] != first[1]), None):
            got = f"{first[0].name} of {first[1][0]} x {first[1][1]} and {other[0].name} of {other[1][0]} x {other[1][1]}"
            fix = "Resize them alike, or leave scores of pixels out: --companions fid kid prdc, or none"
            raise PalpateError(f"All pictures of {name} must have one size", got, fix)
        sizes[name] = min(first[1])
    if len(set(sizes.values())) > 1:
        got = ", ".join(f"{name} {size}" for name, size in sizes.items())
        fix = "Resize them alike, or leave scores of pixels out: --companions fid kid prdc, or none"
        raise PalpateError("Generators side by side must have pictures of one size", got, fix)
    return next(iter(sizes.values()))


def _shape(path: Path) -> tuple[int, int]:
    """Width and height, from the head of the file where it can be told without decoding."""
    try:
        with Image.open(path) as image:
            return image.size
    except OSError:
        return read_image(path).size  # says what is wrong


def _load(touches: Manifest, column: str, size: int, folder: Path, progress: Progress) -> Images:
    """Pictures as squares; many of them in a file."""
    if len(touches) * size * size * 3 > HELD:
        return cached_images(
            touches, column, size, own_cache(folder, touches, column=column), progress
        )
    return load_images(touches.paths(column), size, progress=progress)

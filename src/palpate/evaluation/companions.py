"""Scores of pictures beside the TMMD family: image by image, on the contact alone, and on the features of standard encoders.

Whose weights are not there is said by :mod:`palpate.encoders.standard` and :mod:`palpate.encoders.perceptual`: which file, and where to get it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, Note, PalpateError, Progress, Score, quiet
from palpate.evaluation.comparing import Asked, Outcome, feature_companions
from palpate.metrics import (
    background_digest,
    contact_images,
    mean_score,
    measure_contacts,
    ms_ssim,
    ms_ssim_per_image,
    psnr,
    psnr_per_image,
    ssim,
    ssim_per_image,
)
from palpate.metrics.masks import LEAST
from palpate.metrics.paired import mean_differences

if TYPE_CHECKING:
    from palpate.encoders.perceptual import Lpips
    from palpate.encoders.standard import Kind

Images = NDArray[np.uint8]
#: Companions on pairs of pictures.
ON_PAIRS = ("ssim", "psnr", "ms-ssim", "contact", "lpips")
#: Those that look at the gel without contact where it is known.
ON_GEL = frozenset({"contact", "lpips"})
#: What is said where it is not.
NO_GEL = (
    "Contact scores must have the gel without contact of every touch",
    "touches without",
    "Pass a manifest with the column background as --reference, or leave contact out of --companions",
)
#: Pairs whose contacts are made into pictures at a time.
PICTURES = 256


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Weights of one's own for encoders that are not ours.

    Attributes:
        inception: TorchScript file.
        clip: folder, shipped name or hub id.
        lpips: backbone and heads.
    """

    inception: Path | None = None
    clip: str | None = None
    lpips: tuple[Path, Path] | None = None

    def require(self, kinds: Sequence[str]) -> None:
        """Refuses companions whose weights were not given, saying which and where to get them.

        Raises:
            PalpateError: for ``lpips`` without its files.
        """
        if "lpips" in kinds and self.lpips is None:
            from palpate.encoders.perceptual import FIX

            raise PalpateError("LPIPS must have weights: --lpips BACKBONE HEADS", "none", FIX)


def picture_companions(
    kinds: Sequence[str],
    pictures: Mapping[str, Images],
    real: Images,
    *,
    ids: Sequence[str],
    groups: Sequence[str] | None,
    compared: Sequence[str],
    background: Images | None = None,
    weights: Weights | None = None,
    split: str | None = None,
    default: bool = False,
    progress: Progress = quiet,
) -> Outcome:
    """SSIM, PSNR, MS-SSIM, contact scores and LPIPS of every subject, with paired differences of the generators.

    Args:
        kinds: of :data:`ON_PAIRS`; others are passed over.
        pictures: subject -> (n, h, w, 3), in the order of ``ids``.
        real: the real touches, the same shape.
        ids: n ids.
        groups: n groups, or None.
        compared: the subjects that are generators.
        background: the gel without contact, the same shape; the contact scores need it.
        weights: for LPIPS.
        split: digest that scores keep.
        default: nobody asked for these by name: one that refuses its input is left out with a remark.
        progress: told which subject is scored.

    Raises:
        PalpateError: as the metrics, unless ``default``.
    """
    common: dict[str, Any] = {"ids": ids, "groups": groups, "split": split}
    out, todo = Outcome(), [k for k in ON_PAIRS if k in kinds]
    for done, kind in enumerate(todo):
        progress("comparing pictures", done, len(todo))
        if kind == "contact":
            make = lambda: _contact(pictures, real, background, compared, common)  # noqa: E731
        elif kind == "lpips":
            make = lambda: _lpips(
                pictures, real, background, weights or Weights(), compared, common, progress
            )
        else:
            make = lambda kind=kind: _pairwise(kind, pictures, real, compared, common)  # noqa: E731
        out.attempt(kind, make, asked=not default)
    progress("comparing pictures", len(todo), len(todo))
    return out


def _pairwise(
    kind: str,
    pictures: Mapping[str, Images],
    real: Images,
    compared: Sequence[str],
    common: Mapping[str, Any],
) -> Outcome:
    score: Callable[..., Score] = {"ssim": ssim, "psnr": psnr, "ms-ssim": ms_ssim}[kind]
    each: Callable[..., Any] = {
        "ssim": ssim_per_image,
        "psnr": psnr_per_image,
        "ms-ssim": ms_ssim_per_image,
    }[kind]
    found = {name: score(images, real, subject=name, **common) for name, images in pictures.items()}
    if len(compared) < 2:
        return Outcome(list(found.values()))
    values = {name: each(pictures[name], real) for name in compared}
    return Outcome(
        list(found.values()),
        mean_differences({name: found[name] for name in compared}, values, common["groups"]),
    )


def _contact(
    pictures: Mapping[str, Images],
    real: Images,
    background: Images | None,
    compared: Sequence[str],
    common: Mapping[str, Any],
) -> Outcome:
    if background is None:
        raise PalpateError(*NO_GEL)
    contacts = {name: measure_contacts(v, real, background) for name, v in pictures.items()}
    scores = {name: c.scores(subject=name, **common) for name, c in contacts.items()}
    out = Outcome([s for some in scores.values() for s in some])
    if len(compared) > 1:
        for k, metric in enumerate(s.metric for s in scores[compared[0]]):
            out.differences += mean_differences(
                {name: scores[name][k] for name in compared},
                {name: contacts[name].values[metric] for name in compared},
                common["groups"],
            )
    return out


def _lpips(
    pictures: Mapping[str, Images],
    real: Images,
    background: Images | None,
    weights: Weights,
    compared: Sequence[str],
    common: Mapping[str, Any],
    progress: Progress,
) -> Outcome:
    """LPIPS of whole pictures and, where there are backgrounds, of the contact alone."""
    weights.require(["lpips"])
    assert weights.lpips is not None
    from palpate.encoders.perceptual import load_lpips, lpips_per_image

    network = load_lpips(*weights.lpips)
    settings = {"network": "alex", "version": "0.1", "size": [int(v) for v in real.shape[1:3]]}
    rest: dict[str, Any] = {
        "level": 0.95,
        "split": common["split"],
        "encoder": network.digest,
        "higher_is_better": False,
    }
    out = Outcome()

    def keep(
        metric: str,
        values: Mapping[str, NDArray[np.float64]],
        settings: Mapping[str, Any],
        **more: Any,
    ) -> None:
        found = {
            name: mean_score(
                metric,
                v,
                ids=common["ids"],
                groups=common["groups"],
                subject=name,
                settings=dict(settings),
                **rest,
                **more,
            )
            for name, v in values.items()
        }
        out.scores += found.values()
        if len(compared) > 1:
            out.differences += mean_differences(
                {name: found[name] for name in compared}, values, common["groups"]
            )

    keep(
        "LPIPS",
        {
            name: lpips_per_image(images, real, network, progress=progress)
            for name, images in pictures.items()
        },
        settings,
    )
    if background is not None:
        on_contact = lambda images: _contact_lpips(images, real, background, network, progress)  # noqa: E731
        empty = on_contact(background)
        bare = int(np.isnan(empty).sum())
        keep(
            "contact LPIPS",
            {name: on_contact(images) for name, images in pictures.items()},
            settings
            | {
                "markers": "skip",
                "least": round(LEAST, 6),
                "generated_background": "real",
                "background": background_digest(background),
            },
            notes=[Note("no-contact", {"count": bare, "n": len(real)})] if bare else [],
            details={"empty": float(np.nanmean(empty)) if bare < len(real) else None},
        )
    return out


def _contact_lpips(
    images: Images, real: Images, background: Images, network: Lpips, progress: Progress
) -> NDArray[np.float64]:
    """LPIPS (n,) of the differences to the empty gel inside the contact mask; NaN where a real touch is empty."""
    from palpate.encoders.perceptual import lpips_per_image

    out = np.empty(len(real))
    for start in range(0, len(real), PICTURES):
        at = slice(start, start + PICTURES)
        pairs = contact_images(images[at], real[at], background[at])
        out[at] = lpips_per_image(pairs.generated, pairs.reference, network, mask=pairs.mask)
        progress("LPIPS of the contact", min(start + PICTURES, len(real)), len(real))
    return out


def standard_companions(
    kinds: Sequence[str],
    sets: Mapping[str, FeatureSet],
    pictures: Mapping[str, Images],
    reference: FeatureSet,
    real: Images,
    weights: Weights,
    asked: Asked,
    *,
    compared: Sequence[str],
    paired: bool = True,
    progress: Progress = quiet,
) -> Outcome:
    """FID and KID on Inception's features, CMMD on CLIP's, where weights are given.

    Args:
        kinds: those among ``fid``, ``kid`` and ``cmmd`` that are wanted.
        sets: subject -> ids and groups of its pictures; its features do not matter.
        pictures: subject -> (n, h, w, 3), in the order of its set.
        reference: ids and groups of the real touches.
        real: (m, h, w, 3), in the order of ``reference``.
        weights: which encoders there are.
        asked: seed, split, back end.
        compared: the subjects that are generators.
        paired: whether they stand for the same samples.
        progress: told how many images are done.

    Raises:
        PalpateError: if weights are missing or of another kind, saying where to get them.
    """
    out = Outcome()
    sources: list[tuple[Kind, Path | str | None, tuple[str, ...]]] = [
        ("inception", weights.inception, ("fid", "kid")),
        ("clip", weights.clip, ("cmmd",)),
    ]
    for kind, source, wanted in sources:
        some = [k for k in wanted if k in kinds]
        if source is None or not some:
            continue
        from palpate.encoders.standard import load_standard

        encoder = load_standard(source, kind=kind)
        embedded = lambda one, images: replace(
            one, features=encoder.embed(images, progress=progress), encoder=encoder.digest
        )
        made = {name: embedded(sets[name], images) for name, images in pictures.items()}
        found = embedded(reference, real)
        what = {"inception": "Inception", "clip": "CLIP"}[kind]
        for together in split_off(made, compared):
            out.add(
                feature_companions(
                    some, together, found, asked, what=what, paired=paired, progress=progress
                )
            )
    return out


def split_off(
    sets: Mapping[str, FeatureSet], compared: Sequence[str]
) -> list[dict[str, FeatureSet]]:
    """The generators together, every other subject alone: differences are made between generators only."""
    together = {name: one for name, one in sets.items() if name in compared}
    return [
        *([together] if together else []),
        *({name: one} for name, one in sets.items() if name not in compared),
    ]

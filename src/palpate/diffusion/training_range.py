"""What training saw, as statistics: how unlike it a photo or a text is.

Of a photo the 149 numbers of :class:`~palpate.encoders.rulers.Handcrafted` speak (colors, spectrum,
directions, patterns), of a text its embedding. A photo's embedding does not: it was trained to keep
what captions say, and gray and noise lie among those of the training photos. The distance from the
mean is Mahalanobis',

    d(z) = z' (C + 0.01 tr(C) / k I)^-1 z,  z each number by its deviation, clipped to 4

(Lee et al., NeurIPS 2018). The rate of x is the share of the training photos that are nearer, each
measured by a fit without a fifth of the objects, its own among them: so of new photos like those of
the training 5 % are unlike 95 % of them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from palpate.core import plain, read_record, reading_entry, rng_for, sealed, track, write_text
from palpate.core.files import canonical_json
from palpate.core.records import from_plain
from palpate.data.images import Preprocess, cached_images
from palpate.encoders.embed import embed_texts
from palpate.encoders.rulers import Handcrafted

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest
    from palpate.diffusion.pipeline import TactilePipeline
    from palpate.training.run import TrainingRun

FILE, FORMAT = "range.json", "palpate-range/1"
SIDE = 64  # of the photos in pixels
#: Photos or texts that statistics are made of at most, and ranks that are kept.
MOST, LEVELS = 4_000, 1_000
#: Objects that rates need at least, and the parts that they are held out in.
UNITS, FOLDS = 20, 5
#: Deviations that a number counts at most: a single one far out is no other domain.
LARGEST = 4.0


@dataclass(frozen=True)
class Distances:
    """Distances of photos or texts, and how they spread where the fit did not look.

    Attributes:
        mean, spread: of k numbers; z is ``(x - mean) / spread``, clipped to 4.
        whiten: (k, k); d is the squared length of ``z @ whiten``.
        levels: rising distances of what was held out, evenly spaced in rank.
    """

    mean: Sequence[float]
    spread: Sequence[float]
    whiten: Sequence[Sequence[float]]
    levels: Sequence[float] = ()

    @classmethod
    def fit(cls, rows: NDArray[np.floating], units: Sequence[str]) -> Distances | None:
        """Of rows (n, k) and the unit of each; None of too few units."""
        names = rng_for(0, "range").permutation(sorted({*units}))
        if len(names) < UNITS:
            return None
        spread = np.maximum(rows.std(axis=0), 1e-3)
        z = np.clip((rows - rows.mean(axis=0)) / spread, -LARGEST, LARGEST)
        folds = (np.isin(units, names[k::FOLDS]) for k in range(FOLDS))
        levels = [_squares(z[held] @ _whiten(z[~held])) for held in folds]
        parts = (
            *(rows.mean(axis=0), spread, _whiten(z)),
            np.quantile(np.concatenate(levels), np.linspace(0, 1, LEVELS)),
        )
        return cls(*(np.round(part.astype(float), 4).tolist() for part in parts))

    def rates(self, rows: NDArray[np.floating]) -> list[float]:
        """For each of rows (n, k) the share of the training that is less far, 0 to 1."""
        z = np.clip((rows - np.array(self.mean)) / self.spread, -LARGEST, LARGEST)
        ranks = np.searchsorted(self.levels, _squares(z @ np.array(self.whiten)))
        return (ranks / len(self.levels)).round(4).tolist()


def _whiten(z: NDArray[np.floating]) -> NDArray[np.float64]:
    """(k, k): turns rows like z (n, k) into uncorrelated ones of deviation 1, ridged."""
    variances, axes = np.linalg.eigh(z.T @ z / len(z))
    return axes / np.sqrt(np.maximum(variances, 0) + 0.01 * variances.mean())


def _squares(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    return (rows**2).sum(axis=1)


@dataclass(frozen=True)
class TrainingRange:
    """What a generator was trained on, as far as it says what is out of its range.

    Attributes:
        photos, texts: their distances; None where there were too few.
        words: of all texts, in lower case, sorted; empty where there were none.
        format: of the file.
    """

    photos: Distances | None = None
    texts: Distances | None = None
    words: Sequence[str] = ()
    format: str = FORMAT

    @classmethod
    def of(
        cls, pipeline: TactilePipeline, train: Manifest, texts: Sequence[str], run: TrainingRun
    ) -> TrainingRange:
        """The range of a pipeline by its train part.

        Args:
            pipeline: whose photos are prepared, and whose texts are embedded.
            train: samples with photos.
            texts: that conditioned the training; may be empty.
            run: its cache and progress.
        """
        from palpate.encoders.rows import evenly_spaced  # loads what only training needs

        some = train.take([train.ids[k] for k in evenly_spaced(len(train), MOST)])
        photos = cached_images(some, "vision", pipeline.vision_size, run.cache, run.progress)
        parts = [photos[k : k + 32] for k in range(0, len(photos), 32)]
        numbers = [numbers_of(part) for part in track(parts, "measuring photos", run.progress)]
        columns = (some.column(name) for name in ("object", "video"))
        units = next((c for c in columns if None not in c and len({*c}) >= UNITS), some.ids)
        words = {word for text in texts for word in words_of(text)}
        said, spoken = sorted({*texts}), None
        if said and pipeline.encoders is not None:
            said = [said[k] for k in evenly_spaced(len(said), MOST)]
            spoken = Distances.fit(embed_texts(said, pipeline.encoders), said)
        return cls(Distances.fit(np.concatenate(numbers), units), spoken, sorted(words))

    def photo_rates(self, photos: NDArray[np.uint8]) -> Sequence[float | None]:
        """For each photo (n, h, w, 3) the share of the training photos that are less far."""
        return (
            [None] * len(photos) if self.photos is None else self.photos.rates(numbers_of(photos))
        )

    def unseen(self, text: str) -> list[str]:
        """Words of a text that no text of the training has, in order."""
        return [w for w in dict.fromkeys(words_of(text)) if self.words and w not in self.words]

    def save(self, folder: Path) -> None:
        """Write ``range.json``."""
        write_text(folder / FILE, canonical_json(sealed(plain(self))))

    @classmethod
    def load(cls, folder: Path) -> TrainingRange | None:
        """Read what :meth:`save` wrote; None where there is none.

        Raises:
            PalpateError: if it is damaged.
        """
        if not (file := folder / FILE).is_file():
            return None
        record = read_record(file, "range of the training", form=FORMAT)
        with reading_entry(file, "The range"):
            return from_plain(cls, record)


def words_of(text: str) -> list[str]:
    """The words of a text, in lower case."""
    return re.findall(r"[^\W_]+", text.lower())


@torch.no_grad()
def numbers_of(photos: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Photos, bytes (n, h, w, 3), to their numbers (n, 149)."""
    small = torch.from_numpy(np.array(Preprocess(SIDE, SIDE).fit(photos), np.float32))
    ruler = Handcrafted({"center": torch.zeros(0)})
    return ruler.numbers(small.permute(0, 3, 1, 2) - 127.5).numpy()

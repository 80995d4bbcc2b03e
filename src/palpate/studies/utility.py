"""What generation is for: do generated images train a classifier for real touch?

A linear probe on the features of a tactile encoder names the material of real images of new videos.
It is trained on k real videos of every class, on these plus all generated images, and on the
generated images of k videos of every class alone; k = 1, 2, 4, 8, as far as every tested class has
k videos.

**What must not happen.** The encoder must not have seen the test videos (:func:`utility` checks it
by their pixels), and no classifier may be trained on an image that was generated for a photo of the
video it is tested on. Generated images are those of the *test part's other videos*: the test videos
are dealt into folds, and what names the videos of one fold is trained on generated images of the
others. Images of train photos would be the wrong choice: the generator was trained on the real
touch of these very videos, so they may be recitations of it, and add real videos to the k by
another name. (Sets whose videos are not in the test part need no folds; they are taken whole.)
Every fold leaves out as many videos of a class: else the class of a tested video would be a rarer
one in training than in the test, and whoever is unsure would be wrong more often than by chance.
What is left is to be read with it: the generator itself was trained on the whole train part. The
question is what it adds for new photos of known material, not whether real touch was saved.

The k videos are drawn several times, nested in k. A mean over draws has the interval over test
videos and draws (:mod:`palpate.metrics.means`); gains are paired by both.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import FeatureSet, Progress, Score, Split, quiet, require, rng_for
from palpate.data.manifest import Manifest
from palpate.data.samples import read_samples
from palpate.encoders.embed import embed
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.guard import guard
from palpate.metrics.inputs import Array
from palpate.metrics.means import Mean, mean_of
from palpate.metrics.means import over_seeds as over_draws
from palpate.metrics.paired import differences_of_means
from palpate.metrics.probe import fit_probe
from palpate.report.records import Claim, StudyTable
from palpate.report.results import Results
from palpate.studies.claims import decide
from palpate.studies.evidence import in_words, over_seeds, side_of
from palpate.studies.files import control_folders, data_of
from palpate.studies.graph import Work
from palpate.studies.names import CEILING, EMPTY, MATERIAL, NEAREST, NOLEAK
from palpate.studies.stages import Facts

#: Controls whose images train a classifier: a perfect generator, retrieval, and no touch at all.
USEFUL = (CEILING, NEAREST, EMPTY)
#: Real videos a class.
SHOTS = (1, 2, 4, 8)
REAL = "k real"
#: Beginning of the label of a row of gains.
GAIN = "gain by "


@dataclass(frozen=True)
class Training:
    """What a probe is trained on.

    Attributes:
        real: features of real images, or None.
        generated: features of generated images, or None.
        of_real: videos of every class that are drawn of ``real``.
        of_generated: the same of ``generated``; 0: as many of a class as every fold can leave.
    """

    real: FeatureSet | None = None
    generated: FeatureSet | None = None
    of_real: int = 0
    of_generated: int = 0


@dataclass(frozen=True)
class Draws:
    """How videos are drawn.

    Attributes:
        shots: numbers k of videos a class, a column of the table each.
        draws: how often k videos are drawn.
        folds: of the test videos, where generated images are of these.
        seed: of draws and folds.
        l2: penalty of the probe; with k videos a class there is nothing to choose it by.
    """

    shots: Sequence[int] = SHOTS
    draws: int = 5
    folds: int = 4
    seed: int = 0
    l2: float = 1e-2

    def rows(self, features: FeatureSet, shots: int | Mapping[str, int], draw: int) -> list[int]:
        """Rows of ``shots`` videos of every class, or of ``shots[label]`` of each.

        They are the first in a random order by (seed, draw, class, video): the same videos in every
        set of features, and those of a larger k hold those of a smaller one.
        """
        chosen: set[tuple[str, str]] = set()
        for label, videos in _videos(features).items():
            order = lambda v, c=label: rng_for(self.seed, "utility", draw, c, v).random()
            count = shots if isinstance(shots, int) else shots[label]
            chosen |= {(label, video) for video in sorted(videos, key=order)[:count]}
        return [k for k, pair in enumerate(_pairs(features)) if pair in chosen]

    def fold_of(self, test: FeatureSet, generated: FeatureSet | None) -> NDArray[np.intp]:
        """The fold (n,) of every test row; all in one where no video was generated for.

        The videos of every class are dealt to the folds in turn.
        """
        groups = [group for _, group in _pairs(test)]
        if generated is None or {v for _, v in _pairs(generated)}.isdisjoint(groups):
            return np.zeros(len(groups), np.intp)
        order = lambda v: float(rng_for(self.seed, "utility folds", v).random())
        pairs = sorted({*_pairs(test)}, key=lambda pair: (pair[0], order(pair[1])))
        number = {v: k % self.folds for k, v in enumerate(dict.fromkeys(v for _, v in pairs))}
        return np.array([number[g] for g in groups])


def _pairs(features: FeatureSet) -> list[tuple[str, str]]:
    """Class (one for all where there are none) and video of every row."""
    labels = features.labels or [""] * len(features.ids)
    pairs = zip(labels, features.groups or features.ids, strict=True)
    return [(str(label), str(video)) for label, video in pairs]


def _videos(features: FeatureSet) -> dict[str, set[str]]:
    """Class -> its videos."""
    videos: dict[str, set[str]] = {}
    for label, video in _pairs(features):
        videos.setdefault(label, set()).add(video)
    return videos


def fewest_videos(draws: Draws, features: FeatureSet, test: FeatureSet) -> int:
    """The largest k: each tested class has as many videos, those of its fold left out.

    Classes that ``features`` has not at all do not count.
    """
    videos = _videos(features)
    rows = {*zip(_pairs(test), draws.fold_of(test, features), strict=True)}
    tested = {number: {v for (_, v), fold in rows if fold == number} for _, number in rows}
    left = (len(videos[label] - tested[n]) for (label, _), n in rows if label in videos)
    return min(left, default=0)


def picked(features: FeatureSet, rows: Iterable[int]) -> FeatureSet:
    """The samples in these rows."""
    return features.take([features.ids[k] for k in rows])


def _hits(draws: Draws, draw: int, test: FeatureSet, training: Training) -> Array:
    """Whether a probe is right on every test row (n,): 1 or 0.

    There is a probe a fold; its generated images are those of the videos of the other folds.
    """
    real, generated, pairs = training.real, training.generated, _pairs(test)
    fold = draws.fold_of(test, generated)
    tested = {k: {v for (_, v), f in zip(pairs, fold, strict=True) if f == k} for k in {*fold}}
    drawn = [] if real is None else [picked(real, draws.rows(real, training.of_real, draw))]
    hits = np.zeros(len(fold))
    for number, videos in tested.items():
        sets = [*drawn]
        if generated is not None:
            rest = [k for k, (_, video) in enumerate(_pairs(generated)) if video not in videos]
            free = picked(generated, rest)
            shots = training.of_generated or _left_by_every_fold(generated, tested.values())
            sets.append(picked(free, draws.rows(free, shots, draw)))
        rows = np.flatnonzero(fold == number)
        named = _named(_joined(sets), test.features[rows], draws.l2)
        hits[rows] = [name == pairs[k][0] for name, k in zip(named, rows, strict=True)]
    return hits


def _left_by_every_fold(features: FeatureSet, tested: Iterable[set[str]]) -> dict[str, int]:
    """Class -> its videos without those of the fold that tests most of them."""
    folds = list(tested)
    return {
        label: len(videos) - max(len(videos & fold) for fold in folds)
        for label, videos in _videos(features).items()
    }


def _joined(parts: Sequence[FeatureSet]) -> FeatureSet:
    """Rows of several sets below each other."""
    pairs = [pair for part in parts for pair in _pairs(part)]
    ids = [f"{k}/{i}" for k, part in enumerate(parts) for i in part.ids]
    x = np.concatenate([part.features for part in parts])
    labels, groups = ([pair[c] for pair in pairs] for c in (0, 1))
    return FeatureSet(ids, x, labels, groups, parts[0].encoder)


def _named(features: FeatureSet, rows: NDArray[Any], l2: float) -> Sequence[str]:
    """The classes of rows (m, d), by a probe of these features; one class is always named."""
    classes = {label for label, _ in _pairs(features)}
    if len(classes) < 2:
        return [*classes] * len(rows)
    return fit_probe(features, l2=l2).predict(rows)


def _trainings(
    draws: Draws,
    generated: Mapping[str, FeatureSet],
    real: FeatureSet,
    test: FeatureSet,
    shots: int,
) -> dict[str, Training]:
    """The trainings of one k; without those that a tested class lacks k videos for."""
    trainings: dict[str, Training] = {}
    if shots <= fewest_videos(draws, real, test):
        trainings[REAL] = Training(real, of_real=shots)
        trainings |= {f"{REAL} + {n}": Training(real, x, shots) for n, x in generated.items()}
    for name, x in generated.items():
        if shots <= fewest_videos(draws, x, test):
            trainings[f"{name} alone"] = Training(generated=x, of_generated=shots)
    return trainings


def material_utility(
    train: FeatureSet,
    test: FeatureSet,
    generated: Mapping[str, FeatureSet],
    draws: Draws,
    *,
    controls: Sequence[str] = (),
    split: str | None = None,
    progress: Progress = quiet,
) -> StudyTable:
    """Material accuracy on real test images, by what the probe was trained on.

    Args:
        train: real features of the train part, with materials and videos.
        test: real features of the test part, with materials and videos.
        generated: name -> features of generated images, with the materials and videos of their
            photos; see the head of this module for which photos.
        draws: how videos are drawn.
        controls: names of ``generated`` that are no generators.
        split: digest of the split, kept in the scores.
        progress: called after every k.

    Returns:
        A table, whose last rows are the paired gains over real videos alone.

    Raises:
        PalpateError: without materials.
    """
    for part, features in {"train": train, "test": test, **generated}.items():
        must, fix = f"The features of {part!r} must have materials", "Pass a labeled manifest"
        require(any(features.labels or ()), None, must, "none", fix=fix)
    truth, groups = ([pair[c] for pair in _pairs(test)] for c in (0, 1))

    def measured(training: Training, label: str, shots: int) -> list[Mean]:
        return [
            mean_of(
                MATERIAL,
                _hits(draws, draw, test, training),
                groups,
                subject=label,
                split=split,
                encoder=test.encoder,
                estimator="mean",
                settings={"k": shots, "l2": draws.l2},
                details={"chance": 1 / len({*truth}), "draws": draws.draws},
            )
            for draw in range(draws.draws)
        ]

    means: dict[tuple[str, int], list[Mean]] = {}
    for done, shots in enumerate(draws.shots):
        for label, training in _trainings(draws, generated, train, test, shots).items():
            means[label, shots] = measured(training, label, shots)
        progress("training on k videos", done + 1, len(draws.shots))
    rows: list[list[Score | str | None]] = []
    for label in dict.fromkeys(label for label, _ in means):
        cells = (means.get((label, k)) for k in draws.shots)
        rows.append([label, *(over_draws(runs) if runs else None for runs in cells)])
    for name in generated:
        more = f"{REAL} + {name}"
        pairs = ({m: means.get((m, k), []) for m in (more, REAL)} for k in draws.shots)
        gains = (differences_of_means(pair)[0] if all(pair.values()) else None for pair in pairs)
        rows.append([f"{GAIN}{name}", *gains])
    label_of = (f"{REAL} + {{}}", "{} alone", f"{GAIN}{{}}")
    control_rows = {label.format(name) for name in controls for label in label_of}
    return StudyTable(
        "Material accuracy by training data",
        "Accuracy on real images of new videos, of a linear probe trained on k real videos a "
        "class, on these plus generated images, and on generated images of k videos alone. "
        "Generated images are of photos of other videos than those tested. A k is left out where a "
        "tested class has fewer videos. Gains are paired. Controls: what retrieval or a perfect "
        "generator would add is real touch, and of more videos than k.",
        ["trained on", *(f"k = {k}" for k in draws.shots)],
        rows,
        controls=[str(row[0]) for row in rows if row[0] in control_rows],
    )


def utility_claims(table: StudyTable, generators: Iterable[str]) -> list[Claim]:
    """Generated images help a classifier of real touch: one row a generator of a table of material.

    The gain at the fewest real videos a class decides, where help is needed most; the others are
    listed.
    """
    claims, first = list[Claim](), table.columns[1]
    for name in generators:
        cells = zip(table.columns[1:], _gains(table, name), strict=True)
        gains = [(k, cell) for k, cell in cells if isinstance(cell, Score)]
        if not gains or f"{GAIN}{name}" in table.controls:
            continue
        scores = [score for _, score in gains]
        each = ", ".join(f"{in_words(score)} at {k}" for k, score in gains)
        why = f"Accuracy on real images of new videos changes by {each} real videos a class."
        perfect = _gains(table, CEILING)[0]
        if isinstance(perfect, Score):
            why += (
                f" Images of a perfect generator would change it by {in_words(perfect)} at {first}."
            )
        claim = f"Images of {name} help a classifier of real touch"
        claims.append(Claim(claim, "beyond the paper", decide([side_of(scores[0])]), why, scores))
    return claims


def _gains(table: StudyTable, name: str) -> Sequence[Score | str | None]:
    """The gains by images of one name, from the fewest videos on; None where there are none."""
    cells = (row[1:] for row in table.rows if row[0] == f"{GAIN}{name}")
    return next(cells, [None] * (len(table.columns) - 1))


def utility(
    manifest: Manifest,
    split: Split,
    encoders: EncoderSet,
    generated: Mapping[str, Path],
    draws: Draws,
    *,
    controls: Sequence[str] = (),
    progress: Progress = quiet,
) -> StudyTable:
    """:func:`material_utility` of folders of images.

    Args:
        manifest: the samples.
        split: leak-free; its train part gives the real videos, its test part is tested.
        encoders: with a tactile one, which must not have seen test images.
        generated: name -> folder of images that were generated for photos of the test part.
        draws: how videos are drawn.
        controls: names of ``generated`` that are no generators.
        progress: progress callback.

    Raises:
        PalpateError: if the encoder has seen a test image, or as the parts raise.
    """
    train, test = (manifest.part(split, part) for part in ("train", "test"))
    guard(encoders, "tactile", test, split=split, progress=progress)
    return material_utility(
        embed(train, encoders, "tactile", progress=progress),
        embed(test, encoders, "tactile", progress=progress),
        {n: embed_generated(g, manifest, encoders, progress) for n, g in generated.items()},
        draws,
        controls=controls,
        split=split.digest,
        progress=progress,
    )


def embed_generated(
    images: Path, manifest: Manifest, encoders: EncoderSet, progress: Progress
) -> FeatureSet:
    """Tactile features (n, d) of generated images.

    Materials, videos, sensors and no-contact images are those of the manifest's samples.

    Args:
        images: a folder of ``palpate generate``, or one with a manifest.
        manifest: samples of the same ids, and perhaps others.
        encoders: with a tactile one.
        progress: progress callback.

    Raises:
        PalpateError: if the folder is none of images, or an id is not in the manifest.
    """
    files = read_samples(str(images), "generated").manifest
    paths = [str(path.resolve()) for path in files.paths("tactile")]
    part = manifest.take(files.ids)
    part = replace(part, table=part.table.with_columns(pl.Series("tactile", paths)))
    return embed(part, encoders, "tactile", still=True, progress=progress)


def measure_utility(
    work: Work, *, runs: Mapping[str, Mapping[str, str]], controls: Sequence[str], draws: Draws
) -> Facts:
    """The stage of a study: its table and claims over seeds, as ``results.json``.

    ``runs``: node of the judge -> method -> node of its images, made for photos; one a seed.
    ``controls``: their names.
    """
    manifest, split = data_of(work)
    control_images = control_folders(work, NOLEAK, controls)
    tables = list[StudyTable]()
    for encoders, images in runs.items():
        judge = EncoderSet.load(work.after[encoders] / "encoders", device=work.device)
        folders = {name: work.after[node] / "images" for name, node in images.items()}
        names, progress = [*control_images], work.progress
        folders |= control_images
        tables.append(
            utility(manifest, split, judge, folders, draws, controls=names, progress=progress)
        )
    table = table_over_seeds(tables)
    generators = dict.fromkeys(name for images in runs.values() for name in images)
    claims = utility_claims(table, generators)
    Results("", tables=[table], claims=claims).save(work.folder / "results.json")
    return {"claims": len(claims)}


def table_over_seeds(tables: Sequence[StudyTable]) -> StudyTable:
    """One table of those of several seeds; words are those of the first."""
    rows = zip(*(table.rows for table in tables), strict=True)
    return replace(tables[0], rows=[[*map(_mean, zip(*same, strict=True))] for same in rows])


def _mean(cells: Sequence[Score | str | None]) -> Score | str | None:
    """A cell of several seeds; none where one of them has no score."""
    scores = [cell for cell in cells if isinstance(cell, Score)]
    if len(scores) < len(cells):
        return None if scores else cells[0]
    return over_seeds(scores)

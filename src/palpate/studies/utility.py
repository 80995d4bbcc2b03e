"""What generation is for: do generated images train a classifier, or a retrieval, for real touch?

*Material*: a linear probe on the features of a tactile encoder, tested on real images of new
videos, is trained on k real videos a class, on these plus all generated images, and on the
generated images of k videos a class alone; k = 1, 2, 4, 8, as far as every tested class has
k videos. *Retrieval*: the same for a linear map W
from tactile features x to those y of photos or texts,
``min_W,b sum_i ||x_i W + b - y_i||^2 + (n ridge / d) ||W - I||^2``: without data the encoder's own
space.

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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, PalpateError, Progress, Score, Split, quiet, require, rng_for
from palpate.data.manifest import Manifest
from palpate.diffusion.generation import Generated
from palpate.encoders.embed import embed
from palpate.encoders.encoder_set import EncoderSet
from palpate.evaluation.inputs import guard
from palpate.metrics.inputs import Array
from palpate.metrics.means import Mean, mean_of, over_seeds
from palpate.metrics.paired import differences_of_means
from palpate.metrics.probe import fit_probe
from palpate.metrics.retrieval import retrieval
from palpate.report.study import Claim, Curve, Line, StudyTable
from palpate.studies.claims import decide
from palpate.studies.controls import CEILING
from palpate.studies.embedding import embed_generated
from palpate.studies.evidence import in_words, side_of

#: Real videos a class.
SHOTS = (1, 2, 4, 8)
REAL = "k real"
#: Beginning of the label of a row of gains.
GAIN = "gain by "
#: (features to train on) -> for rows of real test features (m, d), one value or row each.
Fit = Callable[[FeatureSet], Callable[[FeatureSet], Any]]


@dataclass(frozen=True)
class Training:
    """What is trained on: features or None, and videos a class of each.

    ``of_generated`` 0: as many videos of a class as every fold can leave.
    """

    real: FeatureSet | None = None
    generated: FeatureSet | None = None
    of_real: int = 0
    of_generated: int = 0


@dataclass(frozen=True)
class Draws:
    """How videos are drawn.

    Attributes:
        shots: numbers k of videos a class.
        draws: how often.
        folds: of the test videos, where generated images are of these.
        seed: of draws and folds.
        l2: penalty of the probe; with k videos a class there is nothing to choose it by.
        ridge: penalty of the map of retrieval.
    """

    shots: Sequence[int] = SHOTS
    draws: int = 5
    folds: int = 4
    seed: int = 0
    l2: float = 1e-2
    ridge: float = 1.0

    def __post_init__(self) -> None:
        shots = list(self.shots)
        good = bool(shots) and shots == sorted(set(shots)) and shots[0] >= 1
        require(good, "shots", "must be whole numbers from 1, in order", shots, SHOTS)
        require(self.draws >= 1, "draws", "must be at least 1", self.draws, 5)
        require(self.folds >= 2, "folds", "must be at least 2", self.folds, 4)

    def rows(self, features: FeatureSet, shots: int | Mapping[str, int], draw: int) -> list[int]:
        """Rows of k videos of every class, or of so many of each, the same videos in every set.

        The first k of an order by (seed, draw, class, video): nested in k.
        """
        count = lambda label: shots if isinstance(shots, int) else shots[label]
        videos = _videos(features)
        kept = {
            (label, video)
            for label, of in videos.items()
            for video in sorted(of, key=lambda v: self._place(draw, label, v))[: count(label)]
        }
        pairs = zip(*_columns(features), strict=True)
        return [k for k, pair in enumerate(pairs) if pair in kept]

    def _place(self, draw: int, label: str, video: str) -> float:
        return float(rng_for(self.seed, "utility", draw, label, video).random())

    def fold_of(self, test: FeatureSet, generated: FeatureSet | None) -> NDArray[np.intp]:
        """The fold (n,) of every test row; all in one where no video was generated for.

        The videos of every class are dealt to the folds in turn.
        """
        labels, groups = _columns(test)
        if generated is None or {*_columns(generated)[1]}.isdisjoint(groups):
            return np.zeros(len(groups), np.intp)
        place = lambda v: float(rng_for(self.seed, "utility folds", v).random())
        pairs = sorted({*zip(labels, groups, strict=True)}, key=lambda p: (p[0], place(p[1])))
        number = {v: k % self.folds for k, v in enumerate(dict.fromkeys(v for _, v in pairs))}
        return np.array([number[g] for g in groups])


def _columns(features: FeatureSet) -> tuple[list[str], list[str]]:
    """Classes (one for all where there are none) and videos of the rows."""
    n = len(features.ids)
    labels = [str(v) for v in features.labels or [""] * n]
    return labels, [str(g) for g in features.groups or features.ids]


def _videos(features: FeatureSet) -> dict[str, set[str]]:
    """Class -> its videos."""
    videos: dict[str, set[str]] = {}
    for label, video in zip(*_columns(features), strict=True):
        videos.setdefault(label, set()).add(video)
    return videos


def _left(made: FeatureSet, tested: Sequence[set[str]]) -> dict[str, int]:
    """Class -> its videos that are left by the fold, of these sets of videos, that tests most."""
    return {
        label: len(of) - max(len(of & fold) for fold in tested)
        for label, of in _videos(made).items()
    }


def fewest_videos(draws: Draws, features: FeatureSet, test: FeatureSet) -> int:
    """The largest k: each tested class has as many videos, those of its fold left out.

    Classes that ``features`` has not at all do not count.
    """
    fold = draws.fold_of(test, features)
    rows = [*zip(*_columns(test), fold, strict=True)]
    pairs = {*zip(*_columns(features), strict=True)}
    known, left = {label for label, _ in pairs}, list[int]()
    for label, number in {(label, f) for label, _, f in rows if label in known}:
        tested = {video for _, video, f in rows if f == number}
        left.append(sum(of == label and video not in tested for of, video in pairs))
    return min(left, default=0)


def _joined(parts: Sequence[FeatureSet]) -> FeatureSet:
    """Rows of several sets below each other."""
    ids = [f"{k}/{i}" for k, part in enumerate(parts) for i in part.ids]
    columns = [_columns(part) for part in parts]
    labels, groups = ([v for column in columns for v in column[c]] for c in (0, 1))
    x = np.concatenate([part.features for part in parts])
    return FeatureSet(ids, x, labels, groups, parts[0].encoder)


def _picked(features: FeatureSet, rows: Sequence[int]) -> FeatureSet:
    """Some rows; ids may repeat across sets, so they are taken by place."""
    labels, groups = _columns(features)
    ids, x = [features.ids[k] for k in rows], features.features[list(rows)]
    return FeatureSet(ids, x, [labels[k] for k in rows], [groups[k] for k in rows])


def _tested(draws: Draws, draw: int, test: FeatureSet, training: Training, fit: Fit) -> Array:
    """What a training gives for every test row; generated images are those of other folds."""
    real, made = training.real, training.generated
    fold, videos = draws.fold_of(test, made), _columns(test)[1]
    places = [np.flatnonzero(fold == number) for number in np.unique(fold)]
    tested = [{videos[k] for k in at} for at in places]
    parts: list[tuple[NDArray[np.intp], Any]] = []
    for at, names in zip(places, tested, strict=True):
        sets: list[FeatureSet] = []
        if real is not None:
            sets.append(_picked(real, draws.rows(real, training.of_real, draw)))
        if made is not None:
            others = [k for k, v in enumerate(_columns(made)[1]) if v not in names]
            free, shots = _picked(made, others), training.of_generated or _left(made, tested)
            sets.append(_picked(free, draws.rows(free, shots, draw)))
        parts.append((at, fit(_joined(sets))(_picked(test, at.tolist()))))
    values = np.empty((len(fold), *np.shape(parts[0][1])[1:]))
    for at, part in parts:
        values[at] = part
    return values


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
    draws: Draws | None = None,
    *,
    controls: Sequence[str] = (),
    split: str | None = None,
    progress: Progress = quiet,
) -> tuple[StudyTable, Curve]:
    """Material accuracy on real test images, by what the probe was trained on.

    Args:
        train: real features of the train part, with materials and videos.
        test: real features of the test part, with materials and videos.
        generated: name -> features of generated images, with the materials and videos of their
            photos; see the head of this module for which photos.
        draws: how videos are drawn.
        controls: names of ``generated`` that are no generators; the curve leaves them out.
        split: digest of the split, kept in the scores.
        progress: called after every k.

    Returns:
        A table, whose last rows are the paired gains over real videos alone, and the same
        accuracies as a curve over k.

    Raises:
        PalpateError: without labels, or with fewer than two materials.
    """
    draws = draws or Draws()
    for part, features in {"train": train, "test": test, **generated}.items():
        if not any(features.labels or ()):
            must, fix = f"The features of {part!r} must have materials", "Pass a labeled manifest"
            raise PalpateError(must, "none", fix)
    truth, groups = _columns(test)

    def fitted(features: FeatureSet) -> Callable[[FeatureSet], Array]:
        if len({*_columns(features)[0]}) < 2:  # one class is always named
            only = _columns(features)[0][0]
            return lambda rows: np.array([label == only for label in _columns(rows)[0]])
        probe = fit_probe(features, l2=draws.l2)
        return lambda rows: np.array(probe.predict(rows.features)) == np.array(_columns(rows)[0])

    common: dict[str, Any] = {"split": split, "encoder": test.encoder, "estimator": "mean"}
    details = {"chance": 1 / len(set(truth)), "draws": draws.draws}

    def measured(training: Training, label: str, shots: int) -> list[Mean]:
        settings = {"k": shots, "l2": draws.l2}
        fields: dict[str, Any] = {"subject": label, "settings": settings, **common}
        hits = (_tested(draws, draw, test, training, fitted) for draw in range(draws.draws))
        return [mean_of("material accuracy", h, groups, details=details, **fields) for h in hits]

    means: dict[tuple[str, int], list[Mean]] = {}
    for done, shots in enumerate(draws.shots):
        for label, training in _trainings(draws, generated, train, test, shots).items():
            means[label, shots] = measured(training, label, shots)
        progress("training on k videos", done + 1, len(draws.shots))
    text = (
        "Accuracy on real images of new videos, of a linear probe trained on k real videos a "
        "class, on these plus generated images, and on generated images of k videos alone. "
        "Generated images are of photos of other videos than those tested. A k is left out where a "
        "tested class has fewer videos. Gains are paired."
    )
    table = _table(
        "Material accuracy by training data", text, means, draws.shots, generated, controls=controls
    )
    aside = {row for name in controls for row in _rows_of(name)}
    return table, Curve(
        "What generated images add",
        text,
        "videos a class, k",
        "material accuracy",
        _lines({(n, k): runs for (n, k), runs in means.items() if n not in aside}),
        log_x=True,
    )


def _lines(means: Mapping[tuple[str, int], list[Mean]]) -> list[Line]:
    labels = dict.fromkeys(label for label, _ in means)
    return [
        Line(label, [(float(k), over_seeds(runs)) for (n, k), runs in means.items() if n == label])
        for label in labels
    ]


def _table(
    title: str,
    text: str,
    means: Mapping[tuple[str, int], list[Mean]],
    shots: Sequence[int],
    generated: Mapping[str, FeatureSet],
    *,
    controls: Sequence[str],
) -> StudyTable:
    """Rows of what was trained on, and gains over real videos alone; columns of k."""
    rows: list[list[Score | str | None]] = []
    for label in dict.fromkeys(label for label, _ in means):
        cells = (means.get((label, k)) for k in shots)
        rows.append([label, *(over_seeds(runs) if runs else None for runs in cells)])
    gains = [f"{GAIN}{name}" for name in generated]
    for gain, name in zip(gains, generated, strict=True):
        pairs = ((means.get((f"{REAL} + {name}", k)), means.get((REAL, k))) for k in shots)
        rows.append([gain, *(_gain(a, b) if a and b else None for a, b in pairs)])
    columns = ["trained on", *(f"k = {k}" for k in shots)]
    if controls:
        text += " Controls: what retrieval or a perfect generator would add is real touch, and of "
        text += "more videos than k."
    beside = {label for name in controls for label in _rows_of(name)}
    aside = [str(row[0]) for row in rows if row[0] in beside]
    return StudyTable(title, text, columns, rows, controls=aside)


def _rows_of(name: str) -> list[str]:
    """Labels of the rows that images of one name have part in."""
    return [f"{REAL} + {name}", f"{name} alone", f"{GAIN}{name}"]


def _gain(more: Sequence[Mean], less: Sequence[Mean]) -> Score:
    return differences_of_means({more[0].score.subject: more, less[0].score.subject: less})[0]


def utility_claims(table: StudyTable) -> list[Claim]:
    """Generated images help a classifier of real touch: one row a generator of a table of material.

    The gain at the fewest real videos a class decides, where help is needed most; the others are
    listed.
    """
    claims, first = list[Claim](), table.columns[1]
    for label, *cells in table.rows:
        gains = [(k, c) for k, c in zip(table.columns[1:], cells, strict=True) if _is_score(c)]
        if not str(label).startswith(GAIN) or label in table.controls or not gains:
            continue
        scores = [score for _, score in gains]
        each = ", ".join(f"{in_words(score)} at {k}" for k, score in gains)
        why = f"Accuracy on real images of new videos changes by {each} real videos a class."
        if perfect := _gain_of(table, CEILING):
            why += (
                f" Images of a perfect generator would change it by {in_words(perfect)} at {first}."
            )
        name = str(label).removeprefix(GAIN)
        claim = f"Images of {name} help a classifier of real touch"
        claims.append(Claim(claim, "beyond the paper", decide([side_of(scores[0])]), why, scores))
    return claims


def _gain_of(table: StudyTable, name: str) -> Score | None:
    """The gain by images of one name at the fewest videos, if there are such."""
    cell = next((row[1] for row in table.rows if row[0] == f"{GAIN}{name}"), None)
    return cell if _is_score(cell) else None


def _is_score(cell: Any) -> TypeGuard[Score]:
    return isinstance(cell, Score)


def retrieval_utility(
    train: FeatureSet,
    test: FeatureSet,
    keys: FeatureSet,
    generated: Mapping[str, FeatureSet],
    *,
    names: tuple[str, str] = ("tactile", "vision"),
    top: int = 5,
    draws: Draws | None = None,
    controls: Sequence[str] = (),
    split: str | None = None,
) -> StudyTable:
    """How often touch finds its photo or text among the first ``top``, by training data of the map.

    Args:
        train: real tactile features of the train part.
        test: real tactile features of the test part, the queries.
        keys: features of the photos or texts of all samples, generated ones included.
        generated: name -> tactile features of generated images; their keys are by id.
        names: of queries and keys.
        top: how many keys are looked at.
        draws: how videos are drawn.
        controls: names of ``generated`` that are no generators.
        split: digest of the split, kept in the scores.

    Raises:
        PalpateError: if a sample has no key, or the two spaces differ in width.
    """
    draws = draws or Draws()
    if test.features.shape[1] != keys.features.shape[1]:
        got = f"widths {test.features.shape[1]} and {keys.features.shape[1]}"
        must, fix = "Touch and keys must share a space", "Embed both with one set of encoders"
        raise PalpateError(must, got, fix)
    paired = {n: _with_keys(x, keys) for n, x in {"": train, **generated}.items()}
    real, made = paired[""], {n: x for n, x in paired.items() if n}
    wanted = keys.take(list(test.ids))
    texts = wanted.features if names[1] == "text" else None
    width = test.features.shape[1]

    def fitted(rows: FeatureSet) -> Callable[[FeatureSet], Array]:
        weight, bias = linear_map(rows.features[:, :width], rows.features[:, width:], draws.ridge)
        return lambda queries: queries.features @ weight + bias

    def retrieved(queries: NDArray[Any], label: str, shots: int) -> Mean:
        mapped = replace(test, features=queries.astype(np.float32))
        settings = {"k": shots, "ridge": draws.ridge}
        how: dict[str, Any] = {"names": names, "top": (top,), "split": split, "texts": texts}
        return retrieval(mapped, wanted, subject=label, settings=settings, **how)[0].top[0]

    means: dict[tuple[str, int], list[Mean]] = {}
    for shots in draws.shots:
        means["the encoder", shots] = [retrieved(test.features, "the encoder", shots)]
        for label, training in _trainings(draws, made, real, test, shots).items():
            mapped = (_tested(draws, d, test, training, fitted) for d in range(draws.draws))
            means[label, shots] = [retrieved(queries, label, shots) for queries in mapped]
    text = (
        f"Share of real test images whose {names[1]} is among the first {top} by touch, after a "
        "linear map of the tactile features that was fitted to k videos a class; the encoder alone "
        "has none. Generated images are of photos of other videos than those tested."
    )
    title = f"Retrieval of {names[1]} by training data"
    return _table(title, text, means, draws.shots, generated, controls=controls)


def _with_keys(features: FeatureSet, keys: FeatureSet) -> FeatureSet:
    """Tactile features and, to their right, those of their keys."""
    y = keys.take(list(features.ids)).features
    return replace(features, features=np.hstack([features.features, y]), encoder=None)


def linear_map(x: NDArray[Any], y: NDArray[Any], ridge: float) -> tuple[Array, Array]:
    """Weight (d, d) and bias (d,) of the map at the head of this file."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
    a, rest = x - mean_x, (y - mean_y) - (x - mean_x)
    penalty = ridge * len(x) / x.shape[1]
    weight = np.eye(x.shape[1]) + np.linalg.solve(
        a.T @ a + penalty * np.eye(x.shape[1]), a.T @ rest
    )
    return weight, mean_y - mean_x @ weight


def utility(
    manifest: Manifest,
    split: Split,
    encoders: EncoderSet,
    generated: Mapping[str, Generated | Path],
    draws: Draws | None = None,
    *,
    controls: Sequence[str] = (),
    progress: Progress = quiet,
) -> tuple[list[StudyTable], Curve]:
    """Material and retrieval by training data; see the head of this module.

    Args:
        manifest: the samples.
        split: leak-free; its train part gives the real videos, its test part is tested.
        encoders: tactile, vision and text, of which the tactile one must not have seen test images.
        generated: name -> images that were generated for photos of the test part, or their folder.
        draws: how videos are drawn.
        controls: names of ``generated`` that are no generators.
        progress: progress callback.

    Returns:
        Tables of material, of retrieval of photos and, where there are texts, of these; the curve
        of material.

    Raises:
        PalpateError: if the encoder has seen a test image, or as the parts raise.
    """
    parts = {name: manifest.take(split.ids(name)) for name in ("train", "test")}
    guard(encoders, "tactile", parts["test"], split=split, progress=progress)
    real = {n: embed(part, encoders, "tactile", progress=progress) for n, part in parts.items()}
    made = {n: embed_generated(g, manifest, encoders, progress) for n, g in generated.items()}
    how: dict[str, Any] = {"split": split.digest, "controls": controls}
    table, curve = material_utility(
        real["train"], real["test"], made, draws, progress=progress, **how
    )
    tables = [table]
    for kind in ("vision", "text"):
        if kind not in encoders.modalities or not all(manifest.column(kind)):
            continue
        keys = _joined_ids([embed(part, encoders, kind) for part in parts.values()])
        names = ("tactile", kind)
        sets = real["train"], real["test"], keys, made
        tables.append(retrieval_utility(*sets, names=names, draws=draws, **how))
    return tables, curve


def _joined_ids(parts: Sequence[FeatureSet]) -> FeatureSet:
    ids = [i for part in parts for i in part.ids]
    return FeatureSet(ids, np.concatenate([part.features for part in parts]))

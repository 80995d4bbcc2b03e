"""What a leak is worth: material accuracy under a given split and under leak-free ones.

Under a leaking split a test image nearly repeats in train, so remembering is enough; under a
leak-free one the classifier must know the material. The difference, in points of accuracy, is what
leaking is worth. Two classifiers measure it: 1-NN (remembers everything) and a linear probe
(remembers little), on raw pixels or on any embeddings.

1-NN: a test row x gets the label of the train row z with the smallest ||x - z||^2. Equal images are
common (an untouched gel, a frame stored twice), so where several train rows are equally near, the
hit is the share of them with the right label: what a random choice among them would score on
average. Equally near means within the rounding of float32, ``TIE (||x||^2 + max ||z||^2)``.

What is held equal: the samples (train and test of the given split, of materials that can be
compared), the shares, the number of train samples (larger train parts are thinned evenly), the
features and their reduction (fitted to each train part alone), the classifiers, and how the probe's
penalty is chosen (on the train part, leaving out groups).

What can be compared: a material needs two groups, one for each part, and must occur in both parts
of the given and of every leak-free split.

Intervals: 95 %, leaving out one group at a time. Leaving out video v removes its test samples from
both splits at once (the clean side pools the test samples of all its splits), so what is easy or
hard about v cancels in the difference. Train parts stay as they are: the interval says how the
number would vary with other test videos, not with other train videos.

Pixels: the center square as 32 x 32 RGB, row by row. Given features are used as they are if
their rows have length 1 (Euclidean order is then the order by cosine); otherwise their columns are
standardized by the train part.

Reduction: with m the mean of at most ``FIT_ROWS`` train rows X and V the leading right singular
vectors of X - m, a row x becomes (x - m) V. V comes from a subspace iteration with a seeded start
(Halko, Martinsson, Tropp 2011, algorithm 4.4), exact where all columns are kept. Nothing is
whitened.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import FeatureSet, Note, PalpateError, Progress, Split, quiet, require, rng_for
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.leakage.groups import GROUPS
from palpate.leakage.splitting import split as leak_free_split
from palpate.metrics.means import Mean, mean_of, spread_of
from palpate.metrics.probe import fit_probe
from palpate.report.records import Impact, ImpactRow

#: Train samples of the linear probe; its penalty is chosen by twelve fits.
PROBE_ROWS = 10_000
#: Columns kept by the PCA; features of no more columns are not reduced.
COMPONENTS = 128
CLASSIFIERS = ("1-NN", "linear probe")
#: Parts of a split whose samples are compared.
COMPARED = ("train", "test")
#: Entries of a block of distances (float32: 64 MB), of some test rows by all train rows.
CELLS = 1 << 24
#: Rounding of a float32 distance, relative to the squared lengths.
TIE = 2e-6
#: Side of the squares of pixels.
SIZE = 32
#: Train rows that the PCA is fitted to; more change 128 components by less than the choice of the
#: split.
FIT_ROWS = 10_000
#: Rows in memory at a time as floats.
BLOCK = 4096
#: Power iterations and extra directions of the subspace iteration.
POWERS, EXTRA = 4, 16
#: How far from 1 the lengths of normalized rows may be (float16 embeddings are off by 1e-3).
UNIT = 5e-3

Names = NDArray[np.str_]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class _Design:
    """What is compared.

    Attributes:
        table: (n) samples with ``id``, ``material``, ``owner`` (the group) and a column for each
            split: the part of the given one (``split 0``) and of the leak-free ones.
        clean: digests of the latter.
        notes: what was excluded, and what qualifies the result.
        settings: sizes and baselines.
    """

    table: pl.DataFrame
    clean: list[str]
    notes: list[Note]
    settings: dict[str, Any]

    @cached_property
    def material(self) -> Names:
        """(n,) materials."""
        return np.array(self.table["material"].to_list(), dtype=str)

    @cached_property
    def group(self) -> Names:
        """(n,) groups."""
        return np.array(self.table["owner"].to_list(), dtype=str)

    @cached_property
    def splits(self) -> list[tuple[Rows, Rows]]:
        """Numbers of the train and of the test samples, by split."""
        parts = self.table.select(pl.col("^split .*$"))
        train, test = ([(c == part).arg_true().to_numpy() for c in parts] for part in COMPARED)
        return list(zip(train, test, strict=True))


def impact(
    manifest: Manifest,
    split: Split,
    *,
    group: str = "video",
    features: Literal["pixels"] | Mapping[str, FeatureSet] = "pixels",
    seeds: Sequence[int] = (0, 1, 2),
    name: str = "",
    cache: Path | None = None,
    seen: Collection[str] = (),
    progress: Progress = quiet,
) -> Impact:
    """Measure what a split's leak is worth in material accuracy (see the head of this file).

    Args:
        manifest: the samples, with materials.
        split: the split in question; its train and test parts are compared.
        group: column that the leak-free splits keep whole and that intervals are made over.
        features: ``pixels`` (tactile, tactile minus background, vision: those that the manifest
            has), or name -> features of the samples.
        seeds: one leak-free split each; the clean accuracy is that of their test samples together.
        name: of the split, for the headline; default: its rule's name.
        cache: folder for decoded pixels; None keeps nothing.
        seen: features of encoders that were trained on some of the samples; row and headline say
            so.
        progress: called with what is done.

    Returns:
        A row for each kind of features and classifier. The headline is about the first one:
        1-NN on tactile pixels (vision without tactile), or on the first of ``features``; the rule
        is fixed so that nobody picks the largest number.

    Raises:
        PalpateError: without two materials that can be compared, with nulls in the group column, or
            on features that are missing.
        ProblemsError: naming every missing or unreadable image.
    """
    require(len(features) > 0, "features", "must hold features to classify by", features)
    design = _design(manifest, split, group, seeds)
    ids = design.table["id"].to_list()
    if isinstance(features, str):
        sources = pixel_sources(manifest.take(ids), cache=cache, progress=progress)
    else:
        sources = [_given(name, rows.take(ids)) for name, rows in features.items()]
    rows = _measure(design, sources, seen, progress)
    settings = {
        **design.settings,
        "components": COMPONENTS,
        "features": {source.name: source.digest for source in sources},
    }
    title = name or str(split.rule.get("name") or "the given split")
    headline = _headline(rows[0], title, settings)
    return Impact(rows, headline, group, design.clean, settings, design.notes)


def _measure(
    design: _Design, sources: Sequence[Source], seen: Collection[str], progress: Progress
) -> list[ImpactRow]:
    """Rows for each kind of features and classifier."""
    rows: list[ImpactRow] = []
    column, total = design.settings["group"], len(sources) * len(design.splits)
    chance = 1 / len(design.settings["materials"])
    for number, source in enumerate(sources):
        of_splits: list[dict[str, Mean]] = []
        for k, parts in enumerate(design.splits, number * len(design.splits)):
            progress(f"classifying materials by {column}", k, total, source.name)
            of_splits.append(_classify(source, *parts, design))
        for c in CLASSIFIERS:
            row = _row(source.name, c, [means[c] for means in of_splits], chance, column)
            rows.append(replace(row, seen=source.name in seen))
    progress(f"classifying materials by {column}", total, total)
    return rows


def _design(manifest: Manifest, split: Split, group: str, seeds: Sequence[int]) -> _Design:
    """Choose the samples and materials that can be compared, and make leak-free splits."""
    for part in COMPARED:
        must = f"The {part} part must hold samples"
        require(len(split.ids(part)) > 0, None, must, "none", fix="Check the split")
    require(group in GROUPS, "group", f"must be one of {', '.join(GROUPS)}", repr(group), "video")
    inside = manifest.part(split, *COMPARED)
    ids = inside.table.drop_nulls("material")["id"].sort().to_list()  # in any manifest's order
    must, fix = "The impact of a leak needs materials", "Fill the manifest's column material"
    require(len(ids) > 0, None, must, "none in train and test", fix=fix)
    pool = inside.take(ids)
    notes = [Note("no-material", {"count": n})] if (n := len(inside) - len(pool)) else []
    videos = pool.table["video"].drop_nulls().n_unique()
    if group == "contact" and videos not in (0, pool.table["contact"].n_unique()):
        notes.append(Note("shared-videos"))
    if nulls := pool.table[group].null_count():
        must = f"Every sample that is compared needs a {group}"
        fix, example = "Fill the column, or choose another group", {"group": "contact"}
        raise PalpateError(must, f"{nulls} without", fix, example=example)
    parts = pl.Series("split 0", [split.parts[i] for i in ids])
    table = pool.table.select("id", "material", parts, owner=group)
    excluded = _incomparable(table, group)
    table = _without(excluded, table)
    kept = pool.take(table["id"].to_list())
    share = float((table["split 0"] == "train").mean())  # pyright: ignore[reportArgumentType]
    plans = [leak_free_split(kept, train=share, by=group, seed=s) for s in seeds]
    clean = {f"split {k}": [p.parts[i] for i in kept.ids] for k, p in enumerate(plans, 1)}
    table = table.with_columns(pl.Series(name, part) for name, part in clean.items())
    late = _incomparable(table, group)
    excluded |= late
    design = _Design(_without(late, table), [p.digest for p in plans], notes, {})
    splits, materials = design.splits, sorted({*design.table["material"]})
    owners = [[np.unique(design.group[rows]) for rows in parts] for parts in splits]
    test_groups = [len(test) for _, test in owners]
    design.settings.update(
        {
            "given_split": split.digest,
            "group": group,
            "seeds": list(seeds),
            "materials": materials,
            "left_out": excluded,
            "train_samples": min(len(train) for train, _ in splits),
            "test_samples": [len(test) for _, test in splits],
            "test_groups": test_groups,
            "shared_groups": len({*owners[0][0]} & {*owners[0][1]}),
        }
    )
    if excluded:
        params = {"materials": excluded, "total": len(excluded) + len(materials)}
        notes.append(Note("materials-excluded", params))
    if min(test_groups) < 5:
        notes.append(Note("few-test-groups", {"count": min(test_groups), "group": group}))
    return design


def _incomparable(table: pl.DataFrame, column: str) -> dict[str, str]:
    """Materials that cannot be compared, with the reason.

    Raises:
        PalpateError: if fewer than two remain.
    """
    groups = table.group_by("material").agg(pl.col("owner").n_unique()).sort("material").iter_rows()
    groups = dict(groups)
    reasons = {label: f"one {column}" for label, count in groups.items() if count < 2}
    for name, part in product(table.select(pl.col("^split .*$")).columns, COMPARED):
        present = {*table.filter(pl.col(name) == part)["material"]}
        which = "the given" if name == "split 0" else "a leak-free"
        for label in groups.keys() - present:
            reasons.setdefault(label, f"not in {part} of {which} split")
    if len(groups) - len(reasons) < 2:
        counts = ", ".join(f"{n} {why}" for why, n in Counter(reasons.values()).most_common())
        got = f"{len(groups) - len(reasons)} of {len(groups)} ({counts})"
        must = (
            f"There must be two materials in two or more {column}s and in both parts of each split"
        )
        fix = "Add recordings, or choose a finer group (of contacts train and test share videos)"
        got = got if reasons else f"{len(groups)} material"
        raise PalpateError(must, got, fix, example={"group": "contact"})
    return reasons


def _without(excluded: Collection[str], table: pl.DataFrame) -> pl.DataFrame:
    return table.filter(~pl.col("material").is_in(list(excluded)))


def _classify(source: Source, train: Rows, test: Rows, design: _Design) -> dict[str, Mean]:
    """Accuracy of each classifier under one split."""
    size, seed = int(design.settings["train_samples"]), int(design.settings["seeds"][0])
    train = thin(train, design.group[train], design.material[train], size, seed)
    reduction = fit_reduction(source, train, COMPONENTS, seed)
    x, z = reduction.apply(source, train), reduction.apply(source, test)
    owners, material = design.group[train], design.material[train]
    few = thin(np.arange(len(train)), owners, material, min(size, PROBE_ROWS), seed)
    ids, truth = design.table["id"].gather(train[few]).to_list(), design.material[test]
    fitted = FeatureSet(ids, x[few], material[few].tolist(), owners[few].tolist())
    right = np.array(fit_probe(fitted, seed=seed).predict(z)) == truth
    hits = {"1-NN": nearest_hits(z, x, truth, material), "linear probe": right}
    groups = design.group[test].tolist()
    return {c: mean_of(c, hits[c], groups, subject=source.name) for c in CLASSIFIERS}


def _row(
    features: str, classifier: str, means: Sequence[Mean], chance: float, group: str
) -> ImpactRow:
    """One row from the accuracies under the given split and under the leak-free ones."""
    leaking, *leak_free = means
    names = np.concatenate([m.groups for m in leak_free]).tolist()
    hits = np.concatenate([m.values for m in leak_free])
    clean = mean_of(classifier, hits, names, subject=features)
    cost = spread_of([[leaking], [clean]], lambda m: m[..., 0] - m[..., 1])
    a, b = leaking.score, clean.score
    intervals = a.interval, b.interval, cost.interval(-1, 1)
    return ImpactRow(
        features, classifier, float(a), float(b), cost.value, *intervals, chance, group
    )


def _headline(row: ImpactRow, name: str, settings: Mapping[str, Any]) -> str:
    """The one sentence for a paper."""
    count, group = len(settings["seeds"]), settings["group"]
    clean = "the leak-free split" if count == 1 else f"{count} leak-free splits"
    interval, doubt = "", ""
    if row.cost_interval:
        low, high = row.cost_interval
        interval = f" [{100 * low:.1f}, {100 * high:.1f}]"
        doubt = ", which may be nothing" if low <= 0 <= high else ""
    features = f"{row.features}, trained on some of these images" if row.seen else row.features
    start = (
        f"{row.classifier} on {features}: {100 * row.given:.1f} % under {name}, "
        f"{100 * row.clean:.1f} % under {clean} by {group} (chance {100 * row.chance:.1f} %)"
    )
    points = f"{100 * row.cost:.1f} points{interval}"
    if not settings["shared_groups"]:
        return f"{start}: {name} shares no {group}, and the difference is {points}."
    return f"{start}: leaking is worth {points}{doubt}."


def nearest_hits(
    queries: NDArray[np.float32], base: NDArray[np.float32], truth: Names, labels: Names
) -> NDArray[np.float64]:
    """Probability (m,) that 1-NN gets each query right, ties being broken at random.

    Queries (m, d) and base (n, d) have classes by name.
    """
    names, code = np.unique(labels, return_inverse=True)
    one_hot = np.eye(len(names), dtype=np.float32)[code]
    length = np.einsum("ij,ij->i", base, base)
    out = np.empty(len(queries))
    step = max(1, CELLS // len(base))
    for start in range(0, len(queries), step):
        x = queries[start : start + step]
        distance = x @ base.T
        distance *= -2
        distance += length
        rounding = TIE * (np.einsum("ij,ij->i", x, x) + length.max())
        tied = distance <= (distance.min(axis=1) + rounding)[:, None]
        # Sums of at most 2^24 ones are exact in float32.
        votes = tied.astype(np.float32) @ one_hot
        right = (votes * (names == truth[start : start + step, None])).sum(axis=1)
        out[start : start + step] = right / votes.sum(axis=1)
    return out


def thin(rows: Rows, groups: NDArray[Any], classes: NDArray[Any], count: int, seed: int) -> Rows:
    """Choose rows evenly: every class keeps its share (at least one row), and so every group.

    Each class gets ``count * n_c / n`` rows, rounded so that the sum is ``count``; within a class
    the rows, sorted by group and at random within it, are taken at equal steps from a random start,
    so a group keeps its share to within one row. ``count`` is at least the number of classes. The
    rows come in a random order.
    """
    rng = rng_for(seed, "impact thin", count)
    order = rng.permutation(len(rows))
    if len(rows) <= count:
        return rows[order]
    names, sizes = np.unique(classes, return_counts=True)
    exact = count * sizes / len(rows)
    quota = np.maximum(np.floor(exact), 1).astype(np.int64)
    while (off := count - int(quota.sum())) != 0:
        room = (quota < sizes) if off > 0 else (quota > 1)
        gap = np.where(room, (exact - quota) * np.sign(off), -np.inf)
        quota[int(gap.argmax())] += np.sign(off)
    chosen: list[Rows] = []
    for name, share in zip(names, quota, strict=True):
        of_class = order[classes[order] == name]
        line = of_class[np.argsort(groups[of_class], kind="stable")]
        at = (np.arange(share) + rng.random()) * len(line) / share
        chosen.append(line[at.astype(np.int64)])
    return rows[rng.permutation(np.concatenate(chosen))]


@dataclass(frozen=True)
class Source:
    """One kind of features of n samples.

    Attributes:
        name: e.g. ``tactile pixels``.
        width: columns.
        read: rows by number -> (rows, width) float32.
        standardize: divide columns by their spread in the train part.
        digest: SHA-256 of the values of all rows, or of the encoder that made them.
    """

    name: str
    width: int
    read: Callable[[Rows], NDArray[np.float32]]
    standardize: bool
    digest: str


@dataclass(frozen=True)
class Reduction:
    """``((x - mean) / spread) @ axes``."""

    mean: NDArray[np.float32]
    spread: NDArray[np.float32]
    axes: NDArray[np.float32]

    def apply(self, source: Source, rows: Rows) -> NDArray[np.float32]:
        """The reduced features of some rows, (rows, components)."""
        blocks = [rows[start : start + BLOCK] for start in range(0, len(rows), BLOCK)]
        reduced = [((source.read(b) - self.mean) / self.spread) @ self.axes for b in blocks]
        return np.vstack(reduced).astype(np.float32, copy=False)


def pixel_sources(
    manifest: Manifest, *, cache: Path | None = None, progress: Progress = quiet
) -> list[Source]:
    """The kinds of pixels that a manifest has.

    Raises:
        PalpateError: if there are neither vision nor tactile images, or only some samples have one.
        ProblemsError: naming every missing or unreadable file.
    """
    nulls = {
        name: manifest.table[name].null_count() for name in ("tactile", "vision", "background")
    }
    present = [name for name in ("tactile", "vision") if nulls[name] < len(manifest)]
    fix = "Import the data set with its images (palpate import), and take the import"
    must = "Pixels as features need vision or tactile images"
    require(len(present) > 0, None, must, "names alone", fix=fix)
    sources: list[Source] = []
    for name in present:
        images = cached_images(manifest, name, SIZE, cache, progress)
        sources.append(_pixels(f"{name} pixels", images))
        if name == "tactile" and not nulls["background"]:
            background = cached_images(manifest, "background", SIZE, cache, progress)
            sources.append(_pixels("tactile minus background", images, background))
    return sources


def _given(name: str, rows: FeatureSet) -> Source:
    x = rows.features.astype(np.float32, copy=False)
    unit = bool((np.abs(np.linalg.norm(x, axis=1) - 1) < UNIT).all())
    return Source(name, x.shape[1], lambda at: x[at], not unit, rows.encoder or _digest(x))


def _pixels(name: str, images: NDArray[np.uint8], *less: NDArray[np.uint8]) -> Source:
    """Images as rows, minus other images where given; all (n, size, size, 3)."""

    def read(at: Rows) -> NDArray[np.float32]:
        x = images[at].astype(np.float32)
        for other in less:
            x -= other[at]
        return x.reshape(len(at), -1)

    return Source(name, int(np.prod(images.shape[1:])), read, False, _digest(images, *less))


def _digest(*arrays: NDArray[Any]) -> str:
    state = hashlib.sha256()
    for array in arrays:
        state.update(repr((array.dtype.str, array.shape)).encode())
        for start in range(0, len(array), BLOCK):
            state.update(np.ascontiguousarray(array[start : start + BLOCK]).data)
    return state.hexdigest()


def fit_reduction(source: Source, train: Rows, components: int, seed: int) -> Reduction:
    """The PCA at the head of this file, of the rows ``train``, whose order says nothing.

    Features of no more columns than ``components`` are only centered (and standardized).
    """
    used = train if len(train) <= FIT_ROWS else train[np.arange(FIT_ROWS) * len(train) // FIT_ROWS]
    x = source.read(used)
    mean = x.mean(axis=0, dtype=np.float64).astype(np.float32)
    x = x - mean
    spread = x.std(axis=0) if source.standardize else np.ones(source.width, np.float32)
    # Columns that do not vary in train have no scale, and add the same to all distances.
    flat = np.ptp(x, axis=0) <= 1e-6 * np.maximum(np.abs(mean), 1e-30)
    spread = np.where(flat, 1, spread).astype(np.float32)
    x /= spread
    if source.width <= components:
        return Reduction(mean, spread, np.eye(source.width, dtype=np.float32)[:, ~flat])
    width = min(components + EXTRA, *x.shape)
    start = rng_for(seed, "impact pca", source.name).standard_normal((source.width, width))
    basis = start.astype(np.float32)
    for _ in range(POWERS):
        basis = np.linalg.qr(x.T @ (x @ basis))[0]
    values, turn = np.linalg.eigh(((y := x @ basis).T @ y).astype(np.float64))
    values, turn = values[::-1][:components], turn[:, ::-1][:, :components]
    kept = values > 1e-7 * max(values[0], 1e-30)
    return Reduction(mean, spread, basis @ turn[:, kept].astype(np.float32))

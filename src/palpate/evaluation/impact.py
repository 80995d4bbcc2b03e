"""What leaking costs: material accuracy of simple classifiers under a given split and under leak-free ones of the same shares.

Under a leaking split a test picture nearly stands in train, so that remembering is enough; under a leak-free one the classifier must know
the material. The difference, in points of accuracy, is what leaking is worth. Two classifiers that need no training worth the name measure it:
1-NN (remembers everything) and a linear probe (remembers little), on raw pixels or on any embeddings.

What is held equal: the samples (those of the given split's train and test parts, of materials that can be compared), the shares, the number of
train samples (the larger train sides are thinned evenly, :func:`palpate.evaluation.impact_scores.thin`), the features and their reduction
(fitted to each train side alone), the classifiers, and how the probe's penalty is chosen (on the train side, by leaving out groups).

What can be compared: a material needs two groups, one for each side, and must occur on both sides of the given and of every leak-free split.

Intervals: 95 %, by leaving out one group at a time. Leaving out video v removes its test samples from both sides at once (the clean side pools
the test samples of all its splits), so that what is easy or hard about v cancels in the difference. Train sides stay as they are: the
interval tells how the number would vary with other test videos, not with other train videos.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, PalpateError, Progress, Split, quiet
from palpate.data.manifest import Manifest
from palpate.evaluation.impact_features import (
    Rows,
    Source,
    array_sources,
    fit_reduction,
    pixel_sources,
)
from palpate.evaluation.impact_scores import (
    Codes,
    Table,
    accuracy,
    code,
    jackknife,
    nearest_hits,
    tabulate,
    thin,
)
from palpate.leakage.audit import GROUPS
from palpate.leakage.splits import choose_group, leak_free_split
from palpate.metrics.probe import fit_probe
from palpate.report.results import Impact, ImpactRow

#: Train samples of the linear probe; its penalty is chosen by twelve fits.
PROBE_ROWS = 10_000
CLASSIFIERS = ("1-NN", "linear probe")
Features = Literal["pixels"] | Mapping[str, FeatureSet | NDArray[np.floating]]


@dataclass(frozen=True)
class _Side:
    """One split of the compared samples: row numbers of its train and test sides."""

    digest: str
    train: Rows
    test: Rows


@dataclass(frozen=True)
class _Design:
    """What is compared: samples (ids and rows of the manifest), their materials and groups, and the given split followed by the clean ones.

    ``material`` and ``group`` are codes into ``classes`` and ``groups``, one a sample; ``sides`` number the samples from 0.
    """

    ids: list[str]
    rows: Rows
    material: Codes
    group: Codes
    classes: list[str]
    groups: list[str]
    sides: list[_Side]
    notes: list[str]
    settings: dict[str, Any]


def impact(
    manifest: Manifest,
    split: Split,
    *,
    group: str = "video",
    features: Features = "pixels",
    seeds: Sequence[int] = (0, 1, 2),
    size: int = 32,
    components: int = 128,
    balanced: bool = False,
    name: str = "",
    cache: Path | None = None,
    progress: Progress = quiet,
) -> Impact:
    """Measures what a split's leak is worth in material accuracy (see the head of this file).

    Args:
        manifest: the samples, with materials.
        split: the split in question; its train and test parts are compared, a validation part is left aside.
        group: column that the leak-free splits keep whole and that intervals are made over; ``auto`` chooses as
            :func:`palpate.leakage.splits.choose_group` does.
        features: ``pixels`` (touch, touch minus background, vision: whichever the manifest has), or name -> features, e.g. a encoder's embeddings,
            as a :class:`FeatureSet` or an (n, d) array in the order of ``manifest.ids``.
        seeds: one leak-free split each; the clean accuracy is that of their test samples together.
        size: side of the pixels.
        components: columns kept by the PCA; features with no more columns are not reduced.
        balanced: average accuracies over materials instead of over samples.
        name: of the split, for the sentence; default: its rule's name.
        cache: folder for decoded pixels; None keeps nothing.
        progress: told what is being done.

    Returns:
        A row for each kind of features and classifier. The headline is about the first one: 1-NN on touch pixels (on vision without touch), or on
        the first of ``features``; the rule is fixed so that nobody picks the largest number.

    Raises:
        PalpateError: without materials, with fewer than two that can be compared, with nulls in the group column, on ids that the
            manifest lacks, and on features that are missing, of another length, or not finite.
        ProblemsError: naming every missing or unreadable image.
    """
    _require(features, seeds, components)
    design = _design(manifest, split, group, seeds)
    notes = list(design.notes)
    if isinstance(features, str):
        sources, more = pixel_sources(
            manifest.take(design.ids), size=size, cache=cache, progress=progress
        )
        notes += more
    else:
        sources = array_sources(features, manifest, design.ids, design.rows)
    rows: list[ImpactRow] = []
    facts: dict[str, Any] = {}
    total = len(sources) * len(design.sides)
    for at, source in enumerate(sources):
        tables: dict[str, list[Table]] = {c: [] for c in CLASSIFIERS}
        fact: dict[str, Any] = {
            "digest": source.digest,
            "columns": source.width,
            "standardized": source.standardize,
            "penalty": [],
            "explained": [],
        }
        for k, side in enumerate(design.sides):
            progress("classifying materials", at * len(design.sides) + k, total, source.name)
            found, penalty, explained = _classify(source, side, design, components)
            for c in CLASSIFIERS:
                tables[c].append(found[c])
            fact["penalty"].append(penalty)
            fact["explained"].append(round(explained, 4))
        for c in CLASSIFIERS:
            rows.append(_row(source.name, c, tables[c], len(design.classes), balanced))
            fact[c] = [round(accuracy(t, balanced), 5) for t in tables[c]]
        facts[source.name] = fact
    progress("classifying materials", total, total)
    settings = {
        **design.settings,
        "size": size if features == "pixels" else None,
        "components": components,
        "balanced": balanced,
        "features": facts,
        "interval": "leave-one-group-out jackknife over test groups, paired, t, 95 %",
    }
    headline = _headline(
        rows[0], name or str(split.rule.get("name") or "the given split"), design.settings, balanced
    )
    return Impact(
        rows,
        headline,
        design.settings["group"],
        [s.digest for s in design.sides[1:]],
        settings,
        notes,
    )


def _require(features: Features, seeds: Sequence[int], components: int) -> None:
    if isinstance(features, str) and features != "pixels":
        raise PalpateError(
            "Features must be 'pixels' or a mapping name -> features",
            repr(features),
            "Pass features={name: embeddings}",
        )
    if not seeds or len(set(seeds)) < len(seeds):
        raise PalpateError(
            "There must be at least one seed, and each once",
            f"{list(seeds)}",
            "Pass e.g. seeds=(0, 1, 2)",
        )
    if components < 1:
        raise PalpateError(
            "The PCA must keep at least one component", f"{components}", "Pass e.g. components=128"
        )


def _design(manifest: Manifest, split: Split, group: str, seeds: Sequence[int]) -> _Design:
    """Chooses the samples and materials that can be compared, and makes the leak-free splits of them."""
    manifest.take(split.ids("train", "test"))  # names ids that are missing
    for part in ("train", "test"):
        if not split.ids(part):
            raise PalpateError(f"The {part} part must hold samples", "none", "Check the split")
    part_of = [split.parts.get(i) for i in manifest.ids]
    labels = manifest.column("material")
    inside = [k for k, part in enumerate(part_of) if part in ("train", "test")]
    names = manifest.ids
    rows = sorted(
        (k for k in inside if labels[k]), key=lambda k: names[k]
    )  # so that the order of the manifest does not matter
    if not rows:
        raise PalpateError(
            "The impact of leaking needs materials",
            "none in train and test",
            "Fill the manifest's column material",
        )
    notes = (
        [f"{n} samples without a material are left out."] if (n := len(inside) - len(rows)) else []
    )
    if "val" in split.parts.values():
        notes.append(
            "The validation part of the given split is left aside; the leak-free splits are made of its train and test samples."
        )
    pool = manifest.take([names[k] for k in rows])
    column, reason = choose_group(pool) if group == "auto" else (group, "")
    notes += [reason] if reason else []
    owners = _owners(pool, column)
    if column == "contact" and pool.table["video"].drop_nulls().n_unique() not in (
        0,
        pool.table["contact"].n_unique(),
    ):
        notes.append(
            "Whole touches are kept together, but train and test share videos: what a shared video is worth is not in this number, and touches "
            "of one video are less independent than the intervals take them to be."
        )
    here = [labels[k] for k in rows]
    given = [str(part_of[k]) for k in rows]
    left_out = _incomparable(here, owners, [given], column)
    rows, here, owners, given = _keep(rows, here, owners, given, left_out=left_out)
    share = given.count("train") / len(given)
    kept = manifest.take([names[k] for k in rows])
    plans = [leak_free_split(kept, train=share, group=column, seed=s) for s in seeds]
    parts = [given, *([p.split.parts[i] for i in kept.ids] for p in plans)]
    late = _incomparable(here, owners, parts, column)
    rows, here, owners, *parts = _keep(rows, here, owners, *parts, left_out=late)
    left_out |= late
    if left_out:
        notes.append(
            f"Left out ({len(left_out)} of {len(left_out) + len(set(here))} materials): "
            + "; ".join(f"{m} ({why})" for m, why in sorted(left_out.items()))
            + "."
        )
    digests = [split.digest, *(p.split.digest for p in plans)]
    sides = [
        _Side(d, *(np.flatnonzero(np.array(p) == side) for side in ("train", "test")))
        for d, p in zip(digests, parts, strict=True)
    ]
    if (same := len(plans) - len(set(digests[1:]))) > 0:
        notes.append(
            f"{same} of {len(plans)} seeds gave a leak-free split that another gave: there are too few {column} groups for more."
        )
    classes, material = code(here)
    groups, owner = code(owners)
    settings = _facts(split, column, list(seeds), share, classes, left_out, sides, owner, material)
    settings["deviation"] = [round(p.deviation, 5) for p in plans]
    if settings["shared_groups"] == 0:
        notes.append(
            f"The given split shares no {column} between train and test: a difference is due to which of them are in test."
        )
    if (guess := settings["majority"][0]) > 1.5 / len(classes):
        scores = f"{guess:.1%} under the given split".replace("%", " %")
        notes.append(
            f"Materials are not equally common. Always guessing the commonest material of train scores {scores}, not chance."
        )
    if (few := min(settings["test_groups"])) < 5:
        notes.append(
            f"A test part holds {few} {column} group(s) only: the intervals are wide, and too trusting if anything."
        )
    return _Design(
        [names[k] for k in rows],
        np.array(rows),
        material,
        owner,
        classes,
        groups,
        sides,
        notes,
        settings,
    )


def _owners(pool: Manifest, column: str) -> list[str]:
    """The group of each sample."""
    if column not in GROUPS:
        raise PalpateError(
            f"The group must be auto or one of {', '.join(GROUPS)}",
            repr(column),
            "Pass e.g. --group video",
        )
    if nulls := pool.table[column].null_count():
        raise PalpateError(
            f"Every sample that is compared needs a {column}",
            f"{nulls} without",
            "Fill the column, or choose another group: --group touch",
        )
    return pool.column(column)


def _incomparable(
    labels: Sequence[str], owners: Sequence[str], splits: Sequence[Sequence[str]], column: str
) -> dict[str, str]:
    """Materials that cannot be compared, with the reason.

    Raises:
        PalpateError: if fewer than two are left.
    """
    groups = Counter(label for label, _ in set(zip(labels, owners, strict=True)))
    seen = [set(zip(labels, parts, strict=True)) for parts in splits]
    out: dict[str, str] = {}
    for label, count in groups.items():
        if count < 2:
            out[label] = f"one {column}"
            continue
        for at, pairs in enumerate(seen):
            for part in ("train", "test"):
                if label not in out and (label, part) not in pairs:
                    out[label] = (
                        f"not in {part} of {'the given' if at == 0 else 'a leak-free'} split"
                    )
    if len(groups) - len(out) < 2:
        reasons = Counter(out.values())
        raise PalpateError(
            f"What leaking costs can be told for materials in two or more {column}s that are on both sides of each split; it takes two materials",
            f"{len(groups) - len(out)} of {len(groups)} ({', '.join(f'{n} {why}' for why, n in reasons.most_common())})"
            if out
            else f"{len(groups)} material",
            f"Choose a finer group than {column}, e.g. --group touch (train and test then share videos), or add recordings",
        )
    return out


def _keep(
    rows: Sequence[int], labels: Sequence[str], *columns: Sequence[Any], left_out: Mapping[str, str]
) -> tuple[list[int], list[str], *tuple[list[Any], ...]]:
    """Rows, labels and further columns without the samples of some materials."""
    keep = [k for k, label in enumerate(labels) if label not in left_out]
    pick = lambda column: [column[k] for k in keep]  # noqa: E731
    return (pick(rows), pick(labels), *(pick(c) for c in columns))


def _facts(
    split: Split,
    column: str,
    seeds: list[int],
    share: float,
    classes: list[str],
    left_out: Mapping[str, str],
    sides: list[_Side],
    owner: Codes,
    material: Codes,
) -> dict[str, Any]:
    """Sizes and baselines of all sides as JSON; lists are in the order given, then clean by seed."""
    size = min(len(s.train) for s in sides)
    common = [int(np.bincount(material[s.train]).argmax()) for s in sides]
    return {
        "given_split": split.digest,
        "group": column,
        "seeds": seeds,
        "train_share": round(share, 5),
        "materials": classes,
        "left_out": dict(left_out),
        "train_samples": size,
        "probe_train_samples": min(size, PROBE_ROWS),
        "test_samples": [len(s.test) for s in sides],
        "test_groups": [len(np.unique(owner[s.test])) for s in sides],
        "shared_groups": len(np.intersect1d(owner[sides[0].train], owner[sides[0].test])),
        "majority": [
            round(float((material[s.test] == c).mean()), 5)
            for s, c in zip(sides, common, strict=True)
        ],
    }


def _classify(
    source: Source, side: _Side, design: _Design, components: int
) -> tuple[dict[str, Table], float, float]:
    """Both classifiers on one split: a table each, the probe's penalty, and the share of variance that the PCA kept."""
    shape = (len(design.groups), len(design.classes))
    size, seed = int(design.settings["train_samples"]), int(design.settings["seeds"][0])
    train = thin(side.train, design.group[side.train], design.material[side.train], size, seed)
    reduction = fit_reduction(source, train, components, seed)
    x, z = reduction.apply(source, train), reduction.apply(source, side.test)
    y, truth, owner = design.material[train], design.material[side.test], design.group[side.test]
    few = thin(np.arange(len(train)), design.group[train], y, min(size, PROBE_ROWS), seed)
    pick = lambda names, codes: [names[k] for k in codes.tolist()]  # noqa: E731
    rows = train[few]
    known = FeatureSet(
        pick(design.ids, rows),
        x[few],
        pick(design.classes, y[few]),
        pick(design.groups, design.group[rows]),
    )
    probe = fit_probe(known, seed=seed)
    number = {name: k for k, name in enumerate(design.classes)}
    guess = np.array([number[c] for c in probe.predict(z)])
    hits = {
        "1-NN": nearest_hits(z, x, truth, y),
        "linear probe": (guess == truth).astype(np.float64),
    }
    return (
        {c: tabulate(hits[c], owner, truth, shape) for c in CLASSIFIERS},
        probe.l2,
        reduction.explained,
    )


def _row(
    features: str, classifier: str, tables: Sequence[Table], classes: int, balanced: bool
) -> ImpactRow:
    """One row from the tables of the given split and of the clean ones."""
    given, clean = tables[0], tables[1]
    for more in tables[2:]:
        clean = clean + more
    a, a_range, _ = jackknife(given, balanced=balanced)
    b, b_range, _ = jackknife(clean, balanced=balanced)
    cost, range_, _ = jackknife(given, clean, balanced=balanced)
    return ImpactRow(features, classifier, a, b, cost, a_range, b_range, range_, 1 / classes)


def _headline(row: ImpactRow, name: str, settings: Mapping[str, Any], balanced: bool) -> str:
    """The one sentence for a paper."""
    clean = (
        "the leak-free split"
        if len(settings["seeds"]) == 1
        else f"{len(settings['seeds'])} leak-free splits"
    )
    span = (
        f" [{100 * row.cost_interval[0]:.1f}, {100 * row.cost_interval[1]:.1f}]"
        if row.cost_interval
        else ""
    )
    kind = " (balanced)" if balanced else ""
    start = (
        f"{row.classifier} on {row.features}{kind}: {100 * row.given:.1f} % under {name}, {100 * row.clean:.1f} % under {clean} by "
        f"{settings['group']} (chance {100 * row.chance:.1f} %)"
    )
    points = f"{100 * row.cost:.1f} points{span}"
    if not settings["shared_groups"]:
        return f"{start}: {name} shares no {settings['group']}, and the difference is {points}."
    doubt = (
        ", which may be nothing"
        if row.cost_interval and row.cost_interval[0] <= 0 <= row.cost_interval[1]
        else ""
    )
    return f"{start}: leaking is worth {points}{doubt}."

"""What an encoder's embeddings know: classes by a linear probe and k-NN, and retrieval.

A classifier is trained on the train part of a split and scored on its test part; retrieval is
within the test part. Several encoders, or several splits, become columns next to each other with
paired differences: a video is left out of both at once. Under two splits the pools of retrieval get
one size, that of the smaller test part, since chance depends on it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from palpate.core import (
    FeatureSet,
    Measure,
    Note,
    PalpateError,
    Progress,
    Score,
    Split,
    quiet,
    require,
    require_choice,
    rng_for,
)
from palpate.core.features import is_missing
from palpate.core.files import canonical_json
from palpate.data.recordings import described, resampled_by, rule_notes
from palpate.data.samples import Samples, judged, read_samples
from palpate.data.slices import is_parted
from palpate.data.storage import alike
from palpate.encoders.guard import backed
from palpate.evaluation.power import power
from palpate.metrics.intervals import without_interval
from palpate.metrics.means import Mean, over_seeds
from palpate.metrics.paired import differences_of_means
from palpate.metrics.probe import class_accuracies
from palpate.metrics.retrieval import TIE, Floats, retrieval, unit_rows
from palpate.report.labels import measured, subject_of, verdict_of_two
from palpate.report.records import Match, Strip
from palpate.report.results import Call, Results

if TYPE_CHECKING:
    from palpate.data.manifest import Manifest

Modality = Literal["vision", "tactile"]
#: TVL's cosine of captions from which a text counts as right (its OpenCLIP ViT-L/14).
TVL_THRESHOLD = 0.6356
#: Queries shown for each direction, and keys shown for each of them.
STRIPS, SHOWN = 4, 6


@dataclass(frozen=True)
class Plan:
    """What is measured.

    Attributes: see :func:`probe`; ``pools`` are the test samples that every split has of each
    other modality; ``axis`` is what several subjects differ in (``encoder``, ``split``), '' for
    one; ``trained`` if an encoder was trained for each split; ``sure`` if it is known what belongs
    together; ``notes`` say so.
    """

    modality: Modality = "tactile"
    label: str | Sequence[str] = "material"
    group: str = "auto"
    top: Sequence[int] = (1, 5, 10)
    pool: int | None = None
    text_threshold: float = TVL_THRESHOLD
    seed: int = 0
    allow_seen: bool = False
    axis: str = ""
    trained: bool = False
    pools: Mapping[str, int] = field(default_factory=dict[str, int])
    sure: bool = True
    notes: Sequence[Note] = ()

    @property
    def settings(self) -> dict[str, Any]:
        """What the scores keep of it."""
        return {"axis": self.axis} if self.axis else {}


@dataclass
class Probed:
    """What one encoder scores under one split: means, median ranks, retrieved keys, notes; and, by
    label, the test features.
    """

    means: list[Mean] = field(default_factory=list[Mean])
    medians: list[Score] = field(default_factory=list[Score])
    strips: list[Strip] = field(default_factory=list[Strip])
    notes: list[Note] = field(default_factory=list[Note])
    labeled: dict[str, FeatureSet] = field(default_factory=dict[str, FeatureSet])


def probe(  # noqa: PLR0913 - one argument a choice
    data: Manifest | str | Path,
    split: Any,
    *,
    encoder: Any = None,
    against: Any = None,
    modality: Modality = "tactile",
    label: str | Sequence[str] = "material",
    group: str = "auto",
    top: Sequence[int] = (1, 5, 10),
    pool: int | None = None,
    text_threshold: float = TVL_THRESHOLD,
    seed: int = 0,
    allow_seen: bool = False,
    cache: str | Path | None = None,
    progress: Progress = quiet,
) -> Results:
    """Score how well embeddings name classes, and find the text and image that belong to a sample.

    Args:
        data: a manifest with images of the modality, or its file or folder; or a folder of
            ``palpate embed``, with which no encoder goes and nothing is retrieved.
        split: a split or its file; classifiers are fitted to its train part and scored on its test
            part. Several, as a list or name -> split, are compared.
        encoder: name or folder of a set of encoders, or an ``EncoderSet``. Several, as a list or
            name -> encoders, are compared; not together with several splits.
        against: another encoder, to choose between the two: adds how often TMMD by each tells two
            classes apart with 5, 10, 20 and 40 test recordings a side
            (:mod:`palpate.evaluation.power`), and which is better by which scores.
        modality: whose encoder.
        label: columns to predict; those that the data lack, or that have one value in train, are
            left out, with a note.
        group: level whose units stay together in cross-validation and intervals, as in
            :func:`palpate.score`: ``auto`` takes the coarsest with eight units or more, from what
            the split kept whole on. Where nothing is known, or units are fewer, there are no
            intervals.
        top: ranks within which retrieval must find a right key; none skips retrieval.
        pool: rank among so many test samples drawn at random. Default: all, and under several
            splits as many as the smallest test part has.
        text_threshold: cosine of two texts from which one counts as right for the other's sample,
            next to strict retrieval; the default is TVL's, for its text encoder.
        seed: of the folds of the cross-validation, the pools and the queries that are shown.
        allow_seen: probe an encoder that was trained on some of the test images; every score says
            so.
        cache: folder for embeddings, which an interrupted run finds again.
        progress: called with what is done.

    Returns:
        Accuracy and balanced accuracy by a linear probe and k-NN, next to chance and the commonest
        class; retrieval in both directions within the test part; and paired differences.

    Raises:
        PalpateError: if nothing can be measured, images are missing or unreadable, or the encoder
            was trained on test images.
    """
    arguments = locals()
    require_choice("modality", modality, ("tactile", "vision"))
    from palpate.data.reading import load
    from palpate.encoders.guard import load_encoders

    parted = isinstance(data, str | Path) and is_parted(Path(data))
    kept = read_samples(data, "data") if parted else None
    must = "must go with images, and not with embeddings"
    require((kept is None) == (encoder is not None), "encoder", must, str(encoder))
    if kept is not None:
        top, modality = (), kept.made["modality"]
    manifest = load(data) if kept is None else kept.manifest
    splits, encoders = named(split, "split"), named(kept or encoder, "encoder")
    several = {"split": splits, "encoder": encoders}  # names are those of today's files
    arguments |= {name: sets for name, sets in several.items() if len(sets) > 1}
    call = Call.of("probe", probe, arguments)
    if against is not None:
        one = len(encoders) == len(splits) == 1
        require(one, "against", "must go with one encoder and one split", "several", fix="Drop it")
        encoders = named([*encoders.values(), against], "encoder")
    must, fix = "must be one where several splits are compared", "Compare one at a time"
    single = len(splits) == 1 or len(encoders) == 1
    require(single, "encoder", must, len(encoders), fix=fix)
    loaded = {name: Split.load(s) for name, s in splits.items()}
    sets = {name: load_encoders(e, progress) for name, e in encoders.items()}
    axis = "split" if len(splits) > 1 else "encoder" if len(sets) > 1 else ""
    plan = plan_of(
        manifest,
        loaded,
        Plan(modality, label, group, top, pool, text_threshold, seed, allow_seen, axis),
    )
    runs: dict[str, list[Probed]] = {}
    touch = modality == "tactile"
    rulers = [n for n, e in sets.items() if touch and not kept and e.preprocess(modality).residual]
    for s, e in ((s, e) for s in loaded for e in sets):
        subject = {"split": s, "encoder": e}.get(axis, "real")
        runs[subject] = [
            measure(manifest, loaded[s], sets[e], subject, plan, cache=cache, progress=progress)
        ]
    if against is not None and plan.sure:
        firsts = {name: run.labeled for name, (run,) in runs.items()}
        (tested,) = loaded.values()
        for name in next(iter(firsts.values())):
            found = power(
                {subject: labeled[name] for subject, labeled in firsts.items()},
                name,
                rulers=rulers,
                seed=seed,
                progress=progress,
                split=tested.digest,
                settings=plan.settings,
            )
            for subject, means in found.items():
                runs[subject][0].means += means
    results = results_of(f"Probe of the {modality} encoder", runs, plan, manifest, loaded)
    digests = {
        f"{modality} encoder{f' {name}' if axis == 'encoder' else ''}": e.encoder
        if kept
        else e.digest(modality)
        for name, e in sets.items()
    }
    digests = {**results.settings["digests"], **digests}
    settings, calls = {**results.settings, "digests": digests}, [call.with_digests(digests)]
    notes = [*results.notes]
    if against is not None and plan.sure:
        notes += verdict_of_two(sets, results.scores)
    return replace(results, settings=settings, calls=calls, notes=notes)


def plan_of(manifest: Manifest, splits: Mapping[str, Split], plan: Plan) -> Plan:
    """The plan with its labels listed, its group chosen, and the pool sizes of all splits."""
    labels = [plan.label] if isinstance(plan.label, str) else list(plan.label)
    for name in labels:
        manifest.column(name)  # raises for a column that is not there
    require(min(plan.top, default=1) >= 1, "top", "must be ranks from 1", [*plan.top])
    kept = {str(split.rule["group"]) for split in splits.values() if "group" in split.rule}
    parts = [manifest.part(s, part).table for s in splits.values() for part in ("train", "test")]
    parts = [table for table in parts if len(table)]
    only = kept.pop() if len(kept) == 1 else ""
    group, doubt, notes = resampled_by(parts, plan.group, only, paired=True)
    notes += [n for s in splits.values() for n in rule_notes(described(manifest, s).rule)]
    sizes = [len(split.ids("test")) for split in splits.values()]
    must = f"must lie in 2 to {min(sizes)}, the number of test samples"
    require(plan.pool is None or 2 <= plan.pool <= min(sizes), "pool", must, plan.pool)
    threshold = plan.text_threshold
    require(-1 <= threshold <= 1, "text_threshold", "must lie in [-1, 1]", threshold, TVL_THRESHOLD)
    tests = [manifest.part(split, "test") for split in splits.values()]
    tests = [test.take(_with(test, plan.modality)) for test in tests]
    counts = {other: [len(_with(test, other)) for test in tests] for other in _others(plan)}
    pools = {other: min((n for n in ns if n > 1), default=0) for other, ns in counts.items()}
    return replace(
        plan,
        label=labels,
        top=tuple(plan.top),
        group=group,
        pools=pools,
        sure=doubt is None,
        notes=[*notes, *filter(None, [doubt])],
    )


def measure(
    manifest: Manifest,
    split: Split,
    encoders: Any,
    subject: str,
    plan: Plan,
    *,
    cache: str | Path | None = None,
    progress: Progress = quiet,
) -> Probed:
    """Everything that one set of encoders scores under one split; of a ruler on one kind of
    background for all samples.

    Raises:
        PalpateError: if nothing can be measured.
    """
    from palpate.encoders.embed import embed
    from palpate.encoders.guard import guard

    folder = None if cache is None else Path(cache)
    groups = "id" if plan.group == "frame" else plan.group
    embedded = partial(embed, groups=groups, cache=folder, raw=True, progress=progress)
    seen = partial(guard, split=split, allow_seen=plan.allow_seen, progress=progress)
    partners, others = dict[str, FeatureSet](), _others(plan) if plan.top else ()
    kept = _as_kept(encoders)
    looking = encoders if kept is None and "tactile" in (plan.modality, *others) else None
    with backed(manifest, looking, cache) as (samples, kind):
        parts = [samples.part(split, part) for part in ("train", "test")]
        count = sum(map(len, parts))
        parts = [part.take(_with(part, plan.modality)) for part in parts]
        if kept is not None:
            notes = judged(kept.take(parts[1].ids), allow_seen=plan.allow_seen)
            features = [_kept(kept, part, groups) for part in parts]
            kind += [Note("background-kind", {"kind": kept.made["background"]})] * kept.ruled
        else:
            notes = seen(encoders, plan.modality, parts[1])
            own = partial(embedded, encoders=encoders, modality=plan.modality)
            features = _embedded_alike(parts, plan, own, kind)
        for other in others:
            ids = _with(parts[1], other) if other in encoders.modalities else []
            if len(ids) >= 2:
                notes += seen(encoders, other, parts[1].take(ids))
                partners[other] = embedded(parts[1].take(ids), encoders, other)
    if plan.trained:  # the encoder belongs to the split, which is the axis
        features = [replace(f, encoder=None) for f in features]
    result = Probed()
    if count := count - sum(map(len, parts)):
        result.notes.append(Note("probe-no-image", {"modality": plan.modality, "count": count}))
    for label in plan.label:
        values = [["" if is_missing(v) else str(v) for v in p.column(label)] for p in parts]
        if (note := _no_classes(label, *values)) is not None:
            result.notes.append(note)
            continue
        if without := values[1].count(""):
            result.notes.append(Note("probe-unlabeled", {"label": label, "count": without}))
        train, test = (replace(f, labels=v) for f, v in zip(features, values, strict=True))
        result.labeled[label] = test
        result.means += class_accuracies(
            train,
            test,
            label=label,
            seed=plan.seed,
            subject=subject,
            split=split.digest,
            settings=plan.settings,
        )
    for other in others:
        if other not in partners:
            code = "no-partner" if other in encoders.modalities else "no-encoder"
            result.notes.append(Note(f"probe-{code}", {"modality": other}))
            continue
        test = parts[1].take(partners[other].ids)
        if missing := len(parts[1]) - len(test):
            result.notes.append(Note("probe-some-partners", {"modality": other, "count": missing}))
        sides = {plan.modality: features[1].take(test.ids), other: partners[other]}
        touch = sides.get("tactile")
        if touch is not None:
            sides["tactile"] = replace(touch, features=encoders.shared(touch.features))
        _retrieve(result, test, sides, plan=plan, subject=subject, split=split.digest)
    if not result.means:
        must = "There must be a label of two classes, or another modality to retrieve"
        fix = "Name a column with labels, or add texts or photos"
        raise PalpateError(must, "neither", fix, example={"label": "material"})
    noted = lambda score: replace(score, notes=[*score.notes, *notes])
    result.means = [replace(mean, score=noted(mean.score)) for mean in result.means]
    result.medians = [noted(score) for score in result.medians]
    result.notes += kind
    return result


def _as_kept(encoders: Any) -> Samples | None:
    """What stands in the place of encoders where the data are embeddings."""
    return encoders if isinstance(encoders, Samples) else None


def _kept(samples: Samples, part: Manifest, groups: str) -> FeatureSet:
    """Embeddings of a part from a folder of them."""
    taken = replace(samples.take(part.ids), group=groups)
    rows: Any = taken.rows
    return FeatureSet(part.ids, rows, taken.labels, taken.column(groups), samples.encoder)


def _embedded_alike(
    parts: Sequence[Manifest],
    plan: Plan,
    embedded: Callable[[Manifest], FeatureSet],
    notes: list[Note],
) -> list[FeatureSet]:
    """Embeddings of train and test part, whose tactile images are compared after the same storage.

    ``notes`` are told where they were stored otherwise.
    """
    if plan.modality != "tactile":
        return [embedded(part) for part in parts]
    with TemporaryDirectory() as place:
        sides = {n: [Samples(n, p)] for n, p in zip(("train", "test"), parts, strict=True)}
        stored, forms = alike(sides, Path(place), plan.seed)
        notes += [Note("stored-otherwise", {"forms": forms})] if forms else []
        return [embedded(samples.manifest) for (samples,) in stored.values()]


def _retrieve(
    result: Probed,
    test: Manifest,
    sides: Mapping[str, FeatureSet],
    *,
    plan: Plan,
    subject: str,
    split: str,
) -> None:
    """Add what two modalities of the same samples find of each other, the probed one first."""
    (_, queries), (other, keys) = sides.items()
    ranked = partial(
        retrieval,
        queries,
        keys,
        top=plan.top,
        pool=min(plan.pool or len(test), plan.pools[other]),
        seed=plan.seed,
        subject=subject,
        split=split,
        settings=plan.settings,
    )
    ways = list(ranked(names=(plan.modality, other)))
    if other == "text":
        names, threshold = (plan.modality, "similar text"), plan.text_threshold
        ways += ranked(names=names, texts=keys.features, threshold=threshold)
    result.means += [mean for way in ways for mean in way.top]
    result.medians += [way.median for way in ways]
    for x, y, names in (
        (queries, keys, (plan.modality, other)),
        (keys, queries, (other, plan.modality)),
    ):
        strips = _strips(test, unit_rows(x.features), unit_rows(y.features), names, plan.seed)
        subject_shown = subject if plan.axis else ""
        result.strips += [replace(strip, subject=subject_shown) for strip in strips]


def _no_classes(label: str, train: Sequence[str], test: Sequence[str]) -> Note | None:
    """Why one label cannot be learned from train and scored on test; None where it can."""
    parts = {"train": train, "test": test}
    if lacking := [name for name, column in parts.items() if not any(column)]:
        return Note("probe-no-label", {"label": label, "part": " and ".join(lacking)})
    if len(only := {*train} - {""}) == 1:
        return Note("probe-one-class", {"label": label, "only": only.pop()})
    return None


def _strips(test: Manifest, a: Floats, b: Floats, names: tuple[str, str], seed: int) -> list[Strip]:
    """What some queries retrieve; each of another video where there are enough."""
    rows, texts = list(test.table.iter_rows(named=True)), test.column("text")
    order = rng_for(seed, "strips", names[0]).permutation(len(rows))
    by_video = {rows[k]["video"] or rows[k]["id"]: int(k) for k in order}
    strips: list[Strip] = []
    for k in list(by_video.values())[:STRIPS]:
        similar = b @ a[k]
        order = np.argsort(-similar, kind="stable").tolist()
        if names[1] == "text":  # each text once
            order = list({texts[j]: j for j in reversed(order)}.values())[::-1]
        best = order[:SHOWN]
        matches = [
            Match(
                test.ref(rows[j]),
                float(similar[j]),
                j == k or ("text" in names and texts[j] == texts[k]),
                texts[j] if names[1] == "text" else "",
            )
            for j in best
        ]
        words = texts[k] if names[0] == "text" else ""
        rank = 1 + int((similar > similar[k] + TIE).sum())
        strips.append(Strip(test.ref(rows[k]), *names, matches, rank, query_text=words))
    return strips


def results_of(
    title: str,
    runs: Mapping[str, Sequence[Probed]],
    plan: Plan,
    manifest: Manifest,
    splits: Mapping[str, Split],
) -> Results:
    """Scores of all subjects, of several trainings their mean, with paired differences.

    ``runs`` has for each subject what each of its trainings (one a seed) scores.
    """
    scores: list[Score] = []
    single = all(len(seeds) == 1 for seeds in runs.values())
    by_measure: dict[Measure, dict[str, list[Mean]]] = {}
    for subject, seeds in runs.items():
        for run in seeds:
            for mean in run.means:
                by_measure.setdefault(mean.score.measure, {}).setdefault(subject, []).append(mean)
        for means in (sets.get(subject) for sets in by_measure.values()):
            scores += [means[0].score if single else over_seeds(means)] if means else []
        scores += [median for run in seeds if single for median in run.medians]
    differences = [d for sets in by_measure.values() for d in differences_of_means(sets)]
    all_runs = [run for seeds in runs.values() for run in seeds]
    scores = [*scores, *differences]
    scores = scores if plan.sure else [without_interval(s) for s in scores]
    every = [*plan.notes, *(note for run in all_runs for note in run.notes)]
    notes = list({canonical_json(note): note for note in every}.values())
    names = ("modality", "label", "group", "top", "pool", "text_threshold", "seed")
    digests = {"manifest": manifest.digest}
    digests |= {
        f"split {name}" if len(splits) > 1 else "split": s.digest for name, s in splits.items()
    }
    rules = {name: dict(s.rule) for name, s in splits.items()}
    return Results(
        title=title,
        facts=[_drop(d) for d in scores if plan.axis == "split" and d.b is not None],
        scores=scores,
        strips=[strip for seeds in runs.values() for strip in seeds[0].strips],
        notes=notes,
        settings={
            "digests": digests,
            "split rule": rules if len(splits) > 1 else next(iter(rules.values())),
            "options": {name: getattr(plan, name) for name in names},
        },
    )


def _drop(difference: Score) -> str:
    """What a score loses from the first split to the second, in one sentence."""
    d, points = difference.details, 100 * float(difference)
    line = f"{measured(difference)}, {subject_of(difference)}: {points:.1f} points"
    if difference.interval:
        line += " [{:.1f}, {:.1f}]".format(*(100 * bound for bound in difference.interval))
    if d.get("relative") is not None:
        line += f", {100 * d['relative']:.0f} % of {difference.a}"
        if d["relative_interval"]:
            line += " [{:.0f}, {:.0f}]".format(*(100 * bound for bound in d["relative_interval"]))
    return line


def named(value: Any, argument: str) -> dict[str, Any]:
    """One or several, by name; a list by its files' names, by whole paths where those are equal."""
    if isinstance(value, Mapping):
        named = {str(name): each for name, each in value.items()}
    elif isinstance(value, list | tuple):
        paths = [
            str(v) if isinstance(v, str | Path) else f"{argument} {k + 1}"
            for k, v in enumerate(value)
        ]
        stems = [Path(path).stem for path in paths]
        named = dict(zip(stems if len({*stems}) == len(stems) else paths, value, strict=True))
    else:
        named = {argument: value}
    distinct = len(named) >= (len(value) if isinstance(value, list | tuple) else 1)
    must, fix = "must hold at least one, each once", "Name each of them once"
    require(distinct and len(named) > 0, argument, must, f"{value!r}", fix=fix)
    return named


def _others(plan: Plan) -> tuple[Literal["text"], Modality]:
    """What is retrieved besides the plan's modality."""
    return "text", "vision" if plan.modality == "tactile" else "tactile"


def _with(manifest: Manifest, modality: str) -> list[str]:
    """Ids of the samples that have the modality."""
    return [i for i, v in zip(manifest.ids, manifest.column(modality), strict=True) if v]

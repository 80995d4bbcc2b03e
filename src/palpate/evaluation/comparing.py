"""Generators side by side on features: every preset and bandwidth that was asked for, companions, floors, and paired differences. No torch.

Metrics of one name but of other features or another bandwidth get names of their own (``FID (Inception)``, ``TMMD (σ median)``), so that no
two of them share a column.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from palpate.core import FeatureSet, PalpateError, Progress, Score, quiet
from palpate.metrics import PRESETS, Polynomial, compare, compare_fid, compare_tmmd, tmmd
from palpate.metrics.neighbors import prdc_rows
from palpate.metrics.paired import mean_differences

#: Companions on features; the first three need nothing further.
ON_FEATURES = ("fid", "kid", "prdc", "cmmd")
#: Bandwidth of the paper, and of CMMD; the name of a metric says any other one where several are asked for.
SIGMA = 10.0
#: From so many rows on the companions that form all pairs must be asked for.
MANY = 50_000
#: Names that stand beside the generators' in the tables of a split.
BACKGROUND, SAME_MATERIAL, REAL = "background only", "real, same material", "real"
#: Beginnings of metrics that look at one set alone.
ALONE = ("I-TMMD", "CI-TMMD", "D-TMMD", "material accuracy")
KID_NOTE = "The spread over random subsets that others print with KID is no interval; this one is"


@dataclass(frozen=True, kw_only=True)
class Asked:
    """How the TMMD family is to be computed.

    Attributes:
        presets: see :data:`palpate.metrics.PRESETS`; None: ``grouped`` and ``paper`` where groups are known, else ``paper``.
        sigmas: bandwidths: numbers, ``"median"``, ``"multi"``.
        estimator: instead of every preset's own.
        backend, permutations, normalize, seed: see :class:`palpate.metrics.Options`.
        split: digest that scores keep.

    Raises:
        PalpateError: for the preset ``grouped`` with another estimator, which would be grouped in name alone.
    """

    presets: Sequence[str] | None = None
    sigmas: Sequence[float | str] = (SIGMA,)
    estimator: str | None = None
    backend: str = "auto"
    permutations: int = 999
    normalize: Any = "check"
    seed: int = 0
    split: str | None = None

    def __post_init__(self) -> None:
        if not self._may_group and "grouped" in (self.presets or ()):
            fix = "Drop one of the two, or take the preset paper"
            raise PalpateError(
                "The preset grouped must keep the grouped estimator",
                f"the estimator {self.estimator}",
                fix,
            )

    @property
    def _may_group(self) -> bool:
        return self.estimator in (None, "grouped")

    def presets_for(self, *, grouped: bool) -> Sequence[str]:
        """The presets, chosen by whether groups are known where none were asked for."""
        return (
            self.presets
            if self.presets is not None
            else ("grouped", "paper")
            if grouped and self._may_group
            else ("paper",)
        )

    def shown(self, preset: str) -> str:
        """A preset as tables name it: with the estimator, where that is not its own."""
        return (
            preset
            if self.estimator in (None, PRESETS[preset].estimator)
            else f"{preset}, {self.estimator}"
        )

    def options(self, preset: str, sigma: float | str) -> dict[str, Any]:
        """Options of one column of the TMMD family."""
        own = {"estimator": self.estimator} if self.estimator else {}
        return own | {
            "preset": preset,
            "sigma": sigma,
            "backend": self.backend,
            "permutations": self.permutations,
            "normalize": self.normalize,
            "seed": self.seed,
            "split": self.split,
        }


@dataclass
class Outcome:
    """What was scored.

    Attributes:
        scores: of every subject.
        differences: of pairs of generators on the same samples.
        remarks: what was left out, and why.
    """

    scores: list[Score] = field(default_factory=list)
    differences: list[Score] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def add(self, other: Outcome) -> None:
        """Puts another outcome behind this one."""
        self.scores += other.scores
        self.differences += other.differences
        self.remarks += [r for r in other.remarks if r not in self.remarks]

    def attempt(self, what: str, make: Callable[[], Outcome], *, asked: bool) -> None:
        """Adds what ``make`` gives; where nobody asked for it by name, a refusal becomes a remark."""
        try:
            self.add(make())
        except PalpateError as error:
            if asked:
                raise
            self.remarks.append(f"{what} left out: {error.must}; got {error.got}")

    def said(self) -> Outcome:
        """The same with a note at every difference that says who is ahead, and how sure that is, and remarks on copies and on collapse."""
        copies: dict[str, str] = {}
        for s in self.scores:
            if count := s.details.get("copies"):
                copied = f"{s.subject}: {count} of {s.n} generated rows are bit for bit rows of the reference: a copy is not a generator"
                copies.setdefault(s.subject, copied)
        less = [
            f"{s.metric}, {s.subject}: below the floor of real touches, so these vary less than real ones do; that is not better"
            for s in self.scores
            if s.metric.startswith(("I-TMMD E", "CI-TMMD E"))
            and s.floor
            and s.interval
            and s.interval[1] < s.floor
        ]
        return replace(
            self,
            remarks=[*self.remarks, *copies.values(), *less],
            differences=[
                replace(d, note=". ".join(filter(None, [confidence(d), d.note])))
                for d in self.differences
            ],
        )


def confidence(difference: Score) -> str:
    """``"B is better with 97.3 % confidence, Holm p = 0.054"``; '' where nothing can be said."""
    d = difference.details
    if d.get("p_better") is None or d.get("better") is None:
        return ""
    ahead = d["p_better"] if d["better"] == d["a"] else 1 - d["p_better"]
    p = d.get("p_adjusted")
    adjusted = "" if p is None else ", Holm p < 1e-15" if p < 1e-15 else f", Holm p = {p:.2g}"
    return f"{d['better']} is better with {percent(ahead)} confidence{adjusted}"


def percent(share: float) -> str:
    """A share in [0, 1], never rounded to certainty."""
    return "> 99.9 %" if share > 0.999 else "< 0.1 %" if share < 0.001 else f"{100 * share:.1f} %"


def compare_features(
    generators: Mapping[str, FeatureSet],
    reference: FeatureSet,
    asked: Asked,
    *,
    train: FeatureSet | None = None,
    paired: bool = True,
    progress: Progress = quiet,
) -> Outcome:
    """The four tactile metrics of every generator, for every preset and bandwidth, with paired differences.

    Args:
        generators: name -> features.
        reference: features of the real test touches.
        asked: presets, bandwidths, seed.
        train: other real touches, whose TMMD to the reference is the floor of TMMD.
        paired: whether the generators stand for the same samples; if not, no differences are made.
        progress: told how many columns are done.

    Raises:
        PalpateError: as :func:`palpate.metrics.compare`.
    """
    require_rows(generators, reference)
    known = [s.groups is not None for s in generators.values()]
    presets = asked.presets_for(grouped=all(known) and reference.groups is not None)
    floor = reference if all(k == (reference.groups is not None) for k in known) else None
    sets = _together(generators, paired)
    columns = [(preset, sigma) for preset in presets for sigma in asked.sigmas]
    out = Outcome()
    for k, (preset, sigma) in enumerate(columns):
        options = asked.options(preset, sigma)
        fast: dict[str, Any] = {**options, "permutations": 0}
        least = None if train is None else tmmd(train, reference, **fast).value
        for some in sets:
            found = compare(some, reference, floor=floor, **options)
            scores = [replace(s, floor=least) if s.metric == "TMMD" else s for s in found.scores]
            assert found.excess is not None  # compare always gives it
            out.scores += [
                named(s, preset, sigma, asked) for s in _behind(scores, found.excess.scores)
            ]
            out.differences += [
                named(d, preset, sigma, asked)
                for d in _behind(found.differences, found.excess.differences)
            ]
        progress("TMMD family", k + 1, len(columns))
    return out


def _behind(scores: Sequence[Score], excess: Sequence[Score]) -> list[Score]:
    """Every score with its excess E behind it: tables show metrics in the order in which they come."""
    by = {(e.metric.replace(" E", "", 1), e.subject): e for e in excess}
    return [one for s in scores for one in (s, by.get((s.metric, s.subject))) if one is not None]


def _together(sets: Mapping[str, FeatureSet], paired: bool) -> list[dict[str, FeatureSet]]:
    """What is compared with each other: all, or each alone."""
    return [dict(sets)] if paired else [{name: one} for name, one in sets.items()]


def require_rows(generators: Mapping[str, FeatureSet], reference: FeatureSet) -> None:
    """Refuses empty sets.

    Raises:
        PalpateError: naming the set.
    """
    for name, one in (*generators.items(), ("the reference", reference)):
        if not len(one.ids):
            raise PalpateError(
                f"There must be touches in {name}",
                "none",
                "Check its path, and the split: is that part empty?",
            )


def against(found: Outcome, reference: str) -> Outcome:
    """The outcome with a digest of the real touches at every score, and every difference, that compares with them."""
    held = lambda scores: [
        s if s.metric.startswith(ALONE) else replace(s, reference=reference) for s in scores
    ]
    return replace(found, scores=held(found.scores), differences=held(found.differences))


def named(score: Score, preset: str, sigma: float | str, asked: Asked) -> Score:
    """The score as tables show it: its bandwidth in the name, where several were asked for and it is not the usual one, and its preset."""
    score = replace(score, settings={**score.settings, "preset": asked.shown(preset)})
    if len(asked.sigmas) < 2 or sigma == SIGMA:
        return score
    tag = f"(σ {sigma})" if isinstance(sigma, str) else f"(σ = {sigma:g})"
    base = score.metric.removesuffix(" difference")
    return replace(score, metric=f"{base} {tag}" + score.metric[len(base) :])


def feature_companions(
    kinds: Sequence[str],
    generators: Mapping[str, FeatureSet],
    reference: FeatureSet,
    asked: Asked,
    *,
    what: str,
    default: bool = False,
    paired: bool = True,
    progress: Progress = quiet,
) -> Outcome:
    """FID, KID, precision and its kin, and CMMD on given features.

    Args:
        kinds: of :data:`ON_FEATURES`; others are passed over.
        generators: name -> features.
        reference: of real touches.
        asked: for seed, split, back end and permutations; the companions have their own estimators.
        what: where the features come from, as it stands in the metrics' names.
        default: nobody asked for these by name: one that refuses its input, or forms too many pairs, is left out with a remark.
        paired: whether the generators stand for the same samples.
        progress: told about the neighbors.

    Raises:
        PalpateError: as the metrics, unless ``default``.
    """
    many = max(len(reference.ids), *(len(s.ids) for s in generators.values())) > MANY
    out = Outcome()
    for kind in (k for k in ON_FEATURES if k in kinds):
        if default and many and kind != "fid":
            out.remarks.append(
                f"{kind} left out: it forms all pairs of more than {MANY:,} rows; ask for it with --companions {kind}"
            )
            continue
        make = {"fid": _fid, "kid": _kid, "prdc": _prdc, "cmmd": _cmmd}[kind]
        out.attempt(
            f"{kind} on {what}",
            lambda make=make: make(generators, reference, asked, what, paired, progress),
            asked=not default,
        )
    return out


def _fid(
    sets: Mapping[str, FeatureSet],
    reference: FeatureSet,
    asked: Asked,
    what: str,
    paired: bool,
    *_: Any,
) -> Outcome:
    called = lambda score: replace(score, metric=score.metric.replace("FID", f"FID ({what})", 1))  # noqa: E731
    out = Outcome()
    for some in _together(sets, paired):
        found = compare_fid(some, reference, split=asked.split, seed=asked.seed)
        out.scores += [called(s) for s in found.scores]
        out.differences += [called(d) for d in found.differences]
    return out


def _kid(
    sets: Mapping[str, FeatureSet],
    reference: FeatureSet,
    asked: Asked,
    what: str,
    paired: bool,
    *_: Any,
) -> Outcome:
    options: dict[str, Any] = {
        "kernel": Polynomial(),
        "preset": "paper",
        "normalize": False,
        "permutations": 0,
        "seed": asked.seed,
        "split": asked.split,
    }
    out = Outcome()
    for some in _together(sets, paired):
        found = compare_tmmd(some, reference, **options)
        out.scores += [_as_kid(s, what) for s in found.scores]
        out.differences += [_as_kid(d, what) for d in found.differences]
    return out


def _as_kid(score: Score, what: str) -> Score:
    """TMMD with KID's kernel under its own name."""
    settings = {k: v for k, v in score.settings.items() if k != "preset"}
    note = (
        score.note
        if score.metric.endswith(" difference")
        else ". ".join(filter(None, [KID_NOTE, score.note]))
    )
    return replace(
        score, metric=score.metric.replace("TMMD", f"KID ({what})", 1), settings=settings, note=note
    )


def _prdc(
    sets: Mapping[str, FeatureSet],
    reference: FeatureSet,
    asked: Asked,
    what: str,
    paired: bool,
    progress: Progress,
) -> Outcome:
    first = next(iter(sets.values()))
    out, found = Outcome(), {}
    for name, one in sets.items():
        rows = one.take(list(first.ids)) if paired else one  # row by row the same samples
        found[name] = prdc_rows(rows, reference, subject=name, split=asked.split, progress=progress)
    for k, own in enumerate((first.groups, reference.groups, first.groups, reference.groups)):
        scores = {
            name: replace(s[k], metric=f"{s[k].metric} ({what})") for name, (s, _) in found.items()
        }
        out.scores += scores.values()
        if paired and len(found) > 1:
            values = {name: rows[s[k].metric] for name, (s, rows) in found.items()}
            out.differences += mean_differences(
                scores, values, own if scores[next(iter(found))].settings["grouped"] else None
            )
    return out


def _cmmd(
    sets: Mapping[str, FeatureSet],
    reference: FeatureSet,
    asked: Asked,
    what: str,
    paired: bool,
    progress: Progress,
) -> Outcome:
    plain = replace(asked, presets=("cmmd",), sigmas=(SIGMA,), estimator=None)
    bare = {name: replace(one, labels=None) for name, one in sets.items()}
    found = compare_features(
        bare, replace(reference, labels=None), plain, paired=paired, progress=progress
    )
    scores, differences = (
        [_as_cmmd(s, what) for s in some if s.metric.startswith("TMMD")]
        for some in (found.scores, found.differences)
    )
    return Outcome(scores, differences)


def _as_cmmd(score: Score, what: str) -> Score:
    return replace(score, metric=score.metric.replace("TMMD", f"CMMD ({what})"), floor=None)


def require_one_encoder(name: str, one: FeatureSet, reference: FeatureSet) -> None:
    """Refuses features of another encoder than the reference's.

    Raises:
        PalpateError: with both digests.
    """
    if (
        one.encoder is not None
        and reference.encoder is not None
        and one.encoder != reference.encoder
    ):
        got = f"digests {one.encoder[:12]} and {reference.encoder[:12]}"
        raise PalpateError(
            f"{name!r} and the reference must come from one encoder",
            got,
            "Embed both with the same encoder",
        )


def part_of(
    name: str, ids: Sequence[str], wanted: Sequence[str], known: Collection[str]
) -> list[str] | None:
    """Those of a generator's ids that lie in the scored part of a split.

    Args:
        name: the generator.
        ids: its ids.
        wanted: ids of the scored part.
        known: ids of all parts.

    Returns:
        A part of ``ids``, or None where no id is among ``known``: names of the generator's own, which no split can part.

    Raises:
        PalpateError: if ids of the scored part are missing.
    """
    known, held, part = set(known), set(ids), set(wanted)
    if known.isdisjoint(held):
        return None
    if missing := [i for i in wanted if i not in held]:
        got = f"{len(missing)} of {len(wanted)} missing, first {missing[0]!r}"
        raise PalpateError(
            f"{name!r} must have every touch of the split's test part",
            got,
            "Generate these too, or pass the split it is of",
        )
    return [i for i in ids if i in part]


def left_out(name: str, all_ids: Sequence[str], kept: Sequence[str]) -> list[str]:
    """A remark on the touches that :func:`part_of` leaves out, if there are any."""
    n = len(all_ids) - len(kept)
    return (
        [
            f"{name}: {n} of {len(all_ids)} touches lie outside the split's test part, and were left out"
        ]
        if n
        else []
    )

"""The four tactile metrics for features that come in batches, over any number of processes: update, compute, reset, merge.

The classes follow the contract of torchmetrics without needing it (nor torch); :mod:`palpate.metrics.torch_metric` has the same four as
true ``torchmetrics.Metric``. Each takes generated touches with ``update(features)`` and real ones with ``update(features, real=True)``: they
are the reference of :class:`TMMD`, and ``Score.floor`` of the others.

``keep="features"`` (default) keeps the rows. ``compute()`` is what the function of the same metric returns for all of them, with groups,
interval, null and p-value; memory grows with the rows.

``keep="sums"`` keeps moments (:mod:`palpate.metrics.moments`): O(C d^2) memory, whatever the number of rows. The value is within
``details["bound"]`` of the same statistic from all pairs. There is no interval and no p-value, as nothing can be left out. TMMD is the
function's with ``preset="paper"`` (or ``"cmmd"``). The halves of the other three are dealt by a hash of the sample's id, or of its group
where groups are given (whole videos to one half): one draw, whose two halves differ in size, and recorded as a setting of its own, so that it
cannot stand in a column with the closed form. Classes with fewer than two samples in a half are excluded and named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self, Unpack, cast

import numpy as np

from palpate.core import FeatureSet, PalpateError, Score, digest_json
from palpate.metrics.inputs import checked_choice
from palpate.metrics.presets import Options, Plan, plan_for
from palpate.metrics.scored import RANDOM_NOTE, UNBOUNDED, Scored, with_floor
from palpate.metrics.streaming_states import Columns, FeatureState, Layout, SumState, sized, to_host
from palpate.metrics.tables import Table, build_table
from palpate.metrics.tactile import ci_tmmd_of, d_tmmd_of, i_tmmd_of, tmmd, tmmd_of

Keep = Literal["features", "sums"]
State = FeatureState | SumState
SUMS_NOTE = 'From running sums: no interval, no p-value, and pairs of one video are not left out (keep="features" does all three)'
HALVES_NOTE = {
    "sample": RANDOM_NOTE,
    "group": "Halves are whole groups, dealt once by a hash of their names: with few groups another seed gives quite another value",
    "": "",
}


class StreamingMetric:
    """What the four have in common. Instances can be pickled between any two batches.

    Args:
        keep: ``"features"`` or ``"sums"``, see the module.
        classes: for ``"sums"`` of CI- and D-TMMD: the labels there can be.
        center: for ``"sums"``: (d,) any fixed vector near the features, the same in all processes that will be merged, e.g. the mean of the
            real embeddings; the nearer, the smaller the bound. None: the mean of the first batch, for one process.
        floor: for ``"sums"`` without reference: whether real touches are summed too, for ``Score.floor``.
        encoder: digest of the encoder, kept with the score.
        reset_real_features: False: :meth:`reset` keeps real touches, which are then embedded once for a whole training.
        **options: see :class:`palpate.metrics.Options`.

    Raises:
        PalpateError: on options that are refused; for ``"sums"``, on what needs pairs: groups, several or median bandwidths, ordered halves.
    """

    name: ClassVar[str]
    higher_is_better: ClassVar[bool | None] = False
    is_differentiable: ClassVar[bool] = False
    full_state_update: ClassVar[bool] = False
    of_halves: ClassVar[bool] = True
    by_class: ClassVar[bool] = False

    def __init__(
        self,
        *,
        keep: Keep = "features",
        classes: Sequence[str] | None = None,
        center: Any = None,
        floor: bool = False,
        encoder: str | None = None,
        reset_real_features: bool = True,
        **options: Unpack[Options],
    ) -> None:
        checked_choice("keep", keep, ("features", "sums"))
        self.keep, self.encoder, self.reset_real_features, self.options = (
            keep,
            encoder,
            reset_real_features,
            options,
        )
        if keep == "features":
            self.plan = plan_for(
                options, grouped=True
            )  # for its checks: whether groups are known is seen later
            self.layout, self.center = None, None
        else:
            self.plan = plan_of_sums(options, halves=self.of_halves)
            names = ("",) if not self.by_class else checked_classes(classes)
            self.layout = Layout(
                float(cast(float, self.plan.sigma)),
                names,
                self.of_halves,
                2 if floor else 1,
                self.plan.seed,
            )
            self.center = None if center is None else checked_center(center)
        self.state = self.fresh()

    def fresh(self) -> State:
        """A state with nothing in it."""
        return FeatureState() if self.layout is None else SumState(self.layout, self.center)

    @property
    def digest(self) -> str:
        """SHA-256 of the settings that states depend on: metrics of one digest can share a state, whatever they compute from it."""
        layout = (
            None
            if self.layout is None
            else [self.layout.__dict__, None if self.center is None else self.center.tolist()]
        )
        return digest_json(
            [self.keep, self.encoder, self.reset_real_features, self.plan.normalize, layout]
        )

    def update(
        self,
        features: Any,
        *,
        real: bool = False,
        ids: Any = None,
        labels: Any = None,
        groups: Any = None,
    ) -> None:
        """Adds a batch; a batch that is refused changes nothing.

        Args:
            features: (n, d), n may be 0: NumPy or torch on any device (detached; kept on the host, or summed where they are); half
                precision is widened. Rows are copied.
            real: whether these are real touches: the reference of TMMD, the floor of the others.
            ids: n sample ids, strings or integers; without, a digest of each row. Needed by random halves with ``keep="sums"``.
            labels: n classes, for CI- and D-TMMD.
            groups: n videos, strings or integers. Ids, labels and groups are given with every batch of a set, or with none.

        Raises:
            PalpateError: at once for rows that are NaN, infinite, zero or (``normalize="check"``) not of unit length, with their numbers in the
                batch; another width than before; columns of another length.
        """
        self.state.update(
            features,
            self.plan.normalize,
            **Columns(real=real, ids=ids, labels=labels, groups=groups),
        )

    def compute(self) -> Score:
        """The score of all batches since the last reset.

        Raises:
            PalpateError: if a set is missing, or as the function does.
        """
        return self.score_of(self.state)

    def missing(self, state: State) -> bool:
        """Whether a state lacks a set that the metric needs."""
        return not state.rows(real=False) or (not self.of_halves and not state.rows(real=True))

    def score_of(self, state: State) -> Score:
        """The score of a state."""
        if self.missing(state):
            must = f"{self.name} must have seen {'generated touches' if self.of_halves else 'generated and real touches'} before compute()"
            got = f"{state.rows(real=False)} generated and {state.rows(real=True)} real"
            raise PalpateError(
                must,
                got,
                "Call update(features)"
                + ("" if self.of_halves else " and update(features, real=True)")
                + " first",
            )
        return (
            self._from_features(state)
            if isinstance(state, FeatureState)
            else self._from_sums(state)
        )

    def reset(self) -> None:
        """Forgets all batches; with ``reset_real_features=False`` those of generated touches only."""
        self.state.reset(keep_real=not self.reset_real_features)

    def merge_state(self, other: Self) -> None:
        """Adds what another metric of the same settings has seen, e.g. one that came back from a process as a pickle.

        Raises:
            PalpateError: if class, settings, width or center differ.
        """
        if other is self:
            raise PalpateError(
                "A metric must be merged with another one",
                "itself",
                "Merge what other processes have seen",
            )
        if (
            type(other) is not type(self)
            or other.digest != self.digest
            or not same_options(other.options, self.options)
        ):
            got = f"{type(self).__name__} and {type(other).__name__}" + (
                " of different settings" if type(other) is type(self) else ""
            )
            raise PalpateError(
                "Metrics that are merged must be of one class with the same settings",
                got,
                "Construct all alike",
            )
        self.state = cast(Any, self.state).merge(other.state)

    def merge(self, *others: Self) -> Self:
        """A new metric that has seen what this one and others have."""
        out = deepcopy(self)
        for other in others:
            out.merge_state(other)
        return out

    def _of(self, table: Table, generated: FeatureSet, plan: Plan) -> Scored:
        raise NotImplementedError

    def _from_features(self, state: FeatureState) -> Score:
        """What the function gives; the median bandwidth is that of the real touches where there are any."""
        generated, repeated = state.set_of(real=False, encoder=self.encoder)
        real, _ = state.set_of(real=True, encoder=self.encoder)
        assert generated is not None  # score_of looked
        score = self._function(generated, real)
        if repeated:
            again = f"{repeated} row{'s' * (repeated > 1)} have the id of another (a DistributedSampler pads with repetitions): each counts"
            score = replace(score, note=". ".join(filter(None, [score.note, again])))
        return score

    def _function(self, generated: FeatureSet, real: FeatureSet | None) -> Score:
        plan, grouped = (
            plan_for(self.options, grouped=generated.groups is not None),
            generated.groups is not None,
        )
        one = self._of(
            build_table(generated, None, plan, grouped=grouped, median_of=real), generated, plan
        )
        if real is None:
            return one.score
        if (real.groups is None) == grouped:
            must = "The floor must be scored like the generated touches"
            raise PalpateError(must, "groups in one of the two", "Give groups to both, or to none")
        return with_floor(
            one,
            self._of(build_table(real, None, plan, grouped=grouped, median_of=real), real, plan),
        ).score

    def _from_sums(self, state: SumState) -> Score:
        one, by = self._one_set(state, real=False), state.checked_hash(state.hashed)
        score = one.score
        note = (
            score.note
            if score.value is None
            else ". ".join(filter(None, [SUMS_NOTE, HALVES_NOTE[by]]))
        )
        one = replace(
            one,
            score=replace(
                score, note=note, settings={**score.settings, "halves": f"hashed by {by}"}
            ),
        )
        if state.rows(real=True):
            why = (
                "" if state.same_groups else "other groups, or of other numbers of samples a group,"
            )
            one = with_floor(one, self._one_set(state, real=True), why)
        score = one.score
        if self.plan.estimator != "biased":
            return score
        return replace(
            score, null=None, details={k: v for k, v in score.details.items() if k != "z"}
        )  # its center is that of equal halves

    def _one_set(self, state: SumState, *, real: bool) -> Scored:
        table, small, sizes = state.table(real=real)
        one = self._of(
            table,
            sized(state.rows(real=real), labeled=self.by_class, encoder=self.encoder),
            self.plan,
        )
        return replace(
            one,
            score=without_units(
                one.score, {"halves": dict(zip(table.classes, sizes, strict=True))}, small
            ),
        )


class TMMD(StreamingMetric):
    """TMMD of generated touches against real ones (paper, Eq. 2); the streaming form of :func:`palpate.metrics.tmmd`."""

    name = "TMMD"
    of_halves = False

    def _function(self, generated: FeatureSet, real: FeatureSet | None) -> Score:
        assert real is not None  # score_of looked
        return tmmd(generated, real, **self.options)

    def _from_sums(self, state: SumState) -> Score:
        table, _, _ = state.table()
        generated, real = (
            sized(state.rows(real=real), encoder=self.encoder) for real in (False, True)
        )
        score = without_units(
            tmmd_of(table, generated, real, self.plan).score, {"copies": None}, []
        )
        return replace(score, note=SUMS_NOTE if score.value is not None else score.note)


class ITMMD(StreamingMetric):
    """I-TMMD, between halves of the generated touches (paper, Eq. 3); the streaming form of :func:`palpate.metrics.i_tmmd`."""

    name = "I-TMMD"
    higher_is_better: ClassVar[bool | None] = None

    def _of(self, table: Table, generated: FeatureSet, plan: Plan) -> Scored:
        return i_tmmd_of(table, generated, plan)


class CITMMD(StreamingMetric):
    """CI-TMMD, between halves of each class (paper, Eq. 4); the streaming form of :func:`palpate.metrics.ci_tmmd`."""

    name = "CI-TMMD"
    higher_is_better: ClassVar[bool | None] = None
    by_class = True

    def _of(self, table: Table, generated: FeatureSet, plan: Plan) -> Scored:
        return ci_tmmd_of(table, generated, plan)


class DTMMD(StreamingMetric):
    """D-TMMD, halves of a class against other classes (paper, Eq. 5-7); the streaming form of :func:`palpate.metrics.d_tmmd`."""

    name = "D-TMMD"
    higher_is_better: ClassVar[bool | None] = None
    by_class = True

    def _of(self, table: Table, generated: FeatureSet, plan: Plan) -> Scored:
        return d_tmmd_of(table, generated, plan)


def plan_of_sums(options: Options, *, halves: bool) -> Plan:
    """The options of ``keep="sums"``, or why they cannot be.

    Raises:
        PalpateError: on what needs pairs of samples.
    """
    fix = 'Use keep="features", or preset="paper" or "cmmd" and one number as sigma'
    if "grouped" in (options.get("preset"), options.get("estimator")):
        raise PalpateError(
            'keep="sums" cannot leave out pairs of one group', "the grouped estimator", fix
        )
    sigma = options.get("sigma", 10.0)
    if (kernel := options.get("kernel")) is not None:
        raise PalpateError(
            'keep="sums" has the Gaussian kernel',
            f"kernel={kernel!r}",
            'Pass sigma, or keep="features"',
        )
    if isinstance(sigma, str) or np.ndim(sigma) > 0:
        raise PalpateError(
            'keep="sums" must know its one bandwidth beforehand', f"sigma={sigma!r}", fix
        )
    bare: Options = {**options, "permutations": 0, "backend": "moments"}
    plan = plan_for(bare, grouped=False)
    if halves and plan.halves != "random":
        raise PalpateError('keep="sums" deals halves by a hash', f"halves={plan.halves!r}", fix)
    return plan


def same_options(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Whether two metrics were given the same; bandwidths may stand in an array."""
    return a.keys() == b.keys() and all(
        np.array_equal(a[k], b[k]) if k == "sigma" else a[k] == b[k] for k in a
    )


def checked_classes(classes: Sequence[str] | None) -> tuple[str, ...]:
    """Names of classes, as strings.

    Raises:
        PalpateError: if there are none, or one twice or empty.
    """
    names = tuple(str(c) for c in classes or ())
    if not names or len(set(names)) < len(names) or "" in names:
        raise PalpateError(
            'keep="sums" must know the classes', f"{list(names)}", "Pass classes=, each name once"
        )
    return names


def checked_center(center: Any) -> np.ndarray:
    """(d,) float64.

    Raises:
        PalpateError: if it is no finite vector.
    """
    found = np.asarray(to_host(center), dtype=np.float64)
    if found.ndim != 1 or not found.size or not np.isfinite(found).all():
        raise PalpateError(
            "center must be a finite vector (d,)",
            f"shape {found.shape}",
            "Pass e.g. the mean of the real embeddings",
        )
    return found


def without_units(score: Score, details: Mapping[str, Any], small: Sequence[str]) -> Score:
    """A score of sums: without what leaves out units, and with the true reason why classes are excluded."""
    found: dict[str, Any] = {k: v for k, v in score.details.items() if k != "left_out"} | {
        "unit": None,
        "units": None,
        **details,
    }
    for name, value in found.items():
        if name.endswith("_interval"):
            found[name] = None
        elif isinstance(value, dict) and "interval" in value:
            found[name] = {**value, "interval": None}
    note = (
        UNBOUNDED.replace('backend="blocked"', 'keep="features"')
        if score.note == UNBOUNDED
        else score.note
    )
    if "excluded" in found:
        found["excluded"] = {
            **found["excluded"],
            **dict.fromkeys(small, "fewer than two samples in a half"),
        }
    if "per_class" in found:
        found["per_class"] = {
            name: {**of, "units": None} for name, of in found["per_class"].items()
        }
    return replace(score, interval=None, interval_method="", details=found, note=note)

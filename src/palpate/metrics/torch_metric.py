"""The four streaming metrics as true ``torchmetrics.Metric``: in a MetricCollection, on a LightningModule, synchronized by torchmetrics.

``from palpate.metrics.torch_metric import TMMD, ITMMD, CITMMD, DTMMD`` takes the arguments of the class of the same name in
:mod:`palpate.metrics.streaming`, and those of ``torchmetrics.Metric``. ``compute()`` returns the value as a tensor (NaN where it is undefined),
because loggers and torchmetrics' own machinery take tensors and refuse other objects; ``score()`` returns the whole :class:`palpate.core.Score`.

States, all registered with ``add_state`` and a ``dist_reduce_fx``:

* ``keep="features"``: ``records`` ("cat"), a list of byte strings that describe themselves (:mod:`palpate.metrics.streaming_states`). Features,
  names and counts travel in one gather; processes may have seen unequal numbers of rows, or none. Metrics of one collection whose
  settings agree hold one list together (torchmetrics' compute groups): features are stored once for all four.
* ``keep="sums"``: moments ("sum"), their radius ("max"), how halves were dealt ("sum"). ``center`` must be given: states of fixed size need its
  width, and processes that share nothing else must share it.
* ``settings`` ("max"): digest of the settings that states depend on (mode, normalization, encoder; for sums classes, center, bandwidth), which
  must be the same in all processes and within a compute group. What is computed from a state is each process's own affair: construct the
  metric alike everywhere.

torch and torchmetrics are loaded when this module is, and by no other module of this room; by name, because neither has to be there for
the rest of it.
"""

from __future__ import annotations

import importlib
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateError, Score
from palpate.metrics import streaming
from palpate.metrics.moments import Moments
from palpate.metrics.streaming_states import SUMS, Batch, FeatureState, SumState, batch_of

try:
    torch: Any = importlib.import_module("torch")
    Metric: Any = importlib.import_module("torchmetrics").Metric
except ImportError as error:
    raise PalpateError(
        "palpate.metrics.torch_metric needs torch and torchmetrics",
        f"no {error.name}",
        "Run: pip install 'torchmetrics>=1.6', or use palpate.metrics.streaming, which needs neither",
    ) from None

#: Arguments of ``torchmetrics.Metric``.
THEIRS = (
    "compute_on_cpu",
    "dist_sync_on_step",
    "process_group",
    "dist_sync_fn",
    "distributed_available_fn",
    "sync_on_compute",
    "compute_with_cache",
)


class TorchMetric(Metric):
    """What the four have in common; see the module and :class:`palpate.metrics.streaming.StreamingMetric`.

    ``forward`` (calling the metric) adds a batch and returns the value of that batch alone: against all real touches so far for TMMD, NaN
    where a set is missing. That costs a whole computation; ``update`` does not. ``dist_sync_on_step`` does not apply to it.
    """

    higher_is_better: bool | None = False
    is_differentiable = False
    full_state_update = False
    plain_class: type[streaming.StreamingMetric]

    def __init__(self, **options: Any) -> None:
        super().__init__(**{name: options.pop(name) for name in THEIRS if name in options})
        self.plain = self.plain_class(**options)
        self._score: Score | None = None
        settings = [*bytes.fromhex(self.plain.digest)]
        self.add_state("settings", torch.tensor(settings, dtype=torch.uint8), dist_reduce_fx="max")
        if self.plain.layout is None:
            self.add_state("records", [], dist_reduce_fx="cat")
            return
        if self.plain.center is None:
            must = f'{type(self).__name__}(keep="sums") must be given a center'
            raise PalpateError(
                must,
                "none",
                "Pass e.g. center=the mean of the real embeddings, the same in all processes",
            )
        empty = self._plain_state()
        for name in SUMS:
            self.add_state(
                name, torch.from_numpy(getattr(empty.moments, name)), dist_reduce_fx="sum"
            )
        self.add_state("hashed", torch.from_numpy(empty.hashed), dist_reduce_fx="sum")
        self.add_state("rho", torch.zeros((), dtype=torch.float64), dist_reduce_fx="max")

    def update(
        self,
        features: Any,
        *,
        real: bool = False,
        ids: Any = None,
        labels: Any = None,
        groups: Any = None,
    ) -> None:
        """Adds a batch, as :meth:`palpate.metrics.streaming.StreamingMetric.update`."""
        columns: Any = {"real": real, "ids": ids, "labels": labels, "groups": groups}
        self._score = None
        if self.plain.layout is None:
            batch = batch_of(features, self.plain.plan.normalize, **columns)
            own = next(
                (r for r in reversed(self.records) if len(r) and is_real(r) == batch.real), None
            )
            self._read([*self.records[-1:], *([] if own is None else [own])]).check(batch)
            if len(batch.features):
                self.records.append(torch.from_numpy(batch.to_bytes()).to(self.device))
            return
        if on_host(self.n):  # moments on the memory of the tensors
            state = self._sums()
            state.update(features, self.plain.plan.normalize, **columns)
            self.rho.fill_(state.moments.rho if state.moments else 0.0)
            return
        state = self._plain_state()
        state.hashed = host(self.hashed)
        state.update(features, self.plain.plan.normalize, **columns)
        self.hashed.copy_(torch.from_numpy(state.hashed))
        if state.moments is not None:
            seen = np.flatnonzero(state.moments.n)
            at = torch.from_numpy(seen).to(self.n.device)
            for name in SUMS:
                getattr(self, name).index_add_(
                    0, at, torch.from_numpy(getattr(state.moments, name)[seen]).to(self.n.device)
                )
            self.rho.clamp_(min=state.moments.rho)

    def compute(self) -> Any:
        """The value, a float64 tensor on the metric's device; NaN where it is undefined.

        Raises:
            PalpateError: as :meth:`palpate.metrics.streaming.StreamingMetric.compute`, or if processes differ in settings that states depend on.
        """
        self._same_settings(self.settings)
        self._score = self.plain.score_of(self._state())
        return self._tensor(self._score)

    def score(self) -> Score:
        """The score with interval, settings and notes, of all processes."""
        self.compute()
        assert self._score is not None
        return self._score

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Adds a batch and returns the value of the batch alone, see the class."""
        for (
            name,
            state,
        ) in (
            self.metric_state.items()
        ):  # a compute group shares its states, and each member is called
            setattr(self, name, list(state) if isinstance(state, list) else state.clone())
        self.update(*args, **kwargs)
        one = self.plain.fresh()
        if not self.plain.of_halves:  # the reference so far
            one = self._real()
        columns: dict[str, Any] = {**kwargs}
        features = args[0] if args else columns.pop("features")
        if not columns.get("real"):
            one.update(features, self.plain.plan.normalize, **columns)
        self._forward_cache = self._tensor(
            None if self.plain.missing(one) else self.plain.score_of(one)
        )
        return self._forward_cache

    def reset(self) -> None:
        """Forgets all batches; with ``reset_real_features=False`` those of generated touches only."""
        kept = None if self.plain.reset_real_features else self._real()
        super().reset()
        self._score = None
        if isinstance(kept, FeatureState):
            self.records.extend(
                torch.from_numpy(b.to_bytes()).to(self.device) for b in kept.batches
            )
        elif kept is not None and kept.moments is not None:
            for name, value in [
                *((name, getattr(kept.moments, name)) for name in SUMS),
                ("hashed", kept.hashed),
            ]:
                getattr(self, name).copy_(torch.from_numpy(value))
            self.rho.fill_(kept.moments.rho)

    def merge_state(self, incoming_state: Any) -> None:
        """Adds the state of another metric of the same settings.

        Raises:
            PalpateError: if settings differ; of a bare state only those that states depend on are known.
        """
        if isinstance(incoming_state, TorchMetric):
            if incoming_state is self:
                raise PalpateError(
                    "A metric must be merged with another one",
                    "itself",
                    "Merge what other processes have seen",
                )
            if type(incoming_state) is not type(self) or not streaming.same_options(
                incoming_state.plain.options, self.plain.options
            ):
                raise PalpateError(
                    "Metrics that are merged must be of one class with the same settings",
                    "different ones",
                    "Construct all alike",
                )
        states = (
            incoming_state.metric_state if isinstance(incoming_state, Metric) else incoming_state
        )
        self._same_settings(states["settings"])
        self._computed = self._score = None
        super().merge_state(incoming_state)
        self._update_count += getattr(incoming_state, "_update_count", 1)

    def merge(self, *others: Self) -> Self:
        """A new metric that has seen what this one and others have."""
        out = self.clone()
        for other in others:
            out.merge_state(other)
        return out

    def sync(self, *args: Any, **kwargs: Any) -> None:
        """The synchronization of torchmetrics; a process without data then gathers an empty record of the right type."""
        if self.plain.layout is None and isinstance(self.records, list) and not self.records:
            self.records.append(torch.zeros(0, dtype=torch.uint8, device=self.device))
        super().sync(*args, **kwargs)

    def set_dtype(self, dst_type: Any) -> Self:
        """Nothing: sums stay float64, records bytes."""
        return self

    def _apply(self, fn: Any, *args: Any, **kwargs: Any) -> Any:
        """Moves states between devices; never to another type."""
        return super()._apply(lambda t: t.to(fn(t.new_empty(0)).device), *args, **kwargs)

    def _same_settings(self, settings: Any) -> None:
        if bytes(settings.cpu().tolist()).hex() != self.plain.digest:
            must = (
                f"All states of a {type(self).__name__} that are merged must have the same settings"
            )
            raise PalpateError(
                must,
                "different classes, center, bandwidth, encoder or mode",
                "Construct the metric alike in all processes",
            )

    def _tensor(self, score: Score | None) -> Any:
        value = float("nan") if score is None or score.value is None else score.value
        return torch.tensor(
            value,
            dtype=torch.float32 if self.device.type == "mps" else torch.float64,
            device=self.device,
        )

    def _plain_state(self) -> SumState:
        state = self.plain.fresh()
        assert isinstance(state, SumState)
        return state

    def _read(self, records: Any) -> FeatureState:
        tensors = records if isinstance(records, list) else [records]
        return FeatureState([batch for r in tensors for batch in Batch.read(host(r))])

    def _sums(self) -> SumState:
        """The sums: on the same memory where states are on the CPU, else a copy."""
        found, layout, center = (
            {name: host(getattr(self, name)) for name in SUMS},
            self.plain.layout,
            self.plain.center,
        )
        assert layout is not None
        assert center is not None
        return SumState(
            layout,
            center,
            Moments(center, layout.sigma, **found, rho=float(self.rho)),
            host(self.hashed),
        )

    def _state(self) -> streaming.State:
        return self._sums() if self.plain.layout is not None else self._read(self.records)

    def _real(self) -> streaming.State:
        """A copy of what was seen of real touches."""
        if self.plain.layout is None:
            state = self._read([r for r in self.records if is_real(r)])
        else:
            state = self._plain_state().merge(self._sums())
        state.reset(keep_real=True)
        return state


def host(tensor: Any) -> NDArray[Any]:
    """A tensor as an array; without a copy where it is on the CPU."""
    return tensor.detach().cpu().numpy()


def on_host(tensor: Any) -> bool:
    """Whether NumPy can work on the tensor's memory."""
    return tensor.device.type == "cpu"


def is_real(record: Any) -> bool:
    """Whether a record is of real touches: the fifth number of its head, little-endian."""
    return bool(len(record)) and bool(record[32])


class TMMD(TorchMetric):
    """:class:`palpate.metrics.streaming.TMMD` for torchmetrics."""

    plain_class = streaming.TMMD


class ITMMD(TorchMetric):
    """:class:`palpate.metrics.streaming.ITMMD` for torchmetrics."""

    plain_class = streaming.ITMMD
    higher_is_better: bool | None = None


class CITMMD(TorchMetric):
    """:class:`palpate.metrics.streaming.CITMMD` for torchmetrics."""

    plain_class = streaming.CITMMD
    higher_is_better: bool | None = None


class DTMMD(TorchMetric):
    """:class:`palpate.metrics.streaming.DTMMD` for torchmetrics."""

    plain_class = streaming.DTMMD
    higher_is_better: bool | None = None

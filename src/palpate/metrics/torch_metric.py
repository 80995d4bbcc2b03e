"""TMMD as a true ``torchmetrics.Metric``: in collections, on Lightning modules, over processes.

``from palpate.metrics.torch_metric import TMMD`` takes the arguments of
:class:`palpate.metrics.streaming.TMMD`, and those of ``torchmetrics.Metric``. ``compute()`` returns
the value as a tensor (NaN where it is undefined), because loggers and torchmetrics take tensors;
``score()`` returns the whole :class:`palpate.core.Score`.

States, with their ``dist_reduce_fx``:

* ``records`` ("cat"): byte strings that describe themselves
  (:class:`palpate.metrics.streaming.Batch`). Features, names and counts travel in one gather;
  processes may have seen unequal numbers of rows, or none.
* ``settings`` ("max"): digest of the settings, which must be the same in all processes.

torch and torchmetrics are loaded when this module is, and by no other module of this room.
"""

from __future__ import annotations

import importlib
from itertools import islice
from typing import Any, Self

from palpate.core import MissingExtraError, PalpateError, Score
from palpate.metrics import streaming
from palpate.metrics.streaming import Batch, require_like

try:
    torch: Any = importlib.import_module("torch")
    Metric: Any = importlib.import_module("torchmetrics").Metric
except ImportError as error:
    raise MissingExtraError(str(error.name), "train", "palpate.metrics.torch_metric") from None

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


class TMMD(Metric):
    """:class:`palpate.metrics.streaming.TMMD` for torchmetrics; see the module.

    ``forward`` (calling the metric) adds a batch and returns the value of that batch alone against
    all real samples so far, NaN where a set is missing. That costs a whole computation; ``update``
    does not. ``dist_sync_on_step`` does not apply to it.
    """

    higher_is_better: bool | None = False
    is_differentiable = False
    full_state_update = False

    def __init__(self, **options: Any) -> None:
        super().__init__(**{name: options.pop(name) for name in THEIRS if name in options})
        self.plain = streaming.TMMD(**options)
        self._score: Score | None = None
        settings = torch.tensor([*bytes.fromhex(self.plain.digest)], dtype=torch.uint8)
        self.add_state("settings", settings, dist_reduce_fx="max")
        self.add_state("records", [], dist_reduce_fx="cat")

    def update(
        self, features: Any, real: bool = False, *, ids: Any = None, groups: Any = None
    ) -> None:
        """Add a batch, as :meth:`palpate.metrics.streaming.TMMD.update`."""
        self._score = None
        batch = Batch.of(features, self.plain.plan.normalize, real=real, ids=ids, groups=groups)
        # It must fit the last batch, and the last of its set; the ninth byte is ``real``.
        of_set = (r for r in reversed(self.records) if len(r) and bool(r[8]) == batch.real)
        require_like(batch, self._read([*islice(of_set, 1), *self.records[-1:]]))
        self._append([batch])

    def compute(self) -> Any:
        """The value, a float64 tensor on the metric's device; NaN where it is undefined.

        Raises:
            PalpateError: as :meth:`palpate.metrics.streaming.TMMD.compute`, or if processes differ
                in settings that states depend on.
        """
        self._require_settings(self.settings)
        self._score = self.plain.score_of(self._read(self.records))
        return self._tensor(self._score)

    def score(self) -> Score:
        """The score with interval, settings and notes, of all processes."""
        self.compute()
        assert self._score is not None
        return self._score

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Add a batch and return the value of the batch alone, see the class."""
        before = len(self.records)
        self.update(*args, **kwargs)
        added = self._read(self.records[before:])
        alone = [*self._real(), *(b for b in added if not b.real)]
        score = None if self.plain.missing(alone) else self.plain.score_of(alone)
        self._forward_cache = self._tensor(score)
        return self._forward_cache

    def reset(self) -> None:
        """Forget all batches; with ``reset_real_features=False`` not those of real samples."""
        kept = [] if self.plain.reset_real_features else self._real()
        super().reset()
        self._score = None
        self._append(kept)

    def merge_state(self, incoming_state: Any) -> None:
        """Add the state of another metric of the same settings.

        Raises:
            PalpateError: if settings differ.
        """
        theirs = isinstance(incoming_state, Metric)
        self._require_settings(
            (incoming_state.metric_state if theirs else incoming_state)["settings"]
        )
        self._computed = self._score = None
        super().merge_state(incoming_state)
        self._update_count += getattr(incoming_state, "_update_count", 1)

    def sync(self, *args: Any, **kwargs: Any) -> None:
        """As torchmetrics; a process without data gathers an empty record of the right type."""
        if isinstance(self.records, list) and not self.records:
            self.records.append(torch.zeros(0, dtype=torch.uint8, device=self.device))
        super().sync(*args, **kwargs)

    def set_dtype(self, dst_type: Any) -> Self:
        """Do nothing: records are bytes."""
        return self

    def _require_settings(self, settings: Any) -> None:
        if bytes(settings.cpu().tolist()).hex() != self.plain.digest:
            must = f"States of {type(self).__name__} that are merged must have the same settings"
            got, fix = "different ones", "Construct the metric with the same arguments everywhere"
            raise PalpateError(must, got, fix)

    def _tensor(self, score: Score | None) -> Any:
        value = float("nan") if score is None else float(score)
        wide = torch.float32 if self.device.type == "mps" else torch.float64
        return torch.tensor(value, dtype=wide, device=self.device)

    def _read(self, records: Any) -> list[Batch]:
        tensors = records if isinstance(records, list) else [records]
        return [batch for r in tensors for batch in Batch.read(r.detach().cpu().numpy())]

    def _append(self, batches: list[Batch]) -> None:
        records = [b.to_bytes() for b in batches if len(b.features)]
        self.records.extend(torch.from_numpy(r).to(self.device) for r in records)

    def _real(self) -> list[Batch]:
        """What was seen of real samples."""
        return [batch for batch in self._read(self.records) if batch.real]

"""TMMD as a true ``torchmetrics.Metric``: in collections, on Lightning modules, over processes.

``from palpate.metrics.torch_metric import TMMD`` takes the arguments of
:class:`palpate.metrics.streaming.TMMD`, and those of ``torchmetrics.Metric``. ``compute()`` returns
the value as a tensor (NaN where it is undefined), because loggers and torchmetrics take tensors;
``score()`` returns the whole :class:`palpate.core.Score`.

States, with their ``dist_reduce_fx``:

* ``records`` ("cat"): byte strings that describe themselves
  (:class:`palpate.metrics.streaming.Batch`), made of the batches when torchmetrics reads the state.
  Features, names and counts travel in one gather; processes may have seen unequal numbers of rows,
  or none.
* ``settings`` ("max"): digest of the settings, which must be the same in all processes.

torch and torchmetrics are loaded when this module is, and by no other module of this room.
"""

from __future__ import annotations

import importlib
from typing import Any, Self

import numpy as np

from palpate.core import PalpateError, Score, require
from palpate.metrics import streaming
from palpate.metrics.streaming import Batch

try:
    torch: Any = importlib.import_module("torch")
    Metric: Any = importlib.import_module("torchmetrics").Metric
except ImportError as error:
    must, fix = "palpate.metrics.torch_metric needs torch and torchmetrics", "pip install both"
    raise PalpateError(must, f"no package {error.name}", fix) from None

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

    def __hash__(self) -> int:
        """Return that of a module; torchmetrics hashes states, and here each reading is new."""
        return id(self)

    @property
    def records(self) -> list[Any]:
        """The batches as bytes; an empty record where there is none, so that all gather a type."""
        records = [b.to_bytes() for b in self.plain.batches] or [np.zeros(0, np.uint8)]
        return [torch.from_numpy(r).to(self.device) for r in records]

    @records.setter
    def records(self, records: Any) -> None:
        tensors = records if isinstance(records, list) else [records]
        self.plain.batches = [b for r in tensors for b in Batch.read(r.cpu().numpy())]

    def update(
        self, features: Any, real: bool = False, *, ids: Any = None, groups: Any = None
    ) -> None:
        """Add a batch, as :meth:`palpate.metrics.streaming.TMMD.update`."""
        self.plain.update(features, real, ids=ids, groups=groups)

    def compute(self) -> Any:
        """The value, a float64 tensor on the metric's device; NaN where it is undefined.

        Raises:
            PalpateError: as :meth:`palpate.metrics.streaming.TMMD.compute`, or if processes differ
                in settings that states depend on.
        """
        self._require_settings(self.settings)
        self._score = self.plain.compute()
        return self._tensor(self._score)

    def score(self) -> Score:
        """The score with interval, settings and notes, of all processes."""
        self.compute()
        assert self._score is not None
        return self._score

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Add a batch and return the value of the batch alone, see the class."""
        before = len(self.plain.batches)
        self.update(*args, **kwargs)
        alone = [b for k, b in enumerate(self.plain.batches) if b.real or k >= before]
        self._forward_cache = self._tensor(self.plain.score_of(alone))
        return self._forward_cache

    def reset(self) -> None:
        """Forget all batches; with ``reset_real_features=False`` not those of real samples."""
        super().reset()
        self._score = None
        self.plain.reset()

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

    def set_dtype(self, dst_type: Any) -> Self:
        """Do nothing: records are bytes."""
        return self

    def _require_settings(self, settings: Any) -> None:
        same = bytes(settings.cpu().tolist()).hex() == self.plain.digest
        must = f"States of {type(self).__name__} that are merged must have the same settings"
        fix = "Construct the metric with the same arguments everywhere"
        require(same, None, must, "different ones", fix=fix)

    def _tensor(self, score: Score | None) -> Any:
        value = float("nan") if score is None else float(score)
        wide = torch.float32 if self.device.type == "mps" else torch.float64
        return torch.tensor(value, dtype=wide, device=self.device)

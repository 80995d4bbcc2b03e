"""The four tactile metrics for features that come in batches, over any number of processes.

The classes follow the contract of torchmetrics (update, compute, reset, merge) without needing it,
nor torch; :mod:`palpate.metrics.torch_metric` has the same four as true ``torchmetrics.Metric``.
Each takes generated samples with ``update(features)`` and real ones with ``update(features,
real=True)``: they are the reference of :class:`TMMD`, and ``Score.floor`` of the others.
``compute()`` is what the function of the same metric returns for all rows.

Rows are kept: memory grows with them. For TMMD of sets that do not fit, see
:func:`palpate.metrics.distance`, which reads arrays on disk.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from hashlib import blake2b
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, Note, PalpateError, Score, digest_json
from palpate.core.features import is_missing
from palpate.metrics.inputs import (
    Normalize,
    checked_features,
    checked_names,
    column,
    invalid,
    to_host,
)
from palpate.metrics.mmd import plan_for
from palpate.metrics.tactile import ci_tmmd_of, d_tmmd_of, i_tmmd_of, reference_free, tmmd_scored

COLUMNS = ("ids", "labels", "groups")


@dataclass(frozen=True)
class Batch:
    """Rows of one update: (n, d) float32 or float64; n ids, labels and groups, or None."""

    features: NDArray[Any]
    real: bool = False
    ids: list[str] | None = None
    labels: list[str] | None = None
    groups: list[str] | None = None

    @classmethod
    def of(cls, features: Any, normalize: Normalize, *, real: bool, **columns: Any) -> Batch:
        """A checked copy, widened to float32 at least: callers often use their buffers again."""
        name = f"The {'real' if real else 'generated'} features of this update"
        x = checked_features(name, to_host(features), normalize=False, least=0)
        if normalize is not False:
            checked_features(name, x, normalize=normalize, least=0)
        ids, groups = (checked_names(c, columns.get(c), len(x)) for c in ("ids", "groups"))
        labels = column("labels", columns.get("labels"), len(x))
        if labels is not None:
            labels = ["" if is_missing(v) else str(v) for v in labels]
        return cls(np.array(x, order="C"), bool(real), ids, labels, groups)

    @property
    def given(self) -> list[str]:
        """Which of ids, labels and groups there are."""
        return [name for name in COLUMNS if getattr(self, name) is not None]

    def to_bytes(self) -> NDArray[np.uint8]:
        """The batch as bytes: size and ``real`` as int64, then an npz; several may be joined."""
        names = {name: np.array(getattr(self, name), dtype=str) for name in self.given}
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, features=self.features, **names)
        head = np.array([buffer.getbuffer().nbytes, self.real], dtype="<i8").view(np.uint8)
        return np.concatenate([head, np.frombuffer(buffer.getvalue(), dtype=np.uint8)])

    @classmethod
    def read(cls, joined: NDArray[np.uint8]) -> Iterator[Batch]:
        """The batches of bytes that were joined."""
        while joined.size:
            size, real = (int(v) for v in joined[:16].view("<i8"))
            stop = 16 + size
            with np.load(io.BytesIO(joined[16:stop].tobytes()), allow_pickle=False) as data:
                names = {name: data[name].tolist() for name in COLUMNS if name in data}
                yield cls(data["features"], bool(real), **names)
            joined = joined[stop:]


def require_like(batch: Batch, before: Sequence[Batch]) -> None:
    """Raise where a batch does not fit those before: their last one, and the last of its set."""
    for other in [*before[-1:], *[b for b in before if b.real == batch.real][-1:]]:
        widths = [b.features.shape[1] for b in (other, batch)]
        if widths[0] != widths[1]:
            must, got = "must have the same width in all updates", f"{widths[0]} and {widths[1]}"
            raise invalid("features", must, got, "Embed all with the same encoder")
        if len(batch.features) and batch.real == other.real and batch.given != other.given:
            got = " and ".join(", ".join(b.given) or "none" for b in (other, batch))
            must = "All updates of one set must give the same of ids, labels and groups"
            raise PalpateError(must, got, "Give each always, or never")


def joined(batches: Sequence[Batch], real: bool, encoder: str | None) -> FeatureSet | None:
    """The rows of a set in the order of arrival, None if there are none."""
    batches = [b for b in batches if b.real == real]
    if not batches:
        return None
    features = np.concatenate([b.features for b in batches])
    columns: dict[str, Any] = {
        name: [v for b in batches for v in getattr(b, name)] for name in batches[0].given
    }
    columns.setdefault("ids", row_ids(features, "real" if real else "generated"))
    return FeatureSet(features=features, encoder=encoder, **columns)


def row_ids(features: NDArray[Any], kind: str) -> list[str]:
    """Ids for rows without: a digest of the row, so that neither order nor process matters.

    Repeated rows are numbered. ``kind`` keeps a copied row from passing for one of the same scene.
    """
    seen: dict[str, int] = {}
    ids: list[str] = []
    for row in features:
        name = blake2b(row.tobytes(), digest_size=12).hexdigest()
        seen[name] = seen.get(name, -1) + 1
        ids.append(f"{kind} {name}-{seen[name]}")
    return ids


class StreamingMetric:
    """What the four have in common. Instances can be pickled between any two batches.

    Args:
        encoder: digest of the encoder, kept with the score.
        reset_real_features: False: :meth:`reset` keeps real samples, which are then embedded once
            for a whole training.
        **options: see :class:`palpate.metrics.Options`.

    Raises:
        PalpateError: on options that are rejected.
    """

    name: ClassVar[str]
    function: ClassVar[Any]  # (generated, real, options) -> Scored
    needs_real: ClassVar[bool] = False

    def __init__(
        self, *, encoder: str | None = None, reset_real_features: bool = True, **options: Any
    ) -> None:
        self.encoder, self.reset_real_features, self.options = encoder, reset_real_features, options
        self.plan = plan_for(options, grouped=True)  # checks; groups are known with the rows
        self.batches: list[Batch] = []

    @property
    def digest(self) -> str:
        """SHA-256 of the settings, which must agree where states are merged."""
        return digest_json(
            [self.encoder, self.reset_real_features, repr(sorted(self.options.items()))]
        )

    def update(
        self,
        features: Any,
        real: bool = False,
        *,
        ids: Any = None,
        labels: Any = None,
        groups: Any = None,
    ) -> None:
        """Add a batch; a batch that is rejected changes nothing.

        Args:
            features: (n, d), n may be 0: NumPy or torch on any device; half precision is widened.
                Rows are copied.
            real: whether these are real samples: the reference of TMMD, the floor of the others.
            ids: n sample ids, strings or integers; an id in both sets is one scene, whose pairs
                TMMD excludes where there are no groups. Without, a digest of each row.
            labels: n classes, for CI- and D-TMMD.
            groups: n videos, strings or integers. Ids, labels and groups are given with every batch
                of a set, or with none.

        Raises:
            PalpateError: at once for rows that :func:`palpate.metrics.inputs.checked_features`
                rejects, another width than before, or columns of another length.
        """
        columns: dict[str, Any] = {"real": real, "ids": ids, "labels": labels, "groups": groups}
        batch = Batch.of(features, self.plan.normalize, **columns)
        require_like(batch, self.batches)
        if len(batch.features):
            self.batches.append(batch)

    def compute(self) -> Score:
        """The score of all batches since the last reset.

        Raises:
            PalpateError: if a set is missing, or as the function does.
        """
        return self.score_of(self.batches)

    def missing(self, batches: Sequence[Batch]) -> bool:
        """Whether batches lack a set that the metric needs."""
        sets = {b.real for b in batches}
        return False not in sets or (self.needs_real and True not in sets)

    def score_of(self, batches: Sequence[Batch]) -> Score:
        """The score of batches."""
        if self.missing(batches):
            sets = "generated and real samples" if self.needs_real else "generated samples"
            rows = [
                sum(len(b.features) for b in batches if b.real == real) for real in (False, True)
            ]
            got = f"{rows[0]} generated and {rows[1]} real"
            fix = "Call update(features)" + " and update(features, real=True)" * self.needs_real
            raise PalpateError(f"{self.name} must have {sets} before compute()", got, fix)
        generated, real = (joined(batches, real, self.encoder) for real in (False, True))
        assert generated is not None  # missing() looked
        score = type(self).function(generated, real, self.options).score
        repeated = len(generated.ids) - len(set(generated.ids))
        notes = [Note("repeated-ids", {"count": repeated})] if repeated else []
        return replace(score, notes=(*score.notes, *notes))

    def reset(self) -> None:
        """Forget all batches; with ``reset_real_features=False`` not those of real samples."""
        self.batches = [b for b in self.batches if b.real and not self.reset_real_features]

    def merge_state(self, other: Self) -> None:
        """Add what another metric of the same settings has seen, e.g. one unpickled from a process.

        Raises:
            PalpateError: if class, settings or width differ, or on the metric itself.
        """
        if other is self:
            got, fix = "itself", "Merge what other processes have seen"
            raise PalpateError("A metric must be merged with another one", got, fix)
        if type(self) is not type(other) or self.digest != other.digest:
            must = "Metrics that are merged must be of one class with the same settings"
            got = f"{type(self).__name__} and {type(other).__name__}"
            raise PalpateError(must, got, "Construct all with the same arguments")
        merged = [*self.batches]
        for batch in other.batches:
            require_like(batch, merged)
            merged.append(batch)
        self.batches = merged


class TMMD(StreamingMetric):
    """TMMD (paper, Eq. 2), the streaming form of :func:`palpate.metrics.tmmd`."""

    name, needs_real = "TMMD", True
    function = staticmethod(tmmd_scored)


class ITMMD(StreamingMetric):
    """I-TMMD (paper, Eq. 3), the streaming form of :func:`palpate.metrics.i_tmmd`."""

    name, function = "I-TMMD", partial(reference_free, i_tmmd_of)


class CITMMD(StreamingMetric):
    """CI-TMMD (paper, Eq. 4), the streaming form of :func:`palpate.metrics.ci_tmmd`."""

    name, function = "CI-TMMD", partial(reference_free, ci_tmmd_of)


class DTMMD(StreamingMetric):
    """D-TMMD (paper, Eq. 5-7), the streaming form of :func:`palpate.metrics.d_tmmd`."""

    name, function = "D-TMMD", partial(reference_free, d_tmmd_of)

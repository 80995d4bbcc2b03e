"""Squared MMD of sets that are large: TMMD of features that come in batches; arrays as they lie.

:class:`TMMD` follows the contract of torchmetrics (update, compute, reset) without needing it, nor
torch; :mod:`palpate.metrics.torch_metric` has the same as a true ``torchmetrics.Metric``. It takes
generated samples with ``update(features)`` and real ones with ``update(features, real=True)``;
``compute()`` is what :func:`palpate.metrics.tmmd` returns for all rows. Rows are kept: memory grows
with them.

:func:`distance` keeps none: it reads arrays on disk, and computes on the device of tensors.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, Note, PalpateError, Score, digest_json, require
from palpate.metrics.inputs import (
    check,
    checked_features,
    checked_names,
    checked_pair,
    checked_whole,
    copies_across,
    to_host,
)
from palpate.metrics.kernels import gaussian, kernel_sums
from palpate.metrics.mmd import (
    Settings,
    build_table,
    largest_bound,
    mmd_matrix,
    plan_for,
    unit_index,
)
from palpate.metrics.tactile import copied_rows, tmmd_of


@dataclass(frozen=True)
class Batch:
    """Rows of one update, of real samples or of generated ones.

    Attributes:
        arrays: ``features``, (n, d) float32 or float64; (n,) ``ids`` and ``groups`` if given.
        real: whether these are real samples.
    """

    arrays: Mapping[str, NDArray[Any]]
    real: bool = False

    @property
    def features(self) -> NDArray[Any]:
        """(n, d)."""
        return self.arrays["features"]

    def to_bytes(self) -> NDArray[np.uint8]:
        """The batch as bytes: size and ``real`` as int64, then an npz; several may be joined."""
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **self.arrays)
        head = np.array([buffer.getbuffer().nbytes, self.real], dtype="<i8").view(np.uint8)
        return np.concatenate([head, np.frombuffer(buffer.getvalue(), dtype=np.uint8)])

    @classmethod
    def read(cls, joined: NDArray[np.uint8]) -> Iterator[Batch]:
        """The batches of bytes that were joined."""
        while joined.size:
            size, real = (int(v) for v in joined[:16].view("<i8"))
            stop = 16 + size
            with np.load(io.BytesIO(joined[16:stop].tobytes()), allow_pickle=False) as data:
                yield cls(dict(data), bool(real))
            joined = joined[stop:]


def require_like(batch: Batch, before: Sequence[Batch]) -> None:
    """Raise where a batch does not fit those before: their last one, and the last of its set."""
    for other in [*before[-1:], *[b for b in before if b.real == batch.real][-1:]]:
        widths = [b.features.shape[1] for b in (other, batch)]
        must, fix = "must have the same width in all updates", "Embed all with the same encoder"
        require(widths[0] == widths[1], "features", must, f"{widths[0]} and {widths[1]}", fix=fix)
        both = [", ".join(b.arrays) for b in (other, batch)]
        same = not len(batch.features) or batch.real != other.real or both[0] == both[1]
        must = "All updates of one set must give the same of ids and groups"
        require(same, None, must, " and ".join(both), fix="Give each always, or never")


def joined(batches: Sequence[Batch], real: bool, encoder: str | None) -> FeatureSet:
    """The rows of a set in the order of arrival."""
    each = [b.arrays for b in batches if b.real == real]
    arrays = {name: np.concatenate([a[name] for a in each]) for name in each[0]}
    features = arrays["features"]
    ids, groups = (arrays[n].tolist() if n in arrays else None for n in ("ids", "groups"))
    ids = ids or row_ids(features, "real" if real else "generated")
    return FeatureSet(ids, features, None, groups, encoder)


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


class TMMD:
    """TMMD (paper, Eq. 2) of batches. It can be pickled between any two of them.

    Args:
        encoder: digest of the encoder, kept with the score.
        reset_real_features: False: :meth:`reset` keeps real samples, which are then embedded once
            for a whole training.
        **options: see :class:`palpate.metrics.Options`.

    Raises:
        PalpateError: on options that are rejected.
    """

    def __init__(
        self,
        *,
        encoder: str | None = None,
        reset_real_features: bool = True,
        **options: Unpack[Settings],
    ) -> None:
        self.encoder, self.reset_real_features, self.options = encoder, reset_real_features, options
        self.plan = plan_for(options, grouped=True)  # checks; groups are known with the rows
        self.batches: list[Batch] = []

    @property
    def digest(self) -> str:
        """SHA-256 of the settings, which must agree where processes are merged."""
        return digest_json(
            [self.encoder, self.reset_real_features, repr(sorted(self.options.items()))]
        )

    def update(
        self, features: Any, real: bool = False, *, ids: Any = None, groups: Any = None
    ) -> None:
        """Add a batch; a batch that is rejected changes nothing.

        Args:
            features: (n, d), n may be 0: NumPy or torch on any device; half precision is widened.
                Rows are copied.
            real: whether these are real samples, the reference.
            ids: n sample ids, strings or integers; an id in both sets is one scene, whose pairs
                are excluded where there are no groups. Without, a digest of each row.
            groups: n videos, strings or integers. Ids and groups are given with every batch of a
                set, or with none.

        Raises:
            PalpateError: at once for rows that :func:`palpate.metrics.inputs.checked_features`
                rejects, another width than before, or columns of another length.
        """
        name = f"The {'real' if real else 'generated'} features of this update"
        x = checked_features(name, to_host(features), normalize=False, least=0)
        checked_features(name, x, normalize=self.plan.normalize, least=0)
        arrays = {"features": np.array(x, order="C")}  # buffers are often used again
        for column, values in (("ids", ids), ("groups", groups)):
            if (names := checked_names(column, values, len(x))) is not None:
                arrays[column] = np.array(names, dtype=str)
        batch = Batch(arrays, bool(real))
        require_like(batch, self.batches)
        if len(batch.features):
            self.batches.append(batch)

    def compute(self) -> Score:
        """The score of all batches since the last reset.

        Raises:
            PalpateError: if a set is missing, or as :func:`palpate.metrics.tmmd`.
        """
        if score := self.score_of(self.batches):
            return score
        rows = [sum(len(b.features) for b in self.batches if b.real == real) for real in (0, 1)]
        must, fix = "TMMD must have generated and real samples", "Call update for both"
        raise PalpateError(must, f"{rows[0]} generated and {rows[1]} real", fix)

    def score_of(self, batches: Sequence[Batch]) -> Score | None:
        """The score of batches; None where a set is missing."""
        if len({b.real for b in batches}) < 2:
            return None
        generated, real = (joined(batches, real, self.encoder) for real in (False, True))
        score = tmmd_of(build_table(generated, real, self.options)).score
        repeated = len(generated.ids) - len(set(generated.ids))
        notes = [Note("repeated-ids", {"count": repeated})] if repeated else []
        return replace(score, notes=(*score.notes, *notes))

    def reset(self) -> None:
        """Forget all batches; with ``reset_real_features=False`` not those of real samples."""
        self.batches = [b for b in self.batches if b.real and not self.reset_real_features]


def distance(
    generated: Any,
    reference: Any,
    *,
    groups: Any = None,
    reference_groups: Any = None,
    block: int = 1024,
    **options: Unpack[Settings],
) -> Score:
    """Squared MMD between two sets of features (paper, Eq. 2), without an interval.

    Unlike TMMD it streams arrays on disk, and computes on the device of tensors.

    Args:
        generated: (n, d) features, see :mod:`palpate.metrics.inputs`; an array on disk is streamed.
        reference: (m, d) features of the same library; n and m may differ.
        groups: n group names, for ``estimator="grouped"``; the same name in both sets is the same
            group.
        reference_groups: m group names.
        block: rows of a kernel block; memory is about ``block^2`` numbers a thread.
        **options: see :class:`palpate.metrics.Options`; those of halves and tests have no effect.

    Returns:
        The value, which may be negative for ``"unbiased"`` and ``"grouped"``. Blocked: float32
        unit-norm features with an error below 1e-4 at scale 1000, float64 below 1e-9.
        ``details``: ``backend``, and ``bound``: the value is within this of the exact one
        (rounding aside); 0 for ``blocked``.

    Raises:
        PalpateError: on features that :func:`palpate.metrics.inputs.checked_features` rejects,
            fewer than two rows for ``"unbiased"``, or groups that are missing or too few for
            ``"grouped"``.
    """
    grouped = groups is not None and reference_groups is not None
    plan = plan_for({"preset": "paper", **options}, grouped=grouped)
    checked_whole(1, block=block)
    least = 1 if plan.estimator == "biased" else 2
    parts = checked_pair(generated, reference, normalize=plan.normalize, least=least)
    n, m = map(len, parts)
    units = [
        checked_names("groups", groups, n) or [],
        checked_names("reference_groups", reference_groups, m) or [],
    ]
    segment = np.repeat(np.arange(2), [n, m])
    kernel = plan.kernel or gaussian(plan.sigma, parts[1], units[1] or None)
    sums = kernel_sums(
        parts,
        # Where no pair is excluded a set is one item.
        np.stack([segment, unit_index(*units) if plan.estimator == "grouped" else segment]),
        2,
        kernel,
        lambda sums: largest_bound(sums, plan.estimator, 1000.0),
        backend=plan.backend,
        block=block,
    )
    value = float(mmd_matrix(sums.totals, plan.estimator, plan.scale)[0, 1])
    finite = bool(np.isfinite(sums.totals.sums).all())
    fix = "Normalize the rows, or scale them down"
    check(finite, "Kernel values", "must be finite", "infinity or NaN", fix)
    got = f"{len(set(units[0]))} and {len(set(units[1]))} groups"
    must, fix = "must have at least two groups, not all shared", "Pass more groups"
    check(math.isfinite(value), "Each set", must, got, fix, estimator="unbiased")
    return Score(
        "squared MMD",
        plan.subject,
        value,
        estimator=plan.estimator,
        bandwidth=kernel.bandwidth,
        scale=plan.scale,
        n=n,
        m=m,
        settings=kernel.settings(),
        details={"bound": largest_bound(sums, plan.estimator, plan.scale), "backend": sums.backend},
        notes=copied_rows(copies_across(*parts), n),
    )

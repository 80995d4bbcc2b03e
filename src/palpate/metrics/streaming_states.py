"""What a streaming metric remembers between batches: the features themselves, or sums of fixed size.

* :class:`FeatureState` keeps rows with their ids, labels and groups. A batch also has a form as bytes that describes itself (:meth:`Batch.to_bytes`):
  records may be joined end to end in any order, so that one "cat" of byte strings over processes carries features of any type and
  names of any kind exactly, and a process without data adds an empty string. A record is eight little-endian int64 (bytes in all, rows,
  width, bytes a number, 1 if real, bytes of the names, 0, 0), the rows, the names as JSON, and zeros up to a multiple of eight.
* :class:`SumState` keeps :class:`palpate.metrics.moments.Moments` of a few items, O(C d^2) numbers whatever the number of rows; they add up
  over batches and processes. The halves of the metrics without reference are dealt by a hash of the sample's id, or of its group where
  groups are given: no process needs to know what another one saw.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from palpate.core import FeatureSet, PalpateError, seed_for
from palpate.core.features import is_missing
from palpate.metrics.arrays import is_foreign
from palpate.metrics.inputs import Normalize, checked_features, checked_names
from palpate.metrics.kernels import Array, Gaussian, Index
from palpate.metrics.moments import Moments, center_of
from palpate.metrics.tables import Table

HEAD = 8
#: What of Moments adds up; ``rho`` is a maximum.
#: A group's number is below this: sums of half a billion rows are exact.
MARKS = 1 << 24
SUMS = ("n", "zeroth", "first", "second", "fourth", "diagonal")


class Columns(TypedDict, total=False):
    """What belongs to the rows of one update: n entries each, strings or integers, or None. ``real``: touches of the sensor, not of a generator."""

    real: bool
    ids: Any
    labels: Any
    groups: Any


@dataclass(frozen=True)
class Batch:
    """Rows of one update: ``features`` (n, d) float32 or float64, ``real``, and n ids, labels and groups, or None."""

    features: NDArray[Any]
    real: bool = False
    ids: list[str] | None = None
    labels: list[str] | None = None
    groups: list[str] | None = None

    def given(self) -> tuple[str, ...]:
        """Which of ids, labels and groups there are."""
        return tuple(
            name for name in ("ids", "labels", "groups") if getattr(self, name) is not None
        )

    def to_bytes(self) -> NDArray[np.uint8]:
        """The record, see the module."""
        names = json.dumps([self.ids, self.labels, self.groups], separators=(",", ":")).encode()
        rows = np.ascontiguousarray(self.features, dtype=self.features.dtype.newbyteorder("<"))
        filled = 8 * HEAD + rows.nbytes + len(names)
        out = np.zeros(-(-filled // 8) * 8, dtype=np.uint8)
        out[: 8 * HEAD].view("<i8")[:6] = (
            out.size,
            *rows.shape,
            rows.itemsize,
            self.real,
            len(names),
        )
        out[8 * HEAD : 8 * HEAD + rows.nbytes] = rows.reshape(-1).view(np.uint8)
        out[8 * HEAD + rows.nbytes : filled] = np.frombuffer(names, dtype=np.uint8)
        return out

    @classmethod
    def read(cls, joined: NDArray[np.uint8]) -> Iterator[Batch]:
        """The batches of records that stand end to end."""
        while joined.size:
            size, n, d, width, real, text = (int(v) for v in joined[: 8 * HEAD].view("<i8")[:6])
            stop = 8 * HEAD + n * d * width
            rows = joined[8 * HEAD : stop].view(f"<f{width}").reshape(n, d)
            yield cls(rows, bool(real), *json.loads(joined[stop : stop + text].tobytes()))
            joined = joined[size:]


def set_name(real: bool) -> str:
    """What errors call the rows of an update."""
    return f"The {'real' if real else 'generated'} features of this update"


def names_of(name: str, values: Any, n: int, *, gaps: bool = False) -> list[str] | None:
    """Ids, labels or groups as strings: from a list, a NumPy array or a tensor; ``gaps``: None is the empty string.

    Raises:
        PalpateError: as :func:`palpate.metrics.inputs.checked_names`.
    """
    if values is None:
        return None
    plain = values.tolist() if hasattr(values, "tolist") else list(values)
    plain = [
        v.item() if hasattr(v, "item") else v
        for v in (plain if isinstance(plain, list) else [plain])
    ]
    if not gaps or len(plain) != n:
        return checked_names(name, plain, n)
    return ["" if is_missing(v) else str(v) for v in plain]


def to_host(x: Any) -> Any:
    """Arrays of other devices on this one; everything else as it is."""
    if not is_foreign(x):
        return x
    x = x.detach() if hasattr(x, "detach") else x
    return x.cpu() if hasattr(x, "cpu") else x.get() if hasattr(x, "get") else x


def batch_of(features: Any, normalize: Normalize, **columns: Unpack[Columns]) -> Batch:
    """A checked copy of what a caller passed: buffers are often used again for the next batch.

    Rows are kept as they came, widened to float32 at least; ``normalize`` only decides what is refused.
    """
    real = bool(columns.get("real", False))
    x = checked_features(set_name(real), to_host(features), normalize=False, least=0)
    if normalize is not False:
        checked_features(set_name(real), x, normalize=normalize, least=0)
    n = len(x)
    ids, groups = (names_of(name, columns.get(name), n) for name in ("ids", "groups"))
    return Batch(
        np.array(x, order="C"),
        real,
        ids,
        names_of("labels", columns.get("labels"), n, gaps=True),
        groups,
    )


def alike(a: Batch, b: Batch) -> None:
    """Refuses two batches of one metric that cannot stand in one array.

    Raises:
        PalpateError: on other widths; for batches of one set, on columns that only one of them has.
    """
    if a.features.shape[1] != b.features.shape[1]:
        got = f"{a.features.shape[1]} and {b.features.shape[1]}"
        raise PalpateError(
            "The features of all updates must have the same width",
            got,
            "Embed all with the same encoder",
        )
    if a.real == b.real and len(a.features) and len(b.features) and a.given() != b.given():
        got = " and ".join(", ".join(batch.given()) or "none" for batch in (a, b))
        raise PalpateError(
            "All updates of one set must give the same of ids, labels and groups",
            got,
            "Give each always, or never",
        )


@dataclass
class FeatureState:
    """All batches so far."""

    batches: list[Batch] = field(default_factory=list)

    def update(self, features: Any, normalize: Normalize, **columns: Unpack[Columns]) -> None:
        """Adds rows."""
        batch = batch_of(features, normalize, **columns)
        self.check(batch)
        if len(batch.features):
            self.batches.append(batch)

    def check(self, batch: Batch) -> None:
        """Refuses a batch that does not fit the last one, or the last one of its set."""
        for last in (
            next(reversed(self.batches), None),
            next((b for b in reversed(self.batches) if b.real == batch.real), None),
        ):
            if last is not None:
                alike(last, batch)

    def reset(self, *, keep_real: bool) -> None:
        """Forgets the batches; those of real touches only unless they are kept."""
        self.batches = [b for b in self.batches if b.real and keep_real]

    def merge(self, other: FeatureState) -> FeatureState:
        """The batches of both."""
        for batch in other.batches:
            self.check(batch)
        return FeatureState([*self.batches, *other.batches])

    def rows(self, *, real: bool) -> int:
        """Rows of a set."""
        return sum(len(b.features) for b in self.batches if b.real == real)

    def set_of(self, *, real: bool, encoder: str | None) -> tuple[FeatureSet | None, int]:
        """The rows of a set in the order of arrival, None if there are none; and how many ids are repetitions."""
        batches = [b for b in self.batches if b.real == real and len(b.features)]
        for batch in batches[1:]:
            alike(batches[0], batch)
        if not batches:
            return None, 0
        features = np.concatenate([b.features for b in batches])
        column = lambda name: (
            [v for b in batches for v in getattr(b, name)] if name in batches[0].given() else None
        )
        ids = column("ids")
        repeated = 0 if ids is None else len(ids) - len(set(ids))
        return FeatureSet(
            row_ids(features) if ids is None else ids,
            features,
            column("labels"),
            column("groups"),
            encoder,
        ), repeated


def row_ids(features: NDArray[Any]) -> list[str]:
    """Ids for samples without: a digest of the row, so that they depend on neither order nor process; repeated rows are numbered."""
    seen: dict[str, int] = {}
    ids: list[str] = []
    for row in features:
        name = blake2b(row.tobytes(), digest_size=12).hexdigest()
        seen[name] = seen.get(name, -1) + 1
        ids.append(f"{name}-{seen[name]}")
    return ids


@dataclass(frozen=True)
class Layout:
    """What the items of a :class:`SumState` are.

    Attributes:
        sigma: bandwidth.
        classes: names of the classes; ``("",)`` for one of all samples.
        halves: True: items are 2 (class) + (half), and the same again for real touches if ``sets`` is 2; False: generated and real.
        sets: 1, or 2 where real touches are summed as well.
        seed: of the halves.
    """

    sigma: float
    classes: tuple[str, ...] = ("",)
    halves: bool = True
    sets: int = 1
    seed: int = 0

    @property
    def count(self) -> int:
        """Number of items."""
        return 2 * len(self.classes) * self.sets if self.halves else 2

    def part(self, real: bool) -> slice:
        """The items of a set."""
        own = self.count // self.sets if self.halves else 1
        return slice(own * real, own * (real + 1))

    def items(self, n: int, **columns: Unpack[Columns]) -> tuple[Index, Array]:
        """(n,) item of each row, and what :attr:`SumState.hashed` grows by.

        Raises:
            PalpateError: on labels that are not among the classes, rows without id and group, real touches where none are summed.
        """
        real = bool(columns.get("real", False))
        if not self.halves:
            return np.full(n, int(real), dtype=np.intp), np.zeros(4)
        if real and self.sets == 1:
            raise PalpateError(
                'A metric with keep="sums" must be told of real touches',
                "real=True",
                "Pass floor=True to the constructor",
            )
        label = np.zeros(n, dtype=np.intp)
        if self.classes != ("",):
            names = checked_names("labels", names_of("labels", columns.get("labels"), n), n) or (
                [""] * n
            )
            number = {name: c for c, name in enumerate(self.classes)}
            if strange := sorted(set(names) - set(number)):
                got = ", ".join(repr(s) for s in strange[:5]) if strange != [""] else "no labels"
                raise PalpateError(
                    f"labels must be among the {len(number)} classes",
                    got,
                    "Pass all of them as classes=, and a label a row",
                )
            label = np.array([number[name] for name in names], dtype=np.intp)
        ids, groups = (names_of(name, columns.get(name), n) for name in ("ids", "groups"))
        keys = groups if groups is not None else ids
        if keys is None:
            raise PalpateError(
                'keep="sums" must know the id or the group of every sample',
                "neither",
                "Pass ids=, or groups= (videos)",
            )
        half = {key: seed_for(self.seed, "half", key) & 1 for key in set(keys)}
        side = np.array([half[key] for key in keys], dtype=np.intp)
        mark = {key: seed_for(0, "mark", key) % MARKS for key in half} if groups is not None else {}
        marks = float(sum(mark[key] for key in keys)) if mark else 0.0
        grows = np.array(
            [n * (groups is not None), n * (groups is None), marks * (not real), marks * real],
            dtype=np.float64,
        )
        return self.part(real).start + 2 * label + side, grows


@dataclass
class SumState:
    """Moments of the items of a layout.

    Attributes:
        layout: what the items are.
        center: (d,) subtracted from every row; None: the mean of the first batch, from then on.
        moments: the sums; None before the first row where the center is not given.
        hashed: (4,) rows dealt to halves by their group, and by their id; and of each set the sum over rows of a number made of the group, which
            is equal for the same groups with as many rows each. It is added up as all sums are, and exact for half a billion rows.
    """

    layout: Layout
    center: Array | None = None
    moments: Moments | None = None
    hashed: Array = field(default_factory=lambda: np.zeros(4))

    def __post_init__(self) -> None:
        if self.moments is None and self.center is not None:
            self.moments = Moments.empty(self.center, self.layout.sigma, self.layout.count)

    def update(self, features: Any, normalize: Normalize, **columns: Unpack[Columns]) -> None:
        """Adds rows; none is kept."""
        x = checked_features(
            set_name(bool(columns.get("real", False))), features, normalize=normalize, least=0
        )
        if self.moments is not None and x.shape[1] != len(self.moments.center):
            got = f"{len(self.moments.center)} and {x.shape[1]}"
            raise PalpateError(
                "The features of all updates must have the same width",
                got,
                "Embed all with the same encoder",
            )
        if not len(x):
            return
        item, grows = self.layout.items(len(x), **columns)
        hashed = self.hashed + grows
        self.checked_hash(hashed)
        if self.moments is None:
            self.moments = Moments.empty(center_of([x]), self.layout.sigma, self.layout.count)
        self.moments.add(x, item)
        self.hashed[...] = hashed

    @staticmethod
    def checked_hash(hashed: Array) -> str:
        """``"group"``, ``"sample"`` or ``""``: how halves were dealt.

        Raises:
            PalpateError: if both ways.
        """
        if (hashed[:2] > 0).all():
            got = f"{hashed[0]:.0f} rows by group and {hashed[1]:.0f} by id"
            raise PalpateError(
                "Halves must be dealt by group always, or by id always",
                got,
                "Give groups with every update, or with none",
            )
        return "group" if hashed[0] else "sample" if hashed[1] else ""

    def reset(self, *, keep_real: bool) -> None:
        """Back to nothing; of real touches only unless they are kept (``rho`` then stays, as a bound may)."""
        if self.moments is None or not (keep_real and self.rows(real=True)):
            self.hashed, self.moments = np.zeros(4), None
            self.__post_init__()
            return
        own = self.layout.part(False)
        for name in SUMS:
            getattr(self.moments, name)[own] = 0
        self.hashed[:2] *= self.rows(real=True) / max(self.hashed[:2].sum(), 1)
        self.hashed[2] = 0

    def merge(self, other: SumState) -> SumState:
        """The sums of both."""
        found = [s.moments for s in (self, other) if s.moments is not None]
        hashed = self.hashed + other.hashed
        self.checked_hash(hashed)
        return SumState(
            self.layout, self.center, found[0].merge(found[1:]) if found else None, hashed
        )

    @property
    def same_groups(self) -> bool:
        """Whether both sets have the same groups with as many rows each, as far as their sums tell; True where ids were hashed."""
        return bool(self.hashed[2] == self.hashed[3])

    def rows(self, *, real: bool) -> int:
        """Rows of a set."""
        return 0 if self.moments is None else int(self.moments.n[self.layout.part(real)].sum())

    def table(self, *, real: bool = False) -> tuple[Table, list[str], list[list[int]]]:
        """The table of a set of halves, or of generated and real touches.

        Returns:
            The table, with one unit: nothing can be left out; classes with a half of fewer than two samples, which have no items in it; and
            the sizes of the halves of each class.
        """
        classes = self.layout.classes
        moments = (
            self.moments
            if self.moments is not None
            else Moments.empty(np.zeros(1), self.layout.sigma, self.layout.count)
        )
        last = 4 * len(classes)
        if self.layout.halves:
            own = self.layout.part(real)
            moments = replace(moments, **{name: getattr(moments, name)[own] for name in SUMS})
            segment = np.repeat(4 * np.arange(len(classes)), 2) + np.tile([0, 3], len(classes))
        else:
            segment = np.array([0, last])
        sums = moments.sums(segment, np.zeros(len(segment), dtype=np.intp), last + 1)
        sizes = moments.n.reshape(-1, 2)
        small = (
            np.flatnonzero(sizes.min(axis=1) < 2)
            if classes != ("",)
            else np.zeros(0, dtype=np.intp)
        )
        if len(small):
            to = np.arange(last + 1)
            to[:-1].reshape(-1, 4)[small] = -1
            sums = sums.merge(to, last + 1)
        pairs: Iterable[Index] = (
            np.arange(len(segment)).reshape(-1, 2) if self.layout.halves else []
        )
        spread = np.array([moments.spread(at) for at in [np.arange(len(segment)), *pairs]])
        halves = np.concatenate([sizes.sum(axis=0)[None], sizes]) if self.layout.halves else None
        table = Table(
            sums, classes, "sample", ["all"], Gaussian((self.layout.sigma,)), spread, sizes=halves
        )
        return table, [classes[c] for c in small], sizes.astype(int).tolist()


def sized(n: int, *, labeled: bool = False, encoder: str | None = None) -> FeatureSet:
    """A set that only has a size: what a score asks of features that were never kept."""
    blank = [""] * n
    return FeatureSet(blank, np.zeros((n, 0)), blank if labeled else None, None, encoder)

"""What the metrics take and reject: every input is checked once, at the public function.

Features are finite floating-point rows ``(n, d)``: a NumPy array (also one on disk), a torch tensor
on any device, a list of rows, or a :class:`palpate.core.FeatureSet`. Integers are rejected, since
the distance of wrapped integers has no meaning; half precision is widened, since ``exp`` of a small
exponent rounds to 1 there (a perfect score for anything).

NumPy works on blocks in as many threads as BLAS would use; a library of the array-API standard
(torch on CPU or CUDA, CuPy) runs the same blocks on its device, and only sums come back.
"""

from __future__ import annotations

import mmap
import os
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Literal, TypedDict, TypeVar

import numpy as np
from array_api_compat import array_namespace, device
from numpy.typing import NDArray

from palpate.core import FeatureSet, PalpateError, PalpateWarning, few, require
from palpate.core.features import Array, Index, is_missing

Normalize = Literal["check"] | bool

# glibc returns every freed block of some size to the system, whose pages then cost more than the
# arithmetic in them, until a block as large as this one was freed once.
np.empty(31 << 20, np.uint8)

#: Rows may differ from unit length by this much before ``normalize="check"`` rejects them.
NORM_TOLERANCE = 1e-3
#: Rows of an array on disk that are read together.
SLAB = 8192


def check(holds: bool, name: str, must: str, got: Any, fix: str, **example: Any) -> None:
    """Check an input, whose ``name`` is an argument ("x") or a clause ("The features of 'a'").

    As :func:`palpate.core.require`; ``example`` are arguments that would work.
    """
    if not holds:
        argument = name if name.isidentifier() else None
        must = must if argument else f"{name} {must}"
        raise PalpateError(must, str(got), fix, argument=argument, example=example)


class Columns(TypedDict, total=False):
    """Columns of a set of features: one entry a row, in a list, an array, a series or a tensor."""

    ids: Any
    labels: Any
    groups: Any
    encoder: str | None


class PairColumns(Columns, total=False):
    """The same of generated features, and those of the reference."""

    reference_ids: Any
    reference_labels: Any
    reference_groups: Any


def feature_sets(**features: Any) -> list[FeatureSet]:
    """Features by role (``generated``, ``reference``) as :class:`FeatureSet`, without columns.

    Raises:
        PalpateError: on what does not turn into rows.
    """
    return with_columns({}, **features)[0]


def with_columns(
    options: Mapping[str, Any], **features: Any
) -> tuple[list[FeatureSet], dict[str, Any]]:
    """Features by role with those ``options`` that are their columns, and the other options.

    Columns are ``ids``, ``labels`` and ``groups``, of another role than ``generated`` after its
    name and ``_``, and ``encoder``. Without ids, rows get the name of the role and their number:
    rows of two arrays without ids are different samples.

    Raises:
        PalpateError: on what does not turn into rows, or columns of another length.
    """
    settings = {**options}
    encoder = settings.pop("encoder", None)
    return [_feature_set(role, x, settings, encoder) for role, x in features.items()], settings


def _feature_set(
    role: str, features: Any, options: dict[str, Any], encoder: str | None
) -> FeatureSet:
    base = features if isinstance(features, FeatureSet) else None
    names, prefix = ("ids", "labels", "groups"), "" if role == "generated" else f"{role}_"
    columns = [options.pop(prefix + name, None) for name in names]
    if base is not None and all(v is None for v in (*columns, encoder)):
        return base
    x = as_array(role, to_host(features if base is None else base.features))
    _check_rows(role, x, x.ndim == 2)
    n = len(x)
    ids, labels, groups = (
        getattr(base, name, None) if v is None else column(prefix + name, v, n)
        for name, v in zip(names, columns, strict=True)
    )
    ids = ids or [f"{role} {k:0{len(str(n))}d}" for k in range(n)]
    return FeatureSet(ids, x, labels, groups, encoder or getattr(base, "encoder", None))


def column(name: str, values: Any, n: int) -> list[Any] | None:
    """One value a row, from a list, an array, a series or a tensor; None stays None.

    Raises:
        PalpateError: on another length.
    """
    if values is None:
        return None
    items: Any = values.tolist() if hasattr(values, "tolist") else list(values)
    count = len(items) if isinstance(items, list) else items
    listed = isinstance(items, list) and count == n
    check(listed, name, f"must have one entry a row ({n})", count, "Pass the order of the rows")
    return items


def to_host(x: Any) -> Any:
    """An array of another device on this one, without its graph; everything else as it is."""
    if not is_foreign(x):
        return x
    x = x.detach() if hasattr(x, "detach") else x
    return x.cpu() if hasattr(x, "cpu") else x.get() if hasattr(x, "get") else x


def is_foreign(x: Any) -> bool:
    """Whether ``x`` is an array of a library other than NumPy, e.g. a torch tensor."""
    return not isinstance(x, np.ndarray) and (
        hasattr(x, "__array_namespace__") or type(x).__module__.split(".")[0] == "torch"
    )


def release(x: Any) -> None:
    """Drop the pages of an array on disk that were read; they would count as memory."""
    pages: Any = getattr(x, "_mmap", None)
    if isinstance(x, np.memmap) and hasattr(pages, "madvise") and x.mode != "c":
        pages.madvise(mmap.MADV_DONTNEED)  # in mode "c" the caller's changes would be lost


def as_array(name: str, x: Any) -> Any:
    """``np.asarray``; arrays on other devices stay there, tensors on the CPU share their memory.

    Raises:
        PalpateError: on ragged lists and whatever else has no array.
    """
    if is_foreign(x):
        x = x.detach() if getattr(x, "requires_grad", False) else x
        if getattr(getattr(x, "device", None), "type", "") != "cpu":
            return x
        if str(x.dtype).endswith("bfloat16"):  # NumPy has none
            _warn_widened(name, "bfloat16")
            x = x.float()
    if isinstance(x, np.memmap):  # np.asarray would forget where it comes from
        return x
    problem = ""
    try:
        x = np.asarray(x)
    except (TypeError, ValueError, RuntimeError) as error:
        problem = str(error).splitlines()[0]
    check(not problem, name, "must turn into an array", problem, "Pass rows of one width")
    return x


def checked_features(name: str, x: Any, *, normalize: Normalize = "check", least: int = 1) -> Any:
    """``x`` as a float32 or float64 array (n, d), checked slab by slab.

    An array on disk of float32 or float64 rows is read but not kept; one that has to be normalized
    or widened is copied into memory. Arrays of other libraries stay on their device.

    Args:
        name: argument or clause for errors, see :func:`check`.
        x: an array (n, d).
        normalize: ``"check"`` rejects rows whose L2 norm is not 1 within 1e-3; ``True`` divides by
            the norm; ``False`` takes rows as they are.
        least: the fewest rows that the estimator can use.

    Raises:
        PalpateError: on integers, a wrong shape, too few rows, NaN or infinity, zero or
            un-normalized rows (their numbers are given).
    """
    accepted = normalize in (True, False, "check")
    require(accepted, "normalize", 'must be "check", True or False', repr(normalize))
    x = as_array(name, x)
    kind = str(x.dtype).rsplit(".", maxsplit=1)[-1]
    floating = kind.startswith(("float", "bfloat", "longdouble", ">f", "<f"))
    fix = "Pass the encoder's float output, not pixels or codes"
    check(floating, name, "must be floating-point features", f"dtype {x.dtype}", fix)
    _check_rows(name, x, x.ndim == 2 and x.shape[1] > 0)
    must = f"must have at least {least} rows for this estimator"
    check(len(x) >= least, name, must, len(x), "Pass more samples")
    if kind in ("float16", "bfloat16"):
        _warn_widened(name, kind)
    x = _at_least_float32(x)
    norms = row_norms(x)
    bad, fix = ~np.isfinite(norms), "Check what those rows were made from"
    check(not bad.any(), name, "must be finite", f"NaN or infinity in {rows_text(bad)}", fix)
    if normalize is False:
        return x
    bad = norms == 0
    check(not bad.any(), name, "must have no zero vector", f"zeros in {rows_text(bad)}", fix)
    if normalize is True:
        scale = norms[:, None] if isinstance(x, np.ndarray) else like(norms[:, None], x)
        return (x / scale).astype(x.dtype) if isinstance(x, np.ndarray) else x / scale
    bad = np.abs(norms - 1) > NORM_TOLERANCE
    got = f"norm {', '.join(f'{v:.4g}' for v in norms[bad][:1])} in {rows_text(bad)}"
    fix = "Divide by the norm, or choose to keep the norms"
    check(not bad.any(), name, "must be L2-normalized", got, fix, normalize=True)
    return x


def checked_pair(
    generated: Any, reference: Any, *, normalize: Normalize, least: int, name: str = "generated"
) -> list[Any]:
    """Both feature arrays, checked, of one width, one library and one dtype.

    Raises:
        PalpateError: as :func:`checked_features`, and if widths or libraries differ.
    """
    pair = [as_array(name, generated), as_array("reference", reference)]
    both = f"{f'`{name}`' if name.isidentifier() else name} and `reference`"
    got = " and ".join(str(v.shape[-1]) for v in pair if v.ndim)
    same = any(v.ndim != 2 for v in pair) or pair[0].shape[1] == pair[1].shape[1]
    must, fix = f"{both} must have the same width", "Embed both with the same encoder"
    require(same, None, must, got, fix=fix)
    library = lambda v: f"{type(v).__module__.split('.')[0]} {getattr(v, 'device', '')}"
    homes = [library(v) if is_foreign(v) else "numpy" for v in pair]
    must = f"{both} must be arrays of one library on one device"
    require(homes[0] == homes[1], None, must, " and ".join(homes), fix="Move one of them")
    a, b = (
        checked_features(role, v, normalize=normalize, least=least)
        for role, v in zip((name, "reference"), pair, strict=True)
    )
    if isinstance(a, np.ndarray):
        dtype = np.result_type(a.dtype, b.dtype)
        return [v.astype(dtype, copy=False) for v in (a, b)]
    return [like(a, b), b] if "64" in str(b.dtype) else [a, like(b, a)]


def _at_least_float32(x: Any) -> Any:
    """As float32 or float64, in native byte order."""
    if isinstance(x, np.ndarray):
        return x.astype(np.float32 if x.dtype.itemsize <= 4 else np.float64, copy=False)
    xp = array_namespace(x)
    return x if x.dtype == xp.float64 else xp.astype(x, xp.float32)


def row_norms(x: Any) -> Array:
    """(n,) L2 norms in float64, slab by slab."""
    norms = np.empty(len(x))
    for k in range(0, len(x), SLAB):
        slab = x[k : k + SLAB]
        if isinstance(x, np.ndarray):
            squares = np.einsum("ij,ij->i", slab, slab, dtype=np.float64)
        else:
            xp = array_namespace(x)
            squares = np.asarray(to_host(xp.sum(xp.astype(slab, xp.float64) ** 2, axis=1)))
        norms[k : k + SLAB] = np.sqrt(squares)
        release(x)
    return norms


def _check_rows(name: str, x: Any, holds: bool) -> None:
    must, fix = "must have shape (n, d), one row a sample", "Stack one feature vector a row"
    check(holds, name, must, f"shape {tuple(x.shape)}", fix)


def _warn_widened(name: str, kind: str) -> None:
    text = f"{name}: {kind} features were widened to float32; their rounding stays"
    warnings.warn(text, PalpateWarning, stacklevel=4)


def rows_text(bad: NDArray[np.bool_]) -> str:
    """``"3 rows (0, 4, 7)"`` for a boolean mask of rows."""
    at = np.flatnonzero(bad)
    return f"{at.size} row{'s' * (at.size != 1)} ({few(at)})"


def copies_across(x: Any, y: Any) -> int | None:
    """How many rows of ``x`` are also rows of ``y``, bit for bit; None for arrays on a device.

    By 64-bit hashes of the rows, slab by slab, so that arrays on disk are read but not kept.
    """
    if is_foreign(x) or is_foreign(y):
        return None
    seen = set(_row_hashes(y))
    return sum(h in seen for h in _row_hashes(x))


def _row_hashes(x: NDArray[Any]) -> Iterator[int]:
    for k in range(0, len(x), SLAB):
        for row in np.ascontiguousarray(x[k : k + SLAB]):
            yield hash(row.tobytes())
        release(x)


def checked_names(name: str, values: Any, n: int) -> list[str] | None:
    """Names, one a row, as strings; None stays None.

    Raises:
        PalpateError: on a wrong length, or if some rows have a name and others none.
    """
    items = column(name, values, n)
    if items is None:
        return None
    missing = np.array([is_missing(v) for v in items], dtype=bool)
    must, got = "must be known for every row", f"none in {rows_text(missing)}"
    check(not missing.any(), name, must, got, f"Fill {name}, or pass None for all")
    return [str(v) for v in items]


def checked_whole(least: int, **values: Any) -> None:
    """Reject parameters that are not whole numbers of at least ``least``."""
    must = f"must be a whole number of at least {least}"
    for name, value in values.items():
        whole_number = isinstance(value, int | np.integer) and not isinstance(value, bool)
        holds = whole_number and bool(least <= value < 2**63)
        require(holds, name, must, repr(value), fix="Drop it for the default")


def require_one_encoder(a: FeatureSet, b: FeatureSet, both: str) -> None:
    """Reject features of different encoders; ``both`` names them, as "Train and test".

    Raises:
        PalpateError: with both digests.
    """
    digests = [d or "" for d in (a.encoder, b.encoder)]
    must = f"{both} features must come from one encoder"
    got = f"digests {digests[0][:12]} and {digests[1][:12]}"
    same = "" in digests or digests[0] == digests[1]
    require(same, None, must, got, fix="Embed both with the same encoder")


def require_same_ids(
    a: Sequence[str], b: Sequence[str], names: tuple[str, str] = ("generated", "reference")
) -> None:
    """Check that both lists have the same ids, each once, in any order; ``names`` of the two.

    Raises:
        PalpateError: if an id is repeated, or is in one list only; the first few are named.
    """
    each = [[str(v) for v in ids] for ids in (a, b)]
    for name, ids in zip(names, each, strict=True):
        repeated = [i for i, count in Counter(ids).items() if count > 1]
        must, got = f"Every {name} id must be unique", few(map(repr, repeated))
        got = f"{len(repeated)} repeated: {got}"
        require(not repeated, None, must, got, fix="Keep one sample an id")
    first, second = map(set, each)
    lists = zip(names, (second - first, first - second), strict=True)
    got = [f"{len(ids)} not in {name}: {few(map(repr, sorted(ids)))}" for name, ids in lists if ids]
    must = f"The ids of {names[0]} and {names[1]} must be the same"
    fix = "Score the same samples in both: take() the common ids if that is what you mean"
    same = first == second and len(second) > 0
    require(same, None, must, "; ".join(got) or "none", fix=fix)


T = TypeVar("T")
R = TypeVar("R")


def host(x: Any) -> Array:
    """As a float64 NumPy array."""
    return np.asarray(to_host(x), dtype=np.float64)


def like(values: Any, x: Any) -> Any:
    """``values`` in the type, library and device of ``x``."""
    values = values if is_foreign(values) else np.asarray(values)
    return array_namespace(x).asarray(values, dtype=x.dtype, device=device(x))


def rows_at(x: Any, index: Index) -> Any:
    """``x[index]``, a copy; contiguous rows of an array on disk are read in one piece."""
    if isinstance(x, np.ndarray):
        return x[index]
    xp = array_namespace(x)
    return xp.take(x, xp.asarray(index, device=device(x)), axis=0)


def blas_threads() -> int:
    """Threads that BLAS may use: what ``threadpoolctl`` reports, at most the cores there are."""
    from threadpoolctl import threadpool_info

    allowed = [int(pool["num_threads"]) for pool in threadpool_info() if pool["user_api"] == "blas"]
    usable = getattr(os, "sched_getaffinity", None)
    cores = len(usable(0)) if usable else os.cpu_count() or 1
    return max(1, min([cores, *allowed]))


def in_threads(job: Callable[[T], R], items: Iterable[T], x: Any) -> Iterator[R]:
    """``map(job, items)`` in the same order; for NumPy in threads with one BLAS thread each.

    BLAS threads would speed up the product of a block alone, not the passes over its result.
    """
    from threadpoolctl import threadpool_limits

    if not isinstance(x, np.ndarray):
        with full_precision():
            yield from map(job, items)
        return
    workers = blas_threads()
    if workers < 2:
        yield from map(job, items)
        return
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(workers) as pool:
        waiting: list[Any] = []
        for item in items:  # a few ahead: finished blocks must not pile up
            waiting.append(pool.submit(job, item))
            if len(waiting) > 2 * workers:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()


@contextmanager
def full_precision() -> Generator[None]:
    """No TensorFloat-32 in torch's products: its ten bits are too few."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)

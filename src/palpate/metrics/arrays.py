"""Where numbers live: NumPy, or any library of the array-API standard (torch on CPU or CUDA, CuPy), behind one handful of operations.

The blocked sums need a matrix product, ``expm1`` and products with indicator columns; all else is bookkeeping in NumPy. NumPy works in
place and in several threads; other libraries run the same blocks on their own device, and only sums of blocks come back.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from palpate.metrics.inputs import is_foreign

T = TypeVar("T")
R = TypeVar("R")


#: The series of expm1 serves up to here, and may leave out so much (in MMD^2 twice 1000 times that); (t + 1)! at place t; numbers of a block
#: that fit a core's cache.
SERIES, LEFT_OUT, FACTORIALS, CACHED = (
    0.13,
    2e-11,
    tuple(float(f) for f in np.cumprod(np.arange(1, 13))),
    1 << 15,
)


class Ops:
    """Operations on NumPy arrays."""

    def columns(self, x: Any, *extra: Any) -> Any:
        """``x`` (n, d) with further columns (n,) behind, contiguous."""
        out = np.empty((len(x), x.shape[1] + len(extra)), dtype=x.dtype)
        out[:, : x.shape[1]] = x
        for k, column in enumerate(extra):
            out[:, x.shape[1] + k] = column
        return out

    def squares(self, x: Any) -> Any:
        """(n,) squared norms, summed in float64."""
        return np.einsum("ij,ij->i", x, x, dtype=np.float64)

    def ones(self, n: int, like: Any) -> Any:
        """(n,) ones of the type of ``like``."""
        return np.ones(n, dtype=like.dtype)

    def like(self, x: Any, other: Any) -> Any:
        """``x`` in the type of ``other``."""
        return x.astype(other.dtype)

    def add_outer_(self, k: Any, rows: Any, columns: Any) -> Any:
        """``k`` plus a number a row and a number a column, in place."""
        k += rows[:, None]
        k += columns
        return k

    def expm1_(self, x: Any, least: float, shift: tuple[Any, Any] | None = None) -> Any:
        """``expm1`` of numbers from ``least`` to 0, in place, after ``shift`` was added: a number a row and a number a column.

        NumPy's in float32 errs by up to an ulp in one direction, which no number of pairs averages out: 1e-6 of MMD^2 at scale 1000. Near 0
        the series is summed instead, a few rows at a time, so that they stay in the cache. Its rounding has no direction, but for that of the
        factors 1/t!, which is below 1e-11 here.
        """
        if x.dtype != np.float32 or not x.size or not least >= -SERIES:
            return np.expm1(x if shift is None else self.add_outer_(x, *shift), out=x)
        terms = next(
            t for t in range(3, len(FACTORIALS)) if (-least) ** (t + 1) <= LEFT_OUT * FACTORIALS[t]
        )
        step = max(1, CACHED // x.shape[-1])
        room = np.empty((step, *x.shape[1:]), x.dtype)
        for k in range(0, len(x), step):
            part = x[k : k + step]
            if shift is not None:
                self.add_outer_(part, shift[0][k : k + step], shift[1])
            rest = np.multiply(part, np.float32(1 / FACTORIALS[terms - 1]), out=room[: len(part)])
            for t in range(terms - 2, 0, -1):
                rest += np.float32(1 / FACTORIALS[t])
                rest *= part
            rest *= part
            part += rest
        return x

    def divide_(self, x: Any, number: int) -> Any:
        """``x / number``, in place. A factor 1 / number would be rounded, and move all of ``x`` in one direction."""
        if number != 1:
            x /= x.dtype.type(number)
        return x

    def clear_diagonal(self, k: Any) -> Any:
        """A square block without its diagonal, in place."""
        np.fill_diagonal(k, 0)
        return k

    def sum_rows(self, k: Any, starts: NDArray[np.intp]) -> NDArray[np.float64]:
        """(R, m) sums over the runs of rows that begin at ``starts`` (R,), in float64: near-equal numbers in float32 are rounded in one direction."""
        return np.stack(
            [
                k[a:b].sum(axis=0, dtype=np.float64)
                for a, b in zip(starts, [*starts[1:], len(k)], strict=True)
            ]
        )

    def sum_columns(self, k: Any, starts: NDArray[np.intp]) -> NDArray[np.float64]:
        """(n, R) sums over runs of columns, in float64."""
        return np.add.reduceat(k, starts, axis=1, dtype=np.float64)

    def row_squares(self, k: Any) -> NDArray[np.float64]:
        """(n,) sums of squares of the rows of a block."""
        return np.einsum("ij,ij->i", k, k).astype(np.float64)

    def numpy(self, x: Any) -> NDArray[np.float64]:
        """As a float64 NumPy array."""
        return np.asarray(x, dtype=np.float64)

    def at_least_float32(self, x: Any) -> Any:
        """As float32 or float64."""
        return x.astype(
            np.float32 if x.dtype.itemsize <= 4 else np.float64, copy=False
        )  # native byte order too

    def divide_rows(self, x: Any, norms: NDArray[np.float64]) -> Any:
        """Rows divided by (n,) numbers, in the type of ``x``."""
        return (x / norms[:, None]).astype(x.dtype)

    def one_type(self, a: Any, b: Any) -> tuple[Any, Any]:
        """Both in the wider of their types."""
        dtype = np.result_type(a.dtype, b.dtype)
        return a.astype(dtype, copy=False), b.astype(dtype, copy=False)

    def join(self, parts: list[Any]) -> Any:
        """Rows of all parts."""
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def each(self, job: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """``map(job, items)`` in the same order, in as many threads as BLAS would use, one BLAS thread each.

        A block is a product, an ``expm1`` and a sum; letting BLAS alone use both cores would leave the rest to one of them.
        """
        from threadpoolctl import threadpool_limits

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


class ArrayApiOps(Ops):
    """The same on another library's arrays, by the functions that the array-API standard names."""

    def __init__(self, xp: Any, device: Any) -> None:
        self.xp, self.device = xp, device

    def columns(self, x: Any, *extra: Any) -> Any:
        """``x`` (n, d) with further columns (n,) behind."""
        return self.xp.concat(
            [x, *(self.xp.reshape(self.xp.astype(e, x.dtype), (-1, 1)) for e in extra)], axis=1
        )

    def squares(self, x: Any) -> Any:
        """(n,) squared norms, in float64 where the device has it."""
        wide = self.xp.astype(x, self.xp.float64)
        return self.xp.sum(wide * wide, axis=1)

    def ones(self, n: int, like: Any) -> Any:
        """(n,) ones of the type of ``like``."""
        return self.xp.ones(n, dtype=like.dtype, device=self.device)

    def like(self, x: Any, other: Any) -> Any:
        """``x`` in the type of ``other``."""
        return self.xp.astype(x, other.dtype)

    def add_outer_(self, k: Any, rows: Any, columns: Any) -> Any:
        """``k`` plus a number a row and a number a column."""
        return k + rows[:, None] + columns

    def expm1_(self, x: Any, least: float, shift: tuple[Any, Any] | None = None) -> Any:
        """``expm1``."""
        return self.xp.expm1(x if shift is None else self.add_outer_(x, *shift))

    def divide_(self, x: Any, number: int) -> Any:
        """``x / number``."""
        return x if number == 1 else x / number

    def clear_diagonal(self, k: Any) -> Any:
        """A square block without its diagonal."""
        return k * (1 - self.xp.eye(k.shape[0], dtype=k.dtype, device=self.device))

    def sum_rows(self, k: Any, starts: NDArray[np.intp]) -> NDArray[np.float64]:
        """(R, m) sums over runs of rows, in float64: one product."""
        number = np.repeat(np.arange(len(starts)), np.diff([*starts, k.shape[0]]))
        marks = self.xp.asarray(
            (number == np.arange(len(starts))[:, None]).astype(np.float64), device=self.device
        )
        return self.numpy(marks @ self.xp.astype(k, self.xp.float64))

    def sum_columns(self, k: Any, starts: NDArray[np.intp]) -> NDArray[np.float64]:
        """(n, R) sums over runs of columns, in float64."""
        return self.sum_rows(k.T, starts).T

    def row_squares(self, k: Any) -> NDArray[np.float64]:
        """(n,) sums of squares of the rows of a block."""
        return self.numpy(self.xp.sum(k * k, axis=1))

    def numpy(self, x: Any) -> NDArray[np.float64]:
        """As a float64 NumPy array on the host."""
        x = self.xp.astype(x, self.xp.float64)
        return np.asarray(x.cpu() if hasattr(x, "cpu") else x, dtype=np.float64)

    def at_least_float32(self, x: Any) -> Any:
        """As float32 or float64."""
        return x if x.dtype == self.xp.float64 else self.xp.astype(x, self.xp.float32)

    def divide_rows(self, x: Any, norms: NDArray[np.float64]) -> Any:
        """Rows divided by (n,) numbers, in the type of ``x``."""
        return x / self.xp.asarray(norms, dtype=x.dtype, device=self.device)[:, None]

    def one_type(self, a: Any, b: Any) -> tuple[Any, Any]:
        """Both in the wider of their types."""
        dtype = self.xp.result_type(a.dtype, b.dtype)
        return self.xp.astype(a, dtype), self.xp.astype(b, dtype)

    def join(self, parts: list[Any]) -> Any:
        """Rows of all parts."""
        return parts[0] if len(parts) == 1 else self.xp.concat(parts)

    def each(self, job: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """One after the other: the device is the parallel part."""
        with full_products():
            yield from map(job, items)


def blas_threads() -> int:
    """How many threads BLAS may use here: what ``threadpoolctl`` reports, at most the cores this process has."""
    from threadpoolctl import threadpool_info

    allowed = [int(pool["num_threads"]) for pool in threadpool_info() if pool["user_api"] == "blas"]
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    return max(1, min([cores, *allowed]))


@contextmanager
def full_products() -> Generator[None]:
    """No TensorFloat-32 in torch's products inside: training loops switch it on, and its ten bits are a thousand times too coarse here."""
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


def ops_of(x: Any) -> Ops:
    """The operations for an array: NumPy's own, or those of the array-API standard on the array's device."""
    if not is_foreign(x):
        return Ops()
    from array_api_compat import array_namespace, device

    return ArrayApiOps(array_namespace(x), device(x))

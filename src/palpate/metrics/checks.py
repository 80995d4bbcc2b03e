"""What a metric refuses, and how it says so: every input is looked at once, before any arithmetic.

Features must be finite floating-point rows of one width; images must be ``(n, h, w, c)`` in [0, 1] or 8 bit.
Integers are refused as features because the distance of wrapped integers is a number without meaning, and
half precision is widened because ``exp`` of a small exponent rounds to 1 there (a perfect score for anything).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from palpate.core import PalpateError
from palpate.core.score import is_missing
from palpate.metrics.arrays import is_foreign, ops_of, release

Normalize = Literal["check"] | bool
Floats = NDArray[np.floating[Any]]

#: Rows may differ from unit length by this much before ``normalize="check"`` refuses them.
NORM_TOLERANCE = 1e-3
SLAB = 8192


def rows_text(bad: NDArray[np.bool_]) -> str:
    """``"3 rows, first 0, 4, 7"`` for a boolean mask of rows."""
    at = np.flatnonzero(bad)
    first = ", ".join(str(int(i)) for i in at[:5])
    return f"{at.size} row{'s' * (at.size != 1)} ({first}{', ...' * (at.size > 5)})"


def as_array(name: str, x: Any) -> Any:
    """``np.asarray``; arrays of other libraries stay what they are on their device, but tensors on the CPU share their memory with NumPy.

    Raises:
        PalpateError: for ragged lists and what else has no array.
    """
    if is_foreign(x):
        x = x.detach() if getattr(x, "requires_grad", False) else x
        if getattr(getattr(x, "device", None), "type", "") != "cpu":
            return x
        if str(x.dtype).endswith("bfloat16"):  # NumPy has none
            warnings.warn(
                f"{name}: bfloat16 features were widened to float32; their rounding stays",
                stacklevel=4,
            )
            x = x.float()
    if isinstance(x, np.memmap):  # np.asarray would forget where it comes from
        return x
    try:
        return np.asarray(x)
    except (TypeError, ValueError, RuntimeError) as error:
        raise PalpateError(
            f"{name} must turn into a NumPy array",
            str(error).splitlines()[0],
            "Pass an array of one width",
        ) from None


def checked_features(name: str, x: Any, *, normalize: Normalize = "check", least: int = 1) -> Any:
    """``x`` as a float32 or float64 array (n, d) that a kernel may be evaluated on.

    Looked at in slabs, so that an array on disk (``np.memmap``) of float32 or float64 rows is read but not held; one that has to be normalized, or
    widened from half precision, is copied into memory.

    Args:
        name: what the error calls it.
        x: anything ``np.asarray`` takes, (n, d), or an array of a library of the array-API standard, which stays on its device.
        normalize: ``"check"`` refuses rows whose L2 norm is not 1 within 1e-3; ``True`` divides by the norm; ``False`` takes rows as they are.
        least: the fewest rows that the estimator can use.

    Raises:
        PalpateError: on integers, a wrong shape, too few rows, NaN or infinity, zero or un-normalized rows (their numbers are named).
    """
    if normalize is not True and normalize is not False and normalize != "check":
        raise PalpateError(
            'normalize must be "check", True or False',
            repr(normalize),
            "Leave it out for the default",
        )
    x = as_array(name, x)
    kind = x.dtype.name if isinstance(x, np.ndarray) else str(x.dtype).rsplit(".", maxsplit=1)[-1]
    if not kind.startswith(("float", "bfloat", "longdouble")):
        raise PalpateError(
            f"{name} must be floating-point features",
            f"dtype {x.dtype}",
            "Pass the encoder's float output, not pixels or codes",
        )
    if x.ndim != 2 or x.shape[1] == 0:
        raise PalpateError(
            f"{name} must have shape (n, d), one row a sample",
            f"shape {tuple(x.shape)}",
            "Stack one feature vector a row",
        )
    if len(x) < least:
        raise PalpateError(
            f"{name} must have at least {least} rows for this estimator",
            f"{len(x)}",
            "Pass more samples",
        )
    if kind in ("float16", "bfloat16"):
        warnings.warn(
            f"{name}: {kind} features were widened to float32; their rounding stays", stacklevel=3
        )
    ops = ops_of(x)
    x = ops.at_least_float32(x)
    norms = np.empty(len(x))
    for k in range(0, len(x), SLAB):
        norms[k : k + SLAB] = np.sqrt(ops.numpy(ops.squares(x[k : k + SLAB])))
        release(x)
    if (bad := ~np.isfinite(norms)).any():
        raise PalpateError(
            f"{name} must be finite",
            f"NaN or infinity in {rows_text(bad)}",
            "Check what those rows were made from",
        )
    if normalize is not False and (bad := norms == 0).any():
        raise PalpateError(
            f"{name} must have no zero vector",
            f"zeros in {rows_text(bad)}",
            "Check what those rows were made from",
        )
    if normalize is True:
        return ops.divide_rows(x, norms)
    if normalize == "check" and (bad := np.abs(norms - 1) > NORM_TOLERANCE).any():
        got = f"norm {norms[np.flatnonzero(bad)[0]]:.4g} in {rows_text(bad)}"
        raise PalpateError(
            f"{name} must be L2-normalized",
            got,
            "Pass normalize=True to divide by the norm, or normalize=False to keep it",
        )
    return x


def checked_pair(
    x: Any, y: Any, *, normalize: Normalize, least: int, names: tuple[str, str] = ("x", "y")
) -> tuple[Any, Any]:
    """Both feature arrays, checked, of one width, one library and one dtype.

    Raises:
        PalpateError: as :func:`checked_features`, and if widths or libraries differ.
    """
    x, y = as_array(names[0], x), as_array(names[1], y)
    if x.ndim == y.ndim == 2 and x.shape[1] != y.shape[1]:
        got = f"{x.shape[1]} and {y.shape[1]}"
        second = names[1][:1].lower() + names[1][1:] if names[1].startswith("The ") else names[1]
        raise PalpateError(
            f"{names[0]} and {second} must have the same width",
            got,
            "Embed both with the same encoder",
        )
    homes = [
        f"{type(v).__module__.split('.')[0]} {getattr(v, 'device', '')}".strip()
        if is_foreign(v)
        else "numpy"
        for v in (x, y)
    ]
    if homes[0] != homes[1]:
        must = f"{names[0]} and {names[1]} must be arrays of one library on one device"
        raise PalpateError(must, " and ".join(homes), "Move one of them")
    a, b = (
        checked_features(name, v, normalize=normalize, least=least)
        for name, v in zip(names, (x, y), strict=True)
    )
    return ops_of(a).one_type(a, b)


def copies_across(x: Any, y: Any) -> int | None:
    """How many rows of ``x`` are also rows of ``y``, bit for bit. A copy is not a generator.

    By 64-bit hashes of the rows, slab by slab, so that arrays on disk are read but not held. None for arrays on a device.
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


def checked_names(name: str, values: Sequence[Any] | None, n: int) -> list[str] | None:
    """Group names, one a row, as strings; None stays None.

    Raises:
        PalpateError: on a wrong length, or if some rows have a group and others none.
    """
    if values is None:
        return None
    names = list(values)
    if len(names) != n:
        raise PalpateError(
            f"{name} must have one entry a row ({n})",
            f"{len(names)}",
            f"Pass {name} in the order of the rows",
        )
    missing = np.array([is_missing(v) for v in names], dtype=bool)
    if missing.any():
        raise PalpateError(
            f"{name} must be known for every row",
            f"none in {rows_text(missing)}",
            f"Fill {name}, or pass None for all",
        )
    return [str(v) for v in names]


def checked_level(level: Any) -> None:
    """Refuses a coverage that is not inside (0, 1)."""
    if not isinstance(level, int | float | np.number) or not 0 < level < 1:
        raise PalpateError("level must lie in (0, 1)", f"{level!r}", "Pass e.g. level=0.95")


def checked_whole(least: int, **values: Any) -> None:
    """Refuses parameters that are not whole numbers from ``least`` on."""
    for name, value in values.items():
        if (
            isinstance(value, bool)
            or not isinstance(value, int | np.integer)
            or not least <= value < 2**63
        ):
            raise PalpateError(
                f"{name} must be a whole number of at least {least}",
                repr(value),
                "Leave it out for the default",
            )


def checked_positive(**values: float) -> None:
    """Refuses parameters that are not finite and positive."""
    for name, value in values.items():
        if not isinstance(value, int | float | np.number) or not (np.isfinite(value) and value > 0):
            raise PalpateError(f"{name} must be positive", f"{value!r}", f"Pass e.g. {name}=10")


def checked_numbers(**values: Any) -> None:
    """Refuses parameters that are not finite numbers from 0 on."""
    for name, value in values.items():
        if (
            not isinstance(value, int | float | np.number)
            or isinstance(value, bool)
            or not (np.isfinite(value) and value >= 0)
        ):
            raise PalpateError(
                f"{name} must be a finite number from 0 on",
                repr(value),
                "Leave it out for the default",
            )


def checked_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Refuses a word that is not among ``choices``."""
    if value not in choices:
        raise PalpateError(
            f"{name} must be one of {', '.join(choices)}", repr(value), "Choose one of these"
        )


def checked_images(generated: Any, reference: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Two image stacks (n, h, w, c), c = 1 or 3, of one shape, each 8 bit or float in [0, 1].

    Raises:
        PalpateError: on other shapes, dtypes or ranges; image numbers are named.
    """
    pair = [
        np.asarray(as_array(f"The {name} images", v))
        for name, v in (("generated", generated), ("reference", reference))
    ]
    for name, images in zip(("generated", "reference"), pair, strict=True):
        if images.ndim != 4 or images.shape[3] not in (1, 3) or 0 in images.shape:
            raise PalpateError(
                f"The {name} images must have shape (n, h, w, 3), n >= 1",
                f"shape {images.shape}",
                "Stack them with channels last",
            )
        if images.dtype != np.uint8 and images.dtype.kind != "f":
            raise PalpateError(
                f"The {name} images must be uint8, or floats in [0, 1]",
                f"dtype {images.dtype}",
                "Convert them",
            )
        if images.dtype.kind == "f":
            for number, image in enumerate(images):
                low, high = float(image.min()), float(image.max())
                if not (low >= -1e-6 and high <= 1 + 1e-6):  # also false for NaN
                    raise PalpateError(
                        f"The {name} images must lie in [0, 1]",
                        f"[{low:.4g}, {high:.4g}] in image {number}",
                        "Scale them to [0, 1]",
                    )
    if pair[0].shape != pair[1].shape:
        raise PalpateError(
            "Generated and reference images must pair one to one in one size",
            f"shapes {pair[0].shape} and {pair[1].shape}",
            "Pass the same samples in the same order and size",
        )
    return pair[0], pair[1]

"""Groups that a split keeps whole: connected components of samples that share anything they must not share.

Two samples are joined if they have the same value in one of the named columns (video, object, session ...), or the same label in one of
the links (near-duplicate clusters, as integers; a negative label joins nothing). A group is named by the smallest value of the first
column in it, so a group of one video has the video's name; samples without any value are named ``sample:<id>``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from palpate.core import PalpateError
from palpate.data.manifest import Manifest

#: Columns that a split can keep whole.
COLUMNS = ("video", "object", "session", "contact", "domain", "sensor")
Nulls = Literal["refuse", "own"]


def components(
    manifest: Manifest,
    by: Sequence[str],
    links: Sequence[NDArray[np.integer]] = (),
    *,
    nulls: Nulls = "refuse",
) -> list[str]:
    """The group of each sample.

    Args:
        manifest: (n) samples.
        by: columns whose values must not be shared between parts.
        links: (n,) integer labels each; samples with the same label, if it is not negative, stay together.
        nulls: ``refuse`` a null in a column of ``by``; with ``own`` it joins nothing, so that such a sample stands alone unless another
            column or a link joins it.

    Returns:
        n names, in row order.

    Raises:
        PalpateError: on an unknown column, on nulls unless ``own``, on a column of nulls alone, and on links of another length.
    """
    table, n = manifest.table, len(manifest)
    for column in by:
        if column not in COLUMNS:
            raise PalpateError(
                f"Groups must be among {', '.join(COLUMNS)}",
                repr(column),
                "Pass e.g. --by video object",
            )
        empty = table[column].null_count()
        if empty and (nulls == "refuse" or empty == n):
            fix = f"Fill the column, leave {column} out of --by" + (
                ""
                if empty == n
                else ", or pass --nulls own to let each such sample be a group of its own"
            )
            raise PalpateError(
                f"Every sample needs a {column} to be split by it",
                f"{empty} of {n} samples without",
                fix,
            )
    if not by and not links:
        raise PalpateError(
            "A group needs a column or near-duplicate links", "neither", "Pass e.g. --by video"
        )
    labels: list[NDArray[np.int64]] = []
    for column in by:
        rank = table[column].rank("dense").cast(pl.Int64) - 1
        labels.append(rank.fill_null(-1).to_numpy().astype(np.int64))
    for link in links:
        array = np.asarray(link)
        if array.shape != (n,) or array.dtype.kind not in "iu":
            raise PalpateError(
                f"Links must be {n} integers, one a sample",
                f"{array.dtype} of shape {array.shape}",
                "Compute them on this manifest",
            )
        labels.append(
            np.unique(np.where(array < 0, -1, array.astype(np.int64)), return_inverse=True)[
                1
            ].astype(np.int64)
        )
        if (array < 0).any():
            labels[-1] -= 1
    return _names(manifest, by, _joined(labels, n))


def _joined(labels: Sequence[NDArray[np.int64]], n: int) -> NDArray[np.int64]:
    """Components of the graph between n samples and the labels they bear, as numbers."""
    rows: list[NDArray[np.int64]] = []
    columns: list[NDArray[np.int64]] = []
    nodes = n
    for label in labels:
        at = np.flatnonzero(label >= 0)
        rows.append(at)
        columns.append(label[at] + nodes)
        nodes += int(label.max(initial=-1)) + 1
    row, column = np.concatenate(rows), np.concatenate(columns)
    graph = coo_matrix((np.ones(len(row), np.int8), (row, column)), (nodes, nodes)).tocsr()
    return connected_components(graph, directed=False)[1][:n].astype(np.int64)


def _names(manifest: Manifest, by: Sequence[str], component: NDArray[np.int64]) -> list[str]:
    """A name for each sample's component: the smallest value of the first column that has one, else the smallest id."""
    table = manifest.table.select("id", *(c for c in by if c != "id")).with_columns(
        pl.Series("component", component)
    )
    least = table.group_by("component").agg(pl.col(c).min() for c in ("id", *by)).sort("component")
    names: dict[int, str] = {}
    taken: set[str] = set()
    for row in least.iter_rows(named=True):
        first = next((c for c in by if row[c] is not None), None)
        name = (
            f"sample:{row['id']}"
            if first is None
            else row[first]
            if first == by[0]
            else f"{first}:{row[first]}"
        )
        while name in taken:  # a video that is called like another column's group
            name += "'"
        taken.add(name)
        names[row["component"]] = name
    return [names[k] for k in component.tolist()]

"""Groups that a split keeps whole: connected components of samples that share something.

Two samples are joined if they have the same value in one of the named columns (video, object ...),
or the same label in one of the links (clusters of near-duplicates). A group is named by the
smallest value of the first column in it, so that a group of one video has the video's name.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import Note, PalpateError, require
from palpate.data.manifest import SIDES, Manifest
from palpate.data.recordings import cuts

#: Columns that a split can keep whole, and by which a split can be audited.
GROUPS = ("video", "contact", "object", "session", "domain", "sensor")
#: Those above the video.
COARSE = ("object", "session")
Ints = NDArray[np.int64]


def choose_group(manifest: Manifest, parts: int = 2) -> tuple[str, Note | None]:
    """The column to keep whole: what the data set names, else the coarsest that is known.

    Where most materials occur in too few groups, it is the next finer column.

    Returns:
        The column, and a note that says why, unless it is simply the coarsest.
    """
    named = manifest.facts.get("group")
    chain = list(dict.fromkeys([*_known(manifest, [str(named)]), *nested_groups(manifest)]))
    if not chain:
        images = any(manifest.table[modality].count() for modality in SIDES)
        raise PalpateError(
            "A leak-free split needs the video, object or contact of every sample",
            "nulls in each of these columns",
            "Import a table that has one"
            + (", or keep near-duplicates together" if images else ""),
            example={"near": "both"} if images else {},
        )
    lacks = [_lacks(manifest.table, column, parts) for column in chain[:-1]]
    at = next((k for k, note in enumerate(lacks) if note is None), len(lacks))
    if at and (first := lacks[0]):
        return chain[at], Note(first.code, {**first.params, "taken": chain[at]})
    if chain[0] == named != "video":
        return chain[0], Note("group-of-data-set", {"group": chain[0]})
    return chain[0], None if "video" in chain else Note("group-instead", {"group": chain[0]})


def nested_groups(manifest: Manifest) -> list[str]:
    """Object, session, video and contact, coarsest first, as far as every sample has them.

    Objects and sessions that cut across videos, or are no fewer than these, are no coarser groups.
    """
    complete = _known(manifest, ["object", "session", "video", "contact"])
    size = {c: manifest.table[c].n_unique() for c in complete}
    coarse, fine = ([c for c in complete if (c in COARSE) == yes] for yes in (True, False))
    if "video" in complete:
        cut = [c for c in coarse if cuts(manifest.table, [c, "video"])]
        coarse = [c for c in coarse if c not in cut and size[c] < size["video"]]
    return sorted(coarse, key=size.__getitem__) + fine


def _known(manifest: Manifest, columns: Sequence[str]) -> list[str]:
    table = manifest.table
    return [c for c in columns if c in GROUPS and table.height and not table[c].null_count()]


def _lacks(table: pl.DataFrame, column: str, parts: int) -> Note | None:
    """Why a column cannot be the group: too few groups, or too few materials in enough of them."""
    if table[column].n_unique() < parts:
        return Note("group-few", {"group": column, "parts": parts})
    materials = table.drop_nulls("material").group_by("material").agg(pl.col(column).n_unique())
    enough = int((materials[column] >= parts).sum())
    if 2 * enough >= materials.height:
        return None
    params = {"group": column, "parts": parts, "enough": enough}
    return Note("group-materials", params | {"materials": materials.height})


def components(manifest: Manifest, by: Sequence[str], links: Sequence[Ints] = ()) -> pl.Series:
    """The group of each sample.

    Args:
        manifest: (n) samples.
        by: columns whose values must not be shared between parts.
        links: (n,) integer labels each; samples with the same label, if not negative, stay
            together.

    Returns:
        n names, in row order; ``sample:<id>`` for samples without any value.
    """
    table = manifest.table
    for column in by:
        require(column in GROUPS, "by", f"must be among {', '.join(GROUPS)}", repr(column), "video")
        empty = table[column].null_count()
        must = f"Every sample needs a {column} to be split by it"
        got = f"{empty} of {len(table)} samples without"
        require(not empty, None, must, got, fix="Fill the column, or choose another one")
    if len(by) == 1 and not links:  # its values are the groups already
        return table[by[0]]
    labels = [table[c].rank("dense").cast(pl.Int64).fill_null(0).to_numpy() - 1 for c in by]
    return _names(manifest, by, _joined([*labels, *links], len(table)))


def _joined(labels: Sequence[Ints], n: int) -> Ints:
    """Components of the graph between n samples and their labels, as numbers."""
    rows, columns, nodes = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], n
    for label in labels:
        labeled = np.flatnonzero(label >= 0)
        values, number = np.unique(label[labeled], return_inverse=True)
        rows.append(labeled)
        columns.append(number + nodes)
        nodes += len(values)
    row, column = np.concatenate(rows), np.concatenate(columns)
    from scipy.sparse import coo_matrix  # an audit does without
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(row), np.int8), (row, column)), (nodes, nodes))
    return connected_components(graph, directed=False)[1][:n].astype(np.int64)


def _names(manifest: Manifest, by: Sequence[str], component: Ints) -> pl.Series:
    """A name for each sample's component: the smallest value of the first column that has one."""
    prefix = ["" if k == 0 else f"{c}:" for k, c in enumerate(by)]
    candidates = [
        pl.concat_str(pl.lit(p), pl.col(c).min()) for p, c in zip(prefix, by, strict=True)
    ]
    named = (
        manifest.table.with_columns(component=pl.Series(component))
        .group_by("component")
        .agg(name=pl.coalesce(*candidates, pl.concat_str(pl.lit("sample:"), pl.col("id").min())))
    )
    # A video may be called like another column's group.
    number = pl.int_range(pl.len()).over("name")
    named = named.sort("component").with_columns(
        name=pl.when(number > 0).then(pl.format("{}'{}", "name", number)).otherwise("name")
    )
    return pl.Series(component).replace_strict(named["component"], named["name"])

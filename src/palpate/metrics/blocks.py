"""What the jackknife of distances between two sets leaves out: blocks of whole groups."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from palpate.core import FeatureSet, Note, rng_for
from palpate.metrics.inputs import (
    Array,
    Index,
    PairColumns,
    checked_names,
    checked_pair,
    copies_across,
    require_one_encoder,
)

#: The most blocks that a jackknife leaves out.
BLOCKS = 20


class FidOptions(PairColumns, total=False):
    """What :func:`fid` takes by name."""

    subject: str
    seed: int
    split: str | None


class Blocks(NamedTuple):
    """What the jackknife leaves out: the block of every row of both sets, by number."""

    x: Index
    y: Index
    names: Sequence[str]
    details: dict[str, Any]
    tail: str = ""


def checked_rows(
    generated: FeatureSet, reference: FeatureSet, least: int
) -> tuple[Array, Array, list[list[str] | None], list[Note]]:
    """Both sets of rows and of groups, checked, and a note of copies."""
    require_one_encoder(generated, reference, "Generated and reference")
    sets = generated.features, reference.features
    x, y = checked_pair(*sets, normalize=False, least=least)
    groups = [checked_names("groups", s.groups, len(s.ids)) for s in (generated, reference)]
    copies = copies_across(x, y)
    return x, y, groups, [Note("copied-rows", {"count": copies, "n": len(x)})] * bool(copies)


def draw_blocks(n: int, m: int, groups: Sequence[list[str] | None], seed: int) -> Blocks:
    """Groups, or rows where a set has no groups, in at most :data:`BLOCKS` blocks."""
    rng = rng_for(seed, "fid blocks")
    if groups[0] is None or groups[1] is None:
        count, units, unit = min(BLOCKS, n, m), n + m, "row"
        x, y = rng.permutation(n) % count, rng.permutation(m) % count
        members = "rows, taken as independent"
    else:
        names, of_row = np.unique(groups[0] + groups[1], return_inverse=True)
        x, y, units, unit = of_row[:n], of_row[n:], len(names), "group"
        if units <= BLOCKS:
            details = {"units": units, "unit": unit, "left_out": "group"}
            return Blocks(x, y, names.tolist(), details)
        # the largest group first into the block that has least, ties at random: nearly equal sizes
        size = np.bincount(x, minlength=units) / n + np.bincount(y, minlength=units) / m
        order, load, block = rng.permutation(units), np.zeros(BLOCKS), np.zeros(units, np.intp)
        for u in order[np.argsort(-size[order], kind="stable")]:
            block[u] = int(load.argmin())
            load[block[u]] += size[u]
        x, y, count, members = block[x], block[y], BLOCKS, f"whole groups ({units} groups)"
    details = {"units": units, "unit": unit, "left_out": "block"}
    tail = f", random blocks of {members}"
    return Blocks(x, y, [f"block {b}" for b in range(count)], details, tail)

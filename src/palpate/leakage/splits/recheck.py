"""Re-audit of an existing split file: does it still keep what its rule promises, on these samples?

Each check is exact: the manifest's digest, every sample in a part, no group in two parts (columns one by one, then joined as the
rule joins them), and the deviation that the rule states, recounted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.core import PARTS, PalpateError, Split
from palpate.data.manifest import Manifest
from palpate.leakage.splits import choose_group
from palpate.leakage.splits.groups import COLUMNS, components
from palpate.leakage.splits.noleak import entry, load_record, ratio_name


@dataclass(frozen=True)
class Check:
    """One thing that must hold: its name, whether it does, and what was found."""

    name: str
    ok: bool
    text: str


def columns_of(split: Split, manifest: Manifest) -> tuple[str, ...]:
    """The columns that a split's rule keeps whole; of a rule that names none, what the manifest would be split by."""
    by = split.rule.get("by")
    if isinstance(by, list):
        return tuple(str(c) for c in by if c in COLUMNS)
    group = split.rule.get("group")
    return (str(group),) if group in COLUMNS else (choose_group(manifest)[0],)


def recheck(
    manifest: Manifest,
    split: Split,
    *,
    by: Sequence[str] = (),
    links: Sequence[NDArray[np.integer]] = (),
) -> list[Check]:
    """Checks a split against samples.

    Args:
        manifest: the samples.
        split: the split; its own digest was checked when it was loaded.
        by: columns that no two parts may share; default: those of its rule.
        links: labels of near-duplicate clusters, (n,) integers each, which no two parts may share either.

    Raises:
        PalpateError: on an unknown column.
    """
    for column in by:
        if column not in COLUMNS:
            raise PalpateError(
                f"Groups must be among {', '.join(COLUMNS)}",
                repr(column),
                "Pass e.g. --by video object",
            )
    columns = tuple(by) or columns_of(split, manifest)
    checks = [_digest(manifest, split), *_samples(manifest, split)]
    parts = pl.Series("part", [split.parts.get(i) for i in manifest.ids], dtype=pl.String)
    for column in columns:
        checks.append(_shared(f"one part for each {column}", manifest.table[column], parts))
    for k, link in enumerate(links):
        labels = pl.Series(np.asarray(link).astype(np.int64))
        name = "one part for each cluster of near-duplicates" + (
            f" ({k + 1})" if len(links) > 1 else ""
        )
        checks.append(_shared(name, labels.set(labels < 0, None), parts))
    use = [c for c in columns if manifest.table[c].null_count() < len(manifest)]
    if len(use) + len(links) > 1:
        joined = pl.Series(components(manifest, use, links, nulls="own"), dtype=pl.String)
        checks.append(_shared("one part for each group of all these joined", joined, parts))
    if "record" in split.rule:
        checks.append(_record(manifest, split))
    if (stated := split.rule.get("deviation")) is not None and "fold" not in split.rule:
        checks.append(_deviation(manifest, split.rule, parts, use, links, float(stated)))
    return checks


def _digest(manifest: Manifest, split: Split) -> Check:
    if split.manifest is None:
        return Check("manifest", True, "the split names no manifest")
    if split.manifest == manifest.digest:
        return Check("manifest", True, "the digest is that of the split")
    if set(split.parts) == set(manifest.ids):  # lists joined in another order give another digest
        return Check(
            "manifest",
            True,
            "the digest is another, but the split names these very samples (another order, or other columns)",
        )
    return Check("manifest", False, "the split was made for other samples (the digests differ)")


def _samples(manifest: Manifest, split: Split) -> list[Check]:
    ids = set(manifest.ids)
    strange = [i for i in split.parts if i not in ids]
    idle = len(ids) - (len(split.parts) - len(strange))
    return [
        Check(
            "ids of the split are samples",
            not strange,
            f"{len(strange)} are not, first {strange[0]!r}"
            if strange
            else f"{len(split.parts)} are",
        ),
        Check(
            "every sample is in a part",
            not idle,
            f"{idle} of {len(ids)} are in none" if idle else f"all {len(ids)} are",
        ),
    ]


def _shared(name: str, groups: pl.Series, parts: pl.Series) -> Check:
    """Whether any group has samples in two parts."""
    table = pl.DataFrame({"group": groups, "part": parts}).drop_nulls()
    spread = (
        table.group_by("group")
        .agg(pl.col("part").n_unique().alias("parts"), pl.len().alias("samples"))
        .filter(pl.col("parts") > 1)
    )
    if not spread.height:
        return Check(name, True, f"{table['group'].n_unique()} groups, none in two parts")
    first = spread.sort("samples", "group", descending=[True, False])["group"][0]
    return Check(
        name,
        False,
        f"{spread.height} groups with {spread['samples'].sum()} samples are in two parts or more, first {first!r}",
    )


def _record(manifest: Manifest, split: Split) -> Check:
    """Whether every video has the part that the shipped record gives it."""
    name, record = "the published record", load_record("touch-and-go")
    if split.rule["record"] != record["sha256"]:
        return Check(name, False, "the split was made from another version of the record")
    shares, seed = split.rule.get("shares", {}), split.rule.get("seed", 0)
    chosen = entry(
        record, ratio_name(float(shares.get("train", 0)), float(shares.get("val", 0))), int(seed)
    )
    other = {
        v
        for i, v in zip(manifest.ids, manifest.column("video"), strict=True)
        if i in split.parts and chosen.parts.get(v) != split.parts[i]
    }
    return Check(
        name,
        not other,
        f"{len(other)} videos have another part there"
        if other
        else "every video has the part that it gives",
    )


def _deviation(
    manifest: Manifest,
    rule: Mapping[str, Any],
    parts: pl.Series,
    by: Sequence[str],
    links: Sequence[NDArray[np.integer]],
    stated: float,
) -> Check:
    """The largest deviation of a share, counted again, against what the rule states."""
    shares = rule.get("shares")
    name = "the rule's largest deviation"
    if (
        not isinstance(shares, dict)
        or not set(shares) <= set(PARTS)
        or (bool(rule.get("near")) and not links)
    ):
        return Check(
            name,
            True,
            f"stated {stated:.5f}; cannot be counted again without the same groups (--near)",
        )
    groups = components(manifest, by, links, nulls="own") if by or links else manifest.ids
    table = pl.DataFrame({"material": manifest.table["material"], "group": groups, "part": parts})
    # Materials that can be in every part, and all samples.
    enough = (
        table.drop_nulls("material")
        .group_by("material")
        .agg(pl.col("group").n_unique().alias("n"))
        .filter(pl.col("n") >= len(shares))
    )
    kept = [table, *(table.filter(pl.col("material") == m) for m in enough["material"])]
    found = max(
        abs((t["part"] == part).sum() / t.height - share)
        for t in kept
        for part, share in shares.items()
    )
    return Check(name, abs(found - stated) <= 1e-5, f"stated {stated:.5f}, counted {found:.5f}")

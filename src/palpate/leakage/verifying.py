"""Check of an existing split: does it still keep what its rule promises, on these samples?

Each check is exact: the manifest's digest, every sample in a part, no group in two parts (columns
one by one, then joined as the rule joins them), the deviation that the rule states, recounted, and
no signal of the audit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from palpate.core import Note, Progress, Split, quiet
from palpate.data.manifest import Manifest
from palpate.leakage.auditing import audit
from palpate.leakage.groups import GROUPS, choose_group, components
from palpate.leakage.inputs import Data, read_all
from palpate.leakage.noleak import load_record, record_split
from palpate.leakage.splitting import near_links
from palpate.report.results import Audit


@dataclass(frozen=True)
class Check:
    """One thing that must hold: its name, whether it does, and the evidence."""

    name: str
    ok: bool
    text: str

    def __str__(self) -> str:
        return f"{'holds' if self.ok else 'FAILS'}: {self.name}: {self.text}"


@dataclass(frozen=True)
class Verification:
    """The checks of a split, its audit (None without a train and a test part), and notes."""

    split: Split
    checks: Sequence[Check]
    audit: Audit | None = None
    notes: Sequence[Note] = ()

    @property
    def failed(self) -> list[str]:
        """Names of the checks that do not hold."""
        return [check.name for check in self.checks if not check.ok]

    def __str__(self) -> str:
        return "\n".join(map(str, self.checks))

    def to_json(self) -> dict[str, Any]:
        """The verification as a JSON object."""
        return {
            "digest": self.split.digest,
            "checks": [vars(check) for check in self.checks],
            "failed": self.failed,
            "audit": self.audit and self.audit.to_json(),
        }


def verify(
    data: Data,
    split: Split | str | Path,
    *,
    by: str | Sequence[str] = "auto",
    near: Any = None,
    cache: str | Path | None = None,
    reading: Mapping[str, Any] | None = None,
    skip_bad: bool = False,
    progress: Progress = quiet,
) -> Verification:
    """Check a split against samples.

    Args:
        data: the samples, as :func:`palpate.leakage.split` takes them.
        split: the split or its file, whose digest is checked when it is loaded.
        by: columns that no two parts may share; ``auto``: those of its rule.
        near: near-duplicates that no two parts may share, as in :func:`palpate.leakage.split`.
        cache: folder that keeps decoded images for ``near``.
        reading: how the source is read, as in :func:`palpate.leakage.audit`.
        skip_bad: skip bad rows of lists and tables, and note them.
        progress: callback.

    Raises:
        PalpateError: on an unknown column, or a split file that cannot be read.
    """
    split = Split.load(split)
    (source,) = read_all([data], skip_bad, progress, None, reading, arguments=["data"])
    manifest, notes = source.manifest, source.notes
    columns = _columns(split, manifest) if by == "auto" else [by] if isinstance(by, str) else by
    links, _ = near_links(manifest, near, cache, progress)
    known = [c for c in columns if manifest.table[c].null_count() < len(manifest)]
    joined = components(manifest, known, links, nulls="single") if known or links else manifest.ids
    parts = pl.Series("part", [split.parts.get(i) for i in manifest.ids], dtype=pl.String)
    checks = _samples(manifest, split)
    checks += [_shared(f"one part for each {c}", manifest.table[c], parts) for c in columns]
    for link in links:
        labels = pl.Series(np.asarray(link).astype(np.int64))
        labels = labels.set(labels < 0, None)
        checks.append(_shared("one part for each cluster of near-duplicates", labels, parts))
    if len(known) + len(links) > 1:
        checks.append(
            _shared("one part for each group of all these joined", pl.Series(joined), parts)
        )
    if "record" in split.rule:
        checks.append(_record(manifest, split))
    if "deviation" in split.rule and "fold" not in split.rule:
        checks.append(_deviation(manifest, split, joined, parts, bool(links)))
    inside = set(manifest.ids)
    usable = replace(split, parts={i: part for i, part in split.parts.items() if i in inside})
    result: Audit | None = None
    if known and {"train", "test"} <= set(usable.counts()):
        result = audit(manifest, split=usable, by=columns[0], images=False)
        n = result.leaking_samples
        text = f"{n} of {result.test_samples} leak" if n else "none does"
        checks.append(Check("no signal of the audit flags a test sample", not n, text))
    return Verification(split, checks, result, notes)


def _columns(split: Split, manifest: Manifest) -> list[str]:
    """The columns that a split's rule keeps whole, else what the manifest would be split by."""
    by = split.rule.get("by")
    if isinstance(by, list):
        return [str(c) for c in by if c in GROUPS]
    group = split.rule.get("group")
    return [str(group) if group in GROUPS else choose_group(manifest)[0]]


def _samples(manifest: Manifest, split: Split) -> list[Check]:
    """Whether the split is of these samples, all of them."""
    ids = set(manifest.ids)
    unknown = [i for i in split.parts if i not in ids]
    idle = len(ids) - (len(split.parts) - len(unknown))
    same = split.manifest in (None, manifest.digest) or set(split.parts) == ids
    digest = "these samples" if same else "the split was made for other samples"
    first = f"{len(unknown)} are not, first {unknown[0]!r}" if unknown else f"all {len(split)} are"
    return [
        Check("manifest", same, digest),
        Check("ids of the split are samples", not unknown, first),
        Check("every sample is in a part", not idle, f"{idle} of {len(ids)} are in none"),
    ]


def _shared(name: str, groups: pl.Series, parts: pl.Series) -> Check:
    """Whether any group has samples in two parts."""
    table = pl.DataFrame({"group": groups, "part": parts}).drop_nulls()
    parts_of = table.group_by("group").agg(pl.col("part").n_unique())
    spread = parts_of.filter(pl.col("part") > 1).sort("group")
    if not spread.height:
        return Check(name, True, f"{parts_of.height} groups, none in two parts")
    return Check(name, False, f"{spread.height} groups in two parts, first {spread['group'][0]!r}")


def _record(manifest: Manifest, split: Split) -> Check:
    """Whether every video has the part that the shipped record gives it."""
    name, record = "the published record", load_record()
    if split.rule["record"] != record["sha256"]:
        return Check(name, False, "the split was made from another version of the record")
    shares = split.rule.get("shares", {})
    seed = int(split.rule.get("seed", 0))
    expected = record_split(record, shares.get("train", 0), shares.get("val", 0.0), seed).parts
    videos = zip(manifest.ids, manifest.column("video"), strict=True)
    other = {v for i, v in videos if i in split.parts and expected.get(v) != split.parts[i]}
    text = f"{len(other)} videos have another part there" if other else "every video has its part"
    return Check(name, not other, text)


def _deviation(
    manifest: Manifest, split: Split, groups: Sequence[str], parts: pl.Series, linked: bool
) -> Check:
    """The largest deviation of a share, counted again, against what the rule states."""
    name = "the rule's largest deviation"
    stated = float(split.rule["deviation"])
    shares = split.rule.get("shares", {})
    if bool(split.rule.get("near")) != linked:
        return Check(name, True, f"stated {stated:.5f}; cannot be counted without the same groups")
    table = pl.DataFrame({"material": manifest.table["material"], "group": groups, "part": parts})
    per_material = table.drop_nulls("material").group_by("material")
    # Materials that can be in every part, and all samples.
    enough = per_material.agg(pl.col("group").n_unique()).filter(pl.col("group") >= len(shares))
    counted = [table, *(table.filter(pl.col("material") == m) for m in enough["material"])]
    worst = max(
        abs((t["part"] == part).sum() / t.height - share)
        for t in counted
        for part, share in shares.items()
    )
    return Check(name, abs(worst - stated) <= 1e-5, f"stated {stated:.5f}, counted {worst:.5f}")

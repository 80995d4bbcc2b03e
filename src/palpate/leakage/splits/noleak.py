"""Published leak-free splits: TaG-NoLeak as a record of video -> part, HCT-NoLeak as a rule.

**TaG-NoLeak** splits the 126 videos of Touch and Go's two official lists joined (121,861 frames). The record holds video ids alone, for
each ratio and seed the part of every video, what was achieved, and a digest over the sorted lines ``video TAB part``. Its own checksum is SHA-256
of its canonical JSON without the field ``sha256``; it is verified whenever it is read. ``recipes/tag_noleak.py`` writes it again.

**HCT-NoLeak** is the same optimizer on a user's own tree: groups are trajectory folders, joined where they start within a minute of each other
(the manifest's ``session``), since neighboring folders may show the same object.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import (
    PARTS,
    PalpateError,
    Split,
    digest_file,
    digest_json,
    digest_lines,
    read_json,
)
from palpate.data.listing import read_lists
from palpate.data.manifest import Manifest
from palpate.leakage.splits import RULE_VERSION, SplitPlan, leak_free_splits, renamed

FORMAT = "palpate-noleak/1"
#: Train and validation shares of the record, by the name of the ratio.
RATIOS: dict[str, tuple[float, float]] = {
    "80/20": (0.8, 0.0),
    "70/30": (0.7, 0.0),
    "80/10/10": (0.8, 0.1),
}
SEEDS = range(5)
#: Data set -> record.
RECORDS = {"touch-and-go": "tag_noleak.json"}
#: Seconds between the starts of two HCT folders that count as one sitting.
SESSION_GAP = "60 s"
CITE = "Videos of Touch and Go (Yang et al., NeurIPS 2022 Datasets and Benchmarks; CC BY 4.0), ids alone."


@dataclass(frozen=True)
class Entry:
    """One split of a record: ``parts`` video -> part, the ``rule`` that made it, and its digest."""

    parts: Mapping[str, str]
    rule: Mapping[str, Any]
    digest: str


def ratio_name(train: float, val: float) -> str:
    """The record's name of a ratio.

    Raises:
        PalpateError: if the record has no such ratio.
    """
    for name, shares in RATIOS.items():
        if abs(shares[0] - train) < 1e-9 and abs(shares[1] - val) < 1e-9:
            return name
    known = ", ".join(f"{name} (--train {t} --val {v})" for name, (t, v) in RATIOS.items())
    raise PalpateError(
        f"The record's ratios are {known}",
        f"--train {train} --val {val}",
        "Choose one of these, or make a split of your own",
    )


def make_record(lists: Sequence[Path]) -> dict[str, Any]:
    """TaG-NoLeak from the official lists (``train.txt`` and ``test.txt``), as the JSON object of the record."""
    manifest = read_lists(lists, root=lists[0].parent).manifest
    splits: dict[str, dict[str, Any]] = {}
    for name, (train, val) in RATIOS.items():
        splits[name] = {}
        for seed, plan in zip(
            SEEDS,
            leak_free_splits(manifest, list(SEEDS), train=train, val=val, by=["video"]),
            strict=True,
        ):
            parts = {part: sorted(v for v, p in plan.where.items() if p == part) for part in PARTS}
            splits[name][str(seed)] = {
                "digest": _digest(plan.where),
                "deviation": round(plan.deviation, 6),
                "bound": round(plan.bound, 6),
                "status": plan.status,
                "limiting": plan.limiting,
                "samples": plan.split.counts(),
                "videos": {p: v for p, v in parts.items() if v},
            }
    record: dict[str, Any] = {
        "format": FORMAT,
        "name": "TaG-NoLeak",
        "dataset": "touch-and-go",
        "source": CITE,
        "rule": {
            "method": "whole videos, smallest largest deviation of any class's share of frames",
            "version": RULE_VERSION,
            "group": "video",
        },
        "lists": {p.name: digest_file(p) for p in lists},
        "frames": len(manifest),
        "videos": manifest.table["video"].n_unique(),
        "classes": manifest.table["material"].n_unique(),
        "splits": splits,
    }
    return record | {"sha256": digest_json(record)}


def load_record(dataset: str) -> dict[str, Any]:
    """The shipped record of a data set, its checksums verified.

    Raises:
        PalpateError: if there is no record of it, or the record was changed.
    """
    if dataset not in RECORDS:
        raise PalpateError(
            f"There is a record for {', '.join(RECORDS)}, and a rule for hct",
            repr(dataset),
            "Name one of these before --noleak",
        )
    with resources.as_file(
        resources.files("palpate.leakage.splits") / "records" / RECORDS[dataset]
    ) as path:
        record = read_json(path, "record")
    verify_record(record)
    return record


def verify_record(record: Mapping[str, Any]) -> None:
    """Checks a record's checksum and every split's digest.

    Raises:
        PalpateError: if one does not match.
    """
    body = {k: v for k, v in record.items() if k != "sha256"}
    same = record.get("format") == FORMAT and digest_json(body) == record.get("sha256")
    if not same or any(
        _digest(_parts(e)) != e["digest"]
        for by_seed in record["splits"].values()
        for e in by_seed.values()
    ):
        raise PalpateError(
            "A NoLeak record must match its checksum",
            "a record that was changed",
            "Install palpate again",
        )


def entry(record: Mapping[str, Any], ratio: str, seed: int) -> Entry:
    """One split of a record.

    Raises:
        PalpateError: if it has no such seed.
    """
    by_seed = record["splits"][ratio]
    if str(seed) not in by_seed:
        raise PalpateError(
            f"The record's seeds are {', '.join(by_seed)}",
            f"--seed {seed}",
            "Choose one of these, or make a split of your own",
        )
    found = by_seed[str(seed)]
    train, val = RATIOS[ratio]
    shares = {"train": train, "val": val, "test": round(1 - train - val, 12)}
    rule = {
        "name": record["name"],
        **record["rule"],
        "by": ["video"],
        "record": record["sha256"],
        "shares": {p: s for p, s in shares.items() if s},
        "seed": seed,
        "on_the_official_lists": {k: found[k] for k in ("deviation", "bound", "status")},
    }
    return Entry(_parts(found), rule, found["digest"])


def record_split(chosen: Entry, manifest: Manifest) -> tuple[Split, list[str]]:
    """A record's split of a user's own samples of that data set.

    Returns:
        The split, and the record's videos of which there is no sample.

    Raises:
        PalpateError: if a sample has no video, or one that the record does not know.
    """
    videos: list[str | None] = manifest.column("video")
    known = set(videos) - {None}
    strange = sorted(str(v) for v in known if v not in chosen.parts)
    fix = "Use the data set's own video ids, or make a split of your own: palpate split MANIFEST"
    if nulls := sum(v is None for v in videos):
        raise PalpateError(
            "Every sample needs a video to be looked up in the record",
            f"{nulls} samples without",
            fix,
        )
    if strange:
        shown = ", ".join(map(repr, strange[:8])) + (" ..." if len(strange) > 8 else "")
        raise PalpateError(
            "Every video must be one that the record knows",
            f"{len(strange)} of {len(known)} that are not: {shown}",
            fix,
        )
    parts = {i: chosen.parts[str(v)] for i, v in zip(manifest.ids, videos, strict=True)}
    return Split(parts, chosen.rule, manifest.digest), sorted(set(chosen.parts) - known)


def hct_noleak(
    manifest: Manifest, *, train: float = 0.8, val: float = 0.0, seeds: Sequence[int] = (0,)
) -> list[SplitPlan]:
    """HCT-NoLeak: the rule of this module on a user's own import of HCT.

    Args:
        manifest: HCT's samples, with ``video`` (trajectory folder) and ``session``.
        train: share of the train part.
        val: share of the validation part.
        seeds: one split a seed.

    Raises:
        PalpateError: if a sample has no session, or sessions were joined by another gap than the rule's.
    """
    gap = manifest.facts.get("session_gap", SESSION_GAP)
    if gap != SESSION_GAP:
        raise PalpateError(
            f"HCT-NoLeak joins folders that start within {SESSION_GAP}",
            f"sessions joined within {gap}",
            "Import HCT without a gap of your own",
        )
    if empty := manifest.table.select(pl.col("session").null_count()).item():
        raise PalpateError(
            "HCT-NoLeak needs the session of every sample",
            f"{empty} without",
            "Import the tree with: palpate import --format hct",
        )
    plans = leak_free_splits(
        manifest, seeds, train=train, val=val, by=["video", "session"], name="HCT-NoLeak"
    )
    return [renamed(plan, session_gap=gap) for plan in plans]


def _parts(found: Mapping[str, Any]) -> dict[str, str]:
    return {video: part for part, videos in found["videos"].items() for video in videos}


def _digest(parts: Mapping[str, str]) -> str:
    return digest_lines(f"{video}\t{parts[video]}" for video in sorted(parts))

"""Published leak-free splits: TaG-NoLeak as a record of video -> part, HCT-NoLeak as a rule.

**TaG-NoLeak** splits the 126 videos of Touch and Go's two official lists joined (121,861 frames).
The record holds video ids alone: for each ratio and seed the part of every video, what was
achieved, and a digest over the sorted lines ``video TAB part``. Its checksum, SHA-256 of its
canonical JSON without the field ``sha256``, is verified whenever it is read.
``recipes/tag_noleak.py`` checks it against the lists.

**HCT-NoLeak** is the rule of :func:`palpate.leakage.split` on the user's files: groups are
trajectory folders, joined where they start within a minute of each other (the manifest's
``session``), since neighboring folders may show the same object.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from palpate.core import Note, Split, digest_json, few, require
from palpate.data.manifest import Manifest

FORMAT = "palpate-noleak/1"
#: Train and validation shares of the record, by the name of the ratio.
RATIOS: dict[str, tuple[float, float]] = {
    "80/20": (0.8, 0.0),
    "70/30": (0.7, 0.0),
    "80/10/10": (0.8, 0.1),
}
SEEDS = range(5)
HCT_GROUPS = ("video", "session")


def load_record() -> dict[str, Any]:
    """TaG-NoLeak, its checksums verified."""
    text = (resources.files("palpate.leakage") / "tag_noleak.json").read_text("utf-8")
    record = json.loads(text)
    verify_record(record)
    return record


def verify_record(record: Mapping[str, Any]) -> None:
    """Check a record's checksum and every split's digest."""
    body = {k: v for k, v in record.items() if k != "sha256"}
    entries = [entry for by_seed in record["splits"].values() for entry in by_seed.values()]
    same = digest_json(body) == record.get("sha256") and all(
        Split.from_ids(**entry["videos"]).digest == entry["digest"] for entry in entries
    )
    must, got = "A NoLeak record must match its checksum", "a record that was changed"
    require(same, None, must, got, fix="Install palpate again")


def record_split(record: Mapping[str, Any], train: float, val: float, seed: int) -> Split:
    """A split of the record, over videos."""
    ratio = next((name for name, shares in RATIOS.items() if shares == (train, val)), "")
    shares = ", ".join(f"train {t} and val {v}" for t, v in RATIOS.values())
    must, got = f"The record's shares are {shares}", f"train {train} and val {val}"
    fix = "Choose one of these, or make a split by your groups"
    require(ratio != "", None, must, got, fix=fix)
    must = f"must be one of {', '.join(map(str, SEEDS))}, the record's seeds"
    require(str(seed) in record["splits"][ratio], "seed", must, seed)
    entry = record["splits"][ratio][str(seed)]
    shares = {"train": train, "val": val, "test": round(1 - train - val, 12)}
    rule = {
        "name": record["name"],
        **record["rule"],
        "by": ["video"],
        "record": record["sha256"],
        "shares": {part: share for part, share in shares.items() if share},
        "seed": seed,
        "on_the_official_lists": {k: entry[k] for k in ("deviation", "bound", "status")},
    }
    return Split.from_ids(rule=rule, **entry["videos"])


def published(
    manifest: Manifest | None, train: float, val: float, seed: int, notes: Sequence[Note] = ()
) -> Split:
    """TaG-NoLeak on the user's samples of Touch and Go; without samples, over its videos."""
    videos = record_split(load_record(), train, val, seed)
    if manifest is None:
        return videos
    column: list[str | None] = manifest.column("video")
    unknown = sorted({str(v) for v in column if v not in videos.parts})
    must = "The video of every sample must be one that the record knows"
    got = f"{len(unknown)} of {len(set(column))} that are not: {few(map(repr, unknown))}"
    fix = "Use the data set's video ids, or make a split by your groups"
    require(not unknown, None, must, got, fix=fix)
    parts = {i: videos.parts[str(v)] for i, v in zip(manifest.ids, column, strict=True)}
    absent = sorted(set(videos.parts) - set(column))
    more = [Note("videos-without-samples", {"videos": absent, "of": len(videos)})] if absent else []
    return Split(parts, videos.rule, manifest.digest, [*notes, *more])

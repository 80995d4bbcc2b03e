"""Checks the record TaG-NoLeak against Touch and Go's two official lists, or writes a new one.

    python recipes/tag_noleak.py LISTS/train.txt LISTS/test.txt [-o record.json]

The lists are in the data set's repository (fredfyyang/Touch-and-Go, "Visuo-tactile contrastive
learning/dataset/"). Each split of the record must keep whole videos, reach the deviation that it
states, and be optimal: no smaller one exists, by HiGHS. Exit status 1 if one does not. With -o the
record is made anew instead; another solver finds other splits of the same deviations.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import polars as pl

from palpate.core import digest_file, digest_json, write_text
from palpate.core.digest import canonical_json
from palpate.data.listing import read_lists
from palpate.data.manifest import Manifest
from palpate.leakage import audit, split
from palpate.leakage.noleak import FORMAT, RATIOS, SEEDS, load_record, record_split

CITE = (
    "Videos of Touch and Go (Yang et al., NeurIPS 2022 Datasets and Benchmarks; CC BY 4.0),"
    " ids alone."
)
METHOD = "whole videos, smallest largest deviation of any class's share of frames"


def check(manifest: Manifest) -> int:
    """Count the splits of the shipped record that do not hold."""
    record, failed = load_record(), 0
    for ratio, (train, val) in RATIOS.items():
        best = split(manifest, by="video", train=train, val=val).rule["bound"]
        for seed in SEEDS:
            entry = record["splits"][ratio][str(seed)]
            videos = record_split(record, train, val, seed)
            parts = {
                i: videos.parts[v]
                for i, v in zip(manifest.ids, manifest.column("video"), strict=True)
            }
            wrong: list[str] = []
            if audit(manifest, split=type(videos)(parts), by="video").groups_shared:
                wrong.append("a video is in two parts")
            if abs(entry["deviation"] - deviation(manifest, parts, videos.rule["shares"])) > 2e-6:
                wrong.append("the stated deviation is not reached")
            if abs(entry["deviation"] - best) > 2e-6:
                wrong.append(f"the smallest largest deviation is {best}")
            failed += bool(wrong)
            verdict = "; ".join(wrong) or "holds"
            sys.stdout.write(f"{ratio} seed {seed}: deviation {entry['deviation']}: {verdict}\n")
    return failed


def deviation(manifest: Manifest, parts: dict[str, str], shares: dict[str, float]) -> float:
    """The largest deviation of the share of a class, or of all frames, that has enough videos."""
    table = manifest.table.with_columns(part=pl.Series([parts[i] for i in manifest.ids]))
    classes = [t for t in table.partition_by("material") if t["video"].n_unique() >= len(shares)]
    return max(
        abs((some["part"] == part).mean() - share)
        for some in [table, *classes]
        for part, share in shares.items()
    )


def make(manifest: Manifest, lists: list[Path]) -> dict[str, Any]:
    """A new record."""
    splits: dict[str, dict[str, Any]] = {}
    for ratio, (train, val) in RATIOS.items():
        splits[ratio] = {}
        for made in (split(manifest, by="video", train=train, val=val, seed=k) for k in SEEDS):
            columns = zip(manifest.ids, manifest.column("video"), strict=True)
            videos = {v: made.parts[i] for i, v in columns}
            facts = {k: made.rule[k] for k in ("deviation", "bound", "status", "limiting")}
            by_part = {
                p: sorted(v for v, part in videos.items() if part == p) for p in made.counts()
            }
            splits[ratio][str(made.rule["seed"])] = {
                "digest": type(made)(videos).digest,
                **facts,
                "samples": made.counts(),
                "videos": by_part,
            }
    record: dict[str, Any] = {
        "format": FORMAT,
        "name": "TaG-NoLeak",
        "dataset": "touch-and-go",
        "source": CITE,
        "rule": {"method": METHOD, "version": 3, "group": "video"},
        "lists": {p.name: digest_file(p) for p in lists},
        "frames": len(manifest),
        "videos": manifest.table["video"].n_unique(),
        "classes": manifest.table["material"].n_unique(),
        "splits": splits,
    }
    return record | {"sha256": digest_json(record)}


def main() -> int:
    """Check or write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("lists", nargs=2, type=Path, metavar="LIST")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    manifest = read_lists(options.lists, root=options.lists[0].parent).manifest
    if options.output:
        text = canonical_json(make(manifest, options.lists))
        for mark in ('"splits":', '{"bound"'):
            text = text.replace(mark, f"\n{mark}")
        write_text(options.output, text + "\n")
        return 0
    failed = check(manifest)
    total = len(RATIOS) * len(SEEDS)
    sys.stdout.write(f"{total - failed} splits hold, {failed} do not.\n")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())

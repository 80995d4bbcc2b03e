"""Checks the record TaG-NoLeak against Touch and Go's two official lists.

    python recipes/tag_noleak.py LISTS/train.txt LISTS/test.txt

The lists are in the data set's repository (fredfyyang/Touch-and-Go, "Visuo-tactile contrastive
learning/dataset/"). Each split of the record must keep whole videos, reach the deviation that it
states, and be optimal: no smaller one exists, by HiGHS. Exit status 1 if one does not.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import polars as pl

from palpate.data.listing import read_lists
from palpate.data.manifest import Manifest
from palpate.leakage import audit, split
from palpate.leakage.noleak import RATIOS, SEEDS, load_record, record_split


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
        abs(int((some["part"] == part).sum()) / some.height - share)
        for some in [table, *classes]
        for part, share in shares.items()
    )


def main() -> int:
    """Check the record; exit with 1 if a split does not hold."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("lists", nargs=2, type=Path, metavar="LIST")
    lists = parser.parse_args().lists
    failed = check(read_lists(lists, root=lists[0].parent).manifest)
    total = len(RATIOS) * len(SEEDS)
    sys.stdout.write(f"{total - failed} splits hold, {failed} do not.\n")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())

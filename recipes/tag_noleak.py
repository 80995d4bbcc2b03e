"""Writes the record TaG-NoLeak again, from Touch and Go's two official lists.

    python recipes/tag_noleak.py LISTS/train.txt LISTS/test.txt [-o src/palpate/leakage/splits/records/tag_noleak.json]

The lists are in the data set's repository (fredfyyang/Touch-and-Go, "Visuo-tactile contrastive learning/dataset/"). Without -o the shipped
record is compared with the new one. Exit status 1 if they differ.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from palpate.core import write_text
from palpate.core.digest import canonical_json
from palpate.leakage.splits.noleak import load_record, make_record, verify_record


def main() -> int:
    """Makes the record, says what was achieved, and writes or compares it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("lists", nargs=2, type=Path, metavar="LIST")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    start = time.process_time()
    record = make_record(options.lists)
    verify_record(record)
    for ratio, seeds in record["splits"].items():
        for seed, e in seeds.items():
            sys.stdout.write(
                f"{ratio} seed {seed}: largest deviation {e['deviation']} ({e['limiting']}), bound {e['bound']}, {e['status']}, {e['samples']}\n"
            )
    sys.stdout.write(f"sha256 {record['sha256']}, {time.process_time() - start:.1f} CPU seconds\n")
    if options.output:
        text = (
            canonical_json(record)
            .replace('"splits":', '\n"splits":')
            .replace('{"bound"', '\n{"bound"')
            + "\n"
        )
        write_text(options.output, text)
        return 0
    same = load_record("touch-and-go") == record
    sys.stdout.write(
        "The shipped record is the same.\n" if same else "The shipped record differs.\n"
    )
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main())

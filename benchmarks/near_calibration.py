"""Does the promised rate of false near-duplicates hold where train has few videos?

    python benchmarks/near_calibration.py --videos 3 6 12 30 --draws 20

Draws that many train videos of a world of ``benchmarks/near_duplicates.py`` (report half) and 20
other videos as test, of which none leaks, and prints the share of test samples that is flagged.
"""

import argparse
from pathlib import Path

import numpy as np
import polars as pl
from near_duplicates import ROWS, parts, world

from palpate.data.manifest import Manifest
from palpate.leakage.near import near_duplicates

OTHERS = 20


def flagged(whole, modality, videos, rates, rng, cache):
    """The shares of unrelated samples that are flagged at each rate, in one draw."""
    names = rng.permutation(whole.table["video"].unique().sort().to_numpy())
    train, test = (
        Manifest(whole.table.filter(pl.col("video").is_in(part.tolist())), whole.root)
        for part in (names[:videos], names[videos : videos + OTHERS])
    )
    options = {"cache": cache, "threads": 1}
    return [
        near_duplicates(train, test, modality, false_positives=rate, **options).flag.mean()
        for rate in rates
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", nargs="+", default=["gelsight, no b", "digit, no b", "photos, w"])
    parser.add_argument("--videos", type=int, nargs="+", default=[3, 6, 12, 30])
    parser.add_argument("--rates", type=float, nargs="+", default=[0.01, 0.001])
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--work", type=Path, default=Path("runs/near_duplicates"))
    args = parser.parse_args()
    for row in [r for r in ROWS if r.startswith(tuple(args.rows))]:
        source, modality, known = ROWS[row]
        folder, rows = world(args.work, source, "report", 0)
        train, test, *_ = parts(folder, rows, modality, known, 0)
        whole = Manifest(pl.concat([train.table, test.table], how="vertical"), train.root)
        for videos in args.videos:
            rng = np.random.default_rng(videos)
            draws = [
                flagged(whole, modality, videos, args.rates, rng, args.work / "thumbnails")
                for _ in range(args.draws)
            ]
            told = zip(args.rates, np.mean(draws, axis=0), strict=True)
            print(f"{row:26s}{videos:4d} videos", *(f"| {r}: {v:.4f}" for r, v in told), flush=True)


if __name__ == "__main__":
    main()

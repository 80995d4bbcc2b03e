"""Precision and recall of every kind of planted leak, over 20 seeds.

    python benchmarks/leakage_planted.py --seeds 20
    python benchmarks/leakage_planted.py --seeds 20 --flat        # with Glass: prints without any
    texture among the unrelated touches

Each seed makes a train and a test part (tests/forge/leaks.py: 60 videos of 9 kinds of surface,
128 px, 4 samples each) and plants near-duplicates (brightness +-5 %, JPEG quality 60, shifts up to
4 px, and combinations) across videos, the same sample, the same bytes, shared videos and frames 3
apart. Near-duplicates are judged twice: with videos known, and with all metadata dropped. The same
bytes and the same sample count as near-duplicates; frames 3 apart, which may or may not be, are
excluded from that judgment. Peak memory is that of the process.
"""

import argparse
import resource
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import polars as pl

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from forge.leaks import MATERIALS, make_leaky
from palpate.data.manifest import Manifest
from palpate.leakage import audit
from palpate.leakage.near import near_duplicates

DROPPED = ("video", "contact", "object", "session", "material", "sensor", "domain")


def anonymous(manifest):
    table = manifest.table.with_columns(
        pl.lit(None, pl.String).alias(c) for c in DROPPED
    ).with_columns(frame=pl.lit(None, pl.Int64))
    return Manifest(table, manifest.root)


def counts(flag, truth, use=None):
    use = np.ones(len(flag), bool) if use is None else use
    return np.array(
        [(flag & truth & use).sum(), (flag & ~truth & use).sum(), (~flag & truth & use).sum()]
    )


def judge(leaky):
    """Kind -> (true positives, false positives, false negatives), and missed changes."""
    truth = {kind: leaky.truth(kind) for kind in leaky.planted}
    same, copied = truth["identical sample"], truth["identical bytes"]
    alike, spared = truth["near-duplicate"] | same | copied, truth["time gap"]
    found = audit(leaky.train, leaky.test, by="video").to_frame()
    column = lambda name: found[name].to_numpy().astype(bool)
    out = {
        "identical sample": counts(column("identical_sample_flag"), same),
        "identical bytes": counts(column("identical_bytes_flag"), same | copied),
        "shared video": counts(column("shared_video_flag"), same | truth["shared video"] | spared),
        "time gap": counts(column("time_gap_flag"), same | spared),
    }
    missed = Counter()
    for modality in ("vision", "tactile"):
        known = column(f"near_duplicate_{modality}_flag")
        hidden = near_duplicates(anonymous(leaky.train), anonymous(leaky.test), modality).flag
        out[f"near-duplicate {modality}, videos known"] = counts(known, alike, ~spared)
        out[f"near-duplicate {modality}, no metadata"] = counts(hidden, alike, ~spared)
        for flag, how in ((known, "known"), (hidden, "hidden")):
            missed.update(
                (modality, how, leaky.change.get(i, "same"))
                for i, f, t in zip(leaky.test.ids, flag, alike & ~spared, strict=True)
                if t and not f
            )
    return out, missed


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--look", default="gelsight", choices=("gelsight", "digit"))
    parser.add_argument("--flat", action="store_true")
    options = parser.parse_args()
    materials = (*MATERIALS, "Glass") if options.flat else MATERIALS
    total, missed, samples, seconds = {}, Counter(), 0, 0.0
    for seed in range(options.first, options.first + options.seeds):
        with tempfile.TemporaryDirectory() as folder:
            leaky = make_leaky(
                Path(folder), seed, size=options.size, look=options.look, materials=materials
            )
            samples += len(leaky.test)
            start = time.perf_counter()
            found, lost = judge(leaky)
            seconds += time.perf_counter() - start
        missed.update(lost)
        for kind, row in found.items():
            total[kind] = total.get(kind, np.zeros(3, int)) + row
    look = f"{options.size} px, {options.look}"
    print(f"{options.seeds} seeds from {options.first}, {samples} test samples, {look}")
    print(f"{seconds:.0f} s of audits")
    names = ("planted", "found", "wrong", "precision", "recall")
    print(f"{'planted kind':40s}", *(f"{name:>10s}" for name in names))
    for kind, (right, wrong, lost) in total.items():
        precision, recall = right / max(1, right + wrong), right / max(1, right + lost)
        counts = f"{right + lost:10d} {right:10d} {wrong:10d}"
        print(f"{kind:40s} {counts} {precision:10.4f} {recall:10.4f}")
    for (modality, how, change), n in sorted(missed.items()):
        print(f"  missed in {modality} ({how}): {n} of {change}")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()

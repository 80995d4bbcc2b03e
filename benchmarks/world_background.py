"""What pairwise metrics and random halves reward: the sensor itself. Two tables on real touches of the procedural world, no generator.

    python benchmarks/world_background.py --write docs/studies/world_background.md
    python benchmarks/world_background.py --preset demo                      # a first look, under a minute

1. PSNR and SSIM against the true touch of: the empty background of the same video, another touch of the same material on the same sensor unit (another
   video), one of another material on the same unit, and a neighboring frame of the same touch. A generator that draws no touch at all is the first row.
2. Class-aware MMD (CI-TMMD) of real touches with random halves of a class, and with halves of whole videos, beside the mean distance between classes: the
   same data, only the halving differs. Features: patch words of contact minus background, L2-normalized; Gaussian kernel of bandwidth 10, scale 1000.

Intervals are robust to whole videos deviating together. Frames are rendered into memory, without JPEG.
"""

import argparse
import datetime
import sys
from pathlib import Path

import numpy as np
from split_protocols import Frames, feature_set, patch_words, render

from palpate.core import rng_for, short
from palpate.metrics import ci_tmmd, d_tmmd, psnr, ssim
from palpate.sim import PRESETS, VERSION, plan_world

SUBJECTS = {
    "background": "the empty background",
    "same": "another touch, same material, same unit",
    "other": "a touch of another material, same unit",
    "neighbor": "a neighboring frame of the touch",
}


def unit_of(frames, options):
    """The gel unit of each frame."""
    units = {plan.name: plan.sensor for plan in plan_world(options)}
    return np.array([units[video] for video in frames.video])


def partners(frames, units, count, seed):
    """Rows of ``count`` true touches and, by subject, the row each is compared with; -1 for the background."""
    rng = rng_for(seed, "background partners")
    found = {"true": [], **{name: [] for name in SUBJECTS}}
    for row in rng.permutation(len(frames.ids)):
        elsewhere = (units == units[row]) & (frames.video != frames.video[row])
        alike = frames.material == frames.material[row]
        pools = {
            "same": elsewhere & alike,
            "other": elsewhere & ~alike,
            "neighbor": frames.contact == frames.contact[row],
        }
        pools = {name: np.flatnonzero(pool) for name, pool in pools.items()}
        beside = pools["neighbor"]
        pools["neighbor"] = beside[
            np.abs(beside - row) == 1
        ]  # rows of a touch stand in the order of its frames
        if not all(map(len, pools.values())):
            continue
        found["true"].append(row)
        found["background"].append(-1)
        for name, pool in pools.items():
            found[name].append(int(rng.choice(pool)))
        if len(found["true"]) == count:
            break
    return {name: np.array(rows) for name, rows in found.items()}


def pairwise(frames, units, count=2000, seed=0):
    """Subject -> (PSNR score, SSIM score)."""
    rows = partners(frames, units, count, seed)
    true = frames.touch[rows["true"]]
    groups = list(frames.video[rows["true"]])
    out = {}
    for name in SUBJECTS:
        shown = (
            frames.background[rows["true"]] if name == "background" else frames.touch[rows[name]]
        )
        out[name] = (
            psnr(shown, true, groups=groups, subject=name),
            ssim(shown, true, groups=groups, subject=name),
        )
    return out


def halves(frames, seed=0, words=512):
    """The scores of real touches: CI-TMMD with random halves, the same with halves of whole videos, and D-TMMD by video for the distance between classes."""
    features = patch_words(frames.images("tactile"), np.arange(len(frames.ids)), seed, words)
    real = feature_set(features, frames, np.arange(len(frames.ids)), "patch words")
    options = {"normalize": True, "subject": "real"}
    by_video = ci_tmmd(real, preset="paper", halves="group", **options)
    return (
        ci_tmmd(real, preset="paper", seed=seed, **options),
        by_video,
        d_tmmd(real, preset="paper", halves="group", **options),
    )


def shown(score, digits):
    low, high = score.interval or (float("nan"), float("nan"))
    return f"{score.value:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def tables(pairs, found):
    """Both tables in Markdown."""
    lines = ["| against the true touch | PSNR dB | SSIM |", "|---|---|---|"]
    lines += [
        f"| {title} | {shown(pairs[name][0], 1)} | {shown(pairs[name][1], 3)} |"
        for name, title in SUBJECTS.items()
    ]
    random, by_video, between = found
    matrix = np.array(between.details["matrix"])
    apart = matrix[~np.eye(len(matrix), dtype=bool)].mean()
    lines += ["", "| class-aware MMD of real touches (scale 1000) | value |", "|---|---|"]
    lines += [
        f"| random halves of a class | {shown(random, 5)} |",
        f"| halves of whole videos | {shown(by_video, 5)} |",
        f"| between two classes, mean | {apart:.5f} |",
        f"| share of the distance between classes: random halves, by video | {random.value / apart:.4f}, {by_video.value / apart:.4f} |",
    ]
    return "\n".join(lines)


def page(text, preset, options, frames, pairs, command):
    drawn_nothing, true_material = pairs["background"], pairs["same"]
    better = (
        drawn_nothing[0].value > true_material[0].value
        and drawn_nothing[1].value > true_material[1].value
    )
    return f"""# What pairwise metrics and random halves reward

Drawn by a committed command; do not edit by hand. Synthetic: the tables show mechanisms, and their numbers are never compared with those of real data.

    {command}

World: preset `{preset}`, version {VERSION}, options {short(options.digest)}, {len(frames.ids)} contact frames; {datetime.date.today().isoformat()}. Intervals: 95 %, over videos.

{text}

An empty sensor scores {"better" if better else "NOT better"} than a real touch of the right material, by {drawn_nothing[0].value - true_material[0].value:+.1f} dB
and {drawn_nothing[1].value - true_material[1].value:+.3f} SSIM. How the tables are made stands at the head of `benchmarks/world_background.py`.
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--preset", default="small", choices=tuple(PRESETS))
    parser.add_argument("--seed", type=int, default=0, help="of the partners and the random halves")
    parser.add_argument("--pairs", type=int, default=2000, help="true touches of the first table")
    parser.add_argument("--processes", type=int, default=2, help="for rendering")
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    chosen = parser.parse_args()
    options = PRESETS[chosen.preset]
    frames: Frames = render(options, chosen.processes)
    pairs = pairwise(frames, unit_of(frames, options), chosen.pairs, chosen.seed)
    text = tables(pairs, halves(frames, chosen.seed))
    print(
        f"preset {chosen.preset}, version {VERSION}, options {short(options.digest)}: {len(frames.ids)} contact frames\n{text}"
    )
    if chosen.write:
        command = f"python benchmarks/world_background.py {' '.join(sys.argv[1:])}"
        chosen.write.write_text(page(text, chosen.preset, options, frames, pairs, command))


if __name__ == "__main__":
    main()

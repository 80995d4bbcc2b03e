"""Whether the error bars hold: coverage of 95 % intervals, and rejections of a true null.

    python benchmarks/metric_coverage.py                     # print the tables, about seven minutes
    python benchmarks/metric_coverage.py --write docs/studies/metric_coverage.md
    python benchmarks/metric_coverage.py --replicates 100    # a quick look

Frames of a video are drawn as ``normalized(mean + class + video + frame)``: Gaussian effects in 16
dimensions, unit-norm rows. A replicate draws new videos of 3 to 8 frames; a generator adds a shift,
or nothing under the null. ``paired``: generated and real frames are of the same videos, whose
effects they share with a correlation of 0.7 (as on a test set); ``unpaired``: of different videos.

TMMD and I-TMMD are of videos whose class is drawn at random, CI- and D-TMMD of four classes with
equally many videos each; lengths of 1 to 60 frames test E. Scenes are videos of one frame, whose
ids alone are known. The truth is what infinitely many videos would give, from 200,000
simulated ones (its error is below a hundredth of a replicate's standard deviation). I-, CI- and
D-TMMD depend on the sizes of the videos by a known factor (:func:`share`), which the truth
includes; E does not.
"""

import argparse
import datetime
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

from palpate.core import FeatureSet, rng_for
from palpate.metrics import Gaussian, ci_tmmd, compare, d_tmmd, distance, i_tmmd, tmmd

WIDTH, CLASSES = 16, 4
CLASS, VIDEO, FRAME = 0.30, 0.26, 0.26  # standard deviations of the effects
SHIFT = 0.36  # TMMD about 1.2
FIDELITY = 0.7  # correlation of the effects of a video, generated and real
FRAMES, UNEQUAL = (3, 8), (1, 60)  # fewest and most frames of a video
SECOND = 0.8  # shift of the second generator, relative to the first
COVERAGE, REJECTION = (0.92, 0.99), (0.03, 0.08)
TRUTH_VIDEOS = 200_000
KINDS = ("unpaired", "paired")
SCENES = (12, 36, 200)


@dataclass(frozen=True)
class Model:
    """Mean (d,), class effects (C, d) and a generator's shift (d,), fixed over the replicates."""

    mean: np.ndarray
    classes: np.ndarray
    shift: np.ndarray

    @classmethod
    def make(cls, seed=0, width=WIDTH, classes=CLASSES):
        rng = rng_for(seed, "metric coverage", "model")
        unit = lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True)
        mean, away = unit(rng.normal(size=width)), rng.normal(size=width)
        shift = SHIFT * unit(away - mean * (away @ mean))
        return cls(mean, CLASS * unit(rng.normal(size=(classes, width))), shift)

    def noise(self, rng, count, sd):
        return rng.normal(size=(count, len(self.mean))) * sd / np.sqrt(len(self.mean))

    def videos(self, rng, count):
        """(count, d) effects of videos."""
        return self.noise(rng, count, VIDEO)

    def frames(self, rng, effects, labels, sizes, shift=0.0):
        """Rows of unit norm, ``sizes[v]`` frames of each video; and the video of every row."""
        video = np.repeat(np.arange(len(sizes)), sizes)
        rows = self.mean + shift * self.shift + self.classes[labels[video]] + effects[video]
        rows = rows + self.noise(rng, len(video), FRAME)
        return rows / np.linalg.norm(rows, axis=1, keepdims=True), video


@dataclass(frozen=True)
class Truth:
    """What infinitely many videos give, at one bandwidth."""

    tmmd: dict  # size of the shift -> TMMD of a generator
    mixture: float  # E of videos of any class
    within: np.ndarray  # (C,) E of each class
    between: np.ndarray  # (C, C) dist^2 between classes

    @property
    def inter(self):
        """Mean over pairs of classes."""
        return float(self.between[~np.eye(len(self.between), dtype=bool)].mean())


def truth_of(model, sigma=10.0, videos=TRUTH_VIDEOS, seed=1):
    """By simulation with two frames of each of many videos."""
    rng = rng_for(seed, "metric coverage", "truth")
    c = len(model.classes)

    def sample(labels, shift=0.0):
        effects, sizes = model.videos(rng, len(labels)), np.full(len(labels), 2)
        rows, _ = model.frames(rng, effects, labels, sizes, shift)
        return rows[0::2], rows[1::2]

    def excess(first, second):
        k = lambda a, b: np.expm1(-((a - b) ** 2).sum(axis=1) / (2 * sigma**2)).mean()
        apart = np.mean([k(first, np.roll(second, turn, axis=0)) for turn in range(1, 17)])
        return 1000 * (k(first, second) - apart)

    def apart(x, y):  # of different videos; in blocks where moments are too coarse
        if sigma >= 5:
            return distance(x, y, sigma=sigma, tolerance=1e-3).value
        parts = zip(*(np.array_split(v, len(x) // 4000) for v in (x, y)), strict=True)
        return np.mean([distance(a, b, kernel=Gaussian((sigma,))).value for a, b in parts])

    mixed = sample(rng.integers(c, size=videos))
    shifted = {
        size: apart(sample(rng.integers(c, size=videos), size)[0], mixed[0])
        for size in (1.0, SECOND)
    }
    each = [sample(np.full(videos // c, k)) for k in range(c)]
    between = np.array([[0.0 if a is b else apart(a[0], b[0]) for b in each] for a in each])
    within = np.array([excess(*pair) for pair in each])
    return Truth({0.0: 0.0} | shifted, excess(*mixed), within, between)


def share(sizes):
    """I = share x E for halves of whole videos."""
    m = sizes.sum() / 2
    return (sizes * (sizes - 1.0)).sum() / (m * (m - 1))


def feature_set(rows, video, labels, prefix):
    ids, groups = [f"{prefix}{k}" for k in range(len(rows))], [f"{prefix}{v}" for v in video]
    return FeatureSet(ids, rows, [str(c) for c in labels[video]], groups)


def draw_pair(model, rng, videos, paired, shift, lengths=FRAMES):
    """Generated and real sets, their classes drawn at random; and the sizes of the videos."""
    labels = rng.integers(len(model.classes), size=(2, videos))
    effects = model.videos(rng, videos), model.videos(rng, videos)
    if paired:
        labels[0] = labels[1]
        effects = FIDELITY * effects[1] + np.sqrt(1 - FIDELITY**2) * effects[0], effects[1]
    sizes = rng.integers(lengths[0], lengths[1] + 1, size=(2, videos))
    made = model.frames(rng, effects[0], labels[0], sizes[0], shift)
    real = model.frames(rng, effects[1], labels[1], sizes[1])
    prefix = "v" if paired else "g"
    return feature_set(*made, labels[0], prefix), feature_set(*real, labels[1], "v"), sizes


def draw_classes(model, rng, videos, lengths=FRAMES):
    """One set with equally many videos in each class; labels and sizes of the videos."""
    labels = np.arange(videos) % len(model.classes)
    sizes = rng.integers(lengths[0], lengths[1] + 1, size=videos)
    rows, video = model.frames(rng, model.videos(rng, videos), labels, sizes)
    return feature_set(rows, video, labels, "v"), labels, sizes


def without_groups(*sets):
    return [FeatureSet(s.ids, s.features, s.labels) for s in sets]


class Tally:
    """Estimates, intervals and truths of one quantity over the replicates."""

    def __init__(self):
        self.rows = []

    def add(self, value, interval, truth):
        low, high = interval if interval is not None else (np.nan, np.nan)
        self.rows.append((np.nan if value is None else value, low, high, truth))

    @property
    def table(self):
        return np.array(self.rows, dtype=np.float64)

    @property
    def covered(self):
        _, low, high, truth = self.table.T
        return (low <= truth) & (truth <= high)

    @property
    def coverage(self):
        return float(self.covered.mean())


def tally_tmmd(
    model, truth, videos, paired, replicates, seed, permutations=199, frames=0, sigma=10.0
):
    """TMMD with a shift, and p-values without; the first ``frames`` replicates also groupless."""
    tallies = {name: Tally() for name in ("TMMD", "TMMD, frames", "TMMD null", "TMMD null, frames")}
    rejected = {"videos": [], "frames": []}
    for r in range(replicates):
        rng = rng_for(seed, "metric coverage", f"{videos} {paired} {r}")
        for shift, name in ((1.0, "TMMD"), (0.0, "TMMD null")):
            sets = draw_pair(model, rng, videos, paired, shift)[:2]
            options = {"sigma": sigma, "seed": r, "permutations": 0 if shift else permutations}
            scores = {"videos": tmmd(*sets, **options)}
            if r < frames:
                scores["frames"] = tmmd(*without_groups(*sets), preset="paper", **options)
            for unit, score in scores.items():
                tally = tallies[name + (", frames" if unit == "frames" else "")]
                tally.add(score.value, score.interval, truth.tmmd[shift])
                if not shift and permutations:
                    rejected[unit].append(score.details["p_value"] <= 0.05)
    return tallies, {unit: np.array(hits) for unit, hits in rejected.items()}


def tally_scenes(model, truth, scenes, replicates, seed):
    """TMMD of two sets with the same ids and no groups: row k of both is of scene k."""
    tallies = {}
    for r in range(replicates):
        rng = rng_for(seed, "metric coverage", f"scenes {scenes} {r}")
        real = model.videos(rng, scenes)
        shared = FIDELITY * real + np.sqrt(1 - FIDELITY**2) * model.videos(rng, scenes)
        labels, one = rng.integers(len(model.classes), size=scenes), np.ones(scenes, dtype=int)
        ids = [str(k) for k in range(scenes)]
        y, _ = model.frames(rng, real, labels, one)
        for shift in (0.0, 1.0):
            x, _ = model.frames(rng, shared, labels, one, shift)
            for sigma in (10.0, "multi")[: 1 if shift else 2]:
                for preset in (None, "paper"):
                    options = {"sigma": sigma, "preset": preset, "permutations": 0}
                    score = tmmd(x, y, ids=ids, reference_ids=ids, **options)
                    tally = tallies.setdefault((shift, sigma, preset), Tally())
                    tally.add(score.value, score.interval, truth.tmmd[shift])
    return tallies


def scenes_table(model, truth, scenes, replicates, seed, report):
    """Coverage of TMMD where ids are shared, as lines."""
    rows = []
    for count in scenes:
        found = tally_scenes(model, truth, count, replicates, seed)
        for (shift, sigma, preset), tally in found.items():
            name = "TMMD" if shift else "TMMD under the null"
            name += f", sigma {sigma:g}" if sigma != "multi" else ", multi"
            design = f"{count}, {'default' if preset is None else preset}"
            rows.append(coverage_row(name, design, tally))
        report(f"scenes {count}")
    return [
        "## Two plain folders with the same ids, no groups",
        "",
        "One generated and one real image of each scene, paired by id. The default excludes the "
        'pairs of one scene; `preset="paper"` is the formula, which counts them: it lies below the '
        "truth. Under the null, intervals err on the wide side: use the p-value.",
        "",
        HEAD.replace("videos", "scenes, preset"),
        RULE,
        *rows,
        "",
    ]


def tally_halves(model, truth, videos, replicates, seed, frames=0, lengths=FRAMES):
    """I-, CI- and D-TMMD and what does not depend on sizes, by groups."""
    names = ("I-TMMD", "I-TMMD: E", "CI-TMMD", "CI-TMMD: E")
    names += ("D: mean inter-class", "D: E_ratio", "D-TMMD", "D: mean inter-class, frames")
    tallies = {name: Tally() for name in names}

    def add(name, score, truth, key=""):
        value, interval = score.value, score.interval
        if key:
            value, interval = score.details[key], score.details[f"{key}_interval"]
        tallies[name].add(value, interval, truth)

    for r in range(replicates):
        rng = rng_for(seed, "metric coverage", f"halves {videos} {r}")
        made, _, sizes = draw_pair(model, rng, videos, False, 0.0, lengths)
        i = i_tmmd(made)
        add("I-TMMD", i, share(sizes[0]) * truth.mixture)
        add("I-TMMD: E", i, truth.mixture, "E")
        made, labels, sizes = draw_classes(model, rng, videos, lengths)
        shares = [share(sizes[labels == c]) for c in range(len(model.classes))]
        intra = (np.array(shares) * truth.within).mean()
        ci, d = ci_tmmd(made), d_tmmd(made)
        add("CI-TMMD", ci, intra)
        add("CI-TMMD: E", ci, truth.within.mean(), "E")
        add("D-TMMD", d, intra / (intra + truth.between.sum(axis=1).mean()))
        if d.details["E_ratio"] is not None:  # given where the classes are apart
            add("D: E_ratio", d, truth.within.mean() / truth.inter, "E_ratio")
        tallies["D: mean inter-class"].add(*d.details["inter"].values(), truth.inter)
        if r < frames:
            flat = d_tmmd(*without_groups(made)).details["inter"]
            tallies["D: mean inter-class, frames"].add(*flat.values(), truth.inter)
    return tallies


def tally_difference(model, truth, videos, replicates, seed, shifts=(1.0, SECOND)):
    """Two generators on the same videos: the difference of TMMD; unpaired width / paired width."""
    tally, ratios = Tally(), []
    for r in range(replicates):
        rng = rng_for(seed, "metric coverage", f"difference {videos} {r}")
        labels, real = rng.integers(len(model.classes), size=videos), model.videos(rng, videos)
        sizes = rng.integers(FRAMES[0], FRAMES[1] + 1, size=videos)
        shared = FIDELITY * real + np.sqrt(1 - FIDELITY**2) * model.videos(rng, videos)
        draw = lambda effects, shift: feature_set(
            *model.frames(rng, effects, labels, sizes, shift),  # noqa: B023
            labels,  # noqa: B023
            "v",
        )
        sets = dict(zip("ab", [draw(shared, shift) for shift in shifts], strict=True))
        result = compare(sets, draw(real, 0.0), permutations=0)
        delta, scores = result.differences[0], [s for s in result.scores if s.metric == "TMMD"]
        tally.add(delta.value, delta.interval, truth.tmmd[shifts[0]] - truth.tmmd[shifts[1]])
        unpaired = np.hypot(*[s.interval[1] - s.interval[0] for s in scores])
        ratios.append(unpaired / (delta.interval[1] - delta.interval[0]))
    return tally, float(np.median(ratios))


def rate(hits):
    """``93.4 % (91.7 to 94.9)``: a share with its 95 % interval (Clopper-Pearson)."""
    low, high = stats.binomtest(int(np.sum(hits)), len(hits)).proportion_ci(0.95)
    return f"{100 * np.mean(hits):.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def verdict(hits, limits):
    return "yes" if limits[0] <= float(np.mean(hits)) <= limits[1] else "**no**"


HEAD = "| quantity | videos | truth | bias | sd | mean half-width | covered | 92 to 99 % |"
RULE = "|---|---|---|---|---|---|---|---|"


def coverage_row(name, design, tally):
    value, low, high, truth = tally.table.T
    error, reach = value - truth, np.nanmean((high - low) / 2)
    numbers = (
        f"{truth.mean():.3f} | {np.nanmean(error):+.4f} | {np.nanstd(error):.3f} | {reach:.3f}"
    )
    covered = f"{rate(tally.covered)} | {verdict(tally.covered, COVERAGE)}"
    return f"| {name} | {design} | {numbers} | {covered} |"


def tables(videos, replicates, frames, seed, report):
    """All tables, as lines."""
    model = Model.make()
    truth, narrow = truth_of(model), truth_of(model, sigma=1.0, videos=40_000)
    report("truth")
    grouped, flat, rejections, halves, widths = [], [], [], [], []
    for count in videos:
        for kind in KINDS:
            paired, design = kind == "paired", f"{count}, {kind}"
            tallies, rejected = tally_tmmd(
                model, truth, count, paired, replicates, seed, frames=frames
            )
            for label, name in (("TMMD", "TMMD"), ("TMMD under the null", "TMMD null")):
                grouped.append(coverage_row(label, design, tallies[name]))
                flat.append(coverage_row(label, design, tallies[f"{name}, frames"]))
            cells = [f"{rate(hits)} | {verdict(hits, REJECTION)}" for hits in rejected.values()]
            rejections.append(f"| {design} | {' | '.join(cells)} |")
            report(f"TMMD {design}")
    for count in videos:
        options = {"permutations": 0, "sigma": 1.0}
        tallies, _ = tally_tmmd(model, narrow, count, True, replicates // 2, seed, **options)
        grouped.append(coverage_row("TMMD, sigma 1", f"{count}, paired", tallies["TMMD"]))
        tallies = tally_halves(model, truth, count, replicates, seed, frames)
        by_frame = tallies.pop("D: mean inter-class, frames")
        flat.append(coverage_row("D: mean inter-class", str(count), by_frame))
        halves += [coverage_row(name, str(count), tally) for name, tally in tallies.items()]
        unequal = tally_halves(model, truth, count, replicates, seed, lengths=UNEQUAL)
        design = f"{count}, of {UNEQUAL[0]} to {UNEQUAL[1]} frames"
        halves += [coverage_row(n, design, t) for n, t in unequal.items() if t.rows and "E" in n]
        tally, ratio = tally_difference(model, truth, count, replicates // 2, seed)
        row = coverage_row("difference of TMMD", f"{count}, paired", tally)
        widths.append(f"{row} {ratio:.1f} |")
        report(f"halves and differences {count}")
    return [
        "## Intervals that leave out whole videos",
        "",
        *(HEAD, RULE, *grouped, *halves),
        "",
        "## Intervals that leave out frames (no groups given)",
        "",
        '`preset="paper"` on the same features without groups: the unbiased estimator, frames '
        "taken as independent. A note of the score says so.",
        "",
        *(HEAD, RULE, *flat),
        "",
        *scenes_table(model, truth, SCENES, replicates // 2, seed, report),
        "## Two generators on the same videos",
        "",
        f"`palpate.metrics.compare`: one generator with the shift and one with {SECOND} of it, "
        "which share the effects of the videos. The last column is the root of the sum of the "
        "squared widths of the two intervals, over the width of the paired interval.",
        "",
        f"{HEAD} unpaired width / paired |",
        f"{RULE}---|",
        *widths,
        "",
        "## Permutation tests of a true null at 5 %",
        "",
        "| videos | whole videos: rejected | 3 to 8 % | frames: rejected | 3 to 8 % |",
        "|---|---|---|---|---|",
        *rejections,
        "",
    ]


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--videos", type=int, nargs="+", default=[12, 24, 40])
    parser.add_argument("--replicates", type=int, default=600)
    parser.add_argument("--frames", type=int, default=300, help="replicates also without groups")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    options = parser.parse_args()
    start = time.process_time()

    def report(text):
        print(f"{time.process_time() - start:6.0f} s  {text}", file=sys.stderr, flush=True)

    body = tables(options.videos, options.replicates, options.frames, options.seed, report)
    command = "python benchmarks/metric_coverage.py"
    command += f" --write {options.write}" if options.write else ""
    command += f" --videos {' '.join(map(str, options.videos))} --replicates {options.replicates}"
    command += f" --frames {options.frames} --seed {options.seed}"
    head = [
        "# Whether the error bars of the metrics hold",
        "",
        f"Written by `{command}`, {datetime.datetime.now(tz=datetime.UTC).date()}. The script "
        "describes the model and the truth: synthetic unit-norm features, "
        f"{WIDTH} dimensions, {CLASSES} classes, videos of {FRAMES[0]} to {FRAMES[1]} frames, "
        "sigma = 10 unless said; all values times 1000.",
        "",
        "`covered`: the share of replicates whose 95 % interval holds the truth, with its 95 % "
        "interval. `bias` and `sd` are of the estimate about the truth.",
        "",
    ]
    text = "\n".join([*head, *body]).rstrip() + "\n"
    if options.write:
        options.write.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()

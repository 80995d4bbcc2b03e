"""Whether the error bars of the metrics are true: coverage of 95 % intervals, and how often permutations reject a true null.

    python benchmarks/metric_coverage.py                                   # prints the tables, about seven minutes on one core
    python benchmarks/metric_coverage.py --write docs/studies/metric_coverage.md   # writes them
    python benchmarks/metric_coverage.py --replicates 100                  # a quick look

Frames of a video are drawn as ``normalized(mean + class + video + frame)``: Gaussian effects in 16 dimensions, unit-norm rows. A replicate draws new
videos of 3 to 8 frames; a generator adds a shift, or nothing under the null. ``paired``: generated and real frames are of the same videos, whose
effects they share with a correlation of 0.7 (that is how a generator is scored on a test set); ``unpaired``: of different videos.

TMMD and I-TMMD are of videos whose class is drawn at random, CI- and D-TMMD of four classes with equally many videos each. The truth is what infinitely
many videos would give: from 200,000 simulated videos (its own error is below a hundredth of what is left of a replicate's standard deviation). I-, CI- and D-TMMD depend on the
sizes of the videos by a known factor (:mod:`palpate.metrics.halves`), which the truth holds too; E does not.
"""

import argparse
import datetime
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy import stats

from palpate.core import FeatureSet, rng_for
from palpate.metrics import ci_tmmd, compare, d_tmmd, distance, i_tmmd, tmmd
from palpate.metrics.kernels import Gaussian
from palpate.metrics.presets import plan_for
from palpate.metrics.tables import build_table, class_estimate
from palpate.metrics.tactile import d_matrix, denominators

WIDTH, CLASSES = 16, 4
SPREAD = {"class": 0.30, "video": 0.26, "frame": 0.26}
SHIFT = 0.36  # TMMD about 1.2
FIDELITY = 0.7  # correlation of the effects of a video, generated and real
FRAMES = (3, 8)
SECOND = 0.8  # shift of the second generator, as a part of the first's
COVERAGE, REJECTION = (0.92, 0.99), (0.03, 0.08)
TRUTH_VIDEOS = 200_000
KINDS = ("unpaired", "paired")


@dataclass(frozen=True)
class Model:
    """Mean, class effects and a generator's shift, fixed over the replicates."""

    mean: np.ndarray
    classes: np.ndarray
    shift: np.ndarray
    spread: dict = field(default_factory=lambda: dict(SPREAD))

    @classmethod
    def make(cls, seed=0, width=WIDTH, classes=CLASSES):
        rng = rng_for(seed, "metric coverage", "model")
        unit = lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True)  # noqa: E731
        mean = unit(rng.normal(size=width))
        away = rng.normal(size=width)
        return cls(
            mean,
            SPREAD["class"] * unit(rng.normal(size=(classes, width))),
            SHIFT * unit(away - mean * (away @ mean)),
        )

    def videos(self, rng, count):
        """(count, d) effects of videos."""
        return (
            rng.normal(size=(count, len(self.mean)))
            * self.spread["video"]
            / np.sqrt(len(self.mean))
        )

    def frames(self, rng, effects, labels, sizes, shift=0.0):
        """Rows of unit norm: ``sizes[v]`` frames of each video."""
        of = np.repeat(np.arange(len(sizes)), sizes)
        noise = (
            rng.normal(size=(len(of), len(self.mean)))
            * self.spread["frame"]
            / np.sqrt(len(self.mean))
        )
        rows = self.mean + shift * self.shift + self.classes[labels[of]] + effects[of] + noise
        return rows / np.linalg.norm(rows, axis=1, keepdims=True), of


@dataclass(frozen=True)
class Truth:
    """What infinitely many videos give, at one bandwidth."""

    tmmd: dict  # size of the shift -> TMMD of a generator
    mixture: float  # E of videos of any class
    own: np.ndarray  # (C,) E of each class
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
        rows, _ = model.frames(
            rng, model.videos(rng, len(labels)), labels, np.full(len(labels), 2), shift
        )
        return rows[0::2], rows[1::2]

    def excess(first, second):
        k = lambda a, b: np.expm1(-((a - b) ** 2).sum(axis=1) / (2 * sigma**2)).mean()  # noqa: E731
        apart = np.mean([k(first, np.roll(second, turn, axis=0)) for turn in range(1, 17)])
        return 1000 * (k(first, second) - apart)

    def apart(x, y):  # x and y of different videos; blocks where moments are too coarse
        if sigma < 5:
            parts = zip(
                np.array_split(x, len(x) // 4000), np.array_split(y, len(x) // 4000), strict=True
            )
            return np.mean([distance(a, b, kernel=Gaussian((sigma,))).value for a, b in parts])
        return distance(x, y, sigma=sigma, tolerance=1e-3).value

    any_class = sample(rng.integers(c, size=videos))
    shifted = {
        size: apart(sample(rng.integers(c, size=videos), size)[0], any_class[0])
        for size in (1.0, SECOND)
    }
    each = [sample(np.full(videos // c, k)) for k in range(c)]
    between = np.array([[0.0 if a is b else apart(a[0], b[0]) for b in each] for a in each])
    return Truth(
        {0.0: 0.0} | shifted, excess(*any_class), np.array([excess(*s) for s in each]), between
    )


def share(sizes):
    """I = share x E for halves of whole videos (:mod:`palpate.metrics.halves`)."""
    m = sizes.sum() / 2
    return (sizes * (sizes - 1.0)).sum() / (m * (m - 1))


def feature_set(rows, of, labels, prefix, groups=True):
    names = [f"{prefix}{v}" for v in of]
    return FeatureSet(
        [f"{prefix}{k}" for k in range(len(rows))],
        rows,
        [str(c) for c in labels[of]],
        names if groups else None,
    )


def draw_pair(model, rng, videos, paired, shift):
    """Generated and real sets, their classes drawn at random."""
    labels = rng.integers(len(model.classes), size=(2, videos))
    effects = model.videos(rng, videos), model.videos(rng, videos)
    if paired:
        labels[0] = labels[1]
        effects = FIDELITY * effects[1] + np.sqrt(1 - FIDELITY**2) * effects[0], effects[1]
    sizes = rng.integers(FRAMES[0], FRAMES[1] + 1, size=(2, videos))
    made = model.frames(rng, effects[0], labels[0], sizes[0], shift)
    real = model.frames(rng, effects[1], labels[1], sizes[1])
    prefix = "v" if paired else "g"
    return feature_set(*made, labels[0], prefix), feature_set(*real, labels[1], "v"), sizes


def draw_classes(model, rng, videos):
    """One set of as many videos in each class."""
    labels = np.arange(videos) % len(model.classes)
    sizes = rng.integers(FRAMES[0], FRAMES[1] + 1, size=videos)
    rows, of = model.frames(rng, model.videos(rng, videos), labels, sizes)
    return feature_set(rows, of, labels, "v"), labels, sizes


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
        value = self.table
        return (value[:, 1] <= value[:, 3]) & (value[:, 3] <= value[:, 2])

    @property
    def coverage(self):
        return float(self.covered.mean())


def tally_tmmd(
    model, truth, videos, paired, replicates, seed, permutations=199, frames=0, sigma=10.0
):
    """TMMD with a shift, and p-values without one; the first ``frames`` replicates also without groups."""
    tallies = {name: Tally() for name in ("TMMD", "TMMD, frames", "TMMD null", "TMMD null, frames")}
    rejected = {"videos": [], "frames": []}
    for r in range(replicates):
        rng = rng_for(seed, "metric coverage", f"{videos} {paired} {r}")
        for shift, name in ((1.0, "TMMD"), (0.0, "TMMD null")):
            made, real, _ = draw_pair(model, rng, videos, paired, shift)
            ask = {"sigma": sigma, "seed": r, "permutations": 0 if shift else permutations}
            score = tmmd(made, real, **ask)
            tallies[name].add(score.value, score.interval, truth.tmmd[shift])
            flat = tmmd(*without_groups(made, real), **ask) if r < frames else None
            if flat is not None:
                tallies[name + ", frames"].add(flat.value, flat.interval, truth.tmmd[shift])
            if not shift and permutations:
                rejected["videos"].append(score.details["p_value"] <= 0.05)
                rejected["frames"] += [] if flat is None else [flat.details["p_value"] <= 0.05]
    return tallies, {k: np.array(v) for k, v in rejected.items()}


def tally_halves(model, truth, videos, replicates, seed, frames=0):
    """I-, CI- and D-TMMD and what is invariant of them, by groups."""
    names = (
        "I-TMMD",
        "I-TMMD: E",
        "CI-TMMD",
        "CI-TMMD: E",
        "D: mean inter-class",
        "D: E_ratio",
        "D-TMMD",
        "D: mean inter-class, frames",
    )
    tallies = {name: Tally() for name in names}
    for r in range(replicates):
        rng = rng_for(seed, "metric coverage", f"halves {videos} {r}")
        made, _, sizes = draw_pair(model, rng, videos, False, 0.0)
        one = i_tmmd(made)
        tallies["I-TMMD"].add(one.value, one.interval, share(sizes[0]) * truth.mixture)
        tallies["I-TMMD: E"].add(one.details["E"], one.details["E_interval"], truth.mixture)
        made, labels, sizes = draw_classes(model, rng, videos)
        own = np.array([share(sizes[labels == c]) for c in range(len(model.classes))]) * truth.own
        one, ratio = ci_tmmd(made), d_tmmd(made)
        tallies["CI-TMMD"].add(one.value, one.interval, own.mean())
        tallies["CI-TMMD: E"].add(one.details["E"], one.details["E_interval"], truth.own.mean())
        tallies["D-TMMD"].add(
            ratio.value,
            ratio.interval,
            own.mean() / (own.mean() + truth.between.sum(axis=1).mean()),
        )
        if ratio.details["E_ratio"] is not None:  # given where the classes are apart
            tallies["D: E_ratio"].add(
                ratio.details["E_ratio"],
                ratio.details["E_ratio_interval"],
                truth.own.mean() / truth.inter,
            )
        tallies["D: mean inter-class"].add(*ratio.details["inter"].values(), truth.inter)
        if r < frames:
            tallies["D: mean inter-class, frames"].add(
                *inter_class(*without_groups(made), False), truth.inter
            )
    return tallies


def inter_class(made, grouped):
    """The mean of the matrix D off its diagonal, with its interval; ``details["inter"]`` of a D-TMMD that needs no halves."""
    plan = plan_for({}, grouped=grouped)
    table = build_table(made, None, plan, grouped=grouped)
    sums = table.class_halves(np.arange(len(table.classes)))
    found = class_estimate(
        sums,
        lambda t: np.array([denominators(d_matrix(t, plan), "mean_off_diagonal").mean()]),
        table.unit,
    )
    return float(found.values[0]), found.interval(0, plan.level)


def tally_difference(model, truth, videos, replicates, seed, shifts=(1.0, SECOND)):
    """Two generators with shifts of their own on the same videos: the difference of their TMMD, and its width beside unpaired intervals."""
    tally, wider = Tally(), []
    for r in range(replicates):
        rng = rng_for(seed, "metric coverage", f"difference {videos} {r}")
        labels, real = rng.integers(len(model.classes), size=videos), model.videos(rng, videos)
        sizes = rng.integers(FRAMES[0], FRAMES[1] + 1, size=videos)
        shared = FIDELITY * real + np.sqrt(1 - FIDELITY**2) * model.videos(rng, videos)
        sets = [
            feature_set(*model.frames(rng, shared, labels, sizes, shift), labels, "v")
            for shift in shifts
        ]
        reference = feature_set(*model.frames(rng, real, labels, sizes), labels, "v")
        found = compare({"a": sets[0], "b": sets[1]}, reference, permutations=0)
        delta, scores = found.differences[0], (found.scores[0], found.scores[4])
        tally.add(delta.value, delta.interval, truth.tmmd[shifts[0]] - truth.tmmd[shifts[1]])
        alone = np.hypot(*[s.interval[1] - s.interval[0] for s in scores])
        wider.append(alone / (delta.interval[1] - delta.interval[0]))
    return tally, float(np.median(wider))


def rate(hits):
    """``93.4 % (91.7 to 94.9)``: a share with its 95 % interval (Clopper-Pearson)."""
    low, high = stats.binomtest(int(np.sum(hits)), len(hits)).proportion_ci(0.95)
    return f"{100 * np.mean(hits):.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def verdict(hits, limits):
    share = float(np.mean(hits))
    return "yes" if limits[0] <= share <= limits[1] else "**no**"


def coverage_row(name, design, tally):
    t = tally.table
    reach = np.nanmean((t[:, 2] - t[:, 1]) / 2)
    return (
        f"| {name} | {design} | {t[:, 3].mean():.3f} | {np.nanmean(t[:, 0] - t[:, 3]):+.4f} | {np.nanstd(t[:, 0] - t[:, 3]):.3f} | {reach:.3f} "
        f"| {rate(tally.covered)} | {verdict(tally.covered, COVERAGE)} |"
    )


COVERAGE_HEAD = [
    "| quantity | videos | truth | bias | sd | mean half-width | covered | 92 to 99 % |",
    "|---|---|---|---|---|---|---|---|",
]


def tables(videos, replicates, frames, seed, say):
    """All tables, as lines."""
    model = Model.make()
    truth, near = truth_of(model), truth_of(model, sigma=1.0, videos=40_000)
    say("truth")
    grouped, flat, rejections = [], [], []
    for count in videos:
        for kind in KINDS:
            found, rejected = tally_tmmd(
                model, truth, count, kind == "paired", replicates, seed, frames=frames
            )
            design = f"{count}, {kind}"
            grouped += [
                coverage_row(label, design, found[name])
                for label, name in (("TMMD", "TMMD"), ("TMMD under the null", "TMMD null"))
            ]
            flat += [
                coverage_row("TMMD" + tail, design, found["TMMD" + key + ", frames"])
                for tail, key in (("", ""), (" under the null", " null"))
            ]
            cells = [
                f"{rate(rejected[k])} | {verdict(rejected[k], REJECTION)}"
                for k in ("videos", "frames")
            ]
            rejections.append(f"| {design} | {' | '.join(cells)} |")
            say(f"TMMD {design}")
    for count in videos:
        found, _ = tally_tmmd(
            model, near, count, True, replicates // 2, seed, permutations=0, sigma=1.0
        )
        grouped.append(coverage_row("TMMD, sigma 1", f"{count}, paired", found["TMMD"]))
    say("TMMD, sigma 1")
    halves, widths = [], []
    for count in videos:
        found = tally_halves(model, truth, count, replicates, seed, frames)
        flat.append(
            coverage_row(
                "D: mean inter-class", str(count), found.pop("D: mean inter-class, frames")
            )
        )
        halves += [coverage_row(name, str(count), tally) for name, tally in found.items()]
        say(f"halves {count}")
    for count in videos:
        tally, wider = tally_difference(model, truth, count, replicates // 2, seed)
        widths.append(coverage_row("difference of TMMD", f"{count}, paired", tally))
        say(f"difference {count}: {wider:.2f}")
        widths[-1] += f" {wider:.1f} |"
    return [
        "## Intervals that leave out whole videos",
        "",
        *COVERAGE_HEAD,
        *grouped,
        *halves,
        "",
        "## Intervals that leave out frames (no groups given)",
        "",
        '`preset="paper"` on the same features without their groups: the unbiased estimator, frames taken as independent. The score says so in its note.',
        "",
        *COVERAGE_HEAD,
        *flat,
        "",
        "## Two generators on the same videos",
        "",
        f"`palpate.metrics.compare`: one generator with the shift and one with {SECOND} of it, which share the effects of the videos. The last column says how many times wider the root of the sum "
        "of the squared widths of the two intervals is.",
        "",
        COVERAGE_HEAD[0] + " unpaired width / paired |",
        COVERAGE_HEAD[1] + "---|",
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
    parser.add_argument(
        "--frames", type=int, default=300, help="replicates that are also scored without groups"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    asked = parser.parse_args()
    started = time.process_time()
    say = lambda text: print(
        f"{time.process_time() - started:6.0f} s  {text}", file=sys.stderr, flush=True
    )
    body = tables(asked.videos, asked.replicates, asked.frames, asked.seed, say)
    options = f"--videos {' '.join(map(str, asked.videos))} --replicates {asked.replicates} --frames {asked.frames} --seed {asked.seed}"
    command = "python benchmarks/metric_coverage.py" + (
        f" --write {asked.write}" if asked.write else ""
    )
    head = [
        "# Whether the error bars of the metrics are true",
        "",
        f"Written by `{command} {options}`, {datetime.datetime.now(tz=datetime.UTC).date()}. The model and the truth are described in that script: synthetic unit-norm "
        f"features, {WIDTH} dimensions, {CLASSES} classes, videos of {FRAMES[0]} to {FRAMES[1]} frames, sigma = 10 unless said; all values times 1000.",
        "",
        "`covered`: the share of replicates whose 95 % interval holds the truth, with its own 95 % interval. `bias` and `sd` are of the estimate about the truth.",
        "",
    ]
    text = "\n".join([*head, *body]).rstrip() + "\n"
    if asked.write:
        asked.write.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()

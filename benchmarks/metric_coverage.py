"""Whether the error bars hold: coverage of 95 % intervals, and rejections of a true null.

    python benchmarks/metric_coverage.py 600 > docs/studies/metric_coverage.md    # seven minutes
    python benchmarks/metric_coverage.py 2000 --misses    # TMMD alone: where intervals miss

Frames of a video are drawn as ``normalized(mean + class + video + frame)``: Gaussian effects in 16
dimensions, unit-norm rows. A replicate draws new videos of 3 to 8 frames; a generator adds a shift,
or nothing under the null. ``paired``: generated and real frames are of the same videos, whose
effects they share with a correlation of 0.7 (as on a test set); ``unpaired``: of different videos.

TMMD and I-TMMD are of videos whose class is drawn at random, CI- and D-TMMD of four classes with
equally many videos each. Scenes are videos of one frame, whose ids alone are known. The truth is
what infinitely many videos would give, from 200,000 simulated ones.
"""

import datetime
import sys
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from palpate.core import FeatureSet, rng_for
from palpate.metrics import ci_tmmd, compare, d_tmmd, distance, i_tmmd, tmmd

WIDTH, CLASSES = 16, 4
CLASS, VIDEO, FRAME = 0.30, 0.26, 0.26  # standard deviations of the effects
SHIFT = 0.36  # TMMD about 1.2
FIDELITY = 0.7  # correlation of the effects of a video, generated and real
FRAMES, UNEQUAL = (3, 8), (1, 60)  # fewest and most frames of a video
SECOND = 0.8  # shift of the second generator, relative to the first
COVERAGE, REJECTION = (0.92, 0.99), (0.03, 0.08)
KINDS = {"unpaired": False, "paired": True}
SCENES = (12, 36, 200)


@dataclass(frozen=True)
class Model:
    """Mean (d,), class effects (C, d) and a generator's shift (d,), fixed over the replicates."""

    mean: np.ndarray
    classes: np.ndarray
    shift: np.ndarray

    @classmethod
    def make(cls):
        rng = rng_for(0, "metric coverage", "model")
        unit = lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True)
        mean, away = unit(rng.normal(size=WIDTH)), rng.normal(size=WIDTH)
        shift = SHIFT * unit(away - mean * (away @ mean))
        return cls(mean, CLASS * unit(rng.normal(size=(CLASSES, WIDTH))), shift)

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
    """What infinitely many videos give."""

    tmmd: dict  # size of the shift -> TMMD of a generator
    mixture: float  # E of videos of any class
    within: np.ndarray  # (C,) E of each class
    between: np.ndarray  # (C (C - 1),) dist^2 between classes


def truth_of(model, videos=200_000):
    """By simulation with two frames of each of many videos, at sigma 10."""
    rng = rng_for(1, "metric coverage", "truth")
    c = len(model.classes)

    def sample(labels, shift=0.0):
        effects, sizes = model.videos(rng, len(labels)), np.full(len(labels), 2)
        rows, _ = model.frames(rng, effects, labels, sizes, shift)
        return rows[0::2], rows[1::2]

    def excess(first, second):
        k = lambda a, b: np.expm1(-((a - b) ** 2).sum(axis=1) / 200).mean()
        apart = np.mean([k(first, np.roll(second, turn, axis=0)) for turn in range(1, 17)])
        return 1000 * (k(first, second) - apart)

    apart = lambda x, y: distance(x, y, backend="moments").value  # of different videos
    labels = lambda: rng.integers(c, size=videos)
    mixed = sample(labels())
    shifted = {size: apart(sample(labels(), size)[0], mixed[0]) for size in (1.0, SECOND)}
    each = [sample(np.full(videos // c, k)) for k in range(c)]
    between = np.array([apart(a[0], b[0]) for a in each for b in each if a is not b])
    within = np.array([excess(*pair) for pair in each])
    return Truth({0.0: 0.0} | shifted, excess(*mixed), within, between)


def feature_set(rows, video, labels, prefix):
    ids, groups = [f"{prefix}{k}" for k in range(len(rows))], [f"{prefix}{v}" for v in video]
    return FeatureSet(ids, rows, [str(c) for c in labels[video]], groups)


def like(model, rng, effects):
    """Effects of generated videos that share those of the real ones."""
    return FIDELITY * effects + np.sqrt(1 - FIDELITY**2) * model.videos(rng, len(effects))


def draw_pair(model, rng, videos, paired, shift, lengths=FRAMES):
    """Generated and real sets, their classes drawn at random."""
    labels, real = rng.integers(len(model.classes), size=(2, videos)), model.videos(rng, videos)
    labels[0] = labels[1] if paired else labels[0]
    effects = like(model, rng, real) if paired else model.videos(rng, videos)
    sizes = rng.integers(lengths[0], lengths[1] + 1, size=(2, videos))
    made = model.frames(rng, effects, labels[0], sizes[0], shift)
    real = model.frames(rng, real, labels[1], sizes[1])
    return feature_set(*made, labels[0], "v" if paired else "g"), feature_set(*real, labels[1], "v")


def draw_classes(model, rng, videos, lengths=FRAMES):
    """One set with equally many videos in each class."""
    labels = np.arange(videos) % len(model.classes)
    sizes = rng.integers(lengths[0], lengths[1] + 1, size=videos)
    rows, video = model.frames(rng, model.videos(rng, videos), labels, sizes)
    return feature_set(rows, video, labels, "v")


class Tally(list):
    """Estimates, intervals and truths of one quantity over the replicates."""

    def add(self, value, interval, truth):
        self.append((np.nan if value is None else value, *(interval or (np.nan, np.nan)), truth))

    @property
    def covered(self):
        _, low, high, truth = np.array(self).T
        return (low <= truth) & (truth <= high)


def tally_tmmd(model, truth, videos, paired, replicates, seed, frames=0, permutations=199):
    """TMMD with a shift, and p-values without; the first ``frames`` replicates also groupless."""
    tallies, rejected = defaultdict(Tally), defaultdict(list)
    for r in range(replicates):
        rng = rng_for(seed, "metric coverage", f"{videos} {paired} {r}")
        for shift, name in ((1.0, "TMMD"), (0.0, "TMMD null")):
            sets = draw_pair(model, rng, videos, paired, shift)
            options = {"seed": r, "permutations": 0 if shift else permutations}
            scores = {"videos": tmmd(*sets, **options)}
            if r < frames:
                bare = [FeatureSet(s.ids, s.features) for s in sets]
                scores["frames"] = tmmd(*bare, preset="paper", **options)
            for unit, score in scores.items():
                tally = tallies[name + (", frames" if unit == "frames" else "")]
                tally.add(score.value, score.interval, truth.tmmd[shift])
                if not shift and permutations:
                    rejected[unit].append(score.details["p_value"] <= 0.05)
    return tallies, rejected


def tally_scenes(model, truth, scenes, replicates, seed):
    """TMMD of two sets with the same ids and no groups: row k of both is of scene k."""
    tallies = defaultdict(Tally)
    for r in range(replicates):
        rng = rng_for(seed, "metric coverage", f"scenes {scenes} {r}")
        real = model.videos(rng, scenes)
        shared = like(model, rng, real)
        labels, one = rng.integers(len(model.classes), size=scenes), np.ones(scenes, dtype=int)
        ids = [str(k) for k in range(scenes)]
        y, _ = model.frames(rng, real, labels, one)
        for shift in (0.0, 1.0):
            x, _ = model.frames(rng, shared, labels, one, shift)
            for preset in (None, "paper"):
                score = tmmd(x, y, ids=ids, reference_ids=ids, preset=preset, permutations=0)
                tallies[shift, preset].add(score.value, score.interval, truth.tmmd[shift])
    return tallies


def tally_halves(model, truth, videos, replicates, seed, lengths=FRAMES):
    """What I-, CI- and D-TMMD say whatever the numbers of frames and videos."""
    tallies = defaultdict(Tally)
    for r in range(replicates):
        rng = rng_for(seed, "metric coverage", f"halves {videos} {r}")
        mixed = i_tmmd(draw_pair(model, rng, videos, False, 0.0, lengths)[0]).details
        made = draw_classes(model, rng, videos, lengths)
        ci, d = ci_tmmd(made).details, d_tmmd(made).details
        tallies["I-TMMD: E"].add(mixed["E"], mixed["E_interval"], truth.mixture)
        tallies["CI-TMMD: E"].add(ci["E"], ci["E_interval"], truth.within.mean())
        tallies["D: inter"].add(*d["inter"].values(), truth.between.mean())
        if d["E_ratio"] is not None:  # given where the classes are apart
            ratio = truth.within.mean() / truth.between.mean()
            tallies["D: E_ratio"].add(d["E_ratio"], d["E_ratio_interval"], ratio)
    return tallies


def tally_difference(model, truth, videos, replicates, seed, shifts=(1.0, SECOND)):
    """Two generators on the same videos: the difference of TMMD; unpaired width / paired width."""
    tally, ratios = Tally(), []
    for r in range(replicates):
        rng = rng_for(seed, "metric coverage", f"difference {videos} {r}")
        labels, real = rng.integers(len(model.classes), size=videos), model.videos(rng, videos)
        sizes, shared = rng.integers(FRAMES[0], FRAMES[1] + 1, size=videos), like(model, rng, real)
        a, b, reference = (
            feature_set(*model.frames(rng, effects, labels, sizes, shift), labels, "v")
            for effects, shift in ((shared, shifts[0]), (shared, shifts[1]), (real, 0.0))
        )
        result = compare({"a": a, "b": b}, reference, permutations=0)
        delta, scores = result.differences[0], [s for s in result.scores if s.metric == "TMMD"]
        tally.add(delta.value, delta.interval, truth.tmmd[shifts[0]] - truth.tmmd[shifts[1]])
        unpaired = np.hypot(*[s.interval[1] - s.interval[0] for s in scores])
        ratios.append(unpaired / (delta.interval[1] - delta.interval[0]))
    return tally, float(np.median(ratios))


def cell(tally):
    """``94.7 % (-0.0136)``: the share of intervals that hold the truth, and the bias."""
    value, _, _, truth = np.array(tally).T
    return f"{100 * np.mean(tally.covered):.1f} % ({np.nanmean(value - truth):+.4f})"


def misses(replicates, videos=(10, 20, 40)):
    """Intervals of TMMD that hold the truth, lie below it, and lie above it, in percent."""
    model, rows = Model.make(), defaultdict(list)
    truth = truth_of(model)
    for count in videos:
        for kind, pair in KINDS.items():
            tallies, _ = tally_tmmd(model, truth, count, pair, replicates, 0, permutations=0)
            for name in ("TMMD", "TMMD null"):
                _, low, high, exact = np.array(tallies[name]).T
                shares = np.stack([tallies[name].covered, high < exact, low > exact]).mean(axis=1)
                rows[f"{name}, {kind}"].append("{:.1f} ({:.1f}, {:.1f})".format(*100 * shares))
    return table("videos", videos, rows)


def table(unit, counts, rows):
    """Cells by name, a column for each number of ``unit``."""
    lines = [["", *(f"{count} {unit}" for count in counts)], ["---"] * (len(counts) + 1)]
    lines += [[name, *cells] for name, cells in rows.items()]
    return [*(f"| {' | '.join(line)} |" for line in lines), ""]


def tables(replicates, videos=(12, 24, 40)):
    """Both tables, as lines."""
    model = Model.make()
    truth, frames = truth_of(model), replicates // 2
    rows, scenes = defaultdict(list), defaultdict(list)
    for count in videos:
        for kind, pair in KINDS.items():
            tallies, rejected = tally_tmmd(model, truth, count, pair, replicates, 0, frames)
            for name, tally in tallies.items():
                rows[f"{name}, {kind}"].append(cell(tally))
            for unit, hits in rejected.items():
                name = f"true null rejected at 5 %, {unit}, {kind}"
                rows[name].append(f"{100 * np.mean(hits):.1f} %")
        for lengths, suffix in ((FRAMES, ""), (UNEQUAL, ", videos of 1 to 60 frames")):
            for name, tally in tally_halves(model, truth, count, replicates, 0, lengths).items():
                rows[name + suffix].append(cell(tally))
        tally, ratio = tally_difference(model, truth, count, frames, 0)
        rows["difference of TMMD, paired"].append(cell(tally))
        rows["unpaired width of a difference over the paired one"].append(f"{ratio:.1f}")
    for count in SCENES:
        for (shift, preset), tally in tally_scenes(model, truth, count, frames, 0).items():
            scenes[f"TMMD{'' if shift else ' null'}, {preset or 'default'}"].append(cell(tally))
    return [*table("videos", videos, rows), *table("scenes", SCENES, scenes)]


if __name__ == "__main__":
    replicates = int(sys.argv[1]) if len(sys.argv) > 1 else 600
    if "--misses" in sys.argv:
        print("\n".join(misses(replicates)))
        sys.exit()
    print("# Whether the error bars of the metrics hold\n")
    print(
        f"Written by `python benchmarks/metric_coverage.py {replicates}`, "
        f"{datetime.datetime.now(tz=datetime.UTC).date()}, seed 0. Synthetic features (the model "
        "stands in the script), sigma = 10, values times 1000. A cell is the share of replicates "
        "whose 95 % interval holds the truth (known to two points), and the bias in brackets. "
        "Paired: generated and real frames are of the same videos; null: no difference; frames: no "
        "groups given, preset paper. Scenes: one generated and one real image of each id, no "
        "groups; the default excludes the pairs of one id, preset paper does not.\n"
    )
    print("\n".join(tables(replicates)).rstrip())

"""What each of the four metrics responds to, on synthetic features whose structure is known.

    python benchmarks/metric_responses.py                 # print the tables, about four minutes
    python benchmarks/metric_responses.py --write docs/studies/metric_responses.md
    python benchmarks/metric_responses.py --draws 2       # a quick look

Frames are drawn as ``normalized(mean + class + video + frame)``, Gaussian effects in 64 dimensions,
unit-norm rows: ten classes, eight videos of each, ten frames of a video. The reference is drawn so;
a generator is scored on the same videos, whose effects it shares with a correlation of 0.7, and
deviates in one respect.
"""

import argparse
import datetime
import itertools
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from palpate.core import FeatureSet, rng_for
from palpate.metrics import ci_tmmd, d_tmmd, distance, i_tmmd, tmmd

WIDTH, CLASSES, VIDEOS, FRAMES = 64, 10, 8, 10
FIDELITY = 0.7
SPREAD = {"class": 0.45, "video": 0.4, "frame": 0.4}
GENERATORS = {
    "good": {},
    "shifted mean": {"shift": 0.35},
    "half the spread": {"class": 0.225, "video": 0.2, "frame": 0.2},
    "more frame noise": {"frame": 0.7},
    "little frame noise": {"frame": 0.1},
    "memorized videos: one a class": {"video": 0.0, "frame": 0.1},
    "unstable over videos": {"video": 0.7},
    "classes confused: half the labels wrong": {"confused": 0.5},
    "classes indistinguishable": {"class": 0.0},
    "collapsed, a point a class": {"video": 0.0, "frame": 0.0},
    "collapsed to one point": {"class": 0.0, "video": 0.0, "frame": 0.0},
}
REFERENCE_FREE = {"I": i_tmmd, "CI": ci_tmmd, "D": d_tmmd}
SIGMAS = (50.0, 10.0, 3.0, 1.0, 0.5, "median", "multi")


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def draw(rng, change=None, videos=VIDEOS, frames=FRAMES, classes=CLASSES):
    """(generated, reference) feature sets; ``change`` is an entry of :data:`GENERATORS`."""
    model = {"shift": 0.0, "confused": 0.0} | SPREAD | (change or {})
    noise = lambda n: rng.normal(size=(n, WIDTH)) / np.sqrt(WIDTH)
    mean, centers = unit(rng.normal(size=WIDTH)), unit(rng.normal(size=(classes, WIDTH)))
    label = np.repeat(np.arange(classes), videos)
    real = noise(len(label))
    made = FIDELITY * real + np.sqrt(1 - FIDELITY**2) * noise(len(label))
    video = np.repeat(np.arange(len(label)), frames)
    away, shown = unit(rng.normal(size=WIDTH)), label[video].copy()
    wrong = rng.random(len(shown)) < model["confused"]
    shown[wrong] = rng.integers(classes, size=int(wrong.sum()))

    def rows(spread, center, effects):
        x = mean + spread["class"] * center + spread["video"] * effects[video]
        return x + spread["frame"] * noise(len(video))

    generated = unit(rows(model, centers[shown], made) + model["shift"] * away)
    reference = unit(rows(SPREAD, centers[label[video]], real))
    ids = [f"s{k:05d}" for k in rng.permutation(len(video))]  # tells nothing about the video
    columns = [str(c) for c in label[video]], [f"v{v}" for v in video]
    return tuple(FeatureSet(ids, x, *columns) for x in (generated, reference))


def by_video(made):
    """The same set with ids in the order of class, video and frame, which ``ordered`` halves "
    "cut."""
    return FeatureSet(
        [f"s{k:05d}" for k in range(len(made.ids))], made.features, made.labels, made.groups
    )


def cell(values, digits=3):
    values = np.array([np.nan if v is None else v for v in values], dtype=np.float64)
    missing = int((~np.isfinite(values)).sum())
    if missing == len(values):
        return "undefined"
    tail = f" (undefined {missing} of {len(values)})" if missing else ""
    return f"{np.nanmean(values):.{digits}f} ± {np.nanstd(values):.{digits}f}{tail}"


def table(head, rows):
    """Lines of a Markdown table."""
    cells = [head, ["---"] * len(head), *rows]
    return [*(f"| {' | '.join(map(str, row))} |" for row in cells), ""]


def reference_free(made, preset):
    """Column -> value of the metrics that need no reference."""
    scores = {name: metric(made, preset=preset) for name, metric in REFERENCE_FREE.items()}
    values = {f"{name}, {preset}": score.value for name, score in scores.items()}
    if preset == "grouped":
        values["z"] = scores["I"].details["z"]
        for name, key in (("I", "E"), ("CI", "E"), ("D", "E_ratio")):
            values[f"{name}: {key}"] = scores[name].details[key]
    return values


def generator_tables(draws, seed, report):
    """Every generator under every preset."""
    columns = {name: defaultdict(list) for name in GENERATORS}
    for name, change in GENERATORS.items():
        for k in range(draws):
            made, real = draw(rng_for(seed, "metric responses", f"draw {k}"), change)
            values = {"TMMD": tmmd(made, real, permutations=0).value}
            values["TMMD, multi"] = tmmd(made, real, sigma="multi", permutations=0).value
            for preset in ("paper", "cmmd", "grouped"):
                values |= reference_free(made, preset)
            values |= reference_free(by_video(made), "paper-tables")
            for column, value in values.items():
                columns[name][column].append(value)
        report(name)
    grouped = {"TMMD": 2, "TMMD, multi": 1, "I, grouped": 3, "I: E": 2, "z": 1}
    grouped |= {"CI, grouped": 3, "CI: E": 2, "D, grouped": 3, "D: E_ratio": 2}
    others = {f"{m}, {p}": 4 for p in ("paper", "cmmd", "paper-tables") for m in REFERENCE_FREE}
    lines = []
    for title, digits in (("Whole videos (`grouped`)", grouped), ("The other presets", others)):
        rows = [
            [name, *(cell(values[column], d) for column, d in digits.items())]
            for name, values in columns.items()
        ]
        lines += [f"### {title}", "", *table(["generator", *digits], rows)]
    return lines


def all_halves(n=8, seed=0):
    """Largest |mean| of unbiased dist^2 over all halves of n samples, of several data sets.

    And that of biased dist^2 minus its closed form.
    """
    worst = [0.0, 0.0]
    for k in range(5):
        rng = rng_for(seed, "metric responses", f"all halves {k}")
        x = unit(rng.normal(size=(n, 6)) + 3 * k * rng.normal(size=6))
        halves = [np.array(h) for h in itertools.combinations(range(n), n // 2) if 0 in h]
        kernel = np.exp(-((x[:, None] - x[None]) ** 2).sum(axis=-1) / 200)
        off = kernel[~np.eye(n, dtype=bool)].mean()
        for j, (estimator, expected) in enumerate(
            (("unbiased", 0.0), ("biased", 1000 * 2 / (n // 2) * (1 - off)))
        ):
            pairs = [(x[h], x[np.setdiff1d(np.arange(n), h)]) for h in halves]
            mean = np.mean([distance(*pair, estimator=estimator).value for pair in pairs])
            worst[j] = max(worst[j], abs(float(mean) - expected))
    return worst


def halves_table(halvings, seed):
    """Random halves of several generators: mean and spread over halvings, and closed forms."""
    names = ("good", "unstable over videos", "classes indistinguishable")
    rows = []
    for name in (*names, "memorized videos: one a class"):
        rng = rng_for(seed, "metric responses", "halves")
        made, _ = draw(rng, GENERATORS[name], videos=4, frames=5)
        scores = [i_tmmd(made, preset="paper", seed=k) for k in range(halvings)]
        biased = [i_tmmd(made, preset="cmmd", seed=k) for k in range(halvings // 8)]
        values, whole = np.array([s.value for s in scores]), i_tmmd(made)
        row = [name, f"{values.mean():+.5f} ± {values.std() / np.sqrt(halvings):.5f}"]
        row += [f"{values.std():.5f}", f"{np.ptp(scores[0].null) / (2 * 1.96):.5f}"]
        row += [f"{np.mean([s.value for s in biased]):.4f}"]
        row += [f"{biased[0].details['dispersion']:.4f}", f"{whole.value:.4f}"]
        rows.append([*row, f"{whole.details['z']:.1f}"])
    head = ["generator", "unbiased: mean over halvings ± its error", "sd, observed"]
    head += ["sd, closed form", "biased: mean", "closed form", "whole videos", "z"]
    return table(head, rows)


def size_table(draws, seed):
    """What depends on the numbers of videos and frames."""
    columns = ("I, paper", "I, cmmd", "I, grouped", "I: E", "z", "CI, cmmd", "CI, grouped")
    columns += ("CI: E", "D, cmmd", "D, grouped", "D: E_ratio")
    rows = []
    for videos, frames in ((2, 10), (4, 10), (8, 10), (16, 10), (8, 3), (8, 20)):
        values = defaultdict(list)
        for k in range(draws):
            rng = rng_for(seed, "metric responses", f"size {k}")
            made, _ = draw(rng, videos=videos, frames=frames)
            for preset in ("paper", "cmmd", "grouped"):
                for column, value in reference_free(made, preset).items():
                    values[column].append(value)
        row = [f"{videos}, {frames}", videos * frames * CLASSES]
        rows.append([*row, *(cell(values[column]) for column in columns)])
    return table(["videos a class, frames", "n", *columns], rows)


def modes(rng, count, n, dims=256, noise=0.02):
    """n unit-norm rows around ``+-e_1 .. +-e_(count/2)`` at random: the expected mean is 0."""
    at = rng.integers(count, size=n)
    x = noise * rng.normal(size=(n, dims)) / np.sqrt(dims)
    x[np.arange(n), at // 2] += np.where(at % 2, -1.0, 1.0)
    return unit(x)


def flat(x, prefix):
    """A set without labels and groups."""
    return FeatureSet([f"{prefix}{k}" for k in range(len(x))], x)


def sigma_tables(seed):
    """Collapse at the same mean, a shift of the mean, and the scale of every metric, by sigma."""
    rng = rng_for(seed, "metric responses", "modes")
    real, away = modes(rng, 512, 1024), unit(rng.normal(size=256))
    cases = {f"{count} of 512 modes": modes(rng, count, 1024) for count in (512, 256, 64, 8)}
    cases["512 modes, mean moved by 0.1"] = unit(modes(rng, 512, 1024) + 0.1 * away)
    rows = []
    for name, made in cases.items():
        shift = 9.9 * float(((made.mean(axis=0) - real.mean(axis=0)) ** 2).sum())
        sets = flat(made, "g"), flat(real, "r")
        scores = [tmmd(*sets, sigma=s, permutations=99) for s in SIGMAS]
        cells = (f"{s:.3f} (p {s.details['p_value']:.2f})" for s in scores)
        rows.append([name, f"{shift:.3f}", *cells])
    lines = table(["generator", "‖Δ mean‖² x 9.9", *(f"sigma {s}" for s in SIGMAS)], rows)
    made, reference = draw(rng_for(seed, "metric responses", "sigma"), {"shift": 0.35})
    metrics = {
        "TMMD": lambda s: tmmd(made, reference, sigma=s, permutations=0).value * s**2 / 100,
        "I": lambda s: i_tmmd(made, sigma=s).value * s**2 / 100,
        "I: E": lambda s: i_tmmd(made, sigma=s).details["E"] * s**2 / 100,
        "CI: E": lambda s: ci_tmmd(made, sigma=s).details["E"] * s**2 / 100,
        "D (not scaled)": lambda s: d_tmmd(made, sigma=s).value,
        "D: E_ratio (not scaled)": lambda s: d_tmmd(made, sigma=s).details["E_ratio"],
    }
    numbers = [s for s in SIGMAS if not isinstance(s, str)]
    rows = [[name, *(f"{f(s):.3f}" for s in numbers)] for name, f in metrics.items()]
    return lines + table(["metric, times sigma² / 100", *(f"sigma {s:g}" for s in numbers)], rows)


def tables(draws, halvings, seed, report):
    worst = all_halves()
    report("halves enumerated")
    return [
        "## What each metric responds to",
        "",
        f"{CLASSES} classes, {VIDEOS} videos each, {FRAMES} frames a video; mean ± standard "
        f"deviation over {draws} draws of everything. Lower is called better. For `paper-tables` "
        "the ids are in the order of class, video and frame, as sorted file names are; for the "
        "others they are shuffled.",
        "",
        *generator_tables(draws, seed, report),
        "## Random halves carry no signal",
        "",
        "Over *all* halves of eight samples, five data sets: the mean of the unbiased dist² is 0 "
        f"to {worst[0]:.0e}, that of the biased one is its closed form (2/m) 1000 (1 - mean k) to "
        f"{worst[1]:.0e}. Below: {halvings} random halvings of 200 samples (biased: an eighth of "
        "that) of one data set.",
        "",
        *halves_table(halvings, seed),
        "## Numbers of videos and frames",
        "",
        f"The good generator; mean ± standard deviation over {draws} draws.",
        "",
        *size_table(draws, seed),
        "## What a bandwidth sees",
        "",
        "TMMD (unbiased, no groups, 1024 samples in 256 dimensions) of a generator that shows "
        "some of 512 modes `±e_k`, each as likely as the others: the expected mean is 0 for all "
        "of them. In brackets the p-value of a permutation test with 99 relabelings, so that "
        "0.01 is the least. The median distance and its multiples are those of the reference.",
        "",
        *sigma_tables(seed),
    ]


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--halvings", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    options = parser.parse_args()
    start = time.process_time()

    def report(text):
        print(f"{time.process_time() - start:6.0f} s  {text}", file=sys.stderr, flush=True)

    body = tables(options.draws, options.halvings, options.seed, report)
    command = "python benchmarks/metric_responses.py"
    command += f" --write {options.write}" if options.write else ""
    command += f" --draws {options.draws} --halvings {options.halvings} --seed {options.seed}"
    head = [
        "# What the metrics respond to",
        "",
        f"Written by `{command}`, {datetime.datetime.now(tz=datetime.UTC).date()}. Synthetic "
        f"unit-norm features of {WIDTH} dimensions with effects of class, video and frame; the "
        "script describes the model. sigma = 10 and scale 1000 unless said.",
        "",
    ]
    text = "\n".join([*head, *body]).rstrip() + "\n"
    if options.write:
        options.write.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()

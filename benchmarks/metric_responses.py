"""What each of the four metrics responds to, on synthetic features whose structure is known.

    python benchmarks/metric_responses.py                                    # prints the tables, about four minutes on one core
    python benchmarks/metric_responses.py --write docs/studies/metric_responses.md   # writes them
    python benchmarks/metric_responses.py --draws 2                          # a quick look

Frames are drawn as ``normalized(mean + class + video + frame)``, Gaussian effects in 64 dimensions, unit-norm rows: ten classes, eight videos of each, ten
frames of a video. The reference is drawn so; a generator is scored on the same videos, whose effects it shares with a correlation of 0.7, and
deviates in one respect.
"""

import argparse
import datetime
import itertools
import sys
import time
from pathlib import Path

import numpy as np

from palpate.core import FeatureSet, rng_for
from palpate.metrics import ci_tmmd, d_tmmd, i_tmmd, mmd2, tmmd

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
PRESETS = ("paper", "cmmd", "paper-tables", "grouped")


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def draw(rng, change=None, videos=VIDEOS, frames=FRAMES, classes=CLASSES):
    """(generated, reference) feature sets; ``change`` is an entry of :data:`GENERATORS`."""
    of = {"shift": 0.0, "confused": 0.0} | SPREAD | (change or {})
    noise = lambda n: rng.normal(size=(n, WIDTH)) / np.sqrt(WIDTH)  # noqa: E731
    mean, centers = unit(rng.normal(size=WIDTH)), unit(rng.normal(size=(classes, WIDTH)))
    label = np.repeat(np.arange(classes), videos)
    real = noise(len(label))
    made = FIDELITY * real + np.sqrt(1 - FIDELITY**2) * noise(len(label))
    index = np.repeat(np.arange(len(label)), frames)
    away = unit(rng.normal(size=WIDTH))
    shown = label[index].copy()
    wrong = rng.random(len(shown)) < of["confused"]
    shown[wrong] = rng.integers(classes, size=int(wrong.sum()))
    rows = (
        mean
        + of["shift"] * away
        + of["class"] * centers[shown]
        + of["video"] * made[index]
        + of["frame"] * noise(len(index))
    )
    true = (
        mean
        + SPREAD["class"] * centers[label[index]]
        + SPREAD["video"] * real[index]
        + SPREAD["frame"] * noise(len(index))
    )
    ids = [f"s{k:05d}" for k in rng.permutation(len(index))]  # a name says nothing of the video
    names = [f"v{v}" for v in index]
    return tuple(
        FeatureSet(ids, unit(x), [str(c) for c in label[index]], names) for x in (rows, true)
    )


def by_video(made):
    """The same set with names in the order of class, video and frame: what ``ordered`` halves cut."""
    return FeatureSet(
        [f"s{k:05d}" for k in range(len(made.ids))], made.features, made.labels, made.groups
    )


def cell(values, digits=3):
    values = np.array([np.nan if v is None else v for v in values], dtype=np.float64)
    if not np.isfinite(values).any():
        return "undefined"
    tail = (
        ""
        if np.isfinite(values).all()
        else f" (undefined {int((~np.isfinite(values)).sum())} of {len(values)})"
    )
    return f"{np.nanmean(values):.{digits}f} ± {np.nanstd(values):.{digits}f}{tail}"


def generator_tables(draws, seed, say):
    """Every generator under every preset."""
    found = {}
    for name, change in GENERATORS.items():
        for k in range(draws):
            made, real = draw(rng_for(seed, "metric responses", f"draw {k}"), change)
            row = found.setdefault(name, {})
            put = lambda column, value: row.setdefault(column, []).append(value)  # noqa: B023, E731
            put("TMMD", tmmd(made, real, permutations=0).value)
            put("TMMD, multi", tmmd(made, real, sigma="multi", permutations=0).value)
            for preset in PRESETS:
                given = by_video(made) if preset == "paper-tables" else made
                scores = [f(given, preset=preset) for f in (i_tmmd, ci_tmmd, d_tmmd)]
                for metric, score in zip(("I", "CI", "D"), scores, strict=True):
                    put(f"{metric}, {preset}", score.value)
                if preset == "grouped":
                    put("I: E", scores[0].details["E"])
                    put("z", scores[0].details["z"])
                    put("CI: E", scores[1].details["E"])
                    put("D: E_ratio", scores[2].details["E_ratio"])
        say(name)
    wide = [
        ("TMMD", 2),
        ("TMMD, multi", 1),
        ("I, grouped", 3),
        ("I: E", 2),
        ("z", 1),
        ("CI, grouped", 3),
        ("CI: E", 2),
        ("D, grouped", 3),
        ("D: E_ratio", 2),
    ]
    paper = [(f"{m}, {p}", 4) for p in ("paper", "cmmd", "paper-tables") for m in ("I", "CI", "D")]
    lines = []
    for title, columns in (
        ("### Whole videos (`grouped`)", wide),
        ("### The other presets", paper),
    ):
        lines += [
            title,
            "",
            f"| generator | {' | '.join(name for name, _ in columns)} |",
            "|---" * (len(columns) + 1) + "|",
        ]
        lines += [
            f"| {name} | {' | '.join(cell(row[column], digits) for column, digits in columns)} |"
            for name, row in found.items()
        ]
        lines.append("")
    return lines


def all_halves(n=8, seed=0):
    """Largest |mean| of unbiased dist^2 over all halves of n samples, and of biased minus its closed form, over several data sets."""
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
            mean = np.mean(
                [mmd2(x[h], x[np.setdiff1d(np.arange(n), h)], estimator=estimator) for h in halves]
            )
            worst[j] = max(worst[j], abs(float(mean) - expected))
    return worst


def halves_table(halvings, seed):
    """Random halves of several generators: mean and spread over halvings, beside the closed forms and whole videos."""
    lines = [
        "| generator | unbiased: mean over halvings ± its error | sd, observed | sd, closed form | biased: mean | closed form | whole videos | z |",
        "|---|" + "---|" * 7,
    ]
    for name in (
        "good",
        "unstable over videos",
        "classes indistinguishable",
        "memorized videos: one a class",
    ):
        made, _ = draw(
            rng_for(seed, "metric responses", "halves"), GENERATORS[name], videos=4, frames=5
        )
        scores = [i_tmmd(made, preset="paper", seed=k) for k in range(halvings)]
        values = np.array([s.value for s in scores])
        biased = [i_tmmd(made, preset="cmmd", seed=k) for k in range(halvings // 8)]
        whole = i_tmmd(made)
        sd = (scores[0].null[1] - scores[0].null[0]) / (2 * 1.96)
        lines.append(
            f"| {name} | {values.mean():+.5f} ± {values.std() / np.sqrt(halvings):.5f} | {values.std():.5f} | {sd:.5f} "
            f"| {np.mean([s.value for s in biased]):.4f} | {biased[0].details['dispersion']:.4f} | {whole.value:.4f} | {whole.details['z']:.1f} |"
        )
    return [*lines, ""]


def size_table(draws, seed):
    """Numbers of videos and frames: what depends on them."""
    columns = (
        "I, paper",
        "I, cmmd",
        "I, grouped",
        "I: E",
        "z",
        "CI, cmmd",
        "CI, grouped",
        "CI: E",
        "D, cmmd",
        "D, grouped",
        "D: E_ratio",
    )
    lines = [
        f"| videos a class, frames | n | {' | '.join(columns)} |",
        "|---" * (len(columns) + 2) + "|",
    ]
    for videos, frames in ((2, 10), (4, 10), (8, 10), (16, 10), (8, 3), (8, 20)):
        row = {name: [] for name in columns}
        for k in range(draws):
            made, _ = draw(
                rng_for(seed, "metric responses", f"size {k}"), videos=videos, frames=frames
            )
            for preset in ("paper", "cmmd", "grouped"):
                for metric, score in (
                    ("I", i_tmmd(made, preset=preset)),
                    ("CI", ci_tmmd(made, preset=preset)),
                    ("D", d_tmmd(made, preset=preset)),
                ):
                    if f"{metric}, {preset}" in row:
                        row[f"{metric}, {preset}"].append(score.value)
                    for key, name in (
                        ("E", f"{metric}: E"),
                        ("E_ratio", "D: E_ratio"),
                        ("z", "z" if metric == "I" else ""),
                    ):
                        if (
                            preset == "grouped"
                            and name in row
                            and score.details.get(key) is not None
                        ):
                            row[name].append(score.details[key])
        n = videos * frames * CLASSES
        lines.append(
            f"| {videos}, {frames} | {n} | {' | '.join(cell(row[name]) for name in columns)} |"
        )
    return [*lines, ""]


SIGMAS = (50.0, 10.0, 3.0, 1.0, 0.5, "median", "multi")


def modes(rng, count, n, dims=256, noise=0.02):
    """n unit-norm rows around ``+-e_1 .. +-e_(count/2)``, drawn at random: the expected mean is 0 whatever the count."""
    at = rng.integers(count, size=n)
    x = noise * rng.normal(size=(n, dims)) / np.sqrt(dims)
    x[np.arange(n), at // 2] += np.where(at % 2, -1.0, 1.0)
    return unit(x)


def flat(x, prefix):
    return FeatureSet([f"{prefix}{k}" for k in range(len(x))], x)


def sigma_tables(seed):
    """Collapse from 512 modes to fewer at the same mean, a shift of the mean, and the scale of every metric, by bandwidth."""
    rng = rng_for(seed, "metric responses", "modes")
    real = flat(modes(rng, 512, 1024), "r")
    away = unit(rng.normal(size=256))
    cases = {
        f"{count} of 512 modes": flat(modes(rng, count, 1024), "g") for count in (512, 256, 64, 8)
    }
    cases["512 modes, mean moved by 0.1"] = flat(unit(modes(rng, 512, 1024) + 0.1 * away), "g")
    lines = [
        f"| generator | ‖Δ mean‖² x 9.9 | {' | '.join(f'sigma {s}' for s in SIGMAS)} |",
        "|---" * (len(SIGMAS) + 2) + "|",
    ]
    for name, made in cases.items():
        shift = 9.9 * float(((made.features.mean(axis=0) - real.features.mean(axis=0)) ** 2).sum())
        scores = [tmmd(made, real, sigma=s, permutations=99) for s in SIGMAS]
        cells = [f"{s.value:.3f} (p {s.details['p_value']:.2f})" for s in scores]
        lines.append(f"| {name} | {shift:.3f} | {' | '.join(cells)} |")
    made, reference = draw(rng_for(seed, "metric responses", "sigma"), {"shift": 0.35})
    lines += [
        "",
        f"| metric, times sigma² / 100 | {' | '.join(f'sigma {s:g}' for s in SIGMAS if not isinstance(s, str))} |",
        "|---" * len(SIGMAS[:-2]) + "|---|",
    ]
    ask = {
        "TMMD": lambda s: tmmd(made, reference, sigma=s, permutations=0).value * s**2 / 100,
        "I": lambda s: i_tmmd(made, sigma=s).value * s**2 / 100,
        "I: E": lambda s: i_tmmd(made, sigma=s).details["E"] * s**2 / 100,
        "CI: E": lambda s: ci_tmmd(made, sigma=s).details["E"] * s**2 / 100,
        "D (not scaled)": lambda s: d_tmmd(made, sigma=s).value,
        "D: E_ratio (not scaled)": lambda s: d_tmmd(made, sigma=s).details["E_ratio"],
    }
    lines += [
        f"| {name} | {' | '.join(f'{f(s):.3f}' for s in SIGMAS if not isinstance(s, str))} |"
        for name, f in ask.items()
    ]
    return [*lines, ""]


def tables(draws, halvings, seed, say):
    worst = all_halves()
    say("halves enumerated")
    lines = [
        "## What each metric responds to",
        "",
        f"{CLASSES} classes, {VIDEOS} videos each, {FRAMES} frames a video; mean ± standard deviation over {draws} draws of everything. Lower is called better. For `paper-tables` the ids are in "
        "the order of class, video and frame, as sorted file names are; for the others they are shuffled.",
        "",
        *generator_tables(draws, seed, say),
        "## Random halves carry no signal",
        "",
        f"Over *all* halves of eight samples, five data sets: the mean of the unbiased dist² is 0 to {worst[0]:.0e}, that of the biased one is its closed form (2/m) 1000 (1 - mean k) "
        f"to {worst[1]:.0e}. Below: {halvings} random halvings of 200 samples (biased: an eighth of that) of one data set.",
        "",
        *halves_table(halvings, seed),
        "## Numbers of videos and frames",
        "",
        f"The good generator; mean ± standard deviation over {draws} draws.",
        "",
        *size_table(draws, seed),
    ]
    say("sizes")
    lines += [
        "## What a bandwidth sees",
        "",
        "TMMD (unbiased, no groups, 1024 samples in 256 dimensions) of a generator that shows some of 512 modes `±e_k`, each as likely as the others: the expected mean is 0 for all of them. In brackets the p-value of a "
        "permutation test with 99 relabelings, so that 0.01 is the least. The median distance and its multiples are those of the reference.",
        "",
        *sigma_tables(seed),
    ]
    say("sigma")
    return lines


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--halvings", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    asked = parser.parse_args()
    started = time.process_time()
    say = lambda text: print(
        f"{time.process_time() - started:6.0f} s  {text}", file=sys.stderr, flush=True
    )
    body = tables(asked.draws, asked.halvings, asked.seed, say)
    command = "python benchmarks/metric_responses.py" + (
        f" --write {asked.write}" if asked.write else ""
    )
    head = [
        "# What the metrics respond to",
        "",
        f"Written by `{command} --draws {asked.draws} --halvings {asked.halvings} --seed {asked.seed}`, {datetime.datetime.now(tz=datetime.UTC).date()}. Synthetic unit-norm features of {WIDTH} dimensions "
        "with effects of class, video and frame; the model stands in that script. sigma = 10 and scale 1000 unless said.",
        "",
    ]
    text = "\n".join([*head, *body]).rstrip() + "\n"
    if asked.write:
        asked.write.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()

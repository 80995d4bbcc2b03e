"""Which metric ranks controlled degradations of touches in the right order: Kendall's tau over several procedural worlds.

    python benchmarks/metric_degradations.py                                       # prints the tables, about ten minutes on one core
    python benchmarks/metric_degradations.py --write docs/studies/metric_degradations.md   # writes them
    python benchmarks/metric_degradations.py --worlds 3                            # a quick look

A world has ten materials with eight videos each (one object a video): four for testing, and four *training* videos, from which alone a degradation
takes other touches. Of the twelve frames of a test video (six touches of two frames) touches 1, 3, 5 are the reference; the perfect generator shows
touches 2, 4, 6 of the same videos, sample by sample: the right surface on the right gel, another press. It is degraded in eleven ways at five
strengths each, and in one that is none (``new videos``); strength 0 is the perfect generator itself. Features are those of the shipped tactile encoder (``palpate/mini``), which has seen none of
these worlds. Pictures are compared on every twelfth pair, the same ones at all strengths.

Tau is Kendall's tau-b between the strengths 0 to 5 and a metric's values in one world, its sign turned so that +1 says: the stronger the
degradation, the worse the metric rates it. Each world gives one tau; a cell holds their mean, and its verdict uses the t interval over the worlds.
"""

import argparse
import datetime
import sys
import time
from pathlib import Path

import numpy as np
from degraded_touches import (
    FEATURES_ONLY,
    MATERIALS,
    MEANING,
    STRENGTHS,
    VIDEOS,
    degraded,
    make_scene,
)
from scipy import stats

from palpate.core import FeatureSet, rng_for
from palpate.encoders.encoder_set import EncoderSet
from palpate.metrics import (
    Polynomial,
    ci_tmmd,
    d_tmmd,
    distance,
    i_tmmd,
    measure_contacts,
    ms_ssim_per_image,
    psnr_per_image,
    ssim_per_image,
    tmmd,
)
from palpate.metrics.frechet import fid
from palpate.metrics.neighbors import prdc
from palpate.sim import VERSION

FIRST_SEED = 40_000
SPLITS = 8  # halvings of the real touches by video
PIXELS = 12  # every so many pairs are compared pixel by pixel
UP = (
    "precision",
    "recall",
    "density",
    "coverage",
    "PSNR",
    "SSIM",
    "MS-SSIM",
    "contact SSIM",
    "contact MS-SSIM",
    "contact PSNR",
    "contact IoU",
)
TESTS = ("TMMD", "TMMD, median", "TMMD, multi")
COLUMNS = {
    "against the reference": (
        "TMMD",
        "TMMD, median",
        "TMMD, multi",
        "TMMD, paper",
        "KID",
        "FID",
        "precision",
        "recall",
        "density",
        "coverage",
    ),
    "without a reference, lower taken as better": (
        "I, random",
        "I",
        "I: E",
        "CI: E",
        "D",
        "D: E_ratio",
    ),
    "without a reference, distance to the same on real touches": (
        "I: E, off the floor",
        "CI: E, off the floor",
        "D: E_ratio, off the floor",
    ),
    "picture by picture": (
        "PSNR",
        "SSIM",
        "MS-SSIM",
        "contact PSNR",
        "contact SSIM",
        "contact MS-SSIM",
        "contact residual",
        "contact IoU",
    ),
}
CONTROLS = {
    "perfect generator (other touches of the videos)": None,
    "wrong material": ("wrong material", 1.0),
    "new videos of the right material": ("new videos", 1.0),
    "memorized videos": ("memorized videos", 1.0),
    "blurred, 1 px": ("blur", 1.0),
    "blurred, 4 px": ("blur", 4.0),
    "empty gel": ("empty gel", 1.0),
    "one touch a material": ("class collapse", 1.0),
    "one touch": ("full collapse", 1.0),
}
HALVES = "real halves by video"


def feature_set(scene, features, rows=None):
    rows = np.arange(len(features)) if rows is None else rows
    return FeatureSet(
        [str(i) for i in rows],
        features[rows],
        [str(c) for c in scene.label[rows]],
        [str(v) for v in scene.video[rows]],
        "mini",
    )


def free_of_reference(made, kernel=10.0):
    """The three metrics that need no reference."""
    one, classes, ratio = (f(made, normalize=True, sigma=kernel) for f in (i_tmmd, ci_tmmd, d_tmmd))
    return {
        "I, random": i_tmmd(made, preset="paper", normalize=True).value,
        "I": one.value,
        "I: E": one.details["E"],
        "CI: E": classes.details["E"],
        "D": ratio.value,
        "D: E_ratio": ratio.details["E_ratio"],
    }


def against(made, real, permutations):
    """Metric that compares with a reference -> value, and -> p-value for those that are tests."""
    found, p = {}, {}
    for name, sigma in zip(TESTS, (10.0, "median", "multi"), strict=True):
        score = tmmd(made, real, sigma=sigma, normalize=True, permutations=permutations)
        found[name], p[name] = score.value, score.details["p_value"]
    found["TMMD, paper"] = tmmd(made, real, preset="paper", normalize=True, permutations=0).value
    found["KID"] = distance(
        made.features, real.features, kernel=Polynomial(), normalize=False
    ).value
    found["FID"] = fid(made, real, interval=False).value
    found |= dict(
        zip(
            ("precision", "recall", "density", "coverage"),
            (s.value for s in prdc(made, real)),
            strict=True,
        )
    )
    return found, p


def scores_of(scene, features, images, real, floor, permutations=199):
    """Metric -> value, and metric -> p-value for those that are tests."""
    made = feature_set(scene, features)
    found, p = against(made, real, permutations)
    found |= free_of_reference(made)
    found |= {
        f"{name}, off the floor": abs(
            np.nan if None in (found[name], floor[name]) else found[name] - floor[name]
        )
        for name in ("I: E", "CI: E", "D: E_ratio")
    }
    if images is not None:
        found |= picture_scores(scene, images)
    return {name: np.nan if value is None else float(value) for name, value in found.items()}, p


def picture_scores(scene, images):
    """Means over the pairs; a picture that was compared before is not compared again."""
    rows = []
    for k in range(0, len(images), PIXELS):
        key = k, images[k].tobytes()
        if key not in scene.compared:
            pair, real = images[k : k + 1], scene.real[k : k + 1]
            contacts = measure_contacts(pair, real, scene.empty[k : k + 1])
            contact = {name: values[0] for name, values in contacts.values.items()}
            whole = {"PSNR": psnr_per_image, "SSIM": ssim_per_image, "MS-SSIM": ms_ssim_per_image}
            scene.compared[key] = {
                name: each(pair, real)[0] for name, each in whole.items()
            } | contact
        rows.append(scene.compared[key])
    return {
        name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]
    }  # a touch without contact is left out


def run_world(scene, encoders, kinds=tuple(STRENGTHS), permutations=199):
    """``values[kind][metric]``: (6,) over the strengths; ``p[kind][test]``: (6,); the floor."""
    real = feature_set(scene, scene.features["real"])
    floor = free_of_reference(real)
    start = scores_of(scene, scene.features["made"], scene.made, real, floor, permutations)
    values, p = {}, {}
    for kind in kinds:
        rows = [
            start,
            *(
                scores_of(scene, *degraded(scene, kind, s, encoders), real, floor, permutations)
                for s in STRENGTHS[kind]
            ),
        ]
        values[kind] = {
            name: np.array([row[0].get(name, np.nan) for row in rows]) for name in start[0]
        }
        p[kind] = {name: np.array([row[1][name] for row in rows]) for name in TESTS}
    return values, p, {"floor": floor, HALVES: halves_control(scene, permutations)}


def halves_control(scene, permutations=199, splits=SPLITS):
    """Real touches of one half of the videos against those of the other: means over ``splits`` halvings, and all their p-values."""
    rows = []
    for k in range(splits):
        names = rng_for(scene.seed, "metric degradations", f"halves {k}").permutation(
            np.unique(scene.video)
        )
        first = np.isin(scene.video, names[::2])
        sets = [
            feature_set(scene, scene.features["real"], np.flatnonzero(half))
            for half in (first, ~first)
        ]
        rows.append(against(*sets, permutations))
    values, p = [row[0] for row in rows], [row[1] for row in rows]
    return {name: float(np.mean([v[name] for v in values])) for name in values[0]}, {
        name: [q[name] for q in p] for name in TESTS
    }


def tau_of(values, up):
    """Kendall's tau-b of the strengths with what the metric calls worse; 0 for a metric that does not move, NaN where it is not defined."""
    if not np.isfinite(values).all():
        return np.nan
    if np.ptp(values) <= 1e-9 * max(1.0, float(np.abs(values).max())):
        return 0.0
    return float(stats.kendalltau(np.arange(len(values)), -values if up else values).statistic)


def summary(taus):
    """Mean, and t interval over the worlds."""
    taus = np.asarray(taus)
    taus = taus[np.isfinite(taus)]
    if len(taus) < 2:
        return np.nan, (np.nan, np.nan)
    reach = stats.t.ppf(0.975, len(taus) - 1) * taus.std(ddof=1) / np.sqrt(len(taus))
    return float(taus.mean()), (float(taus.mean() - reach), float(taus.mean() + reach))


def verdict(mean, interval):
    """``yes``: ranks (lower end at least 0.8); ``mostly``: above 0.4; ``reversed``: upper end below -0.4; else ``no``."""
    if not np.isfinite(mean):
        return "-"
    if interval[0] >= 0.8:
        return "yes"
    if interval[0] >= 0.4:
        return "mostly"
    return "reversed" if interval[1] <= -0.4 else "no"


def tau_tables(results):
    """Tables of tau by degradation and metric."""
    lines, kept = [], {}
    for title, metrics in COLUMNS.items():
        lines += [
            f"### Metrics {title}",
            "",
            f"| degradation | {' | '.join(metrics)} |",
            "|---" * (len(metrics) + 1) + "|",
        ]
        for kind in STRENGTHS:
            if "picture" in title and kind in FEATURES_ONLY:
                continue
            cells = []
            for metric in metrics:
                mean, interval = summary(
                    [tau_of(values[kind][metric], metric in UP) for values, _, _ in results]
                )
                kept[kind, metric] = mean, interval, verdict(mean, interval)
                half = (interval[1] - interval[0]) / 2
                cells.append(
                    f"{mean:+.2f} ± {half:.2f} {kept[kind, metric][2]}"
                    if np.isfinite(mean)
                    else "undefined"
                )
            lines.append(f"| {kind} | {' | '.join(cells)} |")
        lines.append("")
    return lines, kept


def verdict_table(kept):
    """One row a metric: what it ranks, what it does not see, what it rewards."""
    lines = [
        "| metric | ranks right | mostly | not | reversed (calls the worse one better) |",
        "|---|---|---|---|---|",
    ]
    for metrics in COLUMNS.values():
        for metric in metrics:
            by = {
                word: [
                    kind for kind in STRENGTHS if kept.get((kind, metric), ("", "", ""))[2] == word
                ]
                for word in ("yes", "mostly", "no", "reversed")
            }
            by["no"] += [
                f"{kind} (undefined)"
                for kind in STRENGTHS
                if kept.get((kind, metric), ("", "", ""))[2] == "-"
            ]
            lines.append(
                f"| {metric} | {' | '.join(', '.join(found) or '-' for found in by.values())} |"
            )
    return [*lines, ""]


def detection_table(results):
    """Share of the worlds in which a permutation test finds a degradation at 5 %, by strength."""
    lines = [f"| degradation | {' | '.join(TESTS)} |", "|---" * (len(TESTS) + 1) + "|"]
    for kind in STRENGTHS:
        cells = [
            " ".join(
                f"{100 * np.mean([p[kind][t][k] <= 0.05 for _, p, _ in results]):.0f}"
                for k in range(6)
            )
            for t in TESTS
        ]
        lines.append(f"| {kind} | {' | '.join(cells)} |")
    found = [
        np.mean([p <= 0.05 for *_, rest in results for p in rest[HALVES][1][t]]) for t in TESTS
    ]
    return [*lines, f"| {HALVES} (null) | {' | '.join(f'{100 * v:.0f}' for v in found)} |", ""]


SHOWN = (
    "TMMD",
    "TMMD, multi",
    "KID",
    "FID",
    "precision",
    "coverage",
    "I: E",
    "CI: E",
    "D: E_ratio",
    "PSNR",
    "SSIM",
    "contact SSIM",
    "contact residual",
)


def control_values(results, metric):
    """Control -> one value a world."""
    found = {HALVES: [rest[HALVES][0].get(metric, np.nan) for *_, rest in results]}
    for name, place in CONTROLS.items():
        kind, at = (
            ("blur", 0) if place is None else (place[0], 1 + STRENGTHS[place[0]].index(place[1]))
        )
        found[name] = [values[kind][metric][at] for values, *_ in results]
    return {name: np.array(column) for name, column in found.items()}


def control_table(results):
    """Means over the worlds of the controls."""
    columns = {metric: control_values(results, metric) for metric in SHOWN}
    lines = [f"| control | {' | '.join(SHOWN)} |", "|---" * (len(SHOWN) + 1) + "|"]
    for name in (HALVES, *CONTROLS):
        cells = []
        for metric in SHOWN:
            column = columns[metric][name]
            cells.append("" if not np.isfinite(column).all() else f"{column.mean():.3f}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    floors = {
        name: np.mean([rest["floor"][name] for *_, rest in results])
        for name in ("I: E", "CI: E", "D: E_ratio")
    }
    cells = [f"{floors[metric]:.3f}" if metric in floors else "" for metric in SHOWN]
    return [*lines, f"| floor: the real touches | {' | '.join(cells)} |", ""]


def page(results, command, worlds):
    tables, kept = tau_tables(results)
    strengths = [
        f"| {kind} | {MEANING[kind]} | {', '.join(f'{s:g}' for s in STRENGTHS[kind])} |"
        for kind in STRENGTHS
    ]
    lines = [
        "# Which metric ranks degraded touches right",
        "",
        f"Written by `{command}`, world VERSION {VERSION}, {worlds} worlds of seeds {FIRST_SEED} to {FIRST_SEED + worlds - 1}, {datetime.datetime.now(tz=datetime.UTC).date()}. "
        "Synthetic touches and the small tactile encoder that ships: the table shows mechanisms, and its numbers are never compared with those of real data. How it is made stands in that script.",
        "",
        'Unless said: `preset="grouped"`, sigma = 10, scale 1000. `TMMD, paper` is the unbiased estimator (Eq. 2), `I, random` the paper\'s random halves; `FID` and the neighbor '
        f"metrics have {MATERIALS * VIDEOS * 6} samples a set and the encoder's 128 dimensions.",
        "",
        "| degradation | what | strengths 1 to 5 |",
        "|---|---|---|",
        *strengths,
        "",
        "## Verdict",
        "",
        "`ranks right`: the 95 % interval of the mean tau over the worlds lies above 0.8; `mostly`: above 0.4; `reversed`: below -0.4; `not`: anything else, "
        "blind metrics and those that the worlds do not agree on. `new videos` is no degradation: there `not` is the right answer.",
        "",
        *verdict_table(kept),
        "## Kendall's tau",
        "",
        "Mean over the worlds ± half of its 95 % interval. +1: every stronger degradation is rated worse.",
        "",
        *tables,
        "## How early a test sees it",
        "",
        "Percent of the worlds in which the permutation test of TMMD (whole videos, 199 relabelings) gives p <= 0.05, at strengths 0 to 5. Strength 0 is the perfect generator.",
        "",
        *detection_table(results),
        "## The controls",
        "",
        f"Means over the worlds; of real halves also over {SPLITS} halvings. A perfect generator is not at the best value of the picture metrics: another press of the same surface is another picture.",
        "",
        *control_table(results),
    ]
    return "\n".join(lines).rstrip() + "\n"


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    asked = parser.parse_args()
    encoders, results, started = EncoderSet.load("palpate/mini"), [], time.process_time()
    for seed in range(FIRST_SEED, FIRST_SEED + asked.worlds):
        scene = make_scene(seed, encoders)
        rendered = time.process_time() - started
        results.append(run_world(scene, encoders))
        print(
            f"{time.process_time() - started:6.0f} s  world {seed} (rendered at {rendered:.0f} s)",
            file=sys.stderr,
            flush=True,
        )
    command = f"python benchmarks/metric_degradations.py --worlds {asked.worlds}" + (
        f" --write {asked.write}" if asked.write else ""
    )
    text = page(results, command, asked.worlds)
    if asked.write:
        asked.write.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()

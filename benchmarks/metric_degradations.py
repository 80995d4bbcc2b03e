"""Which metric ranks controlled degradations of tactile images correctly, by Kendall's tau.

    python benchmarks/metric_degradations.py              # print the tables, about ten minutes
    python benchmarks/metric_degradations.py --write docs/studies/metric_degradations.md
    python benchmarks/metric_degradations.py --worlds 3   # a quick look

A world has ten materials with eight videos each (one object a video): four for testing, four for
training, from which alone a degradation takes other images. Of the twelve frames of a test video
(six contacts of two frames) contacts 1, 3, 5 are the reference; the perfect generator shows
contacts 2, 4, 6 of the same videos, sample by sample: the right surface on the right gel, another
press. It is degraded in eleven ways at five strengths, and in one way that is none (``new
videos``); strength 0 is the perfect generator. Features are those of the shipped tactile encoder
(``palpate/mini``), which has seen none of these worlds. Images are compared on every twelfth pair,
the same at all strengths.

Tau is Kendall's tau-b of the strengths 0 to 5 with a metric's values in one world, its sign such
that +1 means: the stronger the degradation, the worse the score. A cell holds the mean over the
worlds, and its verdict uses the t interval over the worlds.
"""

import argparse
import datetime
import sys
import time
from pathlib import Path

import numpy as np
from degraded_images import (
    DEGRADATIONS,
    FEATURES_ONLY,
    MATERIALS,
    STRENGTHS,
    VIDEOS,
    degraded,
    make_scene,
)
from scipy import stats

from palpate.core import FeatureSet, rng_for
from palpate.encoders.encoder_set import EncoderSet
from palpate.metrics import (
    ci_tmmd,
    d_tmmd,
    fid,
    i_tmmd,
    kid,
    measure_contacts,
    per_image,
    prdc,
    tmmd,
)
from palpate.sim import VERSION

FIRST_SEED = 40_000
SPLITS = 8  # halvings of the real images by video
PIXELS = 12  # every twelfth pair is compared image by image
TESTS = {"TMMD": 10.0, "TMMD, median": "median", "TMMD, multi": "multi"}
PRDC = ("precision", "recall", "density", "coverage")
WITH_FLOOR = ("I: E", "CI: E", "D: E_ratio")
WHOLE = ("PSNR", "SSIM", "MS-SSIM")
CONTACT = ("contact PSNR", "contact SSIM", "contact MS-SSIM", "contact residual", "contact IoU")
UP = {*PRDC, *WHOLE, *CONTACT} - {"contact residual"}
COLUMNS = {
    "against the reference": (*TESTS, "TMMD, paper", "KID", "FID", *PRDC),
    "without a reference, lower taken as better": (
        *("I, random", "I", "I: E", "CI: E", "D", "D: E_ratio"),
    ),
    "without a reference, distance to the same on real images": (
        *(f"{name}, off the floor" for name in WITH_FLOOR),
    ),
    "image by image": (*WHOLE, *CONTACT),
}
CONTROLS = {
    "perfect generator (other contacts of the videos)": None,
    "wrong material": ("wrong material", 1.0),
    "new videos of the right material": ("new videos", 1.0),
    "memorized videos": ("memorized videos", 1.0),
    "blurred, 1 px": ("blur", 1.0),
    "blurred, 4 px": ("blur", 4.0),
    "empty gel": ("empty gel", 1.0),
    "one image a material": ("class collapse", 1.0),
    "one image": ("full collapse", 1.0),
}
HALVES = "real halves by video"


def feature_set(scene, features, rows=None):
    rows = np.arange(len(features)) if rows is None else rows
    labels, videos = ([str(v) for v in column[rows]] for column in (scene.label, scene.video))
    return FeatureSet([str(i) for i in rows], features[rows], labels, videos, "mini")


def without_reference(made, sigma=10.0):
    """The three metrics that need no reference."""
    i, ci, d = (f(made, normalize=True, sigma=sigma) for f in (i_tmmd, ci_tmmd, d_tmmd))
    return {
        "I, random": i_tmmd(made, preset="paper", normalize=True).value,
        "I": i.value,
        "I: E": i.details["E"],
        "CI: E": ci.details["E"],
        "D": d.value,
        "D: E_ratio": d.details["E_ratio"],
    }


def against(made, real, permutations):
    """Metric that compares with a reference -> value, and -> p-value for those that are tests."""
    options = {"normalize": True, "permutations": permutations}
    scores = {name: tmmd(made, real, sigma=sigma, **options) for name, sigma in TESTS.items()}
    values = {name: score.value for name, score in scores.items()}
    values["TMMD, paper"] = tmmd(made, real, preset="paper", normalize=True, permutations=0).value
    values["KID"] = kid(made, real).value
    values["FID"] = fid(made, real, interval=False).value
    values |= zip(PRDC, (s.value for s in prdc(made, real)), strict=True)
    return values, {name: score.details["p_value"] for name, score in scores.items()}


def scores_of(scene, features, images, real, floor, permutations=199):
    """Metric -> value, and metric -> p-value for those that are tests."""
    made = feature_set(scene, features)
    values, p = against(made, real, permutations)
    values |= without_reference(made)
    for name in WITH_FLOOR:
        known = None not in (values[name], floor[name])
        values[f"{name}, off the floor"] = abs(values[name] - floor[name]) if known else None
    if images is not None:
        values |= image_scores(scene, images)
    return {name: np.nan if v is None else float(v) for name, v in values.items()}, p


def image_scores(scene, images):
    """Means over the pairs; a pair that was compared before is not compared again."""
    rows = []
    for k in range(0, len(images), PIXELS):
        key = k, images[k].tobytes()
        if key not in scene.compared:
            pair = images[k : k + 1], scene.real[k : k + 1]
            contacts = measure_contacts(*pair, scene.real_gel[k : k + 1]).values
            values = {name: per_image(name, *pair).values for name in WHOLE} | contacts
            scene.compared[key] = {name: v[0] for name, v in values.items()}
        rows.append(scene.compared[key])
    # an image without contact has no contact score
    return {name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]}


def run_world(scene, encoders, kinds=tuple(STRENGTHS), permutations=199):
    """``values[kind][metric]``: (6,) over the strengths; ``p[kind][test]``: (6,); the floor."""
    real = feature_set(scene, scene.features["real"])
    floor = without_reference(real)
    score = lambda *made: scores_of(scene, *made, real, floor, permutations)
    start, values, p = score(scene.features["generated"], scene.generated), {}, {}
    for kind in kinds:
        rows = [start, *(score(*degraded(scene, kind, s, encoders)) for s in STRENGTHS[kind])]
        names = start[0]
        values[kind] = {m: np.array([row[0].get(m, np.nan) for row in rows]) for m in names}
        p[kind] = {name: np.array([row[1][name] for row in rows]) for name in TESTS}
    return values, p, {"floor": floor, HALVES: halves_control(scene, permutations)}


def halves_control(scene, permutations=199, splits=SPLITS):
    """Real images of one half of the videos against the other: mean values, and all p-values."""
    rows = []
    for k in range(splits):
        rng = rng_for(scene.seed, "metric degradations", f"halves {k}")
        first = np.isin(scene.video, rng.permutation(np.unique(scene.video))[::2])
        halves = map(np.flatnonzero, (first, ~first))
        sets = [feature_set(scene, scene.features["real"], half) for half in halves]
        rows.append(against(*sets, permutations))
    values = {name: float(np.mean([v[name] for v, _ in rows])) for name in rows[0][0]}
    return values, {name: [p[name] for _, p in rows] for name in TESTS}


def tau_of(values, up):
    """Kendall's tau-b of the strengths with "worse"; 0 where constant, NaN where undefined."""
    if not np.isfinite(values).all():
        return np.nan
    if np.ptp(values) <= 1e-9 * max(1.0, float(np.abs(values).max())):
        return 0.0
    return float(stats.kendalltau(np.arange(len(values)), -values if up else values).statistic)


def summary(taus):
    """Mean, and t interval over the worlds."""
    taus = np.asarray(taus)[np.isfinite(taus)]
    if len(taus) < 2:
        return np.nan, (np.nan, np.nan)
    reach = stats.t.ppf(0.975, len(taus) - 1) * taus.std(ddof=1) / np.sqrt(len(taus))
    return float(taus.mean()), (float(taus.mean() - reach), float(taus.mean() + reach))


def verdict(mean, interval):
    """``yes``: lower end at least 0.8; ``mostly``: 0.4; ``reversed``: upper end below -0.4."""
    if not np.isfinite(mean):
        return "-"
    if interval[0] >= 0.4:
        return "yes" if interval[0] >= 0.8 else "mostly"
    return "reversed" if interval[1] <= -0.4 else "no"


def table(head, rows):
    """Lines of a Markdown table."""
    cells = [head, ["---"] * len(head), *rows]
    return [*(f"| {' | '.join(map(str, row))} |" for row in cells), ""]


def tau_tables(results):
    """Tables of tau by degradation and metric; and (kind, metric) -> verdict."""
    lines, verdicts = [], {}
    for title, metrics in COLUMNS.items():
        rows = []
        for kind in STRENGTHS:
            if title == "image by image" and kind in FEATURES_ONLY:
                continue
            row = [kind]
            for metric in metrics:
                taus = [tau_of(values[kind][metric], metric in UP) for values, _, _ in results]
                mean, interval = summary(taus)
                word = verdicts[kind, metric] = verdict(mean, interval)
                cell = f"{mean:+.2f} ± {(interval[1] - interval[0]) / 2:.2f} {word}"
                row.append(cell if np.isfinite(mean) else "undefined")
            rows.append(row)
        lines += [f"### Metrics {title}", "", *table(["degradation", *metrics], rows)]
    return lines, verdicts


def verdict_table(verdicts):
    """One row a metric: what it ranks, what it does not see, what it rewards."""
    rows = []
    for metric in (m for metrics in COLUMNS.values() for m in metrics):
        words = {kind: verdicts.get((kind, metric)) for kind in STRENGTHS}
        by = {w: [k for k in words if words[k] == w] for w in ("yes", "mostly", "no", "reversed")}
        by["no"] += [f"{kind} (undefined)" for kind in words if words[kind] == "-"]
        rows.append([metric, *(", ".join(kinds) or "-" for kinds in by.values())])
    head = ["metric", "ranks right", "mostly", "not", "reversed (calls the worse one better)"]
    return table(head, rows)


def detection_table(results):
    """Share of the worlds in which a permutation test finds a degradation at 5 %, by strength."""
    share = lambda values: f"{100 * np.mean(np.array(values) <= 0.05):.0f}"
    rows = [
        [
            kind,
            *(
                " ".join(share([p[kind][t][k] for _, p, _ in results]) for k in range(6))
                for t in TESTS
            ),
        ]
        for kind in STRENGTHS
    ]
    null = [share([p for *_, rest in results for p in rest[HALVES][1][t]]) for t in TESTS]
    return table(["degradation", *TESTS], [*rows, [f"{HALVES} (null)", *null]])


SHOWN = (
    *("TMMD", "TMMD, multi", "KID", "FID", "precision", "coverage", "I: E", "CI: E", "D: E_ratio"),
    *("PSNR", "SSIM", "contact SSIM", "contact residual"),
)


def control_values(results, metric):
    """Control -> one value a world."""
    columns = {HALVES: [rest[HALVES][0].get(metric, np.nan) for *_, rest in results]}
    for name, place in CONTROLS.items():
        kind, at = ("blur", 0) if place is None else place
        at = 0 if place is None else 1 + STRENGTHS[kind].index(at)
        columns[name] = [values[kind][metric][at] for values, *_ in results]
    floors = [rest["floor"].get(metric) for *_, rest in results]
    columns["floor: the real images"] = [np.nan if v is None else v for v in floors]
    return columns


def control_table(results):
    """Means over the worlds of the controls."""
    columns = [control_values(results, metric) for metric in SHOWN]
    mean = lambda values: f"{np.mean(values):.3f}" if np.isfinite(values).all() else ""
    rows = [[name, *(mean(column[name]) for column in columns)] for name in columns[0]]
    return table(["control", *SHOWN], rows)


def page(results, command, worlds):
    tables, verdicts = tau_tables(results)
    strengths = [
        [kind, meaning, ", ".join(f"{s:g}" for s in values)]
        for kind, (values, meaning) in DEGRADATIONS.items()
    ]
    today = datetime.datetime.now(tz=datetime.UTC).date()
    lines = [
        "# Which metric ranks degraded images correctly",
        "",
        f"Written by `{command}`, world VERSION {VERSION}, {worlds} worlds of seeds {FIRST_SEED} "
        f"to {FIRST_SEED + worlds - 1}, {today}. Synthetic tactile images and the small tactile "
        "encoder that ships: the table shows mechanisms, and its numbers are never compared with "
        "those of real data. The script describes how it is made.",
        "",
        'Unless stated: `preset="grouped"`, sigma = 10, scale 1000. `TMMD, paper` is the unbiased '
        "estimator (Eq. 2), `I, random` the paper's random halves; FID and the neighbor metrics "
        f"have {MATERIALS * VIDEOS * 6} samples a set and the encoder's 128 dimensions.",
        "",
        *table(["degradation", "what", "strengths 1 to 5"], strengths),
        "## Verdict",
        "",
        "`ranks right`: the 95 % interval of the mean tau over the worlds lies above 0.8; "
        "`mostly`: above 0.4; `reversed`: below -0.4; `not`: anything else, metrics that see "
        "nothing and those that the worlds do not agree on. `new videos` is no degradation: "
        "there `not` is right.",
        "",
        *verdict_table(verdicts),
        "## Kendall's tau",
        "",
        "Mean over the worlds ± half of its 95 % interval. +1: every stronger degradation is "
        "worse.",
        "",
        *tables,
        "## How early a test sees it",
        "",
        "Percent of the worlds in which the permutation test of TMMD (whole videos, 199 "
        "relabelings) gives p <= 0.05, at strengths 0 to 5. Strength 0 is the perfect generator.",
        "",
        *detection_table(results),
        "## The controls",
        "",
        f"Means over the worlds; of real halves also over {SPLITS} halvings. A perfect generator "
        "is not at the best value of the image metrics: another press of the same surface is "
        "another image.",
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
    options = parser.parse_args()
    encoders, results, start = EncoderSet.load("palpate/mini"), [], time.process_time()
    for seed in range(FIRST_SEED, FIRST_SEED + options.worlds):
        results.append(run_world(make_scene(seed, encoders), encoders))
        print(f"{time.process_time() - start:6.0f} s  world {seed}", file=sys.stderr, flush=True)
    command = f"python benchmarks/metric_degradations.py --worlds {options.worlds}"
    command += f" --write {options.write}" if options.write else ""
    text = page(results, command, options.worlds)
    if options.write:
        options.write.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()

"""Whether the error bars of a study with people hold: coverage of nominal 95 % intervals.

    python benchmarks/preference_coverage.py --studies 200    # about a minute
    python benchmarks/preference_coverage.py --write docs/studies/preference_coverage.md

Every study is a plan with new items and new raters (``tests/preference_crowd.py``): the difference
that a rater feels varies between items (standard deviation 1.5 logits) and between raters (0.7),
small differences are ties, the left image gets a bonus, and some answers are random. The truth is
the preference among all items, raters and sides. ``palpate`` is the interval of ``palpate
preference score``: items and raters resampled, of two raters items alone, which says that it is for
these raters. The others are what is often printed. Exit status 1 if the row of 40 items and 10
raters covers less than 92 % or more than 99 %.
"""

import argparse
import datetime
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from palpate.core import rng_for
from palpate.preference.arrays import VoteArrays
from palpate.preference.making import rater_of, trials_of
from palpate.preference.plan import Item, Plan
from palpate.preference.raters import rater_facts
from palpate.preference.scoring import comparisons
from palpate.preference.statistics import (
    Weights,
    expected_half_width,
    outcome_counts,
    percentiles,
    preferences,
)
from preference_crowd import Crowd

SIZES = ((40, 2), (40, 3), (40, 5), (40, 10), (100, 10))
WANTED, LIMITS = (40, 10), (0.92, 0.99)
CROWD = Crowd({"a": 1.2, "b": 0.0}, left_bias=0.2, lapses=0.02)


def study(items, raters, seed):
    """A plan without images."""
    plan = Plan(
        secret=f"{seed:064x}",
        task="pair",
        question="similar",
        text="",
        title="",
        methods=["a", "b"],
        items=[Item(f"i{k}") for k in range(items)],
        trials=[],
        raters=[],
        seed=seed,
    )
    plan = replace(plan, trials=trials_of(plan, "all"))
    return replace(plan, raters=[rater_of(plan, f"r{k}") for k in range(raters)])


def intervals(items, raters, seed, replicates):
    """Kind of interval -> (low, high) of the preference of a, and the raters that count."""
    plan, crowd = study(items, raters, seed), replace(CROWD, seed=seed)
    votes = crowd.votes(plan)
    kept = [rater.code for rater in rater_facts(plan, votes) if not rater.excluded]
    arrays = VoteArrays(plan, votes, kept, seed, replicates)
    n, share = int(arrays.counts[0].sum()), float(preferences(arrays.counts)[0])
    wilson = stats.binomtest(round(share * n), n).proportion_ci(method="wilson")
    once = np.ones((replicates, len(kept)))
    drawn = Weights.draw(len(kept), items, rng_for(seed, "items"), replicates).items
    of_items = outcome_counts(arrays.values, Weights(once, drawn))
    return {
        "palpate": tuple(comparisons(arrays)[0]["interval"]),
        "items alone": percentiles(preferences(of_items)[:, 0]),
        "Wilson": (wilson.low, wilson.high),
    }, kept


def row(size, studies, replicates, truth):
    """Covered studies and mean half-width by kind of interval, and excluded raters a study.

    ``these``: the interval of palpate of the preference of the very raters of a study.
    """
    made = [intervals(*size, seed, replicates) for seed in range(studies)]
    covered = {k: sum(i[k][0] <= truth <= i[k][1] for i, _ in made) for k in made[0][0]}
    own = [replace(CROWD, seed=k).preference("a", "b", made[k][1], 100_000) for k in range(studies)]
    covered["these"] = sum(
        i["palpate"][0] <= p <= i["palpate"][1] for (i, _), p in zip(made, own, strict=True)
    )
    width = np.mean([(i["palpate"][1] - i["palpate"][0]) / 2 for i, _ in made])
    return covered, width, np.mean([size[1] - len(kept) for _, kept in made])


def cell(count, studies):
    """A share with its 95 % interval."""
    ci = stats.binomtest(count, studies).proportion_ci(method="wilson")
    return f"{count / studies:.1%} ({100 * ci.low:.0f} to {100 * ci.high:.0f})".replace("%", " %")


def table(studies, replicates, report):
    """Rows of Markdown, and the coverage of the wanted row."""
    truth, wanted = CROWD.preference("a", "b", draws=4_000_000), 0.0
    lines = [
        f"True preference {truth:.3f}; `covered` with its 95 % interval over {studies} studies.",
        "",
        "| items x raters | palpate: covered | half-width | expected | of these raters: covered |"
        " items alone: covered | Wilson on all votes: covered | excluded raters a study |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for size in SIZES:
        covered, width, excluded = row(size, studies, replicates, truth)
        wanted = covered["palpate"] / studies if size == WANTED else wanted
        cells = [cell(covered[k], studies) for k in ("palpate", "these", "items alone", "Wilson")]
        widths = f"{width:.3f} | {expected_half_width(*size):.3f}"
        name = f"{size[0]} x {size[1]}" + (", for these raters" if size[1] <= 2 else "")
        rest = " | ".join([cells[0], widths, *cells[1:], f"{excluded:.2f}"])
        lines.append(f"| {name} | {rest} |")
        report(lines[-1])
    return lines, wanted


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--studies", type=int, default=200)
    parser.add_argument("--replicates", type=int, default=1000)
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    options = parser.parse_args()
    start = time.process_time()

    def report(text):
        print(f"{time.process_time() - start:6.0f} s  {text}", file=sys.stderr, flush=True)

    lines, wanted = table(options.studies, options.replicates, report)
    command = f"python benchmarks/preference_coverage.py --studies {options.studies}"
    command += f" --write {options.write}" if options.write else ""
    holds = LIMITS[0] <= wanted <= LIMITS[1]
    head = [
        "# Whether the error bars of a study with people hold",
        "",
        f"Written by `{command}`, {datetime.datetime.now(tz=datetime.UTC).date()}, seeds 0 to "
        f"{options.studies - 1}. The script describes the simulated raters: item sd "
        f"{CROWD.item_sd}, rater sd {CROWD.rater_sd}, tie band {CROWD.tie_band}, left bias "
        f"{CROWD.left_bias} logits, {100 * CROWD.lapses:.0f} % random answers.",
        "",
    ]
    foot = [
        "",
        f"{WANTED[0]} items and {WANTED[1]} raters between 92 and 99 %: "
        + ("yes." if holds else "**no**."),
        "",
        "Two raters are no sample of people: no interval of their votes covers the preference of "
        "people at large. palpate prints theirs as an interval *for these raters*, "
        "which it covers; the first column of that row is what it would be worth if it were read "
        "as more.",
        "",
    ]
    text = "\n".join([*head, *lines, *foot])
    print(text)
    if options.write:
        options.write.write_text(text, encoding="utf-8")
    return int(not holds)


if __name__ == "__main__":
    sys.exit(main())

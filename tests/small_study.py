"""A study of the smallest size, for tests that run it: ``python tests/small_study.py FOLDER``."""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

from palpate.report.results import Results
from palpate.sim import PRESETS as WORLDS
from palpate.studies.methods import METHODS, OURS
from palpate.studies.reproduce import Plan, plan_of, run_study
from palpate.studies.study import PRESETS, Study

SMOKE = PRESETS["smoke"]
TINY = replace(
    SMOKE,
    name="tiny",
    world=replace(WORLDS["tiny"], materials=("Wood", "Brick"), objects_per_material=6, test=0.4),
    steps=4,
    autoencoder=replace(SMOKE.autoencoder, steps=12),
    permutations=19,
)
STUDY = Study(
    "small",
    "A small study",
    (1, 3),
    {"leak": "contact", "seed": 71},
    methods=(METHODS[OURS], METHODS["GVST"], METHODS["Ours w/ BG"]),
    presets={"tiny": TINY},
)


def plan() -> Plan:
    return plan_of(STUDY, preset="tiny", device="cpu")


def run(folder: Path, **options) -> Results:
    return run_study(plan(), folder, **options)


if __name__ == "__main__":
    show = partial(print, flush=True)
    run(Path(sys.argv[1]), print_line=show, progress=lambda *args: show("progress", *args))

"""From folders of images to a study: the items, the trials, and the order of every rater.

Items are ids that the reference and all methods have, at most one a video, taken from the materials
in turn. Order and sides of a rater depend on the plan's secret, which no page holds.
"""

from __future__ import annotations

import datetime
import re
import secrets
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, product, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core import (
    Note,
    PalpateError,
    Progress,
    atomic_folder,
    quiet,
    require,
    require_choice,
    rng_for,
    write_text,
)
from palpate.core.records import LARGEST
from palpate.preference.images import encoded, read_sources
from palpate.preference.page import study_page
from palpate.preference.plan import (
    COPY,
    GEL,
    PAGE,
    PLAN,
    REFERENCE,
    Item,
    Plan,
    Rater,
    Trial,
    last_day,
)
from palpate.preference.statistics import ASSUMED, FEW_RATERS, expected_half_width

#: Code of a question -> what raters read. ``material-pattern`` is the paper's (section 7).
QUESTIONS = {
    "material-pattern": (
        "Which image is closer to the reference in the pattern of its material? Look at lines, "
        "grains and weaves, not at the sensor's background."
    ),
    "similar": "Which image is more similar to the reference?",
    "material": "Which material does this image show? Compare it with the examples.",
}
TITLE = "Tactile images"
#: Share of trials that are repeated, and that are catches; and the fewest of each, of which one
#: may be missed.
EXTRA, FEWEST = 0.1, 5
#: Examples of a material in the task ``sort``.
EXAMPLES = 4
#: Of ``design="paper"``: items, commonest materials, raters; the first method against each other.
PAPER_ITEMS, PAPER_MATERIALS, PAPER_RATERS = 40, 13, 2


def make(  # noqa: PLR0913
    reference: Any,
    generated: Any,
    output: str | Path | None = None,
    *,
    items: int | None = None,
    raters: int | None = None,
    task: str = "pair",
    question: str | None = None,
    design: str | None = None,
    names: Sequence[str] | None = None,
    labels: Any = None,
    size: int = 256,
    title: str = TITLE,
    until: str | None = None,
    seed: int = 0,
    dry_run: bool = False,
    progress: Progress = quiet,
) -> Plan:
    """Plan a blinded study and write its page.

    Args:
        reference: real tactile images: a folder or a manifest, as for ``palpate.score``.
        generated: the methods, one folder or manifest each, or a mapping from names to these. Ids
            are paths below the folder, without suffix.
        output: new folder for ``plan.json`` (secret) and ``study.html`` (the page).
        items: reference images; default 40.
        raters: for whom an order is made; default 10.
        task: ``pair``: which of two images is closer to the reference; ``sort``: which material
            does an image show, among examples of all.
        question: one of ``QUESTIONS``, or the text itself.
        design: ``paper``: 40 items of the 13 commonest materials, two raters, the first method
            against each of the others.
        names: of the methods, instead of those of their folders.
        labels: table with the columns id, material, video, for folders.
        size: side of all images, in pixels.
        title: heading of the page.
        until: ISO date of the last day.
        seed: another seed chooses other items.
        dry_run: plan without reading an image or writing a file.
        progress: progress callback.

    Raises:
        PalpateError: if there is too little to compare, or an option is out of range.
        ProblemsError: if a manifest is inconsistent.
    """
    paper = design == "paper"
    count = PAPER_ITEMS if items is None else items
    raters = (PAPER_RATERS if paper else 10) if raters is None else raters
    require_choice("task", task, ("pair", "sort"))
    require(design in (None, "paper"), "design", "must be paper, if given", repr(design))
    require(2 <= count <= 1000, "items", "must lie in 2 .. 1000", items, 40)
    require(1 <= raters <= 999, "raters", "must lie in 1 .. 999", raters, 10)
    require(32 <= size <= 1024, "size", "must lie in 32 .. 1024", size, 256)
    require(abs(seed) < LARGEST, "seed", "must lie between -2^63 and 2^63", seed, 0)
    until, today = last_day(until), datetime.datetime.now(datetime.UTC).date().isoformat()
    require(until is None or until >= today, "until", "must be today or later", until, "2030-12-31")
    folder = None if output is None or dry_run else Path(output)
    must = "must be a new folder for the study"
    require(dry_run or folder is not None, "output", must, "none", "study/")
    sources = read_sources(reference, generated, names, labels)
    methods = [name for name in sources.paths if name not in (REFERENCE, GEL)]
    if task == "pair" and len(methods) < 2:
        fix = "Pass another method, or sort images by material, which one method can do"
        example = {"task": "sort"}
        raise PalpateError("There must be two methods to compare", "one", fix, example=example)
    code, text = _question(task, question, title, methods)
    chosen, examples, notes = choose_items(
        sources.items,
        count,
        seed,
        materials=PAPER_MATERIALS if paper else None,
        examples=task == "sort",
    )
    few = [Note("these-raters", {"count": raters})] * (raters <= FEW_RATERS)
    expected: dict[str, Any] = {}
    if task == "pair":
        width = round(expected_half_width(len(chosen), raters), 3)
        facts = {"items": len(chosen), "raters": raters, "assumed": ASSUMED}
        expected = {"half_width": width, **facts}
    plan = Plan(
        secret=secrets.token_hex(32),
        task=task,
        question=code,
        text=text,
        title=title,
        methods=methods,
        items=chosen,
        trials=[],
        raters=[],
        examples=examples,
        seed=seed,
        expected=expected,
        until=until,
        size=size,
        notes=[*sources.notes, *notes, *few],
    )
    plan = replace(plan, trials=trials_of(plan, first=paper))
    digits = max(2, len(str(raters)))
    codes = [f"r{k:0{digits}d}" for k in range(1, raters + 1)]
    plan = replace(plan, raters=[rater_of(plan, code) for code in codes])
    if folder is None:
        return plan
    plan = replace(plan, images=encoded(plan, sources, progress))
    with atomic_folder(folder) as part:
        plan.save(part / PLAN)
        write_text(part / PAGE, study_page(plan.public()))
    return plan


def _question(
    task: str, question: str | None, title: str, methods: Sequence[str]
) -> tuple[str, str]:
    """Code and text of the question; the code of a custom text is ''."""
    question = question or ("material" if task == "sort" else "material-pattern")
    text = QUESTIONS.get(question, question)
    for argument, words in (("title", title), ("question", text)):
        require(bool(words.strip()), argument, "must not be blank", repr(words))
        forms = {m: rf"(?<!\w){re.escape(m)}(?!\w)" for m in methods}
        named = [m for m, form in forms.items() if re.search(form, words, re.IGNORECASE)]
        if named and words in (*QUESTIONS.values(), TITLE):
            must, got = f"must hold no word of the {argument} {words!r}", f"{named[0]!r}"
            raise PalpateError(must, got, "Pass other names", argument="names")
        require(not named, argument, "must not name a method", repr(words))
    return (question if question in QUESTIONS else ""), text


Piles = dict[str, list[Item]]


def choose_items(
    candidates: Sequence[Item], n: int, seed: int, *, materials: int | None, examples: bool
) -> tuple[list[Item], list[Item], list[Note]]:
    """Choose items, at most one a video, from the materials in turn, the commonest first.

    Args:
        candidates: ids that all methods have.
        n: how many.
        seed: of the choice.
        materials: take the commonest so many only.
        examples: also choose ``EXAMPLES`` items a material, of other videos.

    Returns:
        (items, examples, notes).

    Raises:
        PalpateError: if there are fewer than two items, or examples are needed and fewer than two
            materials have videos for them.
    """
    order = rng_for(seed, "items").permutation(len(candidates))
    videos: dict[str, Item] = {}
    for item in (candidates[k] for k in order):
        videos.setdefault(item.video or f"\x1f{item.id}", item)
    piles: Piles = {}
    for item in videos.values():
        piles.setdefault(item.material or "", []).append(item)
    single = sorted(name for name, pile in piles.items() if name and len(pile) == 1)
    notes, strips = list[Note](), list[Item]()
    if examples:
        piles, strips = _with_examples(piles)
    if set(piles) == {""}:
        notes.append(Note("materials-unknown"))
    elif single:
        code = "one-video-materials" if examples else "one-video-classes"
        notes.append(Note(code, {"materials": single}))
    common = sorted(piles, key=lambda name: (-len(piles[name]), name))[:materials]
    # One of each material, then a second of each ...
    rounds = zip_longest(*(piles[name] for name in common))
    taken = [item for each in rounds for item in each if item is not None][:n]
    must = "A study needs two items, at most one a video"
    got, fix = f"{len(taken)} of {len(candidates):,} images", "Add images of other videos"
    require(len(taken) >= 2, None, must, got, fix=fix)
    facts = {"n": len(taken), "candidates": len(candidates), "videos": len(videos)}
    if len(taken) < n:
        notes.append(Note("fewer-items", facts | {"wanted": n}))
    elif len(taken) < len(candidates):
        notes.append(Note("sampled-items", facts))
    return taken, strips, notes


def _with_examples(piles: Piles) -> tuple[Piles, list[Item]]:
    """What remains of the materials of two videos and more, and up to half of each as examples."""
    counts = {m: min(EXAMPLES, len(pile) // 2) for m, pile in piles.items() if m and len(pile) > 1}
    must = "Sorting needs two materials with two videos each"
    fix = "Pass labels with the columns id, material, video"
    require(len(counts) >= 2, None, must, len(counts), fix=fix)
    examples = [item for name, count in counts.items() for item in piles[name][:count]]
    return {name: piles[name][count:] for name, count in counts.items()}, examples


def trials_of(plan: Plan, *, first: bool) -> list[Trial]:
    """All questions: one a comparison and item, repeats of a tenth of them, and catches.

    ``first``: only comparisons with the first method.
    """
    methods, rng = plan.methods, rng_for(plan.seed, plan.secret, "trials")
    if plan.task == "sort":  # real images show how much people can know
        pairs = [(name, "") for name in (REFERENCE, *methods)]
        answered, sides = plan.examples, (COPY, "")
    else:
        pairs = [p for p in combinations(methods, 2) if p[0] == methods[0] or not first]
        answered, sides = plan.items, (COPY, GEL)
    each = enumerate(product(pairs, plan.items))
    base = [Trial(f"t{k:04d}", plan.task, item.id, *pair) for k, (pair, item) in each]
    extra = min(len(base), max(FEWEST, round(EXTRA * len(base))))
    again = enumerate(base[k] for k in rng.permutation(len(base))[:extra])
    repeats = [
        Trial(
            f"r{k:04d}", "repeat", trial.item, *trial.sides(plan.task == "pair"), repeats=trial.id
        )
        for k, trial in again
    ]
    some = rng.permutation(max(extra, len(answered)))[:extra] % len(answered)
    catches = [Trial(f"c{k:04d}", "catch", answered[n].id, *sides) for k, n in enumerate(some)]
    return [*base, *repeats, *catches]


def rater_of(plan: Plan, code: str) -> Rater:
    """Order and sides of one rater: sides balanced in every comparison, repeats well apart."""
    rng = rng_for(plan.seed, plan.secret, code)
    swapped: dict[str, bool] = {}
    for pair in dict.fromkeys((t.left, t.right) for t in plan.trials if t.kind != "repeat"):
        members = [t.id for t in plan.trials if t.kind != "repeat" and (t.left, t.right) == pair]
        half = (np.arange(len(members)) + rng.integers(2)) % 2 == 0
        swapped |= dict(zip(members, rng.permutation(half).tolist(), strict=True))
    position = dict(zip(plan.trial, rng.random(len(plan.trial)).tolist(), strict=True))
    for trial in plan.trials:
        if trial.kind == "repeat":  # a third of the study or more after the first time
            swapped[trial.id] = swapped[trial.repeats]
            position[trial.repeats] = rng.uniform(0, 0.6)
            position[trial.id] = rng.uniform(position[trial.repeats] + 0.3, 1)
    order = sorted(position, key=position.__getitem__)
    return Rater(code, order, [swapped[name] and plan.task == "pair" for name in order])

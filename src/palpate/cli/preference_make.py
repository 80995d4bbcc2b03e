"""``palpate preference make``: plan a blinded study with people and write its page."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from palpate.cli.terminal import Common, OptionalOutPath, Switch, Terminal, option_group
from palpate.core import plain, require

#: Seconds that a trial takes, for the time a study will take.
SECONDS = 5


@option_group
class Options(Common):
    """Plan a blinded study: which generator's images do people find closer to the real ones?

    Writes one page that works from disk, and a secret plan. No rater, and nobody who reads the
    page, sees the name of a generator.
    """

    reference: Path
    """The real tactile images: a folder or a manifest."""
    generated: tuple[Path, ...]
    """The methods to compare, one folder or manifest each. Ids are relative file names."""
    output: OptionalOutPath = None
    """New folder for the page and the plan."""
    items: int | None = None
    """Reference images, at most one a video, from all materials. Default: 40."""
    raters: int | None = None
    """Raters to plan for, each with an order of their own. Default: 10; with --design paper 2."""
    task: Literal["pair", "sort"] = "pair"
    """`pair`: which of two images is closer to the reference? `sort`: which material does an image
    show, among examples of all?"""
    question: str | None = None
    """`material-pattern` (the paper's), `similar`, `material`, or a text. Default:
    material-pattern; of --task sort material."""
    design: Literal["paper"] | None = None
    """The paper's study: 40 items of the 13 commonest materials, two raters, the first method
    against each of the others. Who reads its page can tell the first method."""
    names: tuple[str, ...] = ()
    """Names of the methods, instead of those of their folders."""
    labels: Path | None = None
    """CSV or Parquet file with the columns id, material, video, for folders."""
    size: int = 256
    """Side of all images, in pixels."""
    title: str = "Tactile images"
    """Heading of the page."""
    until: str | None = None
    """Last day of the study, e.g. 2030-12-31."""
    seed: int = 0
    """Another seed chooses other items."""
    dry_run: Switch = False
    """Only print the plan and how wide the intervals will be."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Plan, write, and say what comes next."""
    from palpate.preference import make

    inputs = [options.reference, *options.generated]
    apart = not options.output or options.output.resolve() not in [p.resolve() for p in inputs]
    must, fix = "An output must not replace an input", "Choose another folder"
    require(apart, None, must, str(options.output), fix=fix)
    plan = terminal.run(make, **options.keywords())
    for note in plan.notes:
        terminal.note(note)
    trials = len(plan.trials)
    facts: dict[str, Any] = {"study": plan.study, "methods": list(plan.methods)}
    facts |= {"items": len(plan.items), "raters": len(plan.raters), "trials": trials}
    facts["minutes"] = round(trials * SECONDS / 60)
    if plan.expected:
        facts["half_width"] = plan.expected["half_width"]
    if (output := options.output) and not options.dry_run:
        facts |= {"page": str(output / "study.html"), "plan": str(output / "plan.json")}
    terminal.facts("Study", facts)
    if plan.expected:
        reach = f"about {plan.expected['half_width']:.2f} to each side, by simulation"
        terminal.print_line(f"The interval of a comparison will reach {reach}")
    return facts | {"notes": plain(plan.notes)}

"""``palpate demo``: everything once, from photos to a page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from palpate.cli.terminal import Common, OutPath, Terminal, require_extra
from palpate.core import PalpateError


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Run everything once: data, leak-free split, encoders, generator, images, scores, page.

    Without --data it runs offline on the embedded synthetic world. Run the same command again to
    resume from the last finished stage.
    """

    data: Path | None = None
    """A data set (anything `palpate import` reads) instead of the embedded world."""
    output: OutPath = Path("runs/demo")
    """Run folder."""
    preset: Literal["mini", "tiny"] = "mini"
    """`mini` takes minutes on two cores; `tiny` only shows that everything runs."""
    seed: int = 0
    """Of the split, the weights, the order of training and the noise."""
    device: str = "auto"
    """auto, cpu, cuda, mps."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Run the stages and write the page."""
    require_extra("palpate demo")
    from palpate.report import summary_lines
    from palpate.studies.demo import DemoOptions, run_demo
    from palpate.studies.demo_page import results_of

    output = options.output
    kept = any(output.glob("*.partial")) or any(output.glob("*/stage.json"))
    if output.is_dir() and any(output.iterdir()) and not kept:
        must, got = "must be new, empty, or a run folder of the demo", f"{output}, with other files"
        raise PalpateError(must, got, "Choose another folder", argument="output")
    data = options.data and options.data.resolve()
    try:
        with terminal.progress() as progress:
            demo = run_demo(
                DemoOptions(options.preset, data, options.seed, options.device),
                output,
                print_line=terminal.print_line,
                progress=progress,
            )
    except PalpateError:
        if output.is_dir() and not any(output.iterdir()):  # nothing was done
            output.rmdir()
        raise
    results = results_of(demo, terminal.command)
    page = output / "page.html"
    results.to_html(page)
    terminal.print("")
    for line in summary_lines(results):
        terminal.print(line)
    terminal.print(f"Page: {page}")
    return {"page": str(page), "facts": list(results.facts), "digests": results.settings["digests"]}

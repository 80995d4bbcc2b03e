"""``palpate demo``: everything once, from photos to a page."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from palpate.cli.reproduce import run_into
from palpate.cli.terminal import Common, OutPath, Terminal, option_group


@option_group
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
    from palpate.studies.demo import Demo

    data = options.data and options.data.resolve()
    demo = Demo(options.preset, data, options.seed, options.device)
    results = run_into(options.output, demo, terminal)
    page = str(options.output / "page.html")
    return {"page": page, "facts": list(results.facts), "digests": results.settings["digests"]}

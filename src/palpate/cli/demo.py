"""``palpate demo``: everything once, from photos to a page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from palpate.cli.terminal import Common, OutPath, Switch, Terminal, require_extra
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
    """`mini` takes minutes on two cores; `tiny` only shows that everything runs, and trains all its
    models itself."""
    clip: str | None = None
    """Hub id or folder of a pretrained CLIP, instead of the small one that ships with palpate."""
    autoencoder: str | None = None
    """A pretrained autoencoder (see `palpate train generator`), instead of the small one that
    ships."""
    from_scratch: Switch = False
    """Use nothing that ships: train the small models in the run, on another world and the train
    part."""
    by: Literal["auto", "video", "contact", "object"] = "auto"
    """What the split keeps whole; `auto` takes the video, or the contact if videos are too few."""
    background: Switch = False
    """Train the variant that also sees the no-contact image."""
    seed: int = 0
    """Of the split, the weights, the order of training and the noise."""
    skip_bad: Switch = False
    """Skip bad rows and files of --data, and list them."""
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
    names = ("preset", "clip", "autoencoder", "from_scratch", "by", "seed", "skip_bad")
    chosen = {name: getattr(options, name) for name in (*names, "background", "device")}
    data = options.data and options.data.resolve()
    try:
        with terminal.progress() as progress:
            demo = run_demo(
                DemoOptions(data=data, **chosen),
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

"""``palpate demo``: everything once, from photos to a page."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, Terminal, require_extra
from palpate.core import PalpateError


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Run everything once: data, leak-free split, encoders, generator, touches, scores, page.

    Without --data it runs offline on the embedded synthetic world. Stopped half-way, the same command goes on from the last finished stage.
    """

    data: Path | None = None
    """A Touch and Go tree (or anything `palpate import` reads) instead of the embedded world."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("runs/demo")
    """Run folder."""
    preset: Literal["mini", "tiny"] = "mini"
    """`mini` takes minutes on two cores; `tiny` is for trying the plumbing, and trains all its models itself."""
    clip: str | None = None
    """Hub id or folder of a pretrained CLIP, instead of the small one that ships with palpate."""
    autoencoder: str | None = None
    """Hub id or folder of a pretrained VQ model, instead of the small one that ships with palpate."""
    from_scratch: bool = False
    """Take nothing that ships: train the small CLIP, tactile encoder and autoencoder in the run, on another world and the train part."""
    group: Literal["auto", "video", "contact", "object"] = "auto"
    """What the split keeps whole; `auto` takes the video, or the touch where videos are too few."""
    background: bool = False
    """Train the variant that also sees the no-contact image."""
    seed: int = 0
    """Of the split, the weights, the order of training and the noise."""
    skip_bad: bool = False
    """Leave out bad rows and files of --data and list them, instead of refusing."""
    device: str = "auto"
    """auto, cpu, cuda, mps."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Runs the pipeline and writes the page."""
    require_extra("palpate demo")
    from palpate.report import summary_lines, write_report
    from palpate.studies.pipeline import PipelineOptions, run_pipeline
    from palpate.studies.summary import summarize

    out = options.data if options.data is None else options.data.resolve()
    asked = PipelineOptions(
        preset=options.preset,
        data=out,
        clip=options.clip,
        autoencoder=options.autoencoder,
        from_scratch=options.from_scratch,
        group=options.group,
        seed=options.seed,
        skip_bad=options.skip_bad,
        background=options.background,
        device=options.device,
    )
    if (
        options.out.is_dir()
        and any(options.out.iterdir())
        and not any(options.out.glob("*.partial"))
        and not any(options.out.glob("*/stage.json"))
    ):
        raise PalpateError(
            f"{options.out} must be new, empty, or a run folder of the demo",
            "a folder with other files",
            "Choose another --out",
        )
    try:
        with terminal.progress() as progress:
            outcome = run_pipeline(asked, options.out, say=terminal.say, progress=progress)
    except PalpateError:
        if options.out.is_dir() and not any(
            options.out.iterdir()
        ):  # refused before any work was done
            options.out.rmdir()
        raise
    words = ["palpate", "demo", "--preset", options.preset, "--seed", str(options.seed)]
    words += ["--data", str(options.data)] if options.data else []
    words += [
        w
        for name in ("clip", "autoencoder")
        if (value := getattr(options, name))
        for w in (f"--{name}", value)
    ]
    words += ["--from-scratch"] if options.from_scratch else []
    words += ["--group", options.group] if options.group != "auto" else []
    words += ["--background"] if options.background else []
    words += ["--skip-bad"] if options.skip_bad else []
    words += ["--out", str(options.out)]
    results = summarize(outcome, shlex.join(words))
    page = write_report(results, options.out / "page.html").page
    terminal.print("")
    for line in summary_lines(results):
        terminal.print(line)
    terminal.print(f"Page: {page}")
    return {"page": str(page), "facts": list(results.facts), "digests": results.settings["digests"]}

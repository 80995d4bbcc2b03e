"""``palpate reproduce``: the paper's tables from one command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Switch, Terminal, require_extra
from palpate.core import PalpateError

#: Names of ``palpate.studies.study.STUDIES``, without its imports.
Study = Literal["world-gelsight", "world-digit", "tag", "hct", "clips"]


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Run a whole study of the paper: train, generate, score, and write its tables and page.

    Run the same command again to go on where it was stopped; with more seeds, methods or splits
    what is there is kept.
    """

    study: Annotated[Study, tyro.conf.Positional]
    """On the world: `world-gelsight` (tables 1, 3 and 4) or `world-digit` (tables 2 and 4); on data
    at --root: `tag` (Touch and Go), `hct`, or `clips` (of Touch and Go)."""
    output: OutPath
    """Run folder: results.json, page.html, tables.tex, figures/, and a folder a
    stage."""
    preset: str = "mini"
    """`mini`: stages of 82 to 137 minutes a seed, and 36 once; `smoke` only shows
    that everything runs; `paper`, for data at --root, is the paper's size (a GPU)."""
    steps: int | None = None
    """Optimizer steps of each compared method, in place of the preset's."""
    vq: str | None = None
    """The paper's kind of autoencoder: a folder, hub id or .ckpt of latent diffusion's vq-f4; for
    preset `paper`, or in place of the one that is trained."""
    seeds: tuple[int, ...] = (0,)
    """One training of every encoder and generator each; intervals are over these, too."""
    root: Path | None = None
    """The data set on disk, for studies that are not of the world."""
    method: tuple[str, ...] = ()
    """NAME=FOLDER: images of the test part that another system made, scored like ours. The test
    part is that of FOLDER/split/NoLeak.json of an earlier run."""
    people: Path | None = None
    """Results of `palpate preference score -o`: columns of table 3, and what claims follow from."""
    inception: Path | None = None
    """TorchScript file of Inception: FID as published; without it the column is missing."""
    clip: str | None = None
    """Folder or hub id of a CLIP: CMMD as published; without it the column is missing."""
    lpips: Annotated[tuple[Path, Path] | None, tyro.conf.arg(metavar="BACKBONE HEADS")] = None
    """The two files of LPIPS: AlexNet's weights and the heads; else the column is missing."""
    jobs: int = 1
    """Processes that run stages at the same time."""
    device: str = "auto"
    """auto, cpu, cuda, mps."""
    dry_run: Switch = False
    """Print the stages and which are done; write nothing."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Run the stages and write what shows them."""
    require_extra("palpate reproduce")
    others = _folders(options.method)
    from palpate.core import write_text
    from palpate.evaluation.companions import Weights
    from palpate.report import summary_lines
    from palpate.studies.graph import plan_graph
    from palpate.studies.reproduce import nodes_of, plan_of, run_study
    from palpate.studies.study import STUDIES

    output = options.output
    plan = plan_of(
        STUDIES[options.study],
        preset=options.preset,
        seeds=options.seeds,
        root=options.root,
        others=others,
        device=options.device,
        people=options.people,
        steps=options.steps,
        vq=options.vq,
        weights=Weights(inception=options.inception, clip=options.clip, lpips=options.lpips),
    )
    if options.dry_run:
        stages = plan_graph(nodes_of(plan), output)
        for name, done in stages.items():
            terminal.print(f"{'done' if done else 'to do':>5}  {name}")
        return {"stages": stages}
    kept = any(output.glob("*.partial")) or any(output.glob("*/stage.json"))
    if output.is_dir() and any(output.iterdir()) and not kept:
        must, got = "must be new, empty, or a run folder", f"{output}, with other files"
        raise PalpateError(must, got, "Choose another folder", argument="output")
    with terminal.progress() as progress:
        results = run_study(
            plan,
            output,
            command=terminal.command,
            jobs=options.jobs,
            print_line=terminal.print_line,
            progress=progress,
        )
    page = output / "page.html"
    results.to_html(page)
    write_text(output / "tables.tex", results.to_latex())
    results.save_figures(output / "figures")
    terminal.print("")
    for line in summary_lines(results):
        terminal.print(line)
    terminal.print(f"Page: {page}")
    files = {"results": output / "results.json", "page": page}
    digests = results.settings["digests"]
    return {**{k: str(v) for k, v in files.items()}, "facts": results.facts, "digests": digests}


def _folders(values: tuple[str, ...]) -> dict[str, Path]:
    """``NAME=FOLDER`` of other systems."""
    folders: dict[str, Path] = {}
    for value in values:
        name, equals, folder = value.partition("=")
        if not (name and equals and folder) or name in folders:
            must, example = "must be NAME=FOLDER, each name once", {"method": "flowtouch=dir/"}
            raise PalpateError(must, value, "", argument="method", example=example)
        folders[name] = Path(folder)
    return folders

"""``palpate reproduce``: the paper's tables from one command."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, OutPath, Switch, Terminal, option_group
from palpate.core import require

if TYPE_CHECKING:
    from palpate.report.results import Results
    from palpate.studies import reproduce
    from palpate.studies.demo import Demo

#: Names of ``palpate.studies.study.STUDIES``, without its imports.
Study = Literal["world-gelsight", "world-digit", "tag", "hct", "clips"]


@option_group
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
    trust_torchscript: Switch = False
    """Run the code in that file: a program, which runs with your rights and can write files."""
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
    systems = _folders(options.method)
    from palpate.core import write_text
    from palpate.evaluation.scorers import Weights
    from palpate.studies.reproduce import Plan
    from palpate.studies.running import plan_graph
    from palpate.studies.study import STUDIES

    output = options.output
    plan = Plan(
        STUDIES[options.study],
        preset=options.preset,
        seeds=options.seeds,
        root=options.root,
        systems=systems,
        device=options.device,
        people=options.people,
        steps=options.steps,
        vq=options.vq,
        weights=Weights(
            inception=options.inception,
            clip=options.clip,
            lpips=options.lpips,
            trust_torchscript=options.trust_torchscript,
        ),
    )
    if options.dry_run:
        stages = plan_graph(plan.nodes(), output)
        for name, done in stages.items():
            terminal.print(f"{'done' if done else 'to do':>5}  {name}")
        return {"stages": stages}
    results = run_into(output, plan, terminal, options.jobs)
    write_text(output / "tables.tex", results.to_latex())
    results.save_figures(output / "figures")
    files = {"results": output / "results.json", "page": output / "page.html"}
    digests = results.settings["digests"]
    return {**{k: str(v) for k, v in files.items()}, "facts": results.facts, "digests": digests}


def run_into(
    output: Path, plan: reproduce.Plan | Demo, terminal: Terminal, jobs: int = 1
) -> Results:
    """Run all stages in a run folder, write the page and print what it says first.

    Raises:
        PalpateError: if the folder holds other files, or as the stages raise.
    """
    from palpate.report import summary_lines
    from palpate.studies.reproduce import run_study

    kept = any(output.glob("*.partial")) or any(output.glob("*/stage.json"))
    free = not output.is_dir() or not any(output.iterdir()) or kept
    must, got = "must be new, empty, or a run folder", f"{output}, with other files"
    require(free, "output", must, got, fix="Choose another folder")
    results = terminal.run(
        run_study, plan, output, command=terminal.command, jobs=jobs, print_line=terminal.print_line
    )
    page = output / "page.html"
    results.to_html(page)
    terminal.print("")
    for line in summary_lines(results):
        terminal.print(line)
    terminal.print(f"Page: {page}")
    return results


def _folders(values: tuple[str, ...]) -> dict[str, Path]:
    """``NAME=FOLDER`` of other systems."""
    folders: dict[str, Path] = {}
    for value in values:
        name, equals, folder = value.partition("=")
        once = bool(name and equals and folder) and name not in folders
        require(once, "method", "must be NAME=FOLDER, each name once", value, "flowtouch=dir/")
        folders[name] = Path(folder)
    return folders

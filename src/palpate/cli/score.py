"""``palpate score``: how good are these tactile images, or their embeddings?"""

from __future__ import annotations

import math
import shutil
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, Terminal, guard_output
from palpate.core import PalpateError
from palpate.report.results import Results

Companion = Literal[
    "fid", "kid", "cmmd", "prdc", "ssim", "psnr", "ms-ssim", "contact", "lpips", "none"
]


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Score tactile images, or embeddings, against real touches, or on the test part of a split beside controls; several generators side by side."""

    manifest: Annotated[Path | None, tyro.conf.Positional] = None
    """Manifest file or the folder of an import, with the real touches; needs --split."""
    generated: tuple[Path, ...]
    """What to score, one entry a generator: folders of images or of `palpate generate`, manifests, or embeddings (.npy, .npz, .safetensors, .parquet)."""
    reference: Path | None = None
    """The real touches, instead of a manifest and a split: of the same kinds. Ids are relative file names."""
    encoder: str | None = None
    """Folder of `palpate encoder`, a hub id, or palpate/mini; the tactile encoder gives the features. Embeddings need none."""
    split: Path | None = None
    """Split file; its test part is scored. With --reference, its train part gives the floor of TMMD."""
    names: tuple[str, ...] = ()
    """Names of the generators in the tables, instead of those of their folders and files."""
    labels: Path | None = None
    """CSV or Parquet file with the columns id, material, video, for inputs that lack them."""
    groups: Path | None = None
    """The same, for groups alone: where labels and groups lie in two files."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Write scores, gallery and settings as JSON, for `palpate report`."""
    latex: Path | None = None
    """Write the tables as LaTeX (booktabs; longtable for many differences)."""
    presets: tuple[Literal["grouped", "paper", "paper-tables", "cmmd"], ...] = ()
    """Readings of the TMMD family: `paper` is the formula to the letter, `grouped` keeps whole videos together. Default: both, or `paper` without groups."""
    sigma: tuple[str, ...] = ("10",)
    """Bandwidths: numbers, `median` (of the reference's distances), `multi` (five around it)."""
    estimator: Literal["unbiased", "biased", "grouped"] | None = None
    """Instead of the presets' own."""
    backend: Literal["auto", "blocked", "moments"] = "auto"
    """How kernel sums are made; `auto` is right."""
    normalize: Literal["check", "yes", "no"] = "check"
    """Embeddings that are not of unit length: refuse, divide by the norm, or take as they are."""
    permutations: int = 999
    """Relabelings of the permutation test of TMMD; 0 for none."""
    companions: tuple[Companion, ...] | None = None
    """Scores beside the TMMD family. Default: all that need no further weights and whose inputs are there; `none` for none."""
    inception: Path | None = None
    """TorchScript file of Inception: FID and KID are then of its features, as published."""
    clip: str | None = None
    """Folder or hub id of a CLIP: CMMD is then of its features, as published."""
    lpips: Annotated[tuple[Path, Path] | None, tyro.conf.arg(metavar="BACKBONE HEADS")] = None
    """The two files of LPIPS: AlexNet's weights and the heads."""
    group: Literal["auto", "video", "contact", "object"] = "auto"
    """What stays together in halves and intervals; `auto` takes what the split kept whole, else the video."""
    cache: Path | None = None
    """Folder that keeps embeddings of what was read (with MANIFEST those of the real touches). Default: one beside -o, for a run that is stopped; removed at the end."""
    controls: Annotated[bool, tyro.conf.FlagConversionOff] = True
    """With MANIFEST and --split: score the empty gel and real touches of the same material as well (True or False)."""
    seed: int = 0
    """Of random halves, permutations and the control touches."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Scores, prints the tables, writes JSON and LaTeX."""
    from palpate.cli import scoring_runs
    from palpate.cli.scoring_tables import show

    _check(options)
    inputs = _inputs(options)
    if options.output:
        guard_output(options.output, inputs)
    if options.latex:
        guard_output(options.latex, inputs, (b"% palpate",))
        if options.output and options.latex.resolve() == options.output.resolve():
            raise PalpateError(
                "-o and --latex must be two files",
                str(options.latex),
                "Give one of them another name",
            )
    cache = _cache(options)
    with _told(terminal) as told, terminal.progress() as progress:
        results = scoring_runs.score(options, terminal, cache, progress)
    results = replace(results, notes=[*results.notes, *told])
    try:
        show(
            results, terminal, said=[] if terminal.silent else told
        )  # before saving: a disk that fails loses nothing
    finally:  # nor does one behind standard output
        _save(options, results)
    if cache is not None and options.cache is None:
        shutil.rmtree(cache, ignore_errors=True)
    return results.to_json()


def _save(options: Options, results: Results) -> None:
    if options.output:
        results.save(options.output)
    if options.latex:
        from palpate.core import write_text
        from palpate.report.latex import latex_tables

        write_text(options.latex, latex_tables(results))


def _inputs(options: Options) -> list[Path]:
    """Everything that is read."""
    return [
        p
        for p in (
            options.manifest,
            options.reference,
            options.split,
            options.labels,
            options.groups,
            *options.generated,
        )
        if p
    ]


def _cache(options: Options) -> Path | None:
    """The folder for embeddings: the one named, else one beside the output."""
    if options.cache is not None:
        return options.cache
    output = options.output or options.latex
    return output.absolute().parent / f".{output.name}.work" if output else None


def sigmas(options: Options) -> tuple[float | str, ...]:
    """The bandwidths as numbers and words.

    Raises:
        PalpateError: for another word, or a number that is not positive, or whose square is not finite.
    """
    found: list[float | str] = []
    for text in options.sigma:
        if text in ("median", "multi"):
            found.append(text)
            continue
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not 1e-100 < value < 1e100:
            raise PalpateError(
                "--sigma must be numbers from 1e-100 to 1e100, median or multi",
                repr(text),
                "E.g. --sigma 10 median",
            )
        found.append(value)
    return tuple(dict.fromkeys(found))


def _check(options: Options) -> None:
    """Refuses options that do not go together, before anything is read."""
    if not options.generated:
        raise PalpateError(
            "There must be something to score",
            "no --generated",
            "E.g. --generated out/ --reference real/ --encoder palpate/mini",
        )
    if (options.manifest is None) == (options.reference is None):
        got = "neither" if options.manifest is None else "both"
        fix = "Pass --reference R, or MANIFEST with --split and --encoder"
        raise PalpateError(
            "The real touches must be given once: as --reference, or as a manifest", got, fix
        )
    if options.manifest is not None and (options.split is None or options.encoder is None):
        lacking = " and ".join(
            name
            for name, v in (("--split", options.split), ("--encoder", options.encoder))
            if v is None
        )
        raise PalpateError(
            "Scoring a manifest must have a split and encoders",
            f"no {lacking}",
            "Or pass the real touches as --reference",
        )
    if options.names and len(options.names) != len(options.generated):
        got = f"{len(options.names)} names for {len(options.generated)}"
        raise PalpateError(
            "--names must name every generator", got, "One name for each entry of --generated"
        )
    if options.manifest is not None and (options.labels or options.groups):
        raise PalpateError(
            "--labels and --groups must go with --reference",
            "a manifest, which has its own",
            "Leave them out",
        )
    if options.manifest is None and not options.controls:
        raise PalpateError(
            "--controls must go with MANIFEST and --split",
            "--reference, which has no controls",
            "Leave it out",
        )
    for flag, kinds in (("inception", ("fid", "kid")), ("clip", ("cmmd",)), ("lpips", ("lpips",))):
        if (
            getattr(options, flag) is not None
            and options.companions is not None
            and not set(kinds) & set(options.companions)
        ):
            fix = f"Add {kinds[0]} to --companions, or leave --{flag} out"
            raise PalpateError(
                f"--{flag} must have a score to make",
                f"--companions {' '.join(options.companions)}",
                fix,
            )
    if (
        options.companions is not None
        and "none" in options.companions
        and len(options.companions) > 1
    ):
        raise PalpateError(
            "--companions must be none, or names",
            " ".join(options.companions),
            "Leave none out, or all others",
        )
    if options.cache is not None and (
        options.cache.is_file()
        or any(options.cache.resolve().is_relative_to(p.resolve()) for p in _inputs(options))
    ):
        raise PalpateError(
            "--cache must be a folder of its own",
            str(options.cache),
            "Name another one, outside what is read",
        )
    if options.permutations < 0:
        raise PalpateError(
            "--permutations must not be negative", str(options.permutations), "0 makes none"
        )
    if not options.sigma:
        raise PalpateError(
            "--sigma must name at least one bandwidth", "none", "E.g. --sigma 10 median"
        )
    sigmas(options)


@contextmanager
def _told(terminal: Terminal) -> Generator[list[str]]:
    """Warnings of the metrics as remarks, which are listed as they come, and their advice in this command's words."""
    flags = {
        "normalize=True": "Pass --normalize yes to divide by the norm, or --normalize no to keep it",
        'preset="paper"': "Pass --groups FILE, or --presets paper",
        'estimator="unbiased"': "Pass --estimator unbiased, or more groups",
        'backend="blocked"': "Pass --backend blocked",
        "pass None for all": "Fill the empty cells of that column, or leave the column out",
    }
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        said: list[str] = []

        def say(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
            if issubclass(category, UserWarning) and str(message) not in said:
                said.append(str(message))
                terminal.say(f"Note: {message}")

        warnings.showwarning = say
        try:
            yield said
        except PalpateError as error:
            if (
                type(error) is not PalpateError
                or (fix := next((v for k, v in flags.items() if k in error.fix), None)) is None
            ):
                raise
            raise PalpateError(error.must, error.got, fix) from None

"""``palpate score``: how good are these tactile images?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import Common, Terminal, guard_output, require_extra
from palpate.core import Results, Score


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Score generated tactile images on the test part of a split: TMMD family, SSIM, PSNR, material accuracy, with intervals."""

    manifest: Annotated[Path, tyro.conf.Positional]
    """Manifest file or the folder of an import, with the real touches."""
    generated: tuple[Path, ...]
    """Folders of `palpate generate`; several are scored side by side under their folder names."""
    split: Path
    """Split file; its test part is scored."""
    towers: str
    """Folder of `palpate encoder`, a hub id, or palpate/mini; the touch tower gives the features."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Write scores, gallery and settings as JSON, for `palpate report`."""
    presets: tuple[Literal["grouped", "paper", "paper-tables", "cmmd"], ...] = ("grouped", "paper")
    """Readings of the TMMD family: `paper` is the formula to the letter, `grouped` keeps whole videos together."""
    group: Literal["auto", "video", "touch", "object"] = "auto"
    """What stays together in halves and intervals; `auto` takes what the split kept whole."""
    controls: Annotated[bool, tyro.conf.FlagConversionOff] = True
    """Score the empty gel and real touches of the same material as well (True or False)."""
    seed: int = 0
    """Of random halves and of the control touches."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Scores, prints one line a score, writes the JSON."""
    require_extra("palpate score")
    from palpate.core import PalpateError, Split
    from palpate.data.manifest import Manifest
    from palpate.encoders.towers import Towers
    from palpate.generate import Generated
    from palpate.protocol.scoring import score_generated
    from palpate.protocol.summary import gallery

    if not options.presets:
        raise PalpateError("--presets must name at least one preset", "none", "E.g. --presets grouped paper")
    split = Split.load(options.split)
    group = str(split.rule.get("group", "video")) if options.group == "auto" else options.group
    names = [p.name if p.name != "touches" else p.resolve().parent.name for p in options.generated]
    if len(set(names)) < len(names):
        raise PalpateError("Folders of generated touches must differ in name", ", ".join(names), "Rename one: the name stands in the table")
    folders = {name: Generated.load(path) for name, path in zip(names, options.generated, strict=True)}
    if options.output:
        guard_output(options.output, [options.manifest, options.split])
    manifest, towers = Manifest.load(options.manifest), Towers.load(options.towers)
    with terminal.progress() as progress:
        scores = score_generated(
            manifest, split, folders, towers, group=group, presets=options.presets,
            controls=options.controls, seed=options.seed, progress=progress,
        )  # fmt: skip
    digests = {"manifest": manifest.digest, "split": split.digest, "touch tower": towers.digest("touch")}
    results = Results(
        title=f"Scores of {', '.join(names)}", scores=scores, gallery=gallery(manifest, folders[names[0]], options.seed),
        settings={"digests": digests, "split rule": dict(split.rule), "generated": {name: dict(f.settings) for name, f in folders.items()}},
        commands=[terminal.command],
    )  # fmt: skip
    if options.output:
        results.save(options.output)
    show(scores, terminal)
    return results.to_json()


def show(scores: list[Score], terminal: Terminal) -> None:
    """A table in the terminal, one row a score."""
    from rich.table import Table

    table = Table("metric", "preset", "subject", "value", "95 % interval", "floor", "n", box=None, pad_edge=False)
    for s in scores:
        value = "undefined" if s.value is None else f"{s.value:.4g}"
        around = f"[{s.interval[0]:.4g}, {s.interval[1]:.4g}]" if s.interval else "-"
        floor = f"{s.floor:.4g}" if s.floor is not None else "-"
        table.add_row(
            f"{s.metric} {'↑' if s.higher_is_better else '↓'}",
            s.settings.get("preset", ""),
            s.subject,
            value,
            around.replace("[", "\\["),
            floor,
            str(s.n),
        )
    terminal.out.print(table)
    for note in dict.fromkeys(f"{s.metric}, {s.subject}: {s.note}" for s in scores if s.note and s.value is None):
        terminal.say(note)

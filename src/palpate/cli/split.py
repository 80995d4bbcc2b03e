"""``palpate split``: a split that does not leak."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.audit import show
from palpate.cli.terminal import Common, OutPath, Terminal, guard_output


@dataclass(frozen=True, kw_only=True)
class Options(Common):
    """Make a split in which no group stands in two parts and every material keeps its share."""

    manifest: Annotated[Path, tyro.conf.Positional]
    """Manifest file or the folder of an import."""
    output: OutPath
    """Split file to write."""
    train: float = 0.8
    """Share of the train part."""
    val: float = 0.0
    """Share of the validation part; test gets the rest."""
    group: Literal["auto", "video", "touch", "object", "domain", "sensor"] = "auto"
    """What to keep whole. `auto` takes the video, or the touch where videos are too few, and says so."""
    seed: int = 0
    """Another seed gives another split."""


def run(options: Options, terminal: Terminal) -> dict[str, Any]:
    """Makes the split, audits it, writes it."""
    from palpate.data.manifest import Manifest
    from palpate.leakage import audit_split, describe, leak_free_split

    guard_output(options.output, [options.manifest], (b'"format": "palpate-split/',))
    manifest = Manifest.load(options.manifest)
    plan = leak_free_split(manifest, train=options.train, val=options.val, group=options.group, seed=options.seed)
    audit = audit_split(manifest, plan.split, group=plan.group, name=options.output.name)
    plan.split.save(options.output)
    facts = dict(describe(plan))
    terminal.facts(f"Split {options.output}", facts)
    show(audit, terminal)
    return facts | {"path": str(options.output), "audit": dataclasses.asdict(audit)}

"""A graph of stages: each node a call that fills a folder and reads those of earlier nodes.

A node declares a stage: its name, the call, the call's options, and the nodes that it reads. To run
the graph (:mod:`palpate.studies.running`) is to build the stages that are missing, in the order of
the nodes. The digest of a stage holds its options and the digests of the stages that it reads
(:mod:`palpate.studies.stages`), so that a changed option builds again what depends on it and
nothing else; its record holds the digests of their files, so that it is built again after a stage
that was made again with other files (trained on a GPU, say).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.core import Progress, few, quiet, require
from palpate.studies.stages import stage_digest


@dataclass(frozen=True)
class Work:
    """What a node's call works on.

    Attributes:
        folder: to fill.
        after: name -> folder of the nodes that it reads.
        cache: of the run; nothing depends on what it holds.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        progress: called with what is done.
    """

    folder: Path
    after: Mapping[str, Path] = field(default_factory=dict[str, Path])
    cache: Path | None = None
    device: str = "auto"
    progress: Progress = quiet

    @property
    def stage(self) -> str:
        """The name of the stage that is built."""
        return self.folder.name.removesuffix(".partial")


@dataclass(frozen=True)
class Stamped:
    """An option whose value is no JSON, or not all that matters: a digest takes the stamp for it.

    Stamps are made by :mod:`palpate.studies.stamps`.
    """

    value: Any
    stamp: Any


@dataclass(frozen=True)
class Node:
    """A stage of a study.

    Attributes:
        name: folder of the stage in the run folder.
        call: called with a :class:`Work` and the options; fills the folder and returns facts
            (JSON). For several processes a function of a module.
        options: of the call; all of them enter the digest, a :class:`Stamped` one by its stamp.
        after: names of the earlier nodes that it reads; their digests enter its own.
        version: raised by hand when the stage comes to write other bytes.
        measures: it trains nothing: ``palpate verify`` builds it again, to compare.
    """

    name: str
    call: Callable[..., Mapping[str, Any] | None]
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])
    after: Sequence[str] = ()
    version: int = 1
    measures: bool = False

    def build(self, work: Work) -> Mapping[str, Any] | None:
        """Fill the folder of ``work``."""
        values = ((k, v.value if isinstance(v, Stamped) else v) for k, v in self.options.items())
        return self.call(work, **dict(values))

    def inputs(self, digests: Mapping[str, str]) -> dict[str, Any]:
        """What the stage reads, of the ``digests`` of earlier nodes."""
        names = {k: v.stamp if isinstance(v, Stamped) else v for k, v in self.options.items()}
        return {**names, "after": {name: digests[name] for name in self.after}}


class Nodes(list[Node]):
    """The nodes of a study, each after those that it reads."""

    def add(
        self,
        name: str,
        call: Callable[..., Mapping[str, Any] | None],
        /,
        *after: str,
        measures: bool = False,
        version: int = 1,
        **options: Any,
    ) -> None:
        """Append a :class:`Node`.

        Raises:
            PalpateError: for a name that is taken or no folder's, or an unknown ``after``.
        """
        names = {node.name for node in self}
        free = Path(name).name == name and not name.startswith(".") and name not in names
        must = "A stage must have a name of its own, that of a folder"
        require(free, None, must, name, fix="Rename it")
        unknown, fix = sorted({*after} - names), "Add it first, or correct the name"
        must = f"Stage {name} must come after stages of the same graph"
        require(not unknown, None, must, few(unknown), fix=fix)
        self.append(Node(name, call, options, after, version, measures))


def digests_of(nodes: Sequence[Node]) -> dict[str, str]:
    """What names each stage: the digest of what it reads, by name."""
    digests: dict[str, str] = {}
    for node in nodes:
        digests[node.name] = stage_digest(node.name, node.inputs(digests), node.version)
    return digests

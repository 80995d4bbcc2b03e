"""Every field of a preset as an option: ``--lr``, ``--batch-size``, ``--tactile-width`` ...

What is not given is the preset's. The names are the fields', flat; those of a preset's main
training have no prefix.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, make_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import tyro

from palpate.cli.terminal import Common, OutPath, Switch, Terminal
from palpate.core import PalpateError
from palpate.training.options import Compute, LoopOptions

#: Presets of ``palpate train encoder``.
EncoderPresetName = Literal["mini", "tiny", "tvl-tiny", "tvl-small", "tvl-base", "paper"]
#: Fields that have another name on the command line.
WORDS = {"batch": "batch_size"}


@dataclass(frozen=True)
class _Field:
    flag: str
    path: str
    kind: Any
    help: str


@cache
def _fields(preset: type[Any], main: str, skip: tuple[str, ...]) -> tuple[_Field, ...]:
    outside = tuple(f"{path}." for path in skip)
    return tuple(f for f in _walk(preset, main, ()) if not f"{f.path}.".startswith(outside))


def _walk(record: type[Any], main: str, path: tuple[str, ...]) -> Iterator[_Field]:
    hints, texts = get_type_hints(record), attributes(record)
    for each in dataclasses.fields(record):
        kind = hints[each.name]
        where = (*path, each.name)
        inner = [t for t in (kind, *get_args(kind)) if dataclasses.is_dataclass(t)]
        if inner:  # one record, or one of several
            parts = [part for t in inner if isinstance(t, type) for part in _walk(t, main, where)]
            yield from {part.flag: part for part in reversed(parts)}.values()
            continue
        parts = [p.removesuffix("_course") for p in where if p != main]
        flag = "_".join([*parts[:-1], WORDS.get(parts[-1], parts[-1])])
        text = texts.get(each.name) or attributes(LoopOptions).get(each.name, "")
        yield _Field(flag, ".".join(where), kind, text)


@cache
def attributes(record: type[Any]) -> Mapping[str, str]:
    """The texts of a record's docstring about its attributes."""
    # From Python 3.13 on a docstring has lost its indentation already.
    block = inspect.cleandoc(record.__doc__ or "").partition("Attributes:")[2].partition("\n\n")[0]
    texts: dict[str, str] = {}
    for names, text in re.findall(r"^ {4}([\w, ]+): ((?:.|\n {5,})+)", block, re.MULTILINE):
        plain = re.sub(r":\w+:`([^`]*)`|``([^`]*)``", r"\1\2", " ".join(text.split()))
        texts |= dict.fromkeys(names.split(", "), plain[:1].upper() + plain[1:].rstrip(".") + ".")
    return texts


def preset_flags(title: str, preset: type[Any], main: str, skip: tuple[str, ...]) -> Any:
    """A group of options, each None unless given: the fields of a preset class.

    What may be None there is switched off by the word ``none``.

    Args:
        title: of the class.
        preset: the class.
        main: the field that holds the main training, whose options have no prefix.
        skip: paths of fields that have an option of their own, or of whole parts.
    """
    rows: list[tuple[str, Any, Any]] = []
    for each in _fields(preset, main, skip):
        about = tyro.conf.arg(help=each.help, help_behavior_hint="(default: the preset's)")
        off = Literal["none"] if type(None) in get_args(each.kind) else None
        rows.append((each.flag, Annotated[each.kind | off | None, about], field(default=None)))
    return make_dataclass(title, rows, frozen=True, kw_only=True)


def fields_given(preset: type[Any], given: Any, main: str, skip: tuple[str, ...]) -> list[_Field]:
    """The fields of a preset class that were given on the command line."""
    return [f for f in _fields(preset, main, skip) if getattr(given, f.flag) is not None]


def with_flags(preset: Any, given: Any, main: str, skip: tuple[str, ...]) -> Any:
    """The preset with the fields that were given on the command line.

    Raises:
        PalpateError: for a field of a part that the preset does not have.
    """
    for each in fields_given(type(preset), given, main, skip):
        value = getattr(given, each.flag)
        *parts, name = each.path.split(".")
        records = [preset]
        for part in parts:
            records.append(getattr(records[-1], part))
        if not hasattr(records[-1], name):
            must, got = "must belong to a part of the preset", f"a preset without {each.path}"
            raise PalpateError(must, got, "Leave it out", argument=each.flag)
        value = None if value == "none" and type(None) in get_args(each.kind) else value
        for record, inner in zip(reversed(records), [name, *reversed(parts)], strict=True):
            value = dataclasses.replace(record, **{inner: value})
        preset = value
    return preset


@dataclass(frozen=True, kw_only=True)
class Machine:
    """How to run it on the machine at hand; nothing here changes what is computed."""

    device: str = "auto"
    """auto, cpu, cuda, mps."""
    precision: Literal["float32", "bf16", "fp16"] = "float32"
    """Of matrix products; the weights stay float32. bf16 is float32 on an x86 CPU without bf16."""
    tf32: bool = True
    """Let float32 products on CUDA round their factors to 10 bits."""
    compile: Switch = False
    """Compile the loss with torch.compile: minutes at the start, faster steps."""
    channels_last: Switch = False
    """Memory layout of convolutions."""
    gradient_checkpointing: Switch = False
    """Compute activations twice instead of keeping them."""
    chunk: int | None = None
    """Rows that a contrastive encoder sees at a time; the loss is that of the whole batch."""
    checkpoint_minutes: float = 5.0
    """Time between checkpoints."""
    trackers: tuple[Literal["tensorboard", "wandb"], ...] = ()
    """Where the log goes, too."""

    @property
    def compute(self) -> Compute:
        """The settings as the rooms take them."""
        return Compute(**{k: v for k, v in vars(self).items() if k != "device"})


@dataclass(frozen=True, kw_only=True)
class Training(Common):
    """What all trainings take."""

    data: Annotated[Path, tyro.conf.Positional]
    """Manifest file, the folder of an import, or a data set."""
    output: OutPath
    """Folder for what is trained; must be new or empty."""
    split: Path | None = None
    """Split file; only its train part is trained on. Default: the one that lies with the data, in
    `splits/`."""
    seed: int = 0
    """Of everything random: weights, order, augmentation, noise."""
    machine: Machine = field(default_factory=Machine)
    """How to run it on the machine at hand."""

    def require_data(self) -> None:
        """Raise ``PalpateError`` if the data are not there, before torch is imported (seconds)."""
        from palpate.data.formats import require_source

        require_source(self.data)


def print_plan(terminal: Terminal, title: str, plan: dict[str, Any]) -> dict[str, Any]:
    """Print what a training would take, and return it."""
    terminal.facts(title, plan | {"seconds": f"{plan['seconds']:,.0f}"})
    return plan

"""What the verbs that train share: data, output, preset, and how to run it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, fields
from pathlib import Path
from typing import Any, Literal, TypeVar

from palpate.cli.settings import PresetTable, Settings
from palpate.cli.terminal import Common, OutPath, PathArgument, Switch, Terminal, option_group
from palpate.diffusion.presets import PRESETS as GENERATORS
from palpate.diffusion.presets import DiffusionPreset
from palpate.encoders.presets import PRESETS as ENCODERS
from palpate.training.options import Compute

T = TypeVar("T")
_TEXTS = {"name": "", "cost": "", "score": ""}
#: The presets of each verb, and what ``--set`` leaves to other options.
PRESETS = {
    "train encoder": PresetTable(
        ENCODERS, {**_TEXTS, "pretrained": "--clip", "tactile_course.epochs": "--epochs"}
    ),
    "train autoencoder": PresetTable(
        {name: preset for name, preset in GENERATORS.items() if preset.autoencoder},
        {f.name: "" for f in fields(DiffusionPreset) if f.name not in ("size", "autoencoder")},
    ),
    "train generator": PresetTable(
        GENERATORS,
        {
            **_TEXTS,
            "condition.width": "",
            "epochs": "--epochs",
            "loop.steps": "--steps",
            "loop.seed": "--seed",
        },
    ),
}


@option_group
class Computing:
    """How to compute on the machine at hand; nothing here changes what is computed."""

    device: str = "auto"
    """auto, cpu, cuda, mps."""
    precision: Literal["float32", "bf16", "fp16"] = "float32"
    """Of matrix products; the weights stay float32. On an x86 CPU without bf16, bf16 is float32."""
    gradient_checkpointing: Switch = False
    """Compute activations twice instead of keeping them: less memory, slower."""
    checkpoint_minutes: float = 5.0
    """Minutes between checkpoints."""

    @property
    def compute(self) -> Compute:
        """The settings as the rooms take them."""
        return Compute(**{k: v for k, v in vars(self).items() if k != "device"})


@option_group
class Machine(Computing):
    """How to run it on the machine at hand; nothing here changes what is computed."""

    tf32: bool = True
    """Let float32 products on CUDA round their factors to 10 bits."""
    compile: Switch = False
    """Compile the loss with torch.compile: minutes at the start, faster steps."""
    channels_last: Switch = False
    """Store images with channels last, which some GPUs convolve faster."""
    trackers: tuple[Literal["tensorboard", "wandb"], ...] = ()
    """Where the log goes, too."""

    def keywords(self) -> dict[str, Any]:
        """What the functions that train take of it."""
        return {"device": self.device, "compute": self.compute}


@option_group
class EncoderMachine(Machine):
    """The same for the training of encoders."""

    chunk: int | None = None
    """Rows that the encoder sees at a time; the loss is that of the whole batch."""


@option_group
class Training(Common):
    """What all trainings take."""

    data: PathArgument
    """Manifest file, the folder of an import, or a data set."""
    output: OutPath
    """Folder for what is trained; must be new or empty."""
    split: Path | None = None
    """Split file; only its train part is trained on. Default: the one that lies in `splits/` with
    the data."""
    preset: str = "mini"
    """Networks, schedule and length of the training; `palpate presets` lists all, with what each
    costs."""
    settings: Settings = ()
    """Change fields of the preset, as `loop.lr=3e-4`; `palpate presets NAME` lists all."""
    seed: int = 0
    """Of everything random: weights, order, augmentation, noise."""
    machine: Machine = field(default_factory=Machine)
    """How to run it on the machine at hand."""

    def chosen(self, verb: str) -> Any:
        """The preset of a verb with what ``--set`` changes.

        Raises:
            PalpateError: if there is none, or a tracker is not there: before torch is imported,
                which takes seconds.
        """
        preset, _ = PRESETS[verb].preset(self.preset, self.settings), self.machine.compute
        return preset

    def trained(self, terminal: Terminal, train: Callable[..., T], **keywords: Any) -> T:
        """Train, or load what this command trained before and say so."""
        before = (self.output / "palpate.json").is_file()
        model = terminal.run(train, **keywords)
        if before:
            terminal.print_line(f"Finished before: {self.output} is what this command trains.")
        return model

    def print_plan(self, terminal: Terminal, plan: dict[str, Any]) -> dict[str, Any]:
        """Print what a training would take, and return it."""
        rows = plan | {"seconds": f"{plan['seconds']:,.0f}"}
        terminal.facts(f"Plan of {self.output}", rows)
        return plan

    def note_split(self, terminal: Terminal, rule: Mapping[str, Any]) -> None:
        """Print what is known of recordings, and what the split of a model shares."""
        from palpate.data.recordings import rule_notes

        for note in rule_notes(rule):
            terminal.note(note)

"""What the card of a saved pipeline says, and the settings of sampling; read and checked without torch.

``palpate.json`` of :mod:`palpate.diffusion.pipeline` names the schedule, the default sampler and the dropout of the condition, which is all that
decides whether given settings can be sampled with; so a command line can refuse them before it imports anything large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from palpate.core import PalpateError, read_record, reading_entry

FORMAT = "palpate-pipeline/2"
#: Format 1 called the encoders ``towers``; it is still read.
FORMAT_1 = "palpate-pipeline/1"
#: What the card must have beside the format.
KEYS = (
    "digest",
    "preset",
    "size",
    "condition",
    "schedule",
    "sampler",
    "latents",
    "autoencoder",
    "training",
)
Method = Literal["ddim", "dpm"]


@dataclass(frozen=True)
class SamplerOptions:
    """How to sample.

    Attributes:
        method: ``ddim`` (eta 0) or ``dpm`` (DPM-Solver++ of order 2).
        steps: network evaluations a sample (two each under guidance).
        guidance: s; 1 means none.
        batch: samples at once; results do not depend on it (up to rounding).
        rescale: share phi of the guidance rescaling of Lin et al. (2024), which pulls the spread of the guided
            prediction back to that of the conditional one; 0 is the plain formula.
    """

    method: Method = "ddim"
    steps: int = 200
    guidance: float = 7.5
    batch: int = 16
    rescale: float = 0.0


def read_card(folder: Path) -> dict[str, Any]:
    """The card of the pipeline in ``folder``.

    Raises:
        PalpateError: if there is none, or it is of another format or lacks an entry.
    """
    about = read_record(
        folder / "palpate.json", "card of the pipeline", form=(FORMAT, FORMAT_1), keys=KEYS
    )
    about.setdefault("encoders", about.pop("towers", None))
    return about


def require_settings(options: SamplerOptions, *, most: int, dropout: float | None = None) -> None:
    """Refuses settings that cannot be sampled with, before any work is done.

    Args:
        options: the settings.
        most: steps of the schedule.
        dropout: of the condition in training; None: not checked.

    Raises:
        PalpateError: on an unknown method, on steps, batch or guidance out of range, or guidance for a denoiser that never saw the unconditional token.
    """
    if options.steps < 1 or options.batch < 1 or options.steps > most:
        got = f"steps {options.steps}, batch {options.batch}"
        raise PalpateError(
            f"Sampling needs 1 to {most} steps and a batch of at least 1",
            got,
            "Choose e.g. 50 steps and batch 16",
        )
    if options.method not in get_args(Method):
        raise PalpateError(
            f"The sampling method must be {' or '.join(get_args(Method))}",
            repr(options.method),
            "Choose one of these",
        )
    if not (math.isfinite(options.guidance) and options.guidance >= 0):
        raise PalpateError(
            "Guidance must be a finite number from 0 on",
            str(options.guidance),
            "Choose e.g. 2; 1 is none",
        )
    if dropout is not None and options.guidance != 1 and not dropout:
        raise PalpateError(
            "Guidance needs a generator trained with condition dropout",
            f"guidance {options.guidance:g} and dropout 0 in the checkpoint",
            "Pass guidance 1, or train with dropout 0.1",
        )


def require_sampler(
    folder: Path,
    *,
    guidance: float | None = None,
    steps: int | None = None,
    batch: int | None = None,
) -> None:
    """Refuses settings that the pipeline in ``folder`` cannot sample with, by its card alone.

    Args:
        folder: of a saved pipeline.
        guidance: in place of that of its default sampler.
        steps: the same.
        batch: the same.

    Raises:
        PalpateError: see :func:`require_settings`; or if the card cannot be used.
    """
    about, note = read_card(folder), folder / "palpate.json"
    given = {
        k: v
        for k, v in {"guidance": guidance, "steps": steps, "batch": batch}.items()
        if v is not None
    }
    with reading_entry(note, "sampler"):
        options = replace(SamplerOptions(**about["sampler"]), **given)
    with reading_entry(note, "schedule"):
        most = int(about["schedule"]["steps"])
    with reading_entry(note, "condition"):
        dropout = float(about["condition"]["dropout"])
    with reading_entry(note, "sampler"):
        require_settings(options, most=most, dropout=dropout)

"""What a call of ``generate`` will take, from a batch that is sampled with few steps.

    seconds = batches (t_1 + (s - s_1) (t_2 - t_1) / (s_2 - s_1))

t_1 and t_2 are the seconds of a batch with few steps of the scheduler (s_1 and s_2), s the number
that was requested. Photos are read and images written meanwhile.
"""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from palpate.core import Progress, plain, quiet
from palpate.core.digest import fact_lines
from palpate.diffusion.generation import (
    Run,
    as_files,
    frames_of,
    in_memory,
    loaded,
    prepare,
    video_of,
)
from palpate.diffusion.pipeline import TactilePipeline

#: Steps of the two batches that are timed; the first one is sampled twice, to warm up.
FEW, MORE = 2, 4


@dataclass(frozen=True)
class Estimate:
    """What a call will take. Print it.

    Attributes:
        images: all of them.
        missing: those that are not there yet; the rest of the estimate is of these.
        steps: of the solver, an image.
        evaluations: of the network, in all; guidance takes two a step.
        seconds: in all, after the model is loaded.
        bytes: of the images on disk.
        measured: images that were sampled for it; 0 where none could be.
    """

    images: int
    missing: int
    steps: int
    evaluations: int
    seconds: float
    bytes: int
    measured: int

    def to_json(self) -> dict[str, Any]:
        """The estimate as a JSON object."""
        return plain(self)

    def __str__(self) -> str:
        minutes = self.seconds / 60
        rows = {
            "images": f"{self.images:,}",
            "to be made": f"{self.missing:,}",
            "steps": self.steps,
            "network evaluations": f"{self.evaluations:,}",
            "time": f"about {minutes:,.1f} min" if minutes > 2 else f"about {self.seconds:,.1f} s",
            "disk": f"about {self.bytes / 1e6:,.1f} MB",
            "measured on": f"{self.measured} images, with few steps",
        }
        return "\n".join(["Nothing was written", *fact_lines(rows)])


def estimate(
    photos: Any = None,
    *,
    model: TactilePipeline | str | Path = "palpate/mini",
    output: str | Path | None = None,
    device: str = "auto",
    progress: Progress = quiet,
    **options: Any,
) -> Estimate:
    """Estimate a call of :func:`~palpate.diffusion.generation.generate` of the same arguments.

    Returns:
        Images, network evaluations, time and disk; nothing is written.

    Raises:
        PalpateError: as the call would, but for photos that the sampled batch does not hold.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if photos is not None and in_memory(photos):
            photos = as_files(photos, folder)
        elif (video := video_of(photos)) is not None:
            model = loaded(model, device, progress)
            photos = frames_of(video, folder, model, options, progress)[0]
        options |= {"output": None if output is None else Path(output), "device": device}
        run = prepare(photos, model=model, progress=progress, **options)
        return _estimated(run, folder / "sampled")


def _estimated(run: Run, folder: Path) -> Estimate:
    target = run.target
    missing = [i for i in run.inputs if not (target.written(i.id) and target.has(i.id, i.digest()))]
    chunk = [*islice(replace(run, inputs=missing).reader(), run.sampler.batch)]
    copies = run.chooser.n if run.chooser else 1
    count, evaluations = _work(run, run.sampler.steps)
    common = (len(run.inputs), len(missing), run.sampler.steps)
    if not chunk:
        return Estimate(*common, evaluations=0, seconds=0.0, bytes=0, measured=0)
    seconds, counts = list[float](), list[int]()
    for steps in (FEW, FEW, MORE):
        how = dict(run.how) | {"sampler": replace(run.sampler, steps=steps)}
        start = time.perf_counter()
        images = run.sample(chunk, **how)
        seconds.append(time.perf_counter() - start)
        counts.append(_work(run, steps)[0])
    step = max(0.0, (seconds[2] - seconds[1]) / (counts[2] - counts[1]))
    batch = max(seconds[1] + (count - counts[1]) * step, count * step)
    target = target.at(folder)
    for one, image in zip(chunk, images, strict=True):
        target.keep(one, image)
    size = sum(p.stat().st_size for p in folder.rglob("*.png")) / len(chunk)
    batches = math.ceil(len(missing) / run.sampler.batch / target.place[1])
    return Estimate(
        *common,
        evaluations=len(missing) * evaluations * copies,
        seconds=batches * batch,
        bytes=round(len(missing) * size),
        measured=len(chunk),
    )


def _work(run: Run, steps: int) -> tuple[int, int]:
    """Steps of the scheduler, and network evaluations, of one image."""
    model, sampler = run.model, run.sampler
    scheduler = model.scheduler
    scheduler.set_timesteps(steps)
    times = [float(t) / model.schedule.steps for t in scheduler.timesteps]
    guided = sampler.guidance not in (0.0, 1.0)
    twice = sum(sampler.low <= t <= sampler.high for t in times) if guided else 0
    return len(times), len(times) + twice

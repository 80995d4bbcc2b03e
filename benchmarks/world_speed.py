"""How fast the synthetic world renders, and what more workers give.

    python benchmarks/world_speed.py                     # frames, objects, random access; a minute
    python benchmarks/world_speed.py --parts workers     # one and two processes

Times are CPU seconds of this process, medians over videos, and wall-clock ratios for workers.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from palpate.sim import MATERIALS, PRESETS, Video, World, WorldOptions, plan_world, write_world
from palpate.sim.objects import make_object
from palpate.sim.plan import ObjectRef, contact_frames


def cpu_seconds(function: Callable[[], object]) -> float:
    """CPU seconds of one call."""
    start = time.process_time()
    function()
    return time.process_time() - start


def measure_frames(size: int, videos: int = 20) -> dict[str, float]:
    """Contact frames a second (both images), and milliseconds to set up an object.

    Args:
        size: side of the images in pixels; the tile has four times as many.
        videos: how many to render.
    """
    options = WorldOptions(size=size, tile=4 * size, objects_per_material=2, seed=11)
    refs = [ObjectRef(name, 0) for name in MATERIALS]
    objects = [cpu_seconds(lambda ref=ref: make_object(options, ref)) for ref in refs]
    rates = []
    for plan in plan_world(options)[:videos]:
        video = Video(options, plan)
        frames = [f for k in range(options.contacts_per_video) for f in contact_frames(options, k)]
        video.vision(frames[0])  # lights the object, once a video

        def render(video: Video = video, frames: list[int] = frames) -> None:
            for frame in frames:
                video.vision(frame)
                video.tactile(frame)

        rates.append(len(frames) / cpu_seconds(render))
    return {
        "frames a second": statistics.median(rates),
        "object, ms (mean)": 1000 * statistics.mean(objects),
        "object, ms (max)": 1000 * max(objects),
    }


def measure_access(size: int) -> dict[str, float]:
    """Milliseconds of a sample of :class:`World`, in order and at random."""
    world = World(WorldOptions(size=size, tile=4 * size, objects_per_material=2))
    order = range(0, 120)
    apart = range(0, len(world), len(world) // 40)
    return {
        "sample in order, ms": 1000 * cpu_seconds(lambda: [world[k] for k in order]) / 120,
        "sample at random, ms": 1000 * cpu_seconds(lambda: [world[k] for k in apart]) / len(apart),
    }


def measure_workers(preset: str, counts: tuple[int, ...] = (1, 2)) -> dict[str, float]:
    """Wall-clock seconds of a written world by number of processes."""
    options, seconds = dataclasses.replace(PRESETS[preset]), {}
    for count in counts:
        with tempfile.TemporaryDirectory() as folder:
            start = time.monotonic()
            write_world(Path(folder) / "world", options, workers=count)
            seconds[f"{preset} with {count} processes, s"] = time.monotonic() - start
    return seconds


def run() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = ("frames", "access", "workers")
    parser.add_argument("--parts", nargs="+", default=["frames", "access"], choices=parts)
    parser.add_argument("--sizes", nargs="+", type=int, default=[64, 128])
    parser.add_argument("--preset", default="small", choices=list(PRESETS))
    options = parser.parse_args()
    for size in options.sizes:
        measures = {"frames": measure_frames, "access": measure_access}
        for part in (p for p in options.parts if p in measures):
            for name, value in measures[part](size).items():
                print(f"{size:4d} px  {name:24s} {value:9.1f}")
    if "workers" in options.parts:
        for name, value in measure_workers(options.preset).items():
            print(f"{name:34s} {value:9.1f}")


if __name__ == "__main__":
    run()

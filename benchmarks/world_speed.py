"""How fast the procedural world renders, how little memory it takes, and whether lazily rendered frames equal written ones.

    python benchmarks/world_speed.py                                     # everything that is there, about six minutes
    python benchmarks/world_speed.py --parts frames --sizes 64           # frames, objects, videos; beside the prototype if it is found
    python benchmarks/world_speed.py --parts processes memory equal

- ``frames``: CPU seconds of one core (``time.process_time``, so that other work on the machine counts little) for objects, videos and frames of both
  images, at each size with tile 4 x size. The prototype (``--prototype``, or where ``PALPATE_SHARED_DATA`` or ``../shared`` has it; skipped otherwise) does
  the same work in the same run, object for object and video for video in turn: as many materials, objects, videos, touches and frames; with the same
  tile, and once more with its own default of 512.
- ``processes``: the clock for the same world written by one and by two processes, in turn, beside the same for a pure NumPy loop, which shows what
  the machine can give; the load of the machine before is printed.
- ``memory``: peak resident memory of a child process that writes a world of 1, 4 and 16 times as many videos.
- ``equal``: frames rendered alone, in a random order, against the arrays written.
"""

import argparse
import dataclasses
import importlib.util
import json
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from palpate.core import rng_for
from palpate.sim import (
    PRESETS,
    VERSION,
    Video,
    World,
    WorldOptions,
    open_arrays,
    plan_world,
    write_world,
)
from palpate.sim.objects import make_object
from palpate.sim.plan import contact_frames

PARTS = ("frames", "processes", "memory", "equal")
WANTED = {
    "frames a second and core at 64 px": 150,
    "object ms": 60,
    "times the prototype": 1.5,
    "two processes against one": 1.7,
}
PROTOTYPE_TILE = 512


@dataclasses.dataclass
class Cost:
    """CPU seconds: one entry an object (by material), a video, a frame."""

    objects: dict
    videos: list
    frames: list

    def total(self):
        return sum(map(sum, self.objects.values())) + sum(self.videos) + sum(self.frames)

    def rate(self):
        return 1 / np.mean(self.frames)

    def object_ms(self):
        """Mean over objects, and the mean of the slowest material with its name."""
        means = {name: 1000 * float(np.mean(values)) for name, values in self.objects.items()}
        worst = max(means, key=means.get)
        return (
            1000 * float(np.mean(np.concatenate(list(self.objects.values())))),
            means[worst],
            worst,
        )

    def video_ms(self):
        return 1000 * float(np.mean(self.videos))


def empty_cost():
    return Cost({}, [], [])


def clocked(function, *arguments):
    """What ``function`` returns, and the CPU seconds it took."""
    start = time.process_time()
    result = function(*arguments)
    return result, time.process_time() - start


def world_for(size, objects, touches, frames, tile=None, seed=11):
    return WorldOptions(
        seed=seed,
        size=size,
        tile=tile or min(1024, 4 * size),
        objects_per_material=objects,
        contacts_per_video=touches,
        frames_per_contact=frames,
        mixed=0.0,
        free_written="background",
    )


def ours(options, plan, cost):
    """One video of palpate: its object, its set-up (light and pose; the second call of the first photo is taken off the first), its frames."""
    numbers = [
        frame
        for touch in range(options.contacts_per_video)
        for frame in contact_frames(options, touch)
    ]
    ref = plan.objects[0]
    _, spent = clocked(make_object, options, ref)
    cost.objects.setdefault(ref.material, []).append(spent)
    video, spent = clocked(Video, options, plan)
    _, first = clocked(video.vision, numbers[0])
    _, again = clocked(video.vision, numbers[0])
    cost.videos.append(spent + max(0.0, first - again))
    video.background()
    for frame in numbers:
        cost.frames.append(clocked(video.vision, frame)[1] + clocked(video.tactile, frame)[1])


def theirs(prototype, sensors, options, plan, tile, cost):
    """The same video of the prototype."""
    material = options.names.index(plan.objects[0].material)
    thing, spent = clocked(
        prototype.make_object, options.seed, material, plan.objects[0].number, tile
    )
    cost.objects.setdefault(plan.objects[0].material, []).append(spent)
    video, spent = clocked(
        prototype.make_video,
        options.seed,
        plan.index,
        thing,
        sensors[plan.sensor],
        options.contacts_per_video,
        options.frames_per_contact,
        options.size,
    )
    cost.videos.append(spent)
    prototype.background(video)
    for frame in range(options.contacts_per_video * options.frames_per_contact):
        cost.frames.append(clocked(prototype.frame, video, frame)[1])


def find_prototype(given):
    """The prototype as a module, or None where there is none."""
    shared = os.environ.get("PALPATE_SHARED_DATA")
    places = (
        [given]
        if given
        else [*([Path(shared).parent / "prototype"] if shared else []), Path("../shared/prototype")]
    )
    for place in places:
        path = Path(place) if Path(place).suffix == ".py" else Path(place) / "world_prototype.py"
        if path.is_file():
            spec = importlib.util.spec_from_file_location("world_prototype", path)
            module = importlib.util.module_from_spec(spec)
            sys.modules["world_prototype"] = module
            spec.loader.exec_module(module)
            return module
    return None


def measure_frames(size, objects, touches, frames, prototype=None, other_tiles=()):
    """Costs of palpate and, by tile, of the prototype on the same videos, in turn."""
    options = world_for(size, objects, touches, frames)
    plans, mine, rivals = (
        plan_world(options),
        empty_cost(),
        {tile: empty_cost() for tile in other_tiles},
    )
    ours(options, plans[0], empty_cost())  # imports, caches of FFT plans, sensors
    sensors = (
        [prototype.make_sensor(options.seed, unit, size) for unit in range(options.sensors)]
        if prototype
        else []
    )
    for plan in plans:
        for unit in range(options.sensors) if plan is plans[0] else ():
            Video(options, dataclasses.replace(plan, sensor=unit)).background()
        ours(options, plan, mine)
        for tile, cost in rivals.items():
            theirs(prototype, sensors, options, plan, tile, cost)
    return options, mine, rivals


def show_frames(size, options, mine, rivals):
    videos = len(mine.videos)
    print(
        f"\n{size} px, tile {options.tile}: {videos} objects and videos, {len(mine.frames) // videos} contact frames each, CPU time of one core"
    )
    print(
        f"{'':26s} {'frames/s':>9s} {'object ms':>10s} {'slowest material ms':>26s} {'video ms':>9s} {'whole s':>8s}"
    )
    for name, cost in [
        ("palpate", mine),
        *((f"prototype, tile {tile}", cost) for tile, cost in rivals.items()),
    ]:
        mean, worst, who = cost.object_ms()
        print(
            f"{name:26s} {cost.rate():9.1f} {mean:10.1f} {worst:9.1f} {who:>16s} {cost.video_ms():9.1f} {cost.total():8.2f}"
        )
    for tile, cost in rivals.items():
        print(
            f"times the prototype with tile {tile}: frames {mine.rate() / cost.rate():.2f}, objects {cost.object_ms()[0] / mine.object_ms()[0]:.2f}, "
            f"videos {cost.video_ms() / mine.video_ms():.2f}, the whole work {cost.total() / mine.total():.2f}"
        )


def frames_part(chosen):
    prototype = find_prototype(chosen.prototype)
    if prototype is None:
        print("prototype: not found (--prototype), so palpate stands alone")
    for size in chosen.sizes:
        tiles = sorted({min(1024, 4 * size), PROTOTYPE_TILE}) if prototype else []
        count = chosen.objects if size <= 64 else 1
        show_frames(size, *measure_frames(size, count, 4, 4, prototype, tiles))


def burn(rounds):
    """A loop that needs one core and little memory."""
    a = np.random.default_rng(0).standard_normal((64, 64), dtype=np.float32)
    for _ in range(rounds):
        a = np.tanh(a * 1.01 + 0.1)
    return float(a[0, 0])


def machine_ceiling(rounds=60_000):
    """How many times faster two processes do twice the loop than one does it twice, both already started."""
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        pool.map(burn, [10, 10], chunksize=1)
        start = time.perf_counter()
        pool.map(burn, [rounds, rounds], chunksize=1)
        both = time.perf_counter() - start
        start = time.perf_counter()
        pool.map(burn, [rounds])
        pool.map(burn, [rounds])
        return (time.perf_counter() - start) / both


def clock_write(options, workers):
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        record = write_world(Path(folder) / "world", options, workers=workers)
        return time.perf_counter() - start, record


def processes_part(chosen):
    options = dataclasses.replace(PRESETS[chosen.preset], layout="raw")
    print(
        f"\nload of the machine before (1, 5, 15 minutes): {', '.join(f'{v:.2f}' for v in os.getloadavg())}; {os.cpu_count()} processors"
    )
    ceilings, times = [machine_ceiling()], {1: [], 2: []}
    for _ in range(chosen.repeats):
        for workers in (1, 2):
            seconds, record = clock_write(options, workers)
            times[workers].append(seconds)
    ceilings.append(machine_ceiling())
    frames = record.counts["written_frames"]
    for workers, values in times.items():
        listed = ", ".join(f"{v:.1f}" for v in values)
        print(
            f"preset {chosen.preset} as {options.layout}, {workers} process(es): {listed} s, best {frames / min(values):.0f} frames/s"
        )
    ratios = ", ".join(f"{a / b:.2f}" for a, b in zip(*times.values(), strict=True))
    print(
        f"two processes against one: {ratios}; best against best {min(times[1]) / min(times[2]):.2f}"
    )
    print(
        f"a NumPy loop on this machine, before and after: {', '.join(f'{v:.2f}' for v in ceilings)}"
    )


def child(settings, folder):
    """Writes a world in this process and says its peak memory in MiB."""
    record = write_world(Path(folder) / "world", WorldOptions(**settings))
    print(
        json.dumps(
            {
                "mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
                "frames": record.counts["written_frames"],
            }
        )
    )


def peak_of(options):
    """Peak memory in MiB of a fresh process that writes that world, and its written frames."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            str(Path(__file__).resolve()),
            "--child",
            json.dumps(dataclasses.asdict(options)),
            folder,
        ]
        found = json.loads(
            subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[
                -1
            ]
        )
    return found["mib"], found["frames"]


def memory_part(chosen):
    print("\npeak memory of a process that writes a world of 64 px")
    for layout in ("raw", "frames"):
        peaks = []
        for factor in (1, 4, 16):
            mib, frames = peak_of(dataclasses.replace(world_for(64, factor, 4, 4), layout=layout))
            peaks.append(mib)
            print(f"{layout:8s} {factor:3d} x: {frames:6d} written frames, {mib:7.1f} MiB")
        print(f"{layout:8s} 16 x against 1 x: {peaks[-1] - peaks[0]:+.1f} MiB")


def compare(options, count, workers=1, seed=0):
    """Samples compared, values that differ, and the largest difference, of ``count`` samples rendered alone in random order and the arrays written."""
    with tempfile.TemporaryDirectory() as folder:
        write_world(Path(folder) / "world", options, workers=workers)
        arrays, world = open_arrays(Path(folder) / "world"), World(options)
        rows = rng_for(seed, "compared").permutation(len(world))[:count]
        differ = largest = 0
        for row in rows:
            sample = world[int(row)]
            if sample["id"] != arrays.manifest.ids[row]:
                raise SystemExit(
                    f"row {row} is {arrays.manifest.ids[row]} as written and {sample['id']} as rendered"
                )
            for name in ("vision", "tactile", "background"):
                difference = np.abs(sample[name].astype(int) - getattr(arrays, name)[row])
                differ, largest = (
                    differ + int((difference > 0).sum()),
                    max(largest, int(difference.max())),
                )
    return len(rows), differ, largest


def equal_part(chosen):
    print(
        "\nsamples (vision, tactile, background) rendered alone by World[k], in random order, against the arrays that two processes wrote"
    )
    for size, look, count in (
        (64, "gelsight", 1000),
        (64, "digit", 300),
        (128, "gelsight", 200),
        (256, "gelsight", 50),
    ):
        options = dataclasses.replace(
            world_for(size, 2, 4, 4),
            look=look,
            layout="raw",
            mixed=0.2,
            materials=20 if size == 64 else 6,
        )
        compared, differ, largest = compare(options, count, workers=2)
        print(
            f"{size:4d} px {look:9s} {compared:5d} of {len(World(options))} samples: {differ} values differ, largest difference {largest}"
        )


def main():
    if sys.argv[1:2] == ["--child"]:
        child(json.loads(sys.argv[2]), sys.argv[3])
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=PARTS)
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256])
    parser.add_argument(
        "--objects", type=int, default=3, help="objects a material at 64 px; one at larger sizes"
    )
    parser.add_argument("--prototype", help="the prototype's file or folder")
    parser.add_argument(
        "--preset", default="small", choices=tuple(PRESETS), help="of the processes part"
    )
    parser.add_argument("--repeats", type=int, default=2, help="of the processes part")
    chosen = parser.parse_args()
    print(
        f"world version {VERSION}; wanted: {', '.join(f'{name} {value:g}' for name, value in WANTED.items())}"
    )
    run = {
        "frames": frames_part,
        "processes": processes_part,
        "memory": memory_part,
        "equal": equal_part,
    }
    for part in chosen.parts:
        run[part](chosen)


if __name__ == "__main__":
    main()

"""How near the world's GelSight images are to real ones: statistics of five real clips of Touch and Go beside the world's.

    python benchmarks/world_fidelity.py                                  # prints the tables, about two minutes
    python benchmarks/world_fidelity.py --write docs/studies/world_fidelity.md   # writes them
    python benchmarks/world_fidelity.py --sizes 64 --videos 20           # a quick look

The real clips are found under ``PALPATE_SHARED_DATA`` or ``../shared/data`` (``touch_and_go/clips``, needs PyAV). Of each 480 x 640 frame the central
square is taken and averaged down; the pad is taken to be 14 mm high, so that a pixel is 14 / n mm. A run is a stretch of labeled frames; its background
is the frame 4 before its first. Of the world, one frame at random of two contacts a video, against the frame 4 before the contact.

The statistics are those of `benchmarks/world_statistics.py`. A statistic is ``inside`` if the world's median lies between the smallest and the largest median
of a real clip, otherwise ``outside`` with the distance; ``share`` says how many of the world's frames lie within 5 .. 95 % of the real frames.
"""

import argparse
import datetime
import itertools
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from world_statistics import (
    BANDS,
    change,
    color_grid,
    contact_area,
    contrast,
    marker_statistics,
    noise_level,
    spectrum,
    to_size,
)

from palpate.sim import PRESETS, VERSION, Video, plan_world
from palpate.sim.gel import make_sensor, shade
from palpate.sim.options import BACKGROUND_OFFSET
from palpate.sim.plan import contact_frames, first_contact

EVERY = 4  # real frames of a run used
NAMES = {
    "mean R": "mean of R",
    "mean G": "mean of G",
    "mean B": "mean of B",
    "tint": "largest minus smallest channel, mean of 9 cells",
    "rms_r": "rms of R",
    "rms_g": "rms of G",
    "rms_b": "rms of B",
    "p95_r": "95 % of R",
    "p95_g": "95 % of G",
    "p95_b": "95 % of B",
    "chroma": "chroma share",
    "slope": "log-log slope, 0.15 .. 2 /mm",
    "count": "dark blobs a pad",
    "marker area": "their share of the pad, %",
    "largest": "the largest, % of the pad",
    "area": "contact area, %",
    "noise": "image noise, gray levels",
} | {
    f"band_{k}": f"{low:g} .. {high:g} cycles/mm, rms"
    for k, (low, high) in enumerate(itertools.pairwise(BANDS))
}
TABLES = {
    "Color of the empty gel (gray levels)": ["mean R", "mean G", "mean B", "tint"],
    "Contrast: contact minus background (gray levels)": [
        "rms_r",
        "rms_g",
        "rms_b",
        "p95_r",
        "p95_g",
        "p95_b",
        "chroma",
    ],
    "Radial power spectrum of contact minus background": [
        *(f"band_{k}" for k in range(len(BANDS) - 1)),
        "slope",
    ],
    "Markers of the empty gel": ["count", "marker area", "largest"],
    "Contact area and noise": ["area", "noise"],
}


def real_touches():
    """Clip, background, the frame before it, contact frame for the frames used, as the central squares (480, 480, 3); or None where data or PyAV are missing."""
    root = (
        Path(
            os.environ.get(
                "PALPATE_SHARED_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"
            )
        )
        / "touch_and_go"
        / "clips"
    )
    try:
        import av
    except ImportError:
        return None
    if not (root / "label.txt").is_file():
        return None
    numbers = {}
    for line in (root / "label.txt").read_text().split():
        clip, file = line.split(",")[0].split("/")
        numbers.setdefault(clip, []).append(int(file.removesuffix(".jpg")))
    touches = []
    for clip, wanted in sorted(numbers.items()):
        with av.open(str(root / "dataset" / clip / "gelsight.mp4")) as file:
            frames = [f.to_ndarray(format="rgb24")[:, 80:560] for f in file.decode(video=0)]
        wanted = sorted(wanted)
        for first in [a for a in wanted if a - 1 not in wanted]:
            after = first
            while after in wanted:
                after += 1
            before = max(0, first - BACKGROUND_OFFSET)
            for f in range(first, min(after, len(frames)), EVERY):
                touches.append((clip, frames[before], frames[max(0, before - 1)], frames[f]))
    return touches


def world_touches(seeds, videos, size):
    """Material, background, another free frame, contact frame; from ``videos`` videos of each seed of the preset small."""
    touches = []
    for seed in seeds:
        options = replace(PRESETS["small"], seed=seed, size=size, tile=256 if size <= 64 else 512)
        plans = plan_world(options)
        rng = np.random.default_rng(seed)
        for index in rng.permutation(len(plans))[:videos]:
            video = Video(options, plans[index])
            for touch in rng.permutation(options.contacts_per_video)[:2]:
                before = first_contact(options, int(touch)) - BACKGROUND_OFFSET
                frame = int(rng.choice(contact_frames(options, int(touch))))
                material = plans[index].object_of(int(touch)).material
                touches.append(
                    (
                        material,
                        video.tactile(before),
                        video.tactile(before - 1),
                        video.tactile(frame),
                    )
                )
    return touches


def free_change(touches):
    """Median over the touches of the 99 % quantile of the change between two frames without contact."""
    return float(np.median([np.percentile(change(a, b), 99) for _, a, b, _ in touches]))


def measure(touches, threshold):
    """Statistic -> values over the touches, and the cells of the empty gel, (touches, 3, 3, 3)."""
    rows, cells = [], []
    for _, background, _, contact in touches:
        cell, markers = color_grid(background), marker_statistics(background)
        row = (
            {f"mean {c}": float(cell[..., k].mean()) for k, c in enumerate("RGB")}
            | contrast(contact, background)
            | spectrum(contact, background)
        )
        row |= {
            "tint": float((cell.max(-1) - cell.min(-1)).mean()),
            "count": markers["count"],
            "noise": noise_level(background),
        }
        row |= {"marker area": 100 * markers["area"], "largest": 100 * markers["largest"]}
        rows.append(row | {"area": 100 * contact_area(contact, background, threshold)})
        cells.append(cell)
    return {name: np.array([row[name] for row in rows]) for name in NAMES}, np.array(cells)


def verdict(value, low, high):
    distance = max(low - value, value - high)
    return "inside" if distance <= 0 else f"outside by {distance:.2f}"


def by_group(touches, values):
    groups = np.array([touch[0] for touch in touches])
    return {name: float(np.median(values[groups == name])) for name in np.unique(groups)}


def compare(real, world, real_values, world_values):
    """The lines of the tables of :data:`TABLES`."""
    for title, names in TABLES.items():
        yield from (
            f"**{title}**",
            "",
            "| statistic | real clips | real frames | world median | world frames | share | verdict |",
            "|---|---|---|---|---|---|---|",
        )
        for name in names:
            medians = by_group(real, real_values[name]).values()
            low, high = np.percentile(real_values[name], [5, 95])
            a, middle, b = np.percentile(world_values[name], [5, 50, 95])
            share = np.mean((world_values[name] >= low) & (world_values[name] <= high))
            yield (
                f"| {NAMES[name]} | {min(medians):.2f} .. {max(medians):.2f} | {low:.2f} .. {high:.2f} | {middle:.2f} | {a:.2f} .. {b:.2f} "
                f"| {100 * share:.0f} % | {verdict(middle, min(medians), max(medians))} |"
            )
        yield ""


def grid_table(real, real_cells, world_cells):
    """The lines of the table of the nine cells: R, G, B each as real smallest .. largest clip, world's median."""
    yield from (
        "**Empty gel on a grid of 3 x 3 (real clips, world median, verdict)**",
        "",
        "| cell | R | G | B |",
        "|---|---|---|---|",
    )
    for i, j in itertools.product(range(3), repeat=2):
        entries = []
        for c in range(3):
            medians = by_group(real, real_cells[:, i, j, c]).values()
            middle = float(np.median(world_cells[:, i, j, c]))
            entries.append(
                f"{min(medians):.0f} .. {max(medians):.0f}, {middle:.0f} {verdict(middle, min(medians), max(medians))}"
            )
        place = f"{('top', 'middle', 'bottom')[i]} {('left', 'center', 'right')[j]}"
        yield f"| {place} | {' | '.join(entries)} |"
    yield ""


def material_table(real_values, world, world_values):
    """The lines of the medians of each material, with a star where they leave 5 .. 95 % of the real frames."""
    names = [
        "rms_r",
        "rms_g",
        "rms_b",
        "chroma",
        *(f"band_{k}" for k in range(len(BANDS) - 1)),
        "slope",
        "area",
    ]
    yield from (
        "**Medians of each material** (a star: outside 5 .. 95 % of the real frames)",
        "",
        f"| material | {' | '.join(names)} |",
        "|---" * (1 + len(names)) + "|",
    )
    medians = {name: by_group(world, world_values[name]) for name in names}
    for material in sorted(medians["slope"]):
        entries = []
        for name in names:
            low, high = np.percentile(real_values[name], [5, 95])
            value = medians[name][material]
            entries.append(f"{value:.2f}{'' if low <= value <= high else ' *'}")
        yield f"| {material} | {' | '.join(entries)} |"
    yield ""


def unit_table(seeds):
    """The lines of the spread of gel units: mean color of the empty gel without white balance, and markers."""
    yield from (
        "**Units of the family** (64 px, without white balance)",
        "",
        "| seed, unit | mean RGB | blobs | marker area, % |",
        "|---|---|---|---|",
    )
    for seed in seeds:
        options = replace(PRESETS["small"], seed=seed)
        for unit in range(options.sensors):
            image = 255 * shade(
                make_sensor(options, unit), np.zeros((64, 64), np.float32), np.ones(3, np.float32)
            )
            markers = marker_statistics(image)
            red, green, blue = color_grid(image).mean((0, 1))
            yield f"| {seed}, {unit} | {red:.0f} {green:.0f} {blue:.0f} | {markers['count']:.0f} | {100 * markers['area']:.1f} |"
    yield ""


def report(sizes, seeds, videos):
    real_full = real_touches()
    if real_full is None:
        yield "The real clips or PyAV are not there: nothing to compare. Set PALPATE_SHARED_DATA, install av."
        return
    for size in sizes:
        real = [(clip, *(to_size(image, size) for image in images)) for clip, *images in real_full]
        world = world_touches(seeds, videos, size)
        noise = free_change(real), free_change(world)
        threshold = max(4.0, 2 * max(noise))
        (real_values, real_cells), (world_values, world_cells) = (
            measure(real, threshold),
            measure(world, threshold),
        )
        clips = len({touch[0] for touch in real})
        yield from (
            f"## {size} px ({1000 * 14 / size:.0f} µm a pixel): {len(real)} real frames of {clips} clips, {len(world)} of the world",
            "",
        )
        yield from grid_table(real, real_cells, world_cells)
        yield from compare(real, world, real_values, world_values)
        yield (
            f"The change between two frames without contact reaches {noise[0]:.2f} (real) and {noise[1]:.2f} (world) gray levels at 99 % of the pad "
            f"(medians over the touches); the threshold of the contact area is {threshold:.1f}."
        )
        yield ""
        yield from material_table(real_values, world, world_values)
    yield from unit_table(seeds)


def in_words(lines):
    """What the tables say does not fit: medians outside the clips', and statistics of which under 80 % of the world's frames lie among the real ones."""
    size, outside, wide = "", [], []
    for line in lines:
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("## "):
            size = line[3:].split(":")[0].split(" (")[0]
        elif "outside by" in line:
            found = [
                f"{name} {cell.split()[-1]}"
                for name, cell in zip("RGB", cells[1:4], strict=False)
                if "outside by" in cell
            ]
            outside.append(
                f"{size}: {cells[0]} by {', '.join(found)}"
                if found
                else f"{size}: {cells[0]} by {cells[-1].split()[-1]}"
            )
        if len(cells) == 7 and cells[5].endswith("%") and float(cells[5].rstrip(" %")) < 80:
            wide.append(f"{size}: {cells[0]} ({cells[5]})")
    yield from ("## What does not fit", "")
    yield from (
        "Medians of the world outside the spread of the clips (gray levels, or the unit of the row):",
        "",
        *(f"- {text}" for text in outside or ["none"]),
    )
    yield from (
        "",
        "Fewer than 80 % of the world's frames lie between the 5 and 95 % quantiles of the real frames in:",
        "",
    )
    yield from (*(f"- {text}" for text in wide or ["none"]), "")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--videos", type=int, default=60, help="of each seed")
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    asked = parser.parse_args()
    command = "python benchmarks/world_fidelity.py" + (
        f" --write {asked.write}" if asked.write else ""
    )
    options = f"--sizes {' '.join(map(str, asked.sizes))} --seeds {' '.join(map(str, asked.seeds))} --videos {asked.videos}"
    head = [
        "# The simulated GelSight next to real tactile images",
        "",
        f"Written by `{command} {options}`, world VERSION {VERSION}, {datetime.datetime.now(tz=datetime.UTC).date()}. What is measured, and how, "
        "stands in that script and in `benchmarks/world_statistics.py`.",
        "",
        "Read it with care: the real side is five short clips, which look like one or two pads of one product, and their materials are five of the "
        "world's twenty. `inside` means no more than that the world's median frame could have come from one of them.",
        "",
    ]
    body = [*report(asked.sizes, asked.seeds, asked.videos)]
    lines = [*head, *in_words(body), *body]
    text = "\n".join(lines).rstrip() + "\n"
    if asked.write:
        asked.write.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()

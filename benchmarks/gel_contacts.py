"""How often a contact that is given as the picture of an empty gel is noted, and a gel by mistake.

    python benchmarks/gel_contacts.py [--clips CLIPS]

Worlds of both looks, with and without markers, 20 materials, new gel units; and, where the clips of
Touch and Go are, every fifth frame of them: those listed as in contact, those at least 15 frames
away from one, and the least and largest unevenness of the others' quiet half. The lists leave out
light contacts, which the eye sees in the frames between; so the last share holds true ones. Of each
also the least difference of the light over a gel.
"""

import argparse
import os
from pathlib import Path

import numpy as np
from PIL import Image

from palpate.data.images import square
from palpate.data.video import VideoReader
from palpate.diffusion.gels import SMOOTH, light_difference, light_spread, unevenness
from palpate.sim import World, WorldOptions

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
LOOKS = {
    "gelsight": {},
    "gelsight without markers": {"markers": 0},
    "gelsight, 14 rows of markers": {"markers": 14},
    "gelsight of 128 px": {"size": 128},
    "digit": {"look": "digit"},
    "digit with markers": {"look": "digit", "markers": 8},
}


def shares(name, contacts, gels):
    hits, false = (np.mean(np.array(values) > SMOOTH) for values in (contacts, gels))
    low, high = np.quantile(gels, [0, 0.5]), np.max(gels)
    print(
        f"{name}: {100 * hits:.0f} % of {len(contacts)} contacts and {100 * false:.0f} % of "
        f"{len(gels)} gels noted; gels leave {low[0]:.1f}, {low[1]:.1f} (median), {high:.1f}"
    )


def worlds():
    stock = None
    for name, options in LOOKS.items():
        shape = {"objects_per_material": 3, "contacts_per_video": 1, "sensors": 20, "seed": 91}
        world = World(WorldOptions(**shape, **options))
        rows = [world[k] for k in range(0, len(world), 3)]
        small = {
            c: [square(Image.fromarray(row[c]), 64) for row in rows]
            for c in ("tactile", "background")
        }
        shares(name, *([unevenness(i) for i in images] for images in small.values()))
        stock = small["background"][0] if stock is None else stock
        light = [light_difference(gel, stock) for gel in small["background"]]
        spread = min(light_spread(gel) for gel in small["background"])
        print(f"  light against a gelsight: {min(light):.1f} to {max(light):.1f}")
        print(f"  light over a gel: {spread:.1f} at least")


def clips(folder):
    listed = {}
    for line in (folder / "label.txt").read_text().split():
        video, frame = line.split(",")[0].split("/")
        listed.setdefault(video, set()).add(int(Path(frame).stem))
    for video, frames in listed.items():
        contacts, gels, spread = [], [], []
        with VideoReader(folder / "dataset" / video / "gelsight.mp4") as reader:
            for k in range(0, len(reader), 5):
                far = min(abs(k - f) for f in frames) >= 15
                if k in frames or far:
                    small = square(Image.fromarray(reader[k]), 64)
                    (contacts if k in frames else gels).append(unevenness(small))
                    spread.append(light_spread(small))
        shares(video, contacts, gels)
        print(f"  light over it: {min(spread):.1f} at least")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    shared = Path(os.environ.get("PALPATE_SHARED_DATA", SHARED))
    parser.add_argument("--clips", type=Path, default=shared / "touch_and_go" / "clips")
    folder = parser.parse_args().clips
    worlds()
    if (folder / "label.txt").is_file():
        clips(folder)


if __name__ == "__main__":
    main()

"""Two tactile encoders side by side: what they find, what they should not see, what they cost.

    python benchmarks/rulers.py --seeds 77 78 79 --against OLD --write docs/studies/rulers.md

``OLD`` is a folder of encoders, e.g. ``src/palpate/mini/encoders`` of an earlier commit.

On worlds of new objects and gels (``--seeds``; 20 materials, 400 videos), each encoder's features
are standardized by the reference as ``score`` does it for a ruler; those of CI- and D-TMMD by what
the encoder holds. In each of 20 draws the videos
are halved into "generated" and reference, and a fault is planted in the first half:

- swap: images of a tenth of the videos are given to videos of another material;
- collapse: of each material the images of one video stand for all;
- blur: images under a Gaussian of one pixel.

TMMD finds a fault at p < .05; CI- and D-TMMD, which see no reference, where they leave the middle
95 % of the draws without a fault. Beside it: accuracy of naming the gel unit, TMMD of one half as
JPEG 40 at 240 rows against the other as it is, and CPU seconds of embedding (the second time).
Several worlds give means; what a world gave is kept in ``--work``.
"""

import argparse
import datetime
import io
import json
import platform
import time
from functools import partial
from pathlib import Path

import numpy as np
from common import Line, line
from PIL import Image, ImageFilter

from palpate.core import FeatureSet, write_json
from palpate.data.images import load_images
from palpate.data.manifest import Manifest
from palpate.encoders.embed import embed_images
from palpate.encoders.encoder_set import EncoderSet
from palpate.metrics import ci_tmmd, d_tmmd, tmmd
from palpate.metrics.probe import material_accuracy
from palpate.metrics.retrieval import standardized, unit_rows
from palpate.sim import WorldOptions, write_world

DRAWS = 20


def blurred(image):
    return np.asarray(Image.fromarray(image).filter(ImageFilter.GaussianBlur(1)))


def as_jpeg(image, quality=40):
    """Through JPEG at 240 rows, the least that sensors have."""
    large = Image.fromarray(image).resize((240, 240))
    large.save(file := io.BytesIO(), "JPEG", quality=quality)
    return np.asarray(Image.open(file).convert("RGB").resize(image.shape[1::-1]))


class Bench:
    def __init__(self, work, seed):
        folder = work / f"world {seed}"
        write_world(
            folder,
            WorldOptions(
                seed=seed,
                objects_per_material=20,
                contacts_per_video=2,
                frames_per_contact=2,
                phases="spaced",  # as in the recorded page
                free_written="background",
                mixed=0.0,
                sensors=8,
            ),
            workers=2,
            progress=Line(),
        )
        self.data = Manifest.load(folder)
        self.images, self.gels = (
            load_images(self.data.paths(c), 64) for c in ("tactile", "background")
        )
        self.changed = {
            "": self.images,
            "blur": np.stack([*map(blurred, self.images)]),
            "jpeg": np.stack([*map(as_jpeg, self.images)]),
        }
        self.videos, self.materials = map(
            np.array, (self.data.column("video"), self.data.column("material"))
        )
        self.names = sorted({*self.videos.tolist()})
        self.of = {v: self.materials[self.videos == v][0] for v in self.names}

    def numbers(self, encoders, images):
        """Raw numbers of images by one encoder, (n, d)."""
        return embed_images(images, encoders, gels=self.gels, raw=True).astype(np.float64)

    def rows(self, x, at, labels=None):
        videos, labels = self.videos[at], self.materials[at] if labels is None else labels
        return FeatureSet([str(k) for k in range(len(x))], x, labels.tolist(), videos.tolist())

    def planted(self, fault, mine, rng):
        """Rows of the images that stand in the places of the rows of ``mine``."""
        rows = {v: np.flatnonzero(self.videos == v) for v in mine}
        source = {v: v for v in mine}
        if fault == "swap":
            for v in rng.permutation(mine)[: len(mine) // 10]:
                source[v] = rng.choice([w for w in mine if self.of[w] != self.of[v]])
        if fault == "collapse":
            one = {self.of[v]: v for v in rng.permutation(mine)}
            source = {v: one[self.of[v]] for v in mine}
        at = np.concatenate([rows[v] for v in mine])
        return at, np.concatenate([rows[source[v]] for v in mine])

    def draws(self, numbers):
        found = {name: [] for name in ("", "swap", "collapse", "blur")}
        for draw in range(DRAWS):
            rng = np.random.default_rng(draw)
            order = rng.permutation(self.names)
            mine, rest = order[: len(order) // 2], order[len(order) // 2 :]
            other = np.flatnonzero(np.isin(self.videos, rest))
            for fault in found:
                at, shown = self.planted(fault, mine, np.random.default_rng((draw, 1)))
                x = numbers["blur" if fault == "blur" else ""][shown]
                (a, b), _ = standardized([x, numbers[""][other]], numbers[""][other])
                a, b = self.rows(a, at), self.rows(b, other)
                p = tmmd(a, b, preset="grouped", permutations=199).details["p_value"]
                alone = self.rows(unit_rows(x), at)
                free = [f(alone, preset="grouped").value for f in (ci_tmmd, d_tmmd)]
                found[fault].append((p, *free))
        return {k: np.array(v, float) for k, v in found.items()}

    def of_encoder(self, encoders):
        self.numbers(encoders, self.images)
        began = time.process_time()
        numbers = {"": self.numbers(encoders, self.images)}
        cost = time.process_time() - began
        numbers |= {k: self.numbers(encoders, v) for k, v in self.changed.items() if k}
        found, row = self.draws(numbers), {"CPU s": cost}
        for fault, values in found.items():
            low, high = np.quantile(found[""][:, 1:], [0.025, 0.975], axis=0)
            out = ((values[:, 1:] < low) | (values[:, 1:] > high)).mean(0)
            row[fault or "none"] = [float((values[:, 0] < 0.05).mean()), *out.tolist()]
        x = numbers[""]
        (z, coded), _ = standardized([x, numbers["jpeg"]], x)
        half = np.isin(self.videos, self.names[::2])
        a, b = np.flatnonzero(half), np.flatnonzero(~half)
        units = np.array(self.data.column("sensor"))
        named = material_accuracy(self.rows(z[a], a, units[a]), self.rows(z[b], b, units[b]))
        row["gel unit"] = [named.value, 1 / len({*units.tolist()})]
        plain, jpeg = (
            tmmd(self.rows(y[a], a), self.rows(z[b], b), preset="grouped", permutations=0)
            for y in (z, coded)
        )
        row["JPEG 40"] = [plain.value, *plain.interval, jpeg.value]
        return row


def page(rows, seeds):
    """Markdown of two encoders."""
    seeds = " ".join(map(str, seeds))
    ours, old = rows.values()
    found = lambda r, fault: " / ".join(f"{v:.2f}" for v in r[fault])
    near = lambda r: f"{r['gel unit'][0]:.3f}"
    coded = lambda r: f"{r['JPEG 40'][3]:.2f} ({r['JPEG 40'][1]:.2f} to {r['JPEG 40'][2]:.2f})"
    seconds = lambda r: f"{r['CPU s'] / ours['CPU s']:.2f}"
    lines = [
        *(
            (f"{name}, found by TMMD / CI- / D-TMMD", partial(found, fault=fault))
            for fault, name in (
                ("none", "no fault"),
                ("swap", "classes of a tenth swapped"),
                ("collapse", "collapse"),
                ("blur", "blur"),
            )
        ),
        (f"gel unit named (chance {ours['gel unit'][1]:.3f})", near),
        ("TMMD of JPEG 40 (interval without it)", coded),
        ("embedding, seconds over the first's", seconds),
    ]
    body = "\n".join(line(name, of(ours), of(old)) for name, of in lines)
    return f"""# Two rulers

Made by a committed command; do not edit by hand. Synthetic: the table shows a mechanism.

    python benchmarks/rulers.py --seeds {seeds} --against OLD --write docs/studies/rulers.md

`OLD` is the tactile encoder that `palpate/mini` had before the learned ruler (commit e68a139,
`src/palpate/mini/encoders`). Means of worlds of seeds {seeds}: 400 videos each of new objects on
eight gels; {DRAWS} draws of halves each; {platform.machine()}, {datetime.date.today().isoformat()}.

{line("", "palpate/mini", "OLD")}
|---|---|---|
{body}

A fault counts as found by TMMD at p < .05, by CI- and D-TMMD outside the middle 95 % of the draws
without a fault. JPEG 40 is at 240 rows, of one half against the other as it is.
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--work", type=Path, default=Path("runs/rulers"))
    parser.add_argument("--encoder", default="palpate/mini")
    parser.add_argument("--against", default="palpate/handcrafted")
    parser.add_argument("--seeds", type=int, nargs="+", default=[77])
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    options = parser.parse_args()
    rows = {}
    for name in (options.encoder, options.against):
        encoders, worlds = EncoderSet.load(name), []
        for seed in options.seeds:
            known = options.work / f"{encoders.digest('tactile')[:12]} {seed}.json"
            if not known.exists():
                write_json(known, Bench(options.work, seed).of_encoder(encoders))
            worlds.append(json.loads(known.read_text()))
        rows[name] = {k: np.mean([w[k] for w in worlds], axis=0).tolist() for k in worlds[0]}
        print(name)
        for key, value in rows[name].items():
            print(f"  {key:10}", *(f"{v:.3g}" for v in np.atleast_1d(value)))
    if options.write:
        options.write.write_text(page(rows, options.seeds))


if __name__ == "__main__":
    main()

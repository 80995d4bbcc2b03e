"""Whether the shipped generator makes the touch that it is asked for, on worlds nobody has seen.

    python benchmarks/asked.py --seeds 4201 4202 4203

Every seed makes two worlds, with the recipe of the training world: photos and gels come from one
(2 s), and a probe of material learns real touches of the other (2 s + 1). Asked are place, area,
strength and shear of another sample's real touch: of one of the same material, and of any, which a
material often cannot have. The touch that is made goes through the JPEG of the real ones and is
measured as they are. Above stands how well the same measurement reads from real images what the
world knows: the middle, the share and the load of its contact, and the drag of its markers. At
last, nothing is asked for.
"""

import argparse
import datetime
import platform
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import by_video, line
from generator import NAME, WORLDS, World, contacts, stored

from palpate.core import FeatureSet, rng_for
from palpate.data.images import cached_images
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders.embed import embed_images
from palpate.encoders.encoder_set import EncoderSet
from palpate.metrics.conditions import contact_conditions
from palpate.metrics.probe import material_accuracy
from palpate.metrics.retrieval import standardized
from palpate.sim import World as Simulated
from palpate.sim.presets import MINI_SEEDS

PAGE = Path(__file__).parents[1] / "docs/studies/asked.md"
NAMES = ("place x", "place y", "area", "strength", "shear x", "shear y")
#: Indentation that is contact [mm]: below, the gel bridges.
INDENTED = 0.02
WANTED = (0.93, 0.93, 0.9, 0.8, 0.97, 0.97)


def truths(world):
    """(n, 6): what the world knows of the contacts of its samples; strength is the load."""
    simulated, rows = Simulated(world.options), []
    wanted = {*world.part.ids}
    for row in simulated.rows:
        if row.id not in wanted:
            continue
        video = simulated.video(row.video)
        state, n = video.state(row.frame), world.options.size
        depth = video.membrane(state)[0]
        mask = depth > INDENTED
        y, x = (np.mgrid[:n, :n] + 0.5) / n
        weight = depth * mask
        place = [(v * weight).sum() / weight.sum() for v in (x, y)]
        dy, dx = video.sensor.shift(depth, state.shear)
        rows.append([*place, mask.mean(), state.load, 100 * dx.mean() / n, 100 * dy.mean() / n])
    return np.array(rows)


def shuffled(groups, seed):
    """For each sample another one of its group."""
    rng, out = rng_for(seed, "asked of"), np.arange(len(groups))
    for group in np.unique(groups):
        rows = rng.permutation(np.flatnonzero(groups == group))
        out[rows] = np.roll(rows, 1)
    return out


class Trial:
    """One seed: a world to ask on, and one to learn materials from."""

    def __init__(self, seed, chosen, pipeline):
        self.seed, self.pipeline = seed, pipeline
        frames = WORLDS["gelsight"].frames_per_contact

        def world(name, number, count):
            shape = replace(WORLDS["gelsight"], seed=number, contacts_per_video=1, sensors=8)
            shape = replace(shape, objects_per_material=max(1, count // 20))
            return World(chosen.work / name, shape, chosen.work / "cache", every=frames)

        self.test = world(f"asked {seed}", 2 * seed, chosen.judged)
        self.third = world(f"learned {seed}", 2 * seed + 1, chosen.learned)
        self.gels, self.encoders = np.asarray(self.test.gels), EncoderSet.load(NAME)
        self.videos = [f"{seed} {v}" for v in self.test.part.column("video")]
        self.real = contact_conditions(np.asarray(self.test.images), self.gels)
        photos = cached_images(self.test.part, "vision", pipeline.vision_size, self.test.cache)
        self.photos = pipeline.embed(photos)

    def quantiles(self, rows):
        return self.pipeline.contact.requested(rows, [None] * len(rows)).astype(float)

    def made(self, touches):
        images = self.pipeline.sample(
            self.photos, self.test.part.ids, seed=0, background=self.gels, touches=touches
        )
        return stored(images, self.test.options.quality)

    def hits(self, images):
        """Whether a probe that learned from real touches names the material of each."""
        known = embed_images(
            np.asarray(self.third.images), self.encoders, gels=np.asarray(self.third.gels), raw=True
        )
        real = embed_images(np.asarray(self.test.images), self.encoders, gels=self.gels, raw=True)
        own = embed_images(images, self.encoders, gels=self.gels, raw=True)
        (a, b), _ = standardized([known, own], real)
        part = self.third.part
        learned = FeatureSet(part.ids, a, part.column("material"), part.column("video"))
        test = self.test.part
        asked = FeatureSet(test.ids, b, test.column("material"), self.videos)
        return material_accuracy(learned, asked).value

    def run(self):
        """Record by row: what was asked and measured (n, 6), markers (n,), material."""
        materials = np.array(self.test.part.column("material"))
        rows = {"of the same material": materials, "of any": np.zeros(len(materials))}
        record = {"real": (truths(self.test), self.real, np.asarray(self.test.images))}
        for name, groups in rows.items():
            asked = self.quantiles(self.real)[shuffled(groups, self.seed)]
            images = self.made(asked)
            record[name] = (asked, self.quantiles(contact_conditions(images, self.gels)), images)
        record["nothing asked"] = (None, None, self.made(None))
        out = {}
        for name, (asked, measured, images) in record.items():
            moves = np.array(contacts(images, self.gels), float)[:, 2]
            out[name] = (asked, measured, moves, self.hits(images))
            print(self.seed, name, out[name][3], np.nanmean(moves), flush=True)
        return out


def agreement(asked, measured):
    """Correlation, its interval (bootstrap over samples), and the slope of measured on asked."""
    both = np.isfinite(asked) & np.isfinite(measured)
    x, y, rng = asked[both], measured[both], rng_for(0, "bootstrap")
    draws = rng.integers(len(x), size=(500, len(x)))
    spread = np.std([np.corrcoef(x[d], y[d])[0, 1] for d in draws])
    return float(np.corrcoef(x, y)[0, 1]), 1.96 * float(spread), float(np.polyfit(x, y, 1)[0])


def tables(records, videos):
    """The two tables of the page."""
    lines = [line("asked", *NAMES), "|---" * 7 + "|"]
    for name in ("real", "of the same material", "of any"):
        asked, measured = (np.concatenate([r[name][k] for r in records]) for k in (0, 1))
        cells = [agreement(asked[:, k], measured[:, k]) for k in range(6)]
        if name == "real":
            title = "what the world knows, measured on real images"
            lines.append(line(title, *(f"{r:.3f} ± {half:.3f}" for r, half, _ in cells)))
            continue
        title = f"a touch {name}"
        lines.append(line(title, *(f"{r:.3f} ± {half:.3f}" for r, half, _ in cells)))
        lines.append(line(f"{title}: slope", *(f"{slope:.2f}" for _, _, slope in cells)))
    lines.append(line("wanted", *(f"{w:.2f}" for w in WANTED)))
    more = [line("images", "marker motion, %", "of real", "material, %"), "|---" * 4 + "|"]
    of_real = np.nanmean(np.concatenate([r["real"][2] for r in records]))
    for name in records[0]:
        moves = np.concatenate([r[name][2] for r in records])
        here = np.isfinite(moves)
        mean, half = by_video(moves[here], np.array(videos)[here])
        material = 100 * np.mean([r[name][3] for r in records])
        cells = f"{mean:.3f} ± {half:.3f}", f"{mean / of_real:.2f}", f"{material:.1f}"
        more.append(line(name if name in ("real", "nothing asked") else f"a touch {name}", *cells))
    return "\n".join(lines), "\n".join(more)


def page(records, videos, chosen):
    agree, kept = tables(records, videos)
    flags = f"--seeds {' '.join(map(str, chosen.seeds))} --judged {chosen.judged} "
    flags += f"--learned {chosen.learned}"
    return f"""# A touch as it is asked for

Made by a committed command; do not edit by hand. Synthetic: the tables show a mechanism.

    python benchmarks/asked.py {flags}

`{NAME}` by photo on {len(videos)} videos of new objects and gels, one touch of each. Asked for are
place, area, strength and shear of another sample's real touch: of one of the same material, and of
any, which a material often cannot have. Correlation of asked with measured; slope: of measured on
asked. The first row is what the measurement itself reads from real images: place, share and load of
the world's contact, and the drag of its markers. All images went through the JPEG of the real ones.

{agree}

Marker motion is the root mean square displacement, in % of the width; material is what a probe on
the shipped tactile encoder names that learned {chosen.learned} real touches of a third world.
Without conditions the touch is drawn among those of training.

{kept}

Intervals: 95 %. Nothing was chosen on these worlds.
{platform.machine()}, CPU; {datetime.date.today().isoformat()}.
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", required=True, help="of the worlds")
    parser.add_argument("--judged", type=int, default=400, help="photos, a world")
    parser.add_argument("--learned", type=int, default=1000, help="touches of the probe, a world")
    parser.add_argument("--work", type=Path, default=Path("runs/asked"))
    parser.add_argument("--page", type=Path, default=PAGE, help="Markdown file to write")
    chosen = parser.parse_args()
    if seen := [s for s in chosen.seeds for k in (2 * s, 2 * s + 1) if k in MINI_SEEDS]:
        parser.error(f"--seeds {seen[0]} makes a world that the shipped models learned from")
    pipeline = TactilePipeline.from_pretrained(NAME)
    trials = [Trial(seed, chosen, pipeline) for seed in chosen.seeds]
    records = [trial.run() for trial in trials]
    videos = [v for t in trials for v in t.videos]
    chosen.page.write_text(page(records, videos, chosen))
    print(chosen.page.read_text())


if __name__ == "__main__":
    main()

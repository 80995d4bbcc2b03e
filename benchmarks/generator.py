"""How near the shipped generator comes to real touches, on worlds that nobody has seen.

    python benchmarks/generator.py --seeds 4101 4102 4103 --materials 10 20

Every seed makes two worlds: one to judge on (seed 2 s), and a third one (2 s + 1) from which judges
learn real images, as the generator learned from its own. All have the recipe of the training world:
look, loads, frames a contact and their phases. Judges are a small CNN and a support vector machine
on handcrafted texture; they know no generated image. Another CNN learns from the touches that a row
gives for the photos of the third world, and is tested on real touches: what such touches are worth
as data. Before anything is judged, contact strength, area and marker motion of the three worlds are
compared, and where two means differ by more than a tenth, the command stops: a judge is then judged
on another kind of touch.

Tactile images are compared as the real ones are stored: all go through their JPEG once. Every
measurement is kept in the work folder and not made again; a stopped command goes on.
"""

import argparse
import datetime
import math
import platform
import sys
from dataclasses import asdict, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch
from common import BFLOAT, Judge, JudgeLoss, Line, by_video, line, percents
from PIL import Image
from texture import TextureJudge, masked

from palpate.core import FeatureSet, digest_json, read_json, rng_for, short, write_json
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.data.storage import form_of
from palpate.diffusion.autoencoder import load_autoencoder
from palpate.diffusion.gels import gels_of
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders.embed import embed, embed_images, texts_of
from palpate.encoders.encoder_set import EncoderSet
from palpate.metrics import prdc, tmmd
from palpate.metrics.conditions import CONDITIONS, contact_conditions
from palpate.metrics.markers import marker_motion
from palpate.metrics.retrieval import standardized
from palpate.sim import write_world
from palpate.sim.presets import MINI_SEEDS
from palpate.training.engine import Task, fit
from palpate.training.options import LoopOptions
from palpate.training.steps import seeded

sys.path.append(str(Path(__file__).parents[1] / "recipes"))
from mini import WORLDS

NAME, PAGE = "palpate/mini", Path(__file__).parents[1] / "docs/studies/generator.md"
#: Most by which means of two worlds may differ, and the images of a world that are compared.
MATCHED, COMPARED = 0.1, 1200
#: Row -> what drives the generator.
REAL, NEAREST, AUTOENCODER = "real", "real, of the nearest photo", "autoencoder"
BY_PHOTO = "by photo"
DRIVES = {
    "by photo, guidance 1": {"guidance": 1.0},
    BY_PHOTO: {},
    "by caption": {"photo": False, "text": True},
    "by photo and caption": {"text": True},
    "by another sample's photo (control)": {"permuted": True},
    "by photo, on another unseen gel": {"gels": "other"},
    "by photo, on a gel of its training": {"gels": "known"},
}
#: Rows from which a classifier learns.
LEARNED = (NEAREST, AUTOENCODER, *list(DRIVES)[:2])
DIGIT = (REAL, AUTOENCODER, BY_PHOTO)


def stored(images, files):
    """Bytes (n, h, w, 3), each as its real image is stored."""
    pairs = zip(images, map(form_of, files), strict=True)
    return np.stack([form.through(Image.fromarray(x)) if form else x for x, form in pairs])


def contacts(images, gels):
    """Per image: strength [gray levels], area [share], marker motion and net shear [% of width];
    None where there are no markers.
    """
    rows = []
    for image, gel in zip(images, gels, strict=True):
        of = dict(zip(CONDITIONS, contact_conditions(image[None], gel[None])[0], strict=True))
        motion = marker_motion(image, gel)
        moves = [motion.rms, float(np.hypot(*motion.mean))] if motion else [None, None]
        rows.append([float(of["strength"]), float(of["area"]), *moves])
    return rows


MEASURES = ("strength", "area", "marker motion", "net shear")


def unmatched(worlds):
    """What differs between worlds by more than a tenth, in words; ``worlds``: name -> rows of
    :func:`contacts`.
    """
    found = []
    for k, measure in enumerate(MEASURES[:3]):
        known = {name: rows[np.isfinite(rows[:, k]), k] for name, rows in worlds.items()}
        means = {name: float(values.mean()) for name, values in known.items() if len(values)}
        if means and max(means.values()) > (1 + MATCHED) * min(means.values()):
            found.append(f"{measure} {', '.join(f'{m:.3f} {n}' for n, m in means.items())}")
    return found


class World:
    """Samples of a world, or one of ``every`` consecutive ones, and their images."""

    def __init__(self, folder, options, cache, *, every=1):
        folder = folder.with_name(f"{folder.name} {options.digest[:8]}")
        write_world(folder, options, workers=2, progress=Line())
        part = Manifest.load(folder)
        self.options, self.cache, ids = options, cache, part.ids
        # of the frames of a contact each in its turn
        self.part = part.take([ids[k + k // every % every] for k in range(0, len(part), every)])

    @cached_property
    def images(self):
        return cached_images(self.part, "tactile", self.options.size, self.cache)

    @cached_property
    def gels(self):
        return gels_of(self.part, self.options.size, self.cache)

    def some(self, materials):
        """Evenly spaced rows of these materials."""
        rows = np.flatnonzero([m in materials for m in self.part.column("material")])
        return rows[:: max(1, len(rows) // COMPARED)]

    def labels(self, names):
        return np.array([names.index(m) for m in self.part.column("material")])


class Known:
    """What the generator was trained on."""

    def __init__(self, work):
        self.options = WORLDS["gelsight"]
        self.world = World(work / "training world", self.options, work / "cache")

    @cached_property
    def photos(self):
        encoders = EncoderSet.load(NAME)
        return embed(self.world.part, encoders, "vision", cache=self.world.cache).features


class Trial:
    """One seed, some materials, one look: worlds, judges, and what they say, kept in a file."""

    def __init__(self, seed, materials, look, chosen, known):
        self.chosen, self.known, self.look = chosen, known, look
        self.work = chosen.work / f"{look} {materials} {seed}"
        shape = replace(
            WORLDS[look],
            materials=materials,
            sensors=8,
            objects_per_material=max(1, chosen.judged // materials),
            contacts_per_video=1,
        )
        frames = shape.frames_per_contact
        learned = max(1, chosen.learned // (materials * frames * 3))
        more = {"contacts_per_video": 3, "objects_per_material": learned}
        make = partial(World, cache=self.work / "cache")
        self.test = make(self.work / "judging", replace(shape, seed=2 * seed), every=frames)
        self.third = make(self.work / "learning", replace(shape, seed=2 * seed + 1, **more))
        self.names = sorted({*self.third.part.column("material")})
        self.pipeline = TactilePipeline.from_pretrained(NAME)
        self.encoders = EncoderSet.load(NAME)
        self.videos = [f"{seed} {v}" for v in self.test.part.column("video")]
        self.answers = self.test.labels(self.names)
        made_by = [self.test.part.digest, self.third.part.digest, self.pipeline.digest]
        made_by += [load_autoencoder(NAME).digest, chosen.steps, asdict(self.pipeline.sampler)]
        self.path = self.work / f"judged-{short(digest_json(made_by))}.json"
        self.record = read_json(self.path, "record") if self.path.is_file() else {}

    def kept(self, key, make):
        """A measurement, made if it is not on record."""
        if key not in self.record:
            self.record[key] = make()
            write_json(self.path, self.record)
        return self.record[key]

    def matched(self):
        """What differs between the worlds, in words."""

        def of(world, rows):
            return contacts(world.images[rows], world.gels[rows])

        worlds = {"judging": self.test, "learning": self.third}
        if self.known:
            worlds["training"] = self.known.world
        rows = {
            name: self.kept(f"contacts of {name}", partial(of, world, world.some({*self.names})))
            for name, world in worlds.items()
        }
        return unmatched({name: np.array(r, float) for name, r in rows.items()})

    @cached_property
    def judge(self):
        return self.learner(self.third.images, "judge")

    @cached_property
    def texture_judges(self):
        """Without noise, and with noise that masks the grain."""
        images, gels = np.asarray(self.third.images), np.asarray(self.third.gels)
        labels = self.third.labels(self.names)
        return [TextureJudge(x, gels, labels) for x in (images, masked(images, 1))]

    def learner(self, images, name):
        """A CNN that learned materials from images of the third world's samples."""
        with seeded(0, "judge"):
            judge = Judge(len(self.names))
        labels = self.third.labels(self.names)
        loss = JudgeLoss(images, labels)
        course = LoopOptions(self.chosen.steps, 32, 2e-3, warmup=100, weight_decay=1e-3, ema=0.99)
        task = Task(name, len(labels), loss.load, loss, self.third.part.digest)
        folder = self.work / f"learner {name}"
        fit(judge, task, course, folder, compute=BFLOAT, progress=Line())
        return judge.eval()

    @cached_property
    def real_numbers(self):
        return self.numbers(self.test.images, self.test.gels)

    def numbers(self, images, gels):
        return embed_images(np.asarray(images), self.encoders, gels=gels, raw=True)

    def made(self, name, world):
        """Images of a row for the samples of a world, and the gels they are on."""
        if name == REAL:
            return world.images, world.gels
        if name == NEAREST:
            asked = embed(world.part, self.encoders, "vision", cache=world.cache).features
            materials = np.array(self.known.world.part.column("material"))
            allowed = np.isin(materials, self.names)
            near = np.where(allowed, asked @ self.known.photos.T, -np.inf).argmax(1)
            return self.known.world.images[near], self.known.world.gels[near]
        if name == AUTOENCODER:
            code = load_autoencoder(NAME)
            latents = code.encode(np.asarray(world.images), np.asarray(world.gels))
            images, gels = code.decode(latents, np.asarray(world.gels)), world.gels
        else:
            images, gels = self.generated(world, **DRIVES[name])
        return stored(images, world.part.paths("tactile")), gels

    def generated(
        self, world, *, gels="own", photo=True, text=False, permuted=False, guidance=None
    ):
        pixels = cached_images(world.part, "vision", self.pipeline.vision_size, world.cache)
        photos = self.pipeline.embed(pixels) if photo else None
        if permuted:
            photos = photos[rng_for(0, "permuted").permutation(len(photos))]
        ground = world.gels
        if gels != "own":
            source = world.gels if gels == "other" else self.known.world.gels
            ground = source[rng_for(0, gels, "gels").integers(len(source), size=len(pixels))]
        images = self.pipeline.sample(
            photos,
            world.part.ids,
            texts=self.texts(world) if text else None,
            seed=0,
            sampler=self.pipeline.sampler_with(guidance=guidance),
            background=np.asarray(ground),
        )
        return images, ground

    def texts(self, world):
        texts = texts_of(world.part)[0]
        each = {text: self.pipeline.embed_text(text) for text in {*texts}}
        return torch.cat([each[text] for text in texts])

    def judged(self, name):
        """Record what all judges say of a row."""
        images, gels = self.made(name, self.test)
        images, gels = np.asarray(images), np.asarray(gels)
        plain, under_noise = self.texture_judges
        hits = {
            "cnn": self.judge.names(images),
            "texture": plain.names(images, gels),
            "texture masked": under_noise.names(masked(images, 2), gels),
        }
        (x, y), _ = standardized([self.numbers(images, gels), self.real_numbers], self.real_numbers)
        ids, materials = self.test.part.ids, self.test.part.column("material")
        x, y = (FeatureSet(ids, rows, materials, self.videos) for rows in (x, y))
        far, near = tmmd(x, y, preset="grouped", permutations=0), prdc(x, y, grouped=False)
        shows = [marker_motion(image, image) is not None for image in images]
        return {
            **{
                judge: (given == self.answers).astype(int).tolist() for judge, given in hits.items()
            },
            "tmmd": [far.value, *far.interval],
            "recall": near[1].value,
            "coverage": near[3].value,
            "contacts": contacts(images, gels),
            "markers": float(np.mean(shows)),
            "day": datetime.date.today().isoformat(),
        }

    def learned(self, name):
        """Record what a CNN that learned from a row says of real touches."""
        images = np.asarray(self.made(name, self.third)[0])
        judge = self.learner(images, f"from {name}")
        return (judge.names(self.test.images) == self.answers).astype(int).tolist()

    def run(self, rows):
        for name in rows:
            row = self.kept(name, partial(self.judged, name))
            print(self.work.name, name, percents(by_video(row["cnn"], self.videos)), flush=True)
        for name in [n for n in LEARNED if n in rows]:
            hits = self.kept(f"from {name}", partial(self.learned, name))
            print(self.work.name, "from", name, percents(by_video(hits, self.videos)), flush=True)


def pooled(trials, of):
    """Values of the images of all trials, in order, and their videos."""
    values = np.concatenate([np.asarray(of(t.record), float) for t in trials])
    return values, [v for t in trials for v in t.videos]


def lead(trials, name, judge, base=REAL):
    """Share of a row, and how far it is ahead of another, paired by image."""
    of = lambda record, row: record[row][judge] if isinstance(record[row], dict) else record[row]
    own, videos = pooled(trials, lambda r: of(r, name))
    other, _ = pooled(trials, lambda r: of(r, base))
    return own, by_video(own - other, videos), videos


def judges_table(trials, rows):
    heads = "images", "CNN, %", "of real", "ahead of real", "ahead of nearest", "texture, %"
    heads += "texture, masked, %", "learned from it, %", "ahead of real"
    lines = [line(*heads), "|---" * len(heads) + "|"]
    for name in rows:
        cells = [name]
        own, to_real, videos = lead(trials, name, "cnn")
        real = np.mean(pooled(trials, lambda r: r[REAL]["cnn"])[0])
        cells += [percents(by_video(own, videos)), f"{own.mean() / real:.2f}", percents(to_real)]
        near = NEAREST in rows and percents(lead(trials, name, "cnn", NEAREST)[1])
        cells.append(near or "")
        for judge in ("texture", "texture masked"):
            hits, _ = pooled(trials, lambda r, n=name, j=judge: r[n][j])
            of = np.mean(pooled(trials, lambda r, j=judge: r[REAL][j])[0])
            cells.append(f"{100 * hits.mean():.1f} ({hits.mean() / of:.2f})")
        source = f"from {name}"
        if name == REAL:
            cells += [percents(by_video(own, videos)), ""]
        elif all(source in t.record for t in trials):
            hits, videos = pooled(trials, lambda r, s=source: r[s])
            real_hits, _ = pooled(trials, lambda r: r[REAL]["cnn"])
            cells += [
                percents(by_video(hits, videos)),
                percents(by_video(hits - real_hits, videos)),
            ]
        else:
            cells += ["", ""]
        lines.append(line(*cells))
    return "\n".join(lines)


def touches_table(trials, rows):
    heads = "images", "TMMD", "recall", "coverage", "marker motion, %", "net shear, %"
    heads += "strength, gray levels", "area, %"
    digit = trials[0].look == "digit"
    heads += ("shows markers, %",) * digit
    lines = [line(*heads), "|---" * len(heads) + "|"]
    for name in rows:
        far = np.array([t.record[name]["tmmd"] for t in trials])
        half = np.sqrt((((far[:, 2] - far[:, 1]) / 2) ** 2).sum()) / len(far)
        value = far[:, 0].mean()
        cells = [name, f"{value:.3f} [{value - half:.3f}, {value + half:.3f}]"]
        cells += [
            f"{np.mean([t.record[name][k] for t in trials]):.2f}" for k in ("recall", "coverage")
        ]
        measured, videos = pooled(trials, lambda r, n=name: r[n]["contacts"])
        for k in (2, 3):
            here = np.isfinite(measured[:, k])
            pair = here.any() and by_video(measured[here, k], np.array(videos)[here])
            cells.append(f"{pair[0]:.3f} ± {pair[1]:.3f}" if pair else "")
        for k, scale in ((0, 1), (1, 100)):
            low, middle, high = scale * np.nanquantile(measured[:, k], (0.1, 0.5, 0.9))
            cells.append(f"{middle:.1f} [{low:.1f}, {high:.1f}]")
        cells += [f"{100 * np.mean([t.record[name]['markers'] for t in trials]):.1f}"] * digit
        lines.append(line(*cells))
    return "\n".join(lines)


def matching(trials):
    """Means of the worlds, one line a trial."""
    lines = []
    for t in trials:
        names = [n for n in ("training", "learning", "judging") if f"contacts of {n}" in t.record]
        means = [
            np.nanmean(np.array(t.record[f"contacts of {n}"], float), axis=0)[:3] for n in names
        ]
        rows = "; ".join(
            f"{m} {', '.join(f'{row[k]:.3f}' for row in means if not math.isnan(row[k]))}"
            for k, m in enumerate(MEASURES[:3])
            if not all(math.isnan(row[k]) for row in means)
        )
        lines.append(f"{t.work.name} ({', '.join(names)}): {rows}.")
    return "\n".join(lines)


def section(title, trials, rows):
    videos, learned = sum(len(t.videos) for t in trials), len(trials[0].third.part)
    head = f"## {title}\n\nVideos: {videos}; worlds to judge on: {len(trials)}; "
    head += f"images that judges learned from, a world: {learned}."
    tables = judges_table(trials, rows), touches_table(trials, rows)
    return "\n\n".join([head, *tables, f"Worlds, means: {matching(trials)}"]) + "\n"


def page(parts, chosen, day):
    flags = f"--seeds {' '.join(map(str, chosen.seeds))} --materials "
    flags += f"{' '.join(map(str, chosen.materials))} --judged {chosen.judged} "
    flags += f"--learned {chosen.learned} --steps {chosen.steps}"
    return f"""# How near the shipped generator comes

Made by a committed command; do not edit by hand. Synthetic: the tables show a mechanism.

    python benchmarks/generator.py {flags}

`{NAME}` on new objects, videos and gel units, one image of each video. Judges learned real images
of a third world: a small CNN ({chosen.steps} steps of 32), and a support vector machine on local
binary patterns and the spectrum (texture), also under noise of four gray levels, which masks the
grain; of real in brackets. *Learned from it*: a CNN that learned from what a row gives for the
photos of the third world, tested on real touches. Strength, area and marker motion of the worlds
of training, learning and judging agree within a tenth, or the command stops. All generated images
went through the JPEG of the real ones. Intervals: 95 % over videos; differences are paired by
image, in points. TMMD (grouped), recall and coverage (5 neighbors) are to the real images of the
same samples, in ruler features. Marker motion (root mean square) and net shear are means, in % of
the width; strength and area are medians, with 10 and 90 % of the images. Gels are the samples' own,
which training never saw; of the last two rows that of another sample, and one of training.
Nothing was chosen on these worlds.
{platform.machine()}, CPU; {day}.

{chr(10).join(parts)}"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", required=True, help="of the worlds")
    parser.add_argument("--materials", type=int, nargs="+", default=[10, 20])
    parser.add_argument("--judged", type=int, default=1600, help="images to judge, a world")
    parser.add_argument("--learned", type=int, default=4500, help="images to learn from, a world")
    parser.add_argument("--steps", type=int, default=2500, help="of a CNN")
    parser.add_argument("--work", type=Path, default=Path("runs/generator"))
    parser.add_argument("--page", type=Path, default=PAGE, help="Markdown file to write")
    chosen = parser.parse_args()
    seen = [s for s in chosen.seeds for k in (2 * s, 2 * s + 1) if k in MINI_SEEDS]
    if seen:
        parser.error(f"--seeds {seen[0]} makes a world that the shipped models learned from")
    known, parts, days = Known(chosen.work), [], []
    looks = [("gelsight", n, [REAL, NEAREST, AUTOENCODER, *DRIVES]) for n in chosen.materials]
    for look, materials, rows in [*looks, ("digit", max(chosen.materials), DIGIT)]:
        trials = []
        for seed in chosen.seeds:
            trial = Trial(seed, materials, look, chosen, known if look == "gelsight" else None)
            if differing := trial.matched():
                sys.exit(f"{trial.work.name}: worlds differ by more than a tenth: {differing[0]}")
            trial.run(rows)
            trials.append(trial)
        days += [t.record[REAL]["day"] for t in trials]
        title = f"{materials} materials (chance {100 / materials:.0f} %)"
        parts.append(section(title + ", DIGIT" * (look == "digit"), trials, rows))
    chosen.page.write_text(page(parts, chosen, max(days)))
    print(chosen.page.read_text())


if __name__ == "__main__":
    main()

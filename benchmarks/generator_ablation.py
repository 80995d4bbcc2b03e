"""Which choices of a generator matter: one training a row and seed, judged on new videos.

    python benchmarks/generator_ablation.py --materials 10 20 --seeds 0 1 2
    python benchmarks/generator_ablation.py --rows base "condition: mixed" --steps 200    # a look

Every row is the base with one change, trained on one procedural world for equal steps, but for
``length`` (its processor seconds are in the table, unless it was stopped and went on), and judged
on another world: new objects, videos and gel units.
The autoencoder is that of palpate/mini where a row names no other. Judges see real images in
training and nothing else, and are never fitted again: a small CNN, and the linear probe of the
tactile encoder of palpate/mini. Driven by the photo, by the sample's own caption, and by photos in
permuted order (a control). The oracle is told the material itself, one-hot, in training and in
place of the photo: what it misses is not for want of knowing the material. Every row ends in the
records beside the page, which grow run by run: a row that is there is not trained again, and a
training that was stopped goes on. Losers stay.
"""

import argparse
import datetime
import itertools
import json
import math
import platform
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import nn

from palpate.core import FeatureSet, Split, digest_json, rng_for, write_json
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.diffusion.alignment import Alignment
from palpate.diffusion.autoencoder import BackgroundAutoencoder, LatentStats
from palpate.diffusion.autoencoders import autoencoder_of, load_autoencoder
from palpate.diffusion.no_contact import gels_of
from palpate.diffusion.options import AutoencoderOptions, Schedule
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import MINI
from palpate.diffusion.training import train_denoiser, train_pipeline
from palpate.encoders import train_encoder
from palpate.encoders.embed import embed, embed_images, texts_of
from palpate.encoders.encoder_set import EncoderSet, seeded
from palpate.metrics import tmmd
from palpate.metrics.probe import fit_probe, material_accuracy
from palpate.sim import PRESETS, write_world
from palpate.studies.making import fresh
from palpate.training.engine import Losses, Task, fit
from palpate.training.options import Compute, LoopOptions

#: Train on the first, judge on the second; other units, objects and videos.
WORLDS = {
    "train": {"seed": 61, "objects_per_material": 75, "sensors": 4},
    "new": {"seed": 62, "objects_per_material": 10, "sensors": 2},
    "tuned": {"seed": 64, "objects_per_material": 150, "sensors": 4},  # of generator_tuned.py
    # Of generator_goals.py: as many videos as there are objects, one image of each.
    "many": {"seed": 65, "sensors": 8, "contacts_per_video": 1, "frames_per_contact": 1},
}
SHAPE = {"contacts_per_video": 3, "frames_per_contact": 2}
MANY = 1600
VERSION = 2  # raised when rows come to mean something else: all are then trained again
JUDGED = 400  # images a row is judged by
JUDGE = LoopOptions(2500, 32, 2e-3, warmup=100, weight_decay=1e-3, ema=0.99)
VQ_ROW = "autoencoder: VQ"
#: What palpate shipped before: patches of 2 x 2 pixels, one halving, 8,192 codes.
VQ = AutoencoderOptions(
    patch=2, widths=(32, 64), channels=4, codes=8192, steps_free=3000, steps_quantized=400
)
BFLOAT = Compute(precision="bf16")  # float32 on x86 processors without it

BASE = replace(MINI, name="ablation")


def schedule(**changes):
    return replace(BASE, schedule=Schedule(**changes))


def condition(**changes):
    return replace(BASE, condition=replace(BASE.condition, **changes))


def unet(**changes):
    return replace(BASE, unet=replace(BASE.unet, **changes))


ORACLE, LENGTH = "oracle: told the material", "length: twice"
#: Row -> preset; a name before the colon is the choice that changes.
ROWS = {
    "base": BASE,
    "objective: epsilon": schedule(prediction="epsilon"),
    "objective: v": schedule(prediction="v_prediction"),
    "objective: v, min-SNR 5": schedule(prediction="v_prediction", min_snr=5.0),
    "time mean: 0": schedule(prediction="flow", time_mean=0.0),
    "time mean: 1": schedule(prediction="flow", time_mean=1.0),
    "condition: text (Ours)": condition(source="text", gap="none", noise=0.0),
    "condition: text, memory": condition(source="text", gap="memory"),
    "condition: photo": condition(source="vision", gap="mean-shift", noise=0.0),
    "condition: photo, trained map (GVST)": condition(source="resnet", gap="none", noise=0.0),
    "condition: photo, noise": condition(source="vision", gap="mean-shift"),
    "condition: mixed": condition(source="mixed", gap="mean-shift"),
    "condition: both, no noise": condition(noise=0.0),
    "condition: both, memory asked by text": condition(gap="memory"),
    "condition: both, photo as it is": condition(gap="mean-shift"),
    "tokens: 4 learned": condition(tokens=4, learned=True),
    "tokens: words of the text": condition(words=32),
    "tokens: patches of the photo": condition(patches=64),
    "tokens: words and patches": condition(words=32, patches=64),
    "gel as input": BASE,
    "aligned with another encoder": BASE,
    VQ_ROW: BASE,
    "width: 96, 128": unet(widths=(96, 128)),
    "no modulation": unet(modulate=False),
    LENGTH: BASE,
    "batch: 32": replace(BASE, loop=replace(BASE.loop, batch=32)),
    ORACLE: condition(source="text", gap="none", noise=0.0),
}


class Judge(nn.Module):
    """A small CNN that names the material of a tactile image."""

    def __init__(self, classes):
        super().__init__()
        widths = (3, 32, 64, 96, 128)
        blocks = [
            (nn.Conv2d(a, b, 3, 2 if a > 3 else 1, 1), nn.GroupNorm(8, b), nn.SiLU())
            for a, b in itertools.pairwise(widths)
        ]
        self.body = nn.Sequential(*(layer for block in blocks for layer in block))
        self.head = nn.Linear(2 * widths[-1], classes)

    def forward(self, x):
        """Bytes (n, h, w, 3) -> logits; the mean color of an image is removed."""
        x = x.permute(0, 3, 1, 2).float() / 64
        y = self.body(x - x.mean((2, 3), keepdim=True))
        return self.head(torch.cat([y.mean((2, 3)), y.amax((2, 3))], 1))

    @torch.no_grad()
    def names(self, images):
        parts = [
            self(torch.from_numpy(np.array(images[k : k + 64]))).argmax(1)
            for k in range(0, len(images), 64)
        ]
        return torch.cat(parts).numpy()


class JudgeLoss:
    """Cross-entropy of mirrored images."""

    def __init__(self, images, labels):
        self.images, self.labels = images, torch.from_numpy(labels)

    def load(self, step):
        x = torch.from_numpy(np.array(self.images[step.rows]))
        across, down = (step.rand(2) < 0.5).reshape(-1, 2, 1, 1, 1).unbind(1)
        x = torch.where(across, x.flip(2), x)
        return {"x": torch.where(down, x.flip(1), x), "y": self.labels[step.rows]}

    def __call__(self, module, batch):
        each = nn.functional.cross_entropy(
            module(batch["x"]).float(), batch["y"], label_smoothing=0.1, reduction="none"
        )
        return Losses(each.mean(), {}, each.detach())


def by_video(hits, videos):
    """Mean and half of its 95 % interval, over videos."""
    hits, names = np.asarray(hits, float), np.asarray(videos)
    means = np.array([hits[names == v].mean() for v in np.unique(names)])
    return float(hits.mean()), float(1.96 * means.std(ddof=1) / math.sqrt(len(means)))


class Study:
    """The worlds, the judges, the autoencoders, and the rows."""

    look = "gelsight"

    def __init__(self, work, materials, new="new", judged=JUDGED):
        self.work, self.materials = work, materials
        self.cache = work / "cache"
        self.progress = Line()
        self.train, self.new = (self.world(name) for name in ("train", new))
        self.test = self.new.take(self.new.ids[:: max(1, len(self.new) // judged)][:judged])
        self.encoders = EncoderSet.load("palpate/mini")
        self.everything = self.everything_of(self.train)
        self.names = sorted(set(self.train.column("material")))
        pixels = partial(cached_images, size=MINI.size, cache=self.cache)
        self.images, self.real = (pixels(m, "tactile") for m in (self.train, self.test))
        self.gels = gels_of(self.test, MINI.size, self.cache)
        self.answers = np.array([self.names.index(m) for m in self.test.column("material")])
        self.videos = self.test.column("video")
        self.judge = self.trained_judge()
        self.tactile = [
            embed(m, self.encoders, "tactile", cache=self.cache) for m in (self.train, self.test)
        ]
        self.probe = fit_probe(self.tactile[0])

    @staticmethod
    def everything_of(world):
        """A split without a test part: what is judged is of another world."""
        return Split.from_ids(train=world.ids, rule={"name": "everything"}, manifest=world.digest)

    def world(self, name):
        folder = self.work / f"world {name}"
        shape = {"objects_per_material": MANY // self.materials, **SHAPE, **WORLDS[name]}
        options = replace(PRESETS["pretrain"], **shape, materials=self.materials, look=self.look)
        if not (folder / "done").is_file():
            write_world(folder / "tree", options, workers=2, progress=self.progress)
            (folder / "done").write_text(options.digest)
        return Manifest.load(folder / "tree")

    def trained_judge(self):
        with seeded(0, "judge"):
            judge = Judge(len(self.names))
        labels = np.array([self.names.index(m) for m in self.train.column("material")])
        loss = JudgeLoss(self.images, labels)
        task = Task("judge", len(labels), loss.load, loss, self.train.digest)
        fit(judge, task, JUDGE, self.work / "judge", compute=BFLOAT, progress=self.progress)
        return judge.eval()

    def autoencoder(self, name="background"):
        if name == "background":
            return load_autoencoder("palpate/mini")
        folder = self.work / "autoencoder"
        if not (folder / "model").is_dir():
            where = {"cache": self.cache, "progress": self.progress, "compute": BFLOAT}
            made = autoencoder_of(self.train, self.everything, VQ, MINI.size, folder, **where)
            made.save(folder / "model")
        return load_autoencoder(folder / "model")

    def judged(self, images):
        """Accuracy of both judges, and TMMD, of images of the test samples in their order."""
        hits = self.judge.names(images) == self.answers
        features = FeatureSet(
            self.test.ids,
            embed_images(np.asarray(images), self.encoders),
            self.test.column("material"),
            self.videos,
            self.encoders.digest("tactile"),
        )
        probed = material_accuracy(self.tactile[0], features, probe=self.probe)
        far = tmmd(features, self.tactile[1], preset="grouped")
        return {
            "cnn": by_video(hits, self.videos),
            "probe": [probed.value, (probed.interval[1] - probed.interval[0]) / 2],
            "tmmd": [far.value, *far.interval],
        }

    def reconstructed(self, autoencoder):
        if isinstance(autoencoder, BackgroundAutoencoder):
            return autoencoder.decode(autoencoder.encode(self.real, self.gels), self.gels)
        return autoencoder.decode(autoencoder.encode(np.asarray(self.real)))

    def nearest(self, known, cache):
        """The real images of the photos of ``known`` that are most like the test photos."""
        keys, asked = (
            embed(part, self.encoders, "vision", cache=of).features
            for part, of in ((known, cache), (self.test, self.cache))
        )
        images = cached_images(known, "tactile", MINI.size, cache)
        return images[(asked @ keys.T).argmax(1)]

    def guide(self):
        """Encoders of another seed than those that judge."""
        folder = self.work / "guide"
        if not folder.is_dir():
            how = {"preset": "mini", "clip": "palpate/mini", "seed": 1, "output": folder}
            train_encoder(self.train, self.everything, progress=self.progress, **how)
        return EncoderSet.load(folder)

    def row(self, name, seed, steps):
        """Train one row; return what the judges say of its images."""
        folder = self.work / "rows" / digest_json([name, seed, steps, VERSION])[:16]
        if name == ORACLE:
            return self.oracle(folder, seed, steps)
        autoencoder = self.autoencoder("VQ" if name == VQ_ROW else "background")
        began, resumed = time.process_time(), folder.is_dir()
        pipeline = train_pipeline(
            self.train,
            self.everything,
            self.encoders,
            autoencoder,
            ROWS[name],
            folder,
            seed=seed,
            steps=steps,
            background=name == "gel as input",
            align=Alignment(self.guide()) if name.startswith("aligned") else None,
            cache=self.cache,
            compute=BFLOAT,
            progress=self.progress,
        )
        result = {"seconds": None if resumed else round(time.process_time() - began)}
        pipeline.save(fresh(folder / "model"))  # for a look at its images later
        gels = self.gels if pipeline.background else None
        pixels = cached_images(self.test, "vision", pipeline.vision_size, self.cache)
        photos = pipeline.embed(pixels)
        order = rng_for(0, "permuted").permutation(len(photos))
        drives = {"photo": (photos, None), "permuted": (photos[order], None)}
        if "text" in pipeline.denoiser.policy.sources:
            texts = texts_of(self.test)[0]
            each = {text: pipeline.embed_text(text) for text in set(texts)}
            drives["caption"] = (None, torch.cat([each[text] for text in texts]))
        for drive, (photo, text) in drives.items():
            made = pipeline.sample(photo, self.test.ids, texts=text, seed=seed, background=gels)
            result[drive] = self.judged(made)
            np.save(folder / f"{drive}.npy", made)
        if gels is not None:  # what a gel costs that training has not seen
            made = pipeline.sample(
                photos, self.test.ids, seed=seed, background=self.gels_like(self.train, self.cache)
            )
            result["known gels"] = self.judged(made)
            hits = [self.judge.names(np.load(folder / "photo.npy")), self.judge.names(made)]
            loss = np.subtract(*((names == self.answers).astype(float) for names in hits[::-1]))
            result["loss by new gels"] = by_video(loss, self.videos)
        return result

    def oracle(self, folder, seed, steps):
        """The row of a generator whose condition is the one-hot code of the material."""
        began, resumed = time.process_time(), folder.is_dir()
        chosen, code = ROWS[ORACLE], self.autoencoder()
        latents = code.encode(self.images, gels_of(self.train, MINI.size, self.cache))
        stats, codes = LatentStats.of(latents), np.eye(chosen.condition.width, dtype=np.float32)
        known = [self.names.index(m) for m in self.train.column("material")]
        denoiser = train_denoiser(
            latents,
            {"text": codes[known]},
            stats=stats,
            unet=chosen.unet,
            policy=chosen.condition,
            schedule=chosen.schedule,
            loop=replace(chosen.loop_for(len(known), seed=seed), steps=steps),
            folder=folder,
            key=self.train.digest,
            compute=BFLOAT,
            progress=self.progress,
        )
        seconds = None if resumed else round(time.process_time() - began)
        parts = code, denoiser, stats, chosen.schedule, chosen.sampler, MINI.size
        pipeline = TactilePipeline(*parts, gel=self.gels[0])
        how = {"seed": seed, "background": self.gels}
        made = pipeline.sample(None, self.test.ids, texts=codes[self.answers], **how)
        return {"seconds": seconds, "told": self.judged(made)}

    def gels_like(self, known, cache):
        """A gel of ``known`` for each judged sample."""
        gels = gels_of(known, MINI.size, cache)
        rows = rng_for(0, "known gels").integers(len(gels), size=len(self.test))
        return np.stack([gels[row] for row in rows])

    def ceilings(self):
        """What is not generated, judged alike."""
        shown = {
            "real": self.real,
            "real, of the nearest training photo": self.nearest(self.train, self.cache),
        }
        shown["through the autoencoder of palpate/mini"] = self.reconstructed(self.autoencoder())
        return {name: self.judged(images) for name, images in shown.items()}

    def vq_ceiling(self):
        return self.judged(self.reconstructed(self.autoencoder("VQ")))


class Line:
    """A line of progress every half minute."""

    last = 0.0

    def __call__(self, what, done, total, remark=""):
        if time.monotonic() > self.last + 30:
            self.last = time.monotonic()
            print(f"  {what}: {done} of {total} {remark}", flush=True)


def percents(pair):
    """`17.7 ± 4.7` of a share and half of its interval."""
    return f"{100 * pair[0]:.1f} ± {100 * pair[1]:.1f}"


def cells(judged):
    """Both judges and TMMD with its interval, as cells of a table."""
    value, low, high = judged["tmmd"]
    return (
        percents(judged["cnn"]),
        percents(judged["probe"]),
        f"{value:.3f} [{low:.3f}, {high:.3f}]",
    )


def line(*values):
    return f"| {' | '.join(map(str, values))} |"


def row_line(r, real):
    """One row and seed, and what it is of ``real``, the share that the CNN names right."""
    main = r["photo"] if "photo" in r else r["told"]
    cnn, probe, far = cells(main)
    others = [percents(r[d]["cnn"]) if d in r else "" for d in ("caption", "permuted")]
    others.append(percents(r["loss by new gels"]) if "loss by new gels" in r else "")
    ratio = f"{main['cnn'][0] / real:.2f}"
    seconds = r["seconds"] or ""
    return line(r["row"], r["seed"], r["steps"], seconds, cnn, ratio, probe, far, *others)


def tables(record):
    """Markdown of one world: what is not generated, then one line a row and seed."""
    lines = [line("not generated", "CNN, %", "probe, %", "TMMD"), "|---|---|---|---|"]
    lines += [line(name, *cells(c)) for name, c in record["ceilings"].items()]
    heads = ["by photo: CNN, %", "of real", "probe, %", "TMMD", "by caption: CNN, %"]
    heads += ["permuted photos: CNN, %", "lost by new gels, points"]
    heads = ["row", "seed", "steps", "CPU s", *heads]
    lines += ["", line(*heads), "|---" * len(heads) + "|"]
    order = list(ROWS)
    for r in sorted(record["rows"], key=lambda r: (order.index(r["row"]), r["steps"], r["seed"])):
        lines.append(row_line(r, record["ceilings"]["real"]["cnn"][0]))
    return "\n".join(lines)


def page(records):
    """The whole Markdown file."""
    parts = [
        f"""## {materials} materials (chance {100 / int(materials):.0f} %)

{record["train"]} training samples; {record["test"]} judged samples of {record["videos"]} videos.

{tables(record)}
"""
        for materials, record in sorted(records.items(), key=lambda item: int(item[0]))
    ]
    return f"""# What lifts the generator

Made by a committed command; do not edit by hand. Synthetic: the tables show a mechanism.

    python benchmarks/generator_ablation.py --materials 10 20 --seeds 0 1 2

The rows that are there, of {len(ROWS)}: the command goes on where it was stopped. A row is `base`
(the preset `mini`, trained shorter) with one change; the oracle is told the material, one-hot, in
training and in place of the photo. The judges, a small CNN and the linear probe of `palpate/mini`,
saw real images only and are never fitted again; they judge new objects, videos and gel units. The
real images of the nearest training photos are among those that they saw. Intervals: 95 % over
videos, of one training; TMMD (grouped) is to the real images of the same samples. Trainings that
were stopped and went on have no seconds. {platform.machine()}, CPU, bf16; last row of
{datetime.date.today().isoformat()}.

{chr(10).join(parts)}"""


def saved(file):
    """The records of this version."""
    records = json.loads(file.read_text()) if file.is_file() else {}
    return {k: r for k, r in records.items() if r.get("version") == VERSION}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", nargs="+", default=list(ROWS), choices=tuple(ROWS), metavar="ROW")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--materials", type=int, nargs="+", default=[10])
    parser.add_argument("--work", type=Path, default=Path("runs/generator_ablation"))
    parser.add_argument(
        "--page",
        type=Path,
        default=Path(__file__).parents[1] / "docs/studies/generator_ablation.md",
        help="Markdown file to write; the records lie beside it",
    )
    chosen = parser.parse_args()
    file = chosen.page.with_suffix(".json")
    for seed, materials, name in itertools.product(chosen.seeds, chosen.materials, chosen.rows):
        steps = chosen.steps * (2 if name == LENGTH else 1)
        key = {"row": name, "seed": seed, "steps": steps}
        record = saved(file).get(str(materials), {})
        if any(key.items() <= r.items() for r in record.get("rows", ())):
            continue
        study = Study(chosen.work / str(materials), materials, "many")
        if not record:
            counts = {"train": len(study.train), "test": len(study.test)}
            counts |= {"videos": len(set(study.videos)), "version": VERSION}
            record = {**counts, "ceilings": study.ceilings(), "rows": []}
        row = {**key, **study.row(name, seed, steps)}
        records = saved(file)  # again: another process may have added rows of another world
        record = records.setdefault(str(materials), record)
        record["rows"].append(row)
        if name == VQ_ROW:  # its autoencoder is trained by now
            record["ceilings"]["through the VQ autoencoder of its row"] = study.vq_ceiling()
        write_json(file, records)
        chosen.page.write_text(page(records))
        print(row_line(row, record["ceilings"]["real"]["cnn"][0]), flush=True)


if __name__ == "__main__":
    main()

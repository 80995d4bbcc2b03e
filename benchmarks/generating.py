"""What generating costs: ratios within one run, on the same photos, with the shipped generator.

    python benchmarks/generating.py --write docs/studies/generating.md
    python benchmarks/generating.py --small

- ``overlap``: ``palpate.generate`` of photo files into a folder, over the sampling of the same
  conditions in memory (wanted: at most 1.05).
- ``cached``: training steps with the latents and embeddings of a table, over encoding the images,
  photos and texts of each batch (wanted: at least 1.4 times as fast): read from files of 640 x 480
  too, as a loop without caches does, or held in memory. Also on one core alone, as each of several
  processes has: with a core to spare, reading hides behind the step.
- ``steps``: the default number of steps against 200: time (wanted: a tenth), and what judges that
  saw real images alone say (wanted: no difference beyond the noise).
- ``diffusers``: images a second of the pipeline, over a plain loop of U-Net, guidance, scheduler
  and autoencoder (wanted: at least 1).
- ``bf16``: the U-Net in bfloat16 over float32, in sampling and in training, where the CPU has it.
- ``start``: processor seconds of ``palpate generate photo.jpg -o t.png`` with start-up (wanted:
  below 8).

Pairs are measured in turns and the median ratio is kept, of processor seconds and of the wall's;
other work on the machine disturbs the second. One thread, unless said.
"""

import argparse
import datetime
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from common import Judge, JudgeLoss, by_video
from diffusers import DPMSolverMultistepScheduler, UNet2DConditionModel
from PIL import Image

from palpate.core import quiet
from palpate.data.images import load_images
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import LatentStats
from palpate.diffusion.denoiser import Denoiser, starting_noise
from palpate.diffusion.denoiser_training import DiffusionLoss
from palpate.diffusion.generation import generate
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import MINI
from palpate.diffusion.unet import build_unet
from palpate.encoders.embed import embed, embed_images, embed_texts, texts_of
from palpate.encoders.encoder_set import EncoderSet
from palpate.metrics import tmmd
from palpate.metrics.probe import fit_probe, material_accuracy
from palpate.sim import PRESETS, write_world
from palpate.training.engine import Task, fit, has_bf16
from palpate.training.options import Compute, LoopOptions
from palpate.training.steps import seeded

#: Phases as in the recorded page: every touch at its deepest.
SHAPE = {"contacts_per_video": 3, "frames_per_contact": 1, "sensors": 3, "materials": 10}
SHAPE |= {"phases": "spaced"}
#: New objects, videos and gels each: judges learn on the first, few and many steps are judged on
#: the third, one sample of a video; all else is measured on the second.
WORLDS = {"train": {"seed": 81}, "new": {"seed": 82}, "many": {"seed": 83}}
PHOTO = (640, 480)  # frames of Touch and Go
BF16 = Compute(precision="bf16", checkpoint_minutes=1e9)
FLOAT = Compute(checkpoint_minutes=1e9)


class Sizes:
    """How much is measured."""

    def __init__(self, small):
        self.small = small
        self.objects = 2 if small else 9  # of a material, in the new world
        self.photos = 48 if small else 1000
        self.train_objects = 4 if small else 16
        self.turns = 2 if small else 3
        self.train_steps = 4 if small else 10
        self.judged = 24 if small else 400
        self.judge_steps = 60 if small else 600
        self.starts = 1 if small else 3


def clocks():
    """Processor seconds of this process with all its threads, and seconds of the wall."""
    return np.array([time.process_time(), time.perf_counter()])


def in_turns(first, second, turns):
    """Two calls in turns; see `summary`."""
    rows = []
    for k in range(turns):
        at = [clocks()]
        for call in (first, second):
            call(k)
            at.append(clocks())
        rows.append(np.diff(at, axis=0))
    return summary(np.array(rows))


def summary(rows):
    """Median ratio of pairs (n, 2 calls, 2 clocks), and the medians of their seconds."""
    ratio = np.median(rows[:, 0] / rows[:, 1], axis=0)
    a, b = np.median(rows, axis=0)
    return {
        "ratio": round(float(ratio[0]), 3),
        "wall": round(float(ratio[1]), 3),
        "seconds": [round(float(a[0]), 2), round(float(b[0]), 2)],
        "quartiles": np.quantile(rows[:, 0, 0] / rows[:, 1, 0], (0.25, 0.75)).round(3).tolist(),
        "turns": len(rows),
    }


def with_interval(score):
    """Value and both ends; of few images there is no interval."""
    return [score.value, *(score.interval or (float("nan"), float("nan")))]


class Bench:
    """A world of photos, and the shipped generator."""

    def __init__(self, work, sizes):
        self.work, self.sizes = work, sizes
        self.pipeline = TactilePipeline.from_pretrained("palpate/mini", device="cpu")
        self.encoders = EncoderSet.load("palpate/mini")
        self.new = self.world("new", objects_per_material=sizes.objects)
        self.photos = [*self.new.paths("vision")]

    def world(self, name, **changes):
        options = replace(PRESETS["pretrain"], **{**SHAPE, **WORLDS[name], **changes})
        write_world(self.work / name, options, workers=2)
        return Manifest.load(self.work / name)

    def files(self):
        """As many photos as requested, of a common size, each one different."""
        folder = self.work / "photos"
        if not folder.exists():
            folder.mkdir()
            for k in range(self.sizes.photos):
                image = Image.open(self.photos[k % len(self.photos)]).convert("RGB")
                image = image.rotate(90 * (k // len(self.photos))).resize(PHOTO)
                image.save(folder / f"{k:04}.jpg", quality=90)
        return sorted(folder.iterdir())

    def overlap(self):
        """Turns over parts of the photos, so that other work disturbs both."""
        files, turns = self.files(), (2 if self.sizes.small else 8)
        parts = [files[k::turns] for k in range(turns)]
        small = np.stack([np.asarray(Image.open(f).resize((64, 64))) for f in files[:64]])
        rows = self.pipeline.embed(small)

        def whole(k):
            generate(parts[k], model=self.pipeline, output=self.work / f"out {time.time_ns()}")

        def alone(k):
            names, batch = [f.name for f in parts[k]], self.pipeline.sampler.batch
            for start in range(0, len(names), batch):
                some = names[start : start + batch]
                self.pipeline.sample(rows[torch.arange(len(some)) % len(rows)], some, seed=0)

        generate(files[:2], model=self.pipeline, output=self.work / f"warm {time.time_ns()}")
        return {"photos": len(files), "pixels": PHOTO, **in_turns(whole, alone, turns)}

    @staticmethod
    def frames(paths, folder):
        """The images as a video's frames of a common size."""
        folder.mkdir(exist_ok=True)
        files = [folder / f"{k:04}.jpg" for k in range(len(paths))]
        for path, file in zip(paths, files, strict=True):
            if not file.exists():
                Image.open(path).convert("RGB").resize(PHOTO).save(file, quality=90)
        return files

    def cached(self):
        """Steps of the denoiser's training; encoded once, or in every step."""
        part = self.new
        tables = {s: embed(part, self.encoders, s).features for s in ("vision", "text")}
        size, code = self.pipeline.size, self.pipeline.autoencoder
        sizes = {"tactile": size, "background": size, "vision": self.pipeline.vision_size}
        files = {c: self.frames(part.paths(c), self.work / f"frames {c}") for c in sizes}
        pixels = {c: load_images(files[c], side) for c, side in sizes.items()}
        texts = np.array(texts_of(part)[0])
        latents = code.encode(pixels["tactile"], pixels["background"])
        stats = LatentStats.of(latents)
        policy = self.pipeline.denoiser.policy
        means = {s: torch.from_numpy(t).mean(0) for s, t in tables.items()}

        def model():
            with seeded(0, "denoiser"):
                shape = {"channels": latents.shape[1], "size": latents.shape[2]}
                unet = build_unet(MINI.unet, policy, **shape)
                memory = tuple(torch.from_numpy(tables[s]) for s in ("text", "vision"))
                return Denoiser(unet, policy, means, memory)

        tokens = model().tokens

        class Live:
            """A table whose rows are computed when they are read."""

            def __init__(self, function):
                self.function = function

            def __getitem__(self, rows):
                with torch.no_grad():
                    return self.function(rows)

        def held(column, rows):
            return pixels[column][rows]

        def read(column, rows):
            return load_images([files[column][k] for k in rows], sizes[column])

        def photo(take, rows):
            features = embed_images(take("vision", rows), self.encoders, "vision")
            return tokens(torch.from_numpy(features), "vision")

        def latent(take, rows):
            return code.encode(take("tactile", rows), take("background", rows))

        def text(rows):
            return tokens(torch.from_numpy(embed_texts(list(texts[rows]), self.encoders)), "text")

        known = {s: tokens(torch.from_numpy(t), s) for s, t in tables.items()}
        common = {"stats": stats, "schedule": MINI.schedule, "policy": policy}
        losses = {"cached": DiffusionLoss(latents, known, None, **common)}
        for name, take in (("held", held), ("read", read)):
            live = {"vision": Live(partial(photo, take)), "text": Live(text)}
            losses[name] = DiffusionLoss(Live(partial(latent, take)), live, None, **common)

        def train(name, compute, _=0):
            """Clocks at the end of each step."""
            loss, at = losses[name], []
            task = Task("benchmark", len(part), loss.load, loss)
            loop = replace(MINI.loop, steps=self.sizes.train_steps, evaluations=0)
            with tempfile.TemporaryDirectory() as folder:
                how = {"compute": compute, "progress": lambda *_: at.append(clocks())}
                fit(model(), task, loop, Path(folder), **how)
            return np.diff(at, axis=0)[1:]

        self.train = train
        return {name: self.training((name, FLOAT), ("cached", FLOAT)) for name in ("read", "held")}

    def cached_alone(self):
        """The same on one core."""
        if not hasattr(os, "sched_setaffinity"):  # Linux alone
            return None
        cores = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {min(cores)})
        try:
            return self.cached()
        finally:
            os.sched_setaffinity(0, cores)

    def training(self, first, second):
        """Median ratio of the steps of two trainings, in turns; the first steps are left out."""
        turns = [[self.train(*first), self.train(*second)] for _ in range(self.sizes.turns)]
        rows = np.concatenate([np.stack(turn, axis=1) for turn in turns])
        return summary(rows)

    def steps(self):
        """Default steps and 200, the same samples and noise; judged by what saw real images."""
        objects = -(-self.sizes.judged // SHAPE["materials"])
        some = self.world("many", objects_per_material=objects, contacts_per_video=1, two_videos=0)
        some = some.take(some.ids[: self.sizes.judged])
        size = self.pipeline.size
        gels = load_images(some.paths("background"), size)
        photos = self.pipeline.embed(load_images(some.paths("vision"), self.pipeline.vision_size))
        made, seconds = {}, {}
        for steps in (self.pipeline.sampler.steps, 200):
            start = clocks()
            sampler = self.pipeline.sampler_with(steps=steps)
            made[steps] = self.pipeline.sample(
                photos, some.ids, seed=0, background=gels, sampler=sampler
            )
            seconds[steps] = clocks() - start
        train = self.world("train", objects_per_material=self.sizes.train_objects)
        images = load_images(train.paths("tactile"), size)
        names = sorted(set(train.column("material")))
        labels = np.array([names.index(m) for m in train.column("material")])
        with seeded(0, "judge"):
            judge = Judge(len(names))
        loss = JudgeLoss(images, labels)
        loop = LoopOptions(self.sizes.judge_steps, 32, 2e-3, warmup=50, weight_decay=1e-3, ema=0.99)
        task = Task("judge", len(labels), loss.load, loss)
        fit(judge, task, loop, self.work / "judge", compute=BF16, progress=quiet)
        judge.eval()
        known = embed(train, self.encoders, "tactile")
        real = embed(some, self.encoders, "tactile")
        probe = fit_probe(known)
        answers = np.array([names.index(m) for m in some.column("material")])
        videos = some.column("video")

        def judged(pixels):
            hits = (judge.names(pixels) == answers).astype(float)
            rows = embed_images(np.asarray(pixels), self.encoders, gels=gels)
            features = replace(real, features=rows)
            row = {
                "cnn": by_video(hits, videos),
                "probe": with_interval(material_accuracy(known, features, probe=probe)),
                "tmmd": with_interval(tmmd(features, real, preset="grouped")),
            }
            return hits, features, row

        rows = {"real": judged(load_images(some.paths("tactile"), size))[2]}
        hits, sets = {}, {}
        for steps, pixels in made.items():
            hits[steps], sets[steps], rows[str(steps)] = judged(pixels)
        few, many = made
        between = tmmd(sets[few], sets[many], preset="grouped")
        return {
            "images": len(some),
            "steps": [few, many],
            "ratio": round(float(seconds[few][0] / seconds[many][0]), 3),
            "wall": round(float(seconds[few][1] / seconds[many][1]), 3),
            "seconds": [round(float(seconds[k][0]), 1) for k in (few, many)],
            "cnn difference": by_video(hits[few] - hits[many], videos),
            "tmmd between": with_interval(between),
            "judged": rows,
        }

    def diffusers(self):
        """The pipeline, and the shortest loop of diffusers' parts that makes the same images."""
        pipeline, batch = self.pipeline, self.pipeline.sampler.batch
        pipeline.unet.save_pretrained(self.work / "unet")
        unet = UNet2DConditionModel.from_pretrained(self.work / "unet").eval()
        scheduler = DPMSolverMultistepScheduler.from_config(pipeline.scheduler.config)
        small = np.stack([np.asarray(Image.open(f).resize((64, 64))) for f in self.photos[:batch]])
        rows, ids = pipeline.embed(small), [str(k) for k in range(batch)]
        gels = np.broadcast_to(pipeline.gel, (batch, *pipeline.gel.shape))
        tokens = pipeline.denoiser.condition(rows)
        both = torch.cat([pipeline.denoiser.null_tokens(1).expand(tokens.shape), tokens])
        s, images = pipeline.sampler.guidance, {}
        # The loop guides at every step by the plain formula; so must the pipeline here.
        plainly = replace(pipeline.sampler, high=1.0, rescale=0.0)

        @torch.no_grad()
        def plain(_):
            scheduler.set_timesteps(pipeline.sampler.steps)
            z = starting_noise(ids, (unet.config.out_channels, 16, 16), 0)
            for t in scheduler.timesteps:
                twice = {"encoder_hidden_states": both, "class_labels": both.flatten(1)}
                out = unet(torch.cat([z, z]), t, return_dict=False, **twice)[0]
                without, given = out.chunk(2)
                prediction = without + s * (given - without)
                z = scheduler.step(prediction, t, z, return_dict=False)[0]
            images["plain"] = pipeline.autoencoder.decode(pipeline.stats.restore(z), gels)

        def ours(_):
            images["ours"] = pipeline.sample(rows, ids, seed=0, sampler=plainly)

        plain(0)
        result = in_turns(plain, ours, 8 * self.sizes.turns + 1)
        difference = np.abs(images["plain"].astype(int) - images["ours"]).max()
        per_image = result["seconds"][1] / batch
        return {
            **result,
            "images a processor second": round(1 / per_image, 2),
            "largest difference of a pixel": int(difference),
        }

    def bf16(self):
        """Sampling and training steps."""
        if not has_bf16():
            return {"skipped": "this CPU has no bfloat16"}
        other = TactilePipeline.from_pretrained("palpate/mini", device="cpu").to(torch.bfloat16)
        batch = self.pipeline.sampler.batch
        small = np.stack([np.asarray(Image.open(f).resize((64, 64))) for f in self.photos[:batch]])
        rows, ids = self.pipeline.embed(small), [str(k) for k in range(batch)]
        made = {}

        def run(name, pipeline, _):
            made[name] = pipeline.sample(rows, ids, seed=0).astype(int)

        run("b", other, 0)
        sampling = in_turns(
            partial(run, "f", self.pipeline), partial(run, "b", other), self.sizes.turns
        )
        sampling["mean difference of a pixel"] = float(np.abs(made["f"] - made["b"]).mean())
        if not hasattr(self, "train"):
            self.cached()
        training = self.training(("cached", FLOAT), ("cached", BF16))
        return {"sampling": sampling, "training": training}

    def start(self):
        """A process for one photo, imports and the reading of the model included."""
        photo, seconds = self.files()[0], []
        for k in range(self.sizes.starts):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            output = self.work / f"t{k}.png"
            command = [sys.executable, "-m", "palpate", "generate", photo, "-o", output, "-q"]
            subprocess.run(command, check=True, capture_output=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
        return {"processor seconds": round(float(np.median(seconds)), 2), "runs": len(seconds)}


PARTS = {
    "cached": Bench.cached,
    "cached, one core": Bench.cached_alone,
    "bf16": Bench.bf16,
    "diffusers": Bench.diffusers,
    "start": Bench.start,
    "steps": Bench.steps,
    "overlap": Bench.overlap,
}


def measure(parts, small):
    """Part -> what was measured."""
    torch.set_num_threads(1)
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), Sizes(small))
        for name in parts:
            begin = time.perf_counter()
            results[name] = PARTS[name](bench)
            print(name, json.dumps(results[name]), f"({time.perf_counter() - begin:.0f} s)")
            sys.stdout.flush()
    return results


def points(pair):
    """`17.7 ± 4.7` of a share and half of its interval."""
    return f"{100 * pair[0]:.1f} ± {100 * pair[1]:.1f}"


def ends(row):
    """Value and interval, if there is one."""
    value, low, high = row
    return f"{value:.3f} [{low:.3f}, {high:.3f}]" if low == low else f"{value:.3f}"


def page(results):
    """The whole Markdown file."""
    rows = []

    def add(what, r, wanted):
        a, b = r["seconds"]
        ratios = f"{r['ratio']:.3f} | {r['wall']:.3f}"
        rows.append(f"| {what} | {a:.2f} / {b:.2f} | {ratios} | {wanted} |")

    r = results["overlap"]
    many = f"`generate` of {r['photos']:,} photos of {r['pixels'][0]} x {r['pixels'][1]}"
    add(f"{many} into a folder / sampling alone", r, "at most 1.05 (wall)")
    what = f"frames of {PHOTO[0]} x {PHOTO[1]} read and encoded in each step / cached"
    add(f"training, {what}", results["cached"]["read"], "at least 1.4")
    add("training, only encoded in each step / cached", results["cached"]["held"], "")
    if alone := results["cached, one core"]:
        add("training on one core, read and encoded / cached", alone["read"], "at least 1.4")
        add("training on one core, only encoded / cached", alone["held"], "")
    r = results["steps"]
    add(f"{r['steps'][0]} steps / {r['steps'][1]}", r, "a tenth")
    add("plain loop of diffusers / pipeline", results["diffusers"], "at least 1")
    if "sampling" in results["bf16"]:
        add("sampling, float32 / U-Net in bf16", results["bf16"]["sampling"], "")
        add("training, float32 / bf16 autocast", results["bf16"]["training"], "")
    judged = [
        f"| {name} | {points(j['cnn'])} | {ends(j['probe'])} | {ends(j['tmmd'])} |"
        for name, j in r["judged"].items()
    ]
    value, low, high = results["steps"]["tmmd between"]
    start, loop = results["start"], results["diffusers"]
    bf16 = results["bf16"].get("sampling", {}).get("mean difference of a pixel")
    rounding = "" if bf16 is None else f" bf16 changes a pixel by {bf16:.2f} of 255 on average."
    return f"""# Generating: speed

Made by a committed command; do not edit by hand. {platform.machine()}, {os.cpu_count()} cores,
torch {torch.__version__}, one thread unless said; {datetime.date.today().isoformat()}.

    python benchmarks/generating.py --write docs/studies/generating.md

The shipped generator, on photos of a procedural world that it has not seen. Both of a pair ran in
turns in one process, and the ratio is the median over turns; processor seconds are those of all
threads.

| first / second | processor s, a turn (a step) | ratio, processor | ratio, wall | wanted |
|---|---|---|---|---|
{chr(10).join(rows)}

One photo with `palpate generate photo.jpg -o t.png`, start-up included:
{start["processor seconds"]} processor seconds (median of {start["runs"]}; wanted: below 8). The
pipeline makes {loop["images a processor second"]} images a processor second; its images and those
of the plain loop differ by {loop["largest difference of a pixel"]} of 255 at most.{rounding}

## Few steps against many

{r["images"]} samples of new videos, the same noise. Judges saw real images alone: a small CNN and
the linear probe of the tactile encoder of `palpate/mini`; TMMD (grouped) to the real images of the
same samples. 95 % intervals over videos.

| images | CNN, % | probe | TMMD |
|---|---|---|---|
{chr(10).join(judged)}

Paired, few minus many steps: CNN {points(r["cnn difference"])} points. TMMD between the two sets:
{value:.3f} [{low:.3f}, {high:.3f}].
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=[*PARTS], default=[*PARTS], metavar="PART")
    parser.add_argument("--small", action="store_true", help="minutes become seconds")
    parser.add_argument("--write", type=Path, help="the page")
    chosen = parser.parse_args()
    begin, load = time.perf_counter(), os.getloadavg()[0]
    results = measure(chosen.only, chosen.small)
    minutes = (time.perf_counter() - begin) / 60
    print(f"{minutes:.1f} minutes, load {load:.1f} to {os.getloadavg()[0]:.1f}")
    if chosen.write and len(results) == len(PARTS):
        text = page(results)
        chosen.write.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()

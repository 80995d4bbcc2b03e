"""What the training engine costs, as ratios within one run.

::

    python benchmarks/training.py [--only overhead trust processes embedding memory]

- ``overhead``: seconds of a step of the engine, over a bare PyTorch loop of the same model, batch
  and optimizer (wanted: below 1.03).
- ``trust``: what digests and flushing add to a training, over its steps (wanted: below .03): the
  seconds of a checkpoint over those of the same file written alone, next to the steps between two
  checkpoints; and those of a cache of pixels, written and checked, next to the epochs that read it.
- ``processes``: images a second of two gloo processes, one thread each, over one process with one
  thread, at equal global batch (wanted: 1.5), and images a processor second of the first process;
  next to it the ceiling: two processes that train apart at the same time, over one.
- ``embedding``: seconds to embed 10,000 images, over the bare forward pass (wanted: below 1.1).
- ``memory``: peak memory of the process in a step of batch 256 of a ViT-Small in chunks of 8
  (wanted: below 6 GB), and how far loss and gradient are from the plain batch's at batch 16
  (wanted: 1e-4).

What steps cost on a GPU: ``benchmarks/gpu.py``. Pairs are measured in turns, and the median ratio
is printed: other work on the machine then disturbs both. ``ratio`` is of processor seconds (one
thread), which other work hardly changes; for ``processes`` it is by the clock, since waiting for
the other process takes no processor time.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import socket
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
from safetensors.torch import save_file

from palpate.core import cached, is_whole, quiet, rng_for
from palpate.data.images import Preprocess, mapped
from palpate.encoders.contrastive import TactileLoss, TactileModel
from palpate.encoders.embed import embed_images
from palpate.encoders.encoder_set import EncoderSet, new_tactile
from palpate.encoders.losses import in_chunks, three_way
from palpate.encoders.models import to_unit
from palpate.encoders.presets import preset_of
from palpate.encoders.rows import Rows, augmented, bytes_to_unit, draw_augmentation, factorize
from palpate.training import engine
from palpate.training.engine import Task, fit
from palpate.training.options import Compute, RowOrder
from palpate.training.steps import Step

MINI = preset_of("mini")
WORDS = ["rough", "smooth", "soft", "hard", "grained", "ribbed", "woven", "sharp", "flat", "warm"]


class Images(Rows):
    """Rows of random images, texts and photos in memory."""

    def __init__(self, n: int) -> None:
        rng = rng_for(0, "benchmark")
        side = MINI.image
        self.images = rng.integers(0, 256, (n, side, side, 3), dtype=np.uint8)
        self.captions = [", ".join(rng.choice(WORDS, 3, replace=False)) for _ in range(n)]
        self.caption_ids = factorize(self.captions)
        self.photo, self.without_photo = torch.arange(n), 0
        self.text, self.vision = (torch.randn(n, 128) for _ in range(2))
        self.text, self.vision = (t / t.norm(dim=1, keepdim=True) for t in (self.text, self.vision))


def tactile_model():
    return TactileModel(new_tactile(MINI.tactile_config(128), 0))


def clocks():
    """Processor seconds of this process with all its threads, and seconds of the wall."""
    return np.array([time.process_time(), time.perf_counter()])


def in_turns(first, second, repeats=5):
    """The median over turns of the ratio of two durations."""
    first(), second()
    turns = []
    for _ in range(repeats):
        at = [clocks()]
        for call in (first, second):
            call()
            at.append(clocks())
        turns.append(np.diff(at, axis=0))
    return summary(np.array(turns))


def summary(turns):
    """Ratios and seconds of turns (n, 2 calls, 2 clocks): medians."""
    ratio, (first, second) = np.median(turns[:, 0] / turns[:, 1], axis=0), np.median(turns, axis=0)
    return {
        "ratio": round(float(ratio[0]), 3),
        "ratio_of_wall_seconds": round(float(ratio[1]), 3),
        "processor_seconds": [round(float(first[0]), 3), round(float(second[0]), 3)],
        "turns": len(turns),
    }


def engine_steps(rows, model, steps, loss, folder, progress=quiet):
    options = MINI.tactile_course.options(len(rows.images), 0)
    options = replace(options, steps=steps)
    task = Task(
        "benchmark", len(rows.images), lambda s: rows.load(s, MINI.tactile_course.augment), loss
    )
    compute = Compute(checkpoint_minutes=1e9)
    fit(model, task, options, Path(folder), compute=compute, progress=progress)


def overhead(steps=40):
    """The engine and the shortest loop that does the same to the same model, step by step in turns.

    A step of the engine ends where it reports progress; there a step of the bare loop is taken.
    What the engine does once (the log, the last checkpoint) is not in it.
    """
    rows = Images(1024)
    preprocess, course = Preprocess(MINI.image, MINI.image), MINI.tactile_course
    options = replace(course.options(1024, 0), steps=steps)
    loss = TactileLoss(rows, preprocess, "identical-text")
    model, order = tactile_model(), RowOrder(1024, options.batch, 0)
    optimizer = torch.optim.AdamW(model.parameters(), lr=options.lr, foreach=True)

    def bare(k):
        optimizer.zero_grad(set_to_none=True)
        step = Step(k, order(k), 0)
        index = torch.from_numpy(step.rows)
        pixels = bytes_to_unit(torch.from_numpy(rows.images[step.rows]))
        pixels = preprocess.normalize(augmented(pixels, draw_augmentation(course.augment, step)))
        embedded = model.tactile(pixel_values=pixels).image_embeds
        embedded = embedded / embedded.norm(dim=1, keepdim=True)
        text, vision = rows.text[index], rows.vision[index]
        how = {"targets": "identical-text"}
        scale, texts = model.log_scale.exp(), rows.caption_ids[index]
        total, _ = three_way(embedded, text, vision, scale, texts, **how)
        total.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()

    at = []

    def progress(what, done, total, remark=""):
        at.append(clocks())
        bare(done - 1)
        at.append(clocks())

    with tempfile.TemporaryDirectory() as folder:
        engine_steps(rows, tactile_model(), steps, loss, folder, progress)
    # From the end of a bare step to the next progress, and from there to the end of a bare step.
    turns = np.diff(at, axis=0)[1:].reshape(-1, 2, 2)
    return {"wanted": "below 1.03", **summary(turns[2:])}


def trust(rows=10_000, turns=5):
    """Digests and flushing, with against without, over the steps that they come with.

    A checkpoint is written in a thread beside the steps; here all of its seconds count.
    """
    few, course = Images(1024), MINI.tactile_course
    loss = TactileLoss(few, Preprocess(MINI.image, MINI.image), "identical-text")
    parameters = dict(tactile_model().named_parameters())
    parts = ("model", "ema", "exp_avg", "exp_avg_sq")
    state = {f"{part}.{name}": p for part in parts for name, p in parameters.items()}
    state = engine._copies(state)
    pixels = Images(rows).images
    at = []
    with tempfile.TemporaryDirectory(dir=".") as name:  # /tmp may be memory
        folder = Path(name)
        engine_steps(few, tactile_model(), 12, loss, folder, lambda *words: at.append(clocks()))
        step = np.median(np.diff(at, axis=0)[1:], axis=0)

        def cache():
            for file in folder.glob("sealed.npy*"):
                file.unlink()
            cached(folder / "sealed.npy", lambda part: np.save(part, pixels), mapped, quiet)
            assert is_whole(folder / "sealed.npy")

        plain = folder / "plain"
        tasks = {
            "checkpoint": (
                partial(engine._save, state, folder / "sealed.safetensors"),
                lambda: (save_file(state, plain), plain.replace(folder / "plain.safetensors")),
            ),
            "cache": (cache, lambda: np.save(folder / "plain.npy", pixels)),
        }
        seconds = {task: differences(*calls, turns) for task, calls in tasks.items()}
        megabytes = {
            task: (folder / f"sealed.{suffix}").stat().st_size / 1e6
            for task, suffix in (("checkpoint", "safetensors"), ("cache", "npy"))
        }
    steps = np.array([60 * Compute().checkpoint_minutes] * 2), rows / course.batch * step
    shares = {
        "between two checkpoints": seconds["checkpoint"] / steps[0],
        "first epoch": seconds["cache"] / steps[1],
        "training": seconds["checkpoint"] / steps[0] + seconds["cache"] / steps[1] / course.epochs,
    }
    digits = lambda values: [float(f"{value:.3g}") for value in values]
    return {
        "wanted": "below 0.03",
        "share_by_processor_and_wall": {name: digits(share) for name, share in shares.items()},
        "more_seconds": {name: digits(each) for name, each in seconds.items()},
        "megabytes": {name: round(size, 1) for name, size in megabytes.items()},
        "step_seconds": digits(step),
        "turns": turns,
    }


def differences(first, second, turns):
    """The median over turns of what one call takes more than another, by both clocks."""
    first(), second()
    more = []
    for _ in range(turns):
        at = [clocks()]
        for call in (first, second):
            call()
            at.append(clocks())
        took = np.diff(at, axis=0)
        more.append(took[0] - took[1])
    return np.median(more, axis=0)


WORKER = """
import sys, tempfile, torch
sys.path.insert(0, sys.argv[1])
from training import Images, Preprocess, TactileLoss
from training import clocks, engine_steps, tactile_model
from palpate.training.processes import connect, place
connect("cpu")
torch.set_num_threads(1)
rows = Images(1024)
loss = TactileLoss(rows, Preprocess(64, 64), "identical-text")
with tempfile.TemporaryDirectory() as folder:
    engine_steps(rows, tactile_model(), 1, loss, folder)
    print("ready", flush=True)
    sys.stdin.readline()
    began = clocks()
    engine_steps(rows, tactile_model(), 10, loss, folder)
    print(place()[1], *(10 * 128 / (clocks() - began)))
"""


def rates(n, world):
    """Images a processor second and a second of ``n`` workers at the same time, (n, 2)."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    workers = []
    try:
        for rank in range(n):
            where = {"RANK": rank % world, "LOCAL_RANK": rank % world, "WORLD_SIZE": world}
            where |= {"MASTER_ADDR": "localhost", "MASTER_PORT": port}
            workers.append(
                subprocess.Popen(
                    [sys.executable, "-c", WORKER, str(Path(__file__).parent)],
                    env=os.environ | {name: str(value) for name, value in where.items()},
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                )
            )
        for worker in workers:
            assert worker.stdout.readline() == "ready\n"
        for worker in workers:
            worker.stdin.write("\n")
            worker.stdin.flush()
        lines = [[float(cell) for cell in w.communicate()[0].split()] for w in workers]
    finally:  # when one fails, the others would wait for it
        for worker in workers:
            worker.kill()
    assert {line[0] for line in lines} == {world}
    return np.array(lines)[:, 1:]


def processes(turns=5):
    """Images a second of two processes that share a batch, and of two that know nothing of each
    other, over one, in turns: the latter is what the machine allows.
    """
    one, two, apart = [], [], []
    for _ in range(turns):
        one.append(rates(1, 1)[0])
        two.append(rates(2, 2)[0])
        apart.append(rates(2, 1).sum(axis=0))
    (processor, wall), (_, ceiling), (_, part) = (
        np.median(np.array(above) / np.array(below), axis=0).tolist()
        for above, below in ((two, one), (apart, one), (two, apart))
    )
    return {
        "wanted": "at least 1.5",
        "ratio": wall,
        "ratio_by_processor": processor,
        "ceiling": ceiling,
        "ratio_to_ceiling": part,
        "images_a_second": [np.median(rows, axis=0)[1] for rows in (one, two, apart)],
        "turns": turns,
    }


def embedding(n=10_000):
    """``embed_images`` and the bare forward pass."""
    rng = rng_for(0, "embedding")
    images = rng.integers(0, 256, (n, MINI.image, MINI.image, 3), dtype=np.uint8)
    preprocess = Preprocess(MINI.image, MINI.image)
    tactile = new_tactile(MINI.tactile_config(128), 0).eval().requires_grad_(False)
    encoders = EncoderSet(tactile=tactile, preprocesses={"tactile": preprocess})

    @torch.inference_mode()
    def bare():
        for k in range(0, n, 128):
            tactile(pixel_values=preprocess.normalize(to_unit(images[k : k + 128])))

    return {"wanted": "below 1.1", **in_turns(lambda: embed_images(images, encoders), bare, 3)}


def contrastive_step(model, config, batch, chunk):
    generator = torch.Generator().manual_seed(0)
    side = config.image_size
    pixels = torch.randn(batch, 3, side, side, generator=generator)
    text, vision = (torch.randn(batch, 768, generator=generator) for _ in range(2))

    def encode(x):
        return torch.nn.functional.normalize(model(pixel_values=x).image_embeds, dim=1)

    rows = in_chunks(encode, pixels, chunk)
    total, _ = three_way(rows, text, vision, 10.0, torch.arange(batch))
    model.zero_grad()
    total.backward()
    return float(total.detach()), torch.cat(
        [p.grad.flatten() for p in model.parameters() if p.grad is not None]
    )


def memory(batch=256, chunk=8):
    """Cached gradients of a ViT-Small: small, and equal to the plain batch."""
    config = preset_of("tvl-small").tactile_config(768)
    model, began = new_tactile(config, 0), clocks()
    contrastive_step(model, config, batch, chunk)
    seconds = (clocks() - began).tolist()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    plain, cached = (contrastive_step(model, config, 16, c) for c in (None, 4))
    return {
        "wanted": "below 6 GB, 1e-4",
        "peak_GB": round(peak, 2),
        "loss_apart": abs(plain[0] - cached[0]),
        "gradient_apart": float((plain[1] - cached[1]).norm() / plain[1].norm()),
        "batch": batch,
        "chunk": chunk,
        "processor_and_wall_seconds": seconds,
    }


PARTS = {
    "overhead": overhead,
    "trust": trust,
    "processes": processes,
    "embedding": embedding,
    "memory": memory,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="*", choices=PARTS, default=list(PARTS))
    names = parser.parse_args().only
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    machine = {"machine": platform.machine(), "cores": os.cpu_count(), "torch": torch.__version__}
    print(json.dumps(machine | {"load": os.getloadavg()[0]}))
    for name in names:
        print(json.dumps({"part": name, **PARTS[name]()}), flush=True)


if __name__ == "__main__":
    main()

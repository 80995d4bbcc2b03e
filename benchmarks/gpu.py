"""What the preset ``paper`` costs on a GPU: training steps and sampling, plain and fast.

    python benchmarks/gpu.py --write docs/studies/gpu.md
    python benchmarks/gpu.py --device cpu --small      # a try of the code without a GPU

- ``train``: the tactile encoder, and the U-Net, in steps of the training engine: in float32, with
  TF32, in bf16, and in bf16 with ``torch.compile``.
- ``cached``: the same of the U-Net where each step also encodes its images and texts, as a loop
  without caches does; they lie in memory, so reading them is not in it (wanted: at least 1.4 times
  the seconds of the cached step).
- ``sample``: DDIM with 200 steps, guided, with the autoencoder: by a plain float32 loop of
  diffusers' parts, and by the pipeline in the same modes.

Weights are random, in the published sizes: what a step costs does not depend on them. Operations
are counted by PyTorch (without those that cached gradients repeat); the share is that of the
device's peak by its data sheet, at the precision of the factors. Rows end in the records beside the
page, of one device and one torch each, and are not measured again.
"""

import argparse
import datetime
import gc
import json
import os
import platform
import sys
import tempfile
import time
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path

import numpy as np
import torch
from diffusers import VQModel
from torch.utils.flop_counter import FlopCounterMode
from transformers import CLIPTextConfig, CLIPTextModelWithProjection

from palpate.core import write_json
from palpate.diffusion.autoencoder import Autoencoder, LatentStats
from palpate.diffusion.denoiser import Denoiser, build_scheduler, starting_noise
from palpate.diffusion.denoiser_training import DiffusionLoss
from palpate.diffusion.pipeline import TactilePipeline
from palpate.diffusion.presets import preset_of
from palpate.diffusion.unet import build_unet
from palpate.encoders.encoder_set import encode_tactile, new_tactile
from palpate.encoders.losses import in_chunks, three_way
from palpate.encoders.presets import preset_of as encoder_preset
from palpate.training.engine import Losses, Task, fit
from palpate.training.options import Compute, LoopOptions
from palpate.training.steps import Step

#: TFLOP/s of dense products by the data sheets (SXM), by the precision of the factors.
PEAKS = {
    "H200": {"float32": 67, "tf32": 495, "bf16": 989},
    "H100 80GB HBM3": {"float32": 67, "tf32": 495, "bf16": 989},
    "A100": {"float32": 19.5, "tf32": 156, "bf16": 312},
}
#: The precision of the products, and how else the training or pipeline is run.
MODES = {
    "float32": ("float32", {}),
    "tf32": ("tf32", {}),
    "bf16": ("bf16", {}),
    "bf16 + channels-last": ("bf16", {"channels_last": True}),
    "bf16 + compile": ("bf16", {"compile": True}),
}
PLAIN = "float32, plain loop of diffusers"
#: Channels of the levels of latent diffusion's vq-f4.
LEVELS = (128, 256, 512)
#: The text encoder of CLIP ViT-L/14, which the preset is conditioned on.
TEXT = {"hidden_size": 768, "intermediate_size": 3072, "num_attention_heads": 12}
ENCODED = ", encoded in each step"
#: Of the page's table.
COLUMNS = ["what", "mode", "batch", "ms a step", "images a second", "ratio"]
COLUMNS += ["TFLOP/s", "of peak", "GB", "day"]


class EnoughError(Exception):
    """As many steps as are timed; a checkpoint of gigabytes is not written."""


def synchronized():
    """The clock, once the device has done all it was given."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def denoiser(chosen):
    """The untrained denoiser of a preset."""
    policy, side = chosen.condition, chosen.size // 2 ** (len(LEVELS) - 1)
    return Denoiser(build_unet(chosen.unet, policy, channels=3, size=side), policy), side


def encoder_steps(chosen, batch, chunk):
    """The tactile encoder, its loss against fixed partners, and the data of a batch."""
    model = new_tactile(chosen.tactile_config(chosen.dim), 0)
    data = {"pixels": torch.randn(batch, 3, chosen.image, chosen.image)}
    data |= {name: torch.randn(batch, chosen.dim) for name in ("text", "vision")}

    def loss(module, batch):
        embedded = in_chunks(partial(encode_tactile, module), batch["pixels"], chunk)
        texts = torch.arange(len(embedded), device=embedded.device)
        return Losses(three_way(embedded, batch["text"], batch["vision"], 10.0, texts)[0])

    return model, loss, lambda step: {name: rows[step.rows] for name, rows in data.items()}


def autoencoder(channels):
    """The untrained autoencoder."""
    sizes = {
        "down_block_types": ("DownEncoderBlock2D",) * len(LEVELS),
        "up_block_types": ("UpDecoderBlock2D",) * len(LEVELS),
        "block_out_channels": LEVELS,
        "layers_per_block": 2,
        "latent_channels": channels,
    }
    return Autoencoder(VQModel(**sizes).eval().requires_grad_(False))


class Live:
    """A table whose rows are computed when they are read, in the precision of the training."""

    def __init__(self, rows, device, mode, function):
        self.rows, self.device, self.function = rows, device, function
        self.bf16 = MODES[mode][0] == "bf16"

    @torch.no_grad()
    def __getitem__(self, index):
        rows = self.rows[index].to(self.device)
        with torch.autocast(self.device, torch.bfloat16) if self.bf16 else nullcontext():
            return self.function(rows).float().cpu()


def encoded_steps(chosen, batch, device, mode):
    """`denoiser_steps` where latents, and what a text becomes, are made anew in each step."""
    model, loss, load = denoiser_steps(chosen, batch)
    code = autoencoder(model.channels).to(device)
    config = CLIPTextConfig(**TEXT, projection_dim=model.policy.width)
    text = CLIPTextModelWithProjection(config).to(device).eval()
    pixels = torch.randint(256, (batch, 3, chosen.size, chosen.size), dtype=torch.uint8)
    words = torch.randint(config.vocab_size, (batch, 77))
    loss.latents = Live(pixels, device, mode, lambda rows: code.latents(rows / 127.5 - 1))
    embedded = lambda rows: text(rows).text_embeds[:, None]
    loss.tokens["text"] = Live(words, device, mode, embedded)
    return model, loss, load


def denoiser_steps(chosen, batch):
    """The denoiser, its loss, and the data of a batch of latents."""
    model, side = denoiser(chosen)
    policy = model.policy
    latents = torch.randn(batch, model.channels, side, side)
    tokens = {source: torch.randn(batch, 1, policy.width) for source in policy.sources}
    how = {"stats": LatentStats.of(latents), "schedule": chosen.schedule, "policy": policy}
    loss = DiffusionLoss(latents, tokens, None, **how)
    return model, loss, loss.load


def steps(built, batch, device, mode, count):
    """Seconds of a step of the engine, and operations of a row."""
    model, loss, load = built
    model.to(device)
    with FlopCounterMode(display=False) as counter:
        few = {name: rows.to(device) for name, rows in load(Step(0, np.arange(2), 0)).items()}
        loss(model, few).total.backward()
    at = []

    def progress(what, done, total, remark=""):
        at.append(synchronized())
        if done == count:
            raise EnoughError

    precision, more = MODES[mode]
    compute = Compute(
        precision="bf16" if precision == "bf16" else "float32",
        tf32=precision != "float32",
        checkpoint_minutes=1e9,
        **more,
    )
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    options = LoopOptions(count + 1, batch, 1e-6, warmup=0, ema=0.9999)
    with tempfile.TemporaryDirectory() as folder:
        task = Task("benchmark", batch, load, loss)
        with suppress(EnoughError):
            fit(model, task, options, Path(folder), compute=compute, progress=progress)
    return float(np.median(np.diff(at)[2:])), counter.get_total_flops() / 2


def generator(chosen, device):
    """The pipeline of a preset, with random weights."""
    model, _ = denoiser(chosen)
    ones = (1.0,) * model.channels
    return TactilePipeline(
        autoencoder=autoencoder(model.channels),
        denoiser=model.eval().requires_grad_(False),
        stats=LatentStats((0.0,) * model.channels, ones, "one"),
        schedule=chosen.schedule,
        sampler=chosen.sampler,
        size=chosen.size,
    ).to(device)


@torch.no_grad()
def plain_loop(pipeline, rows, ids, count, at):
    """The shortest loop of diffusers' parts that makes the same images."""
    tokens = pipeline.denoiser.condition(rows)
    both = torch.cat([pipeline.denoiser.null_tokens(1).expand(tokens.shape), tokens])
    scheduler = build_scheduler(pipeline.schedule, pipeline.sampler.method)
    scheduler.set_timesteps(count, device=tokens.device)
    z = starting_noise(ids, pipeline._latent, 0).to(tokens.device)
    for t in scheduler.timesteps:
        out = pipeline.unet(torch.cat([z, z]), t, both, return_dict=False)[0]
        without, given = out.chunk(2)
        prediction = without + pipeline.sampler.guidance * (given - without)
        z = scheduler.step(prediction, t, z, return_dict=False)[0]
        at.append(synchronized())
    return pipeline.autoencoder.decode(z)


def sampling(chosen, device, mode, batch, count):
    """Seconds of a sampler step and of decoding a batch, and operations of an image's step."""
    precision, how = MODES.get(mode, ("float32", {}))
    torch.backends.cuda.matmul.allow_tf32 = precision != "float32"
    torch.backends.cudnn.allow_tf32 = precision != "float32"
    pipeline = generator(chosen, device)
    rows, ids = torch.randn(batch, pipeline.denoiser.policy.width), [*map(str, range(batch))]
    with FlopCounterMode(display=False) as counter:
        pipeline.sample(rows[:1], ids[:1], seed=0, sampler=pipeline.sampler_with(steps=1, batch=1))
    decoding = FlopCounterMode(display=False)
    with decoding:
        pipeline.autoencoder.decode(torch.randn(1, *pipeline._latent))
    operations = counter.get_total_flops() - decoding.get_total_flops()
    if precision == "bf16":
        pipeline.to(torch.bfloat16)
    if how.get("channels_last"):
        pipeline.unet.to(memory_format=torch.channels_last)
    if how.get("compile"):
        pipeline.unet = torch.compile(pipeline.unet)

    def run(count):
        at = [synchronized()]
        if mode == PLAIN:
            plain_loop(pipeline, rows, ids, count, at)
        else:
            sampler = pipeline.sampler_with(steps=count, batch=batch)
            pipeline.sample(
                rows,
                ids,
                seed=0,
                sampler=sampler,
                on_step=lambda k, t, z: (at.append(synchronized()), z)[1],
            )
        return np.array(at), synchronized()

    run(2)
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    at, end = run(count)
    return float(np.median(np.diff(at)[1:])), float(end - at[-1]), operations


class Bench:
    """All that is measured, in rows that are printed and kept as they come."""

    def __init__(self, device, small, output, modes=MODES):
        self.device, self.small, self.output, self.modes = device, small, output, modes
        self.record = {
            "device": torch.cuda.get_device_name() if device == "cuda" else platform.machine(),
            "cores": os.cpu_count(),
            "torch": torch.__version__,
            "python": platform.python_version(),
            "rows": [],
        }
        file = output and output.with_suffix(".json")
        if file and file.is_file():
            known = json.loads(file.read_text())
            for key in ("device", "torch"):
                if known[key] != self.record[key]:
                    here = f"here is {self.record[key]}: write another page"
                    sys.exit(f"{file} has rows of {known[key]}; {here}")
            self.record = known
        name = self.record["device"]
        self.peaks = next((p for known, p in PEAKS.items() if known in name), {})

    def row(self, what, mode, batch, measure):
        """Images a second of one row, or that it does not fit."""
        row = {"what": what, "mode": mode, "batch": batch}
        if any(row.items() <= known.items() for known in self.record["rows"]):
            return
        began = time.perf_counter()
        gc.collect()
        torch._dynamo.reset()
        if self.device == "cuda":
            torch.cuda.empty_cache()
        try:
            seconds, operations, more = measure()
        except torch.OutOfMemoryError:
            row["note"] = "out of memory"
        else:
            rate = operations * batch / seconds / 1e12
            row |= {"seconds": seconds, "images": batch / more.pop("whole", seconds)}
            row |= {"TFLOP/s": rate, **more}
            if peak := self.peaks.get(MODES.get(mode, ("float32",))[0]):
                row["share"] = rate / peak
            if self.device == "cuda":
                row["GB"] = torch.cuda.max_memory_allocated() / 1e9
        row["all"] = time.perf_counter() - began
        row["day"] = datetime.date.today().isoformat()
        self.record["rows"].append(row)
        print(json.dumps(row), flush=True)
        if self.output:
            write_json(self.output.with_suffix(".json"), self.record)
            self.output.write_text(page(self.record), encoding="utf-8")

    def train(self, what):
        """One model in the requested modes."""
        for mode in self.modes:
            if what == "encoder of paper":
                if "channels_last" in MODES[mode][1]:
                    continue  # it has one convolution
                batch, chosen = (4, "mini") if self.small else (256, "paper")
                chunk = 2 if self.small else 32
                make = partial(encoder_steps, encoder_preset(chosen), batch, chunk)
            else:
                batch = 4 if self.small else 32
                how = (self.preset(), batch)
                make = partial(denoiser_steps, *how)
                if what.endswith(ENCODED):
                    make = partial(encoded_steps, *how, self.device, mode)

            def measure(make=make, batch=batch, mode=mode):
                return *steps(make(), batch, self.device, mode, 8), {}

            self.row(f"training, {what}", mode, batch, measure)

    def preset(self):
        """The preset, or in a try a tiny one in its place."""
        return preset_of("tiny" if self.small else "paper")

    def sample(self):
        """The generator in the requested modes, and by the plain loop."""
        chosen, batch, count = self.preset(), 2 if self.small else 16, 4 if self.small else 10
        for mode in (PLAIN, *self.modes):

            def measure(mode=mode):
                one = sampling(chosen, self.device, mode, batch, count)
                step, decode, operations = one
                whole = chosen.sampler.steps * step + decode
                return step, operations, {"whole": whole, "decode": decode}

            self.row("sampling, paper", mode, batch, measure)


PARTS = {
    "train paper": lambda bench: bench.train("U-Net of paper"),
    "cached paper": lambda bench: bench.train(f"U-Net of paper{ENCODED}"),
    "sample paper": lambda bench: bench.sample(),
    "train encoder": lambda bench: bench.train("encoder of paper"),
}


def cached(record):
    """How much faster a step is with latents and conditions cached, by model and mode."""
    keys = ("what", "mode", "day")
    seconds = {tuple(r[k] for k in keys): r["seconds"] for r in record["rows"] if "seconds" in r}
    told = []
    for (what, mode, day), encoded in seconds.items():
        plain = what.removesuffix(ENCODED)
        if what != plain and (plain, mode, day) in seconds:
            name, ratio = plain.split()[-1], encoded / seconds[plain, mode, day]
            told.append(f"`{name}`, {mode}: **{ratio:.2f}**")
    return "; ".join(told) or "not measured"


def page(record):
    """The whole Markdown file."""
    lines, first = [], {}
    modes = [PLAIN, *MODES]
    order = lambda r: (r["what"], r["day"], modes.index(r["mode"]))
    shown = [r for r in record["rows"] if not r["what"].endswith(ENCODED)]
    for row in sorted(shown, key=order):
        cells = [row["what"], row["mode"], row["batch"]]
        if "note" in row:
            cells += [row["note"]]
        else:
            base = first.setdefault((row["what"], row["day"]), row["images"])
            ratio = f"{row['images'] / base:.2f}"
            share = f"{100 * row['share']:.0f} %" if "share" in row else ""
            memory = f"{row['GB']:.1f}" if "GB" in row else ""
            cells += [f"{1000 * row['seconds']:.0f}", f"{row['images']:.3g}", ratio]
            cells += [f"{row['TFLOP/s']:.0f}", share, memory, row["day"]]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return f"""# On one GPU: speed

Made by a committed command; do not edit by hand. **{record["device"]}**,
{record["cores"]} processor cores, torch {record["torch"]}, Python {record["python"]}.

    python benchmarks/gpu.py --write docs/studies/gpu.md

Random weights in the published sizes of `paper`: the U-Net (406 M parameters), a `vq-f4` with 256
codes, 256 px, and the encoder of tactile images (ViT-Large) in chunks of 32. A training step has
optimizer and moving average. A sampled image takes 200 steps, each of two passes; ten are timed,
their median stands for all, and decoding comes on top. The ratio is to the first row of the same
work and day, the share that of the device's peak by its data sheet, at that precision.

| {" | ".join(COLUMNS)} |
{"|---" * len(COLUMNS)}|
{chr(10).join(lines)}

## Cached latents and conditions

Seconds of a step that also encodes its images and texts (uint8 images in memory), over those of a
step with both cached, as `palpate train generator` has them (wanted: at least 1.4).

{cached(record)}.
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=[*PARTS], default=[*PARTS], metavar="PART")
    parser.add_argument("--modes", nargs="+", choices=[*MODES], default=[*MODES], metavar="MODE")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--small", action="store_true", help="tiny models: a try of the code")
    parser.add_argument("--write", type=Path, help="the page, kept up to date row by row")
    chosen = parser.parse_args()
    if chosen.device == "cuda" and not torch.cuda.is_available():
        parser.exit(2, "There is no CUDA device here; --device cpu --small tries the code.\n")
    if chosen.small and chosen.write:
        parser.error("--small measures other models, which are not written")
    bench = Bench(chosen.device, chosen.small, chosen.write, chosen.modes)
    for name in chosen.only:
        PARTS[name](bench)
    if chosen.write:
        chosen.write.write_text(page(bench.record), encoding="utf-8")


if __name__ == "__main__":
    main()

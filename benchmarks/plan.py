"""What the study costs at the paper's size, counted from the models themselves.

::

    python benchmarks/plan.py [--share 0.17] [--peak 989]

Operations of a forward pass are counted layer by layer (a multiplication and an addition are two),
a training step is three of them, a guided sample two a sampler step. How many trainings, images and
features the study makes is counted from its own stages. Seconds are operations over
``--share`` of ``--peak`` (TFLOP/s; 989 is an H100 in bf16, of which the U-Net's training reached
17 %): measure yours with ``python benchmarks/gpu.py``, and put its share here. Reading and decoding
come on top where they cannot keep up. Prints the tables of docs/start/plan.md.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from typing import Any

import torch
from diffusers import VQModel
from torch.utils.flop_counter import FlopCounterMode
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from palpate.diffusion.autoencoder import BackgroundAutoencoder
from palpate.diffusion.presets import PAPER
from palpate.diffusion.unet import build_unet
from palpate.encoders.presets import PAPER as ENCODER
from palpate.studies.reproduce import Plan
from palpate.studies.study import ON_DISK, STUDIES

#: (train samples, test samples): the paper's counts, four fifths of them train.
DATA = {
    "Touch and Go": (11_120, 2_780),
    "HCT": (31_323, 7_831),
    "a million frames": (800_000, 200_000),
}
EPOCHS = {"generator": 30, "encoder": 200}  # paper, sections 2 and 3
STEPS = PAPER.sampler.steps
AUTOENCODER = ON_DISK["paper"].autoencoder
VQ = "palpate/mini"  # stands for a trained one in the plan; only stages are counted


def operations(forward: Callable[[], Any]) -> float:
    """Operations of one forward pass, on no device."""
    with FlopCounterMode(display=False) as counter:
        forward()
    return float(counter.get_total_flops())


def counted() -> dict[str, float]:
    """Operations for one image: U-Net, autoencoder, tactile encoder."""
    assert not isinstance(PAPER.unet, str)
    assert PAPER.unet is not None
    size, policy = PAPER.size, PAPER.condition
    with torch.device("meta"):
        unet = build_unet(PAPER.unet, policy, channels=3, size=size // 4)
        token = torch.zeros(1, 1, policy.width)
        vq = VQModel(
            down_block_types=("DownEncoderBlock2D",) * 3,
            up_block_types=("UpDecoderBlock2D",) * 3,
            block_out_channels=(128, 256, 512),
            layers_per_block=2,
            latent_channels=3,
        )
        sizes = ENCODER.tactile
        tower = CLIPVisionModelWithProjection(
            CLIPVisionConfig(
                hidden_size=sizes.width,
                intermediate_size=4 * sizes.width,
                num_hidden_layers=sizes.layers,
                num_attention_heads=sizes.heads,
                patch_size=ENCODER.patch,
                image_size=ENCODER.image,
                projection_dim=ENCODER.dim,
                attn_implementation="eager",
            )
        )
        latents, side = torch.zeros(1, 3, size // 4, size // 4), ENCODER.image
        ours = BackgroundAutoencoder(AUTOENCODER.channels, AUTOENCODER.narrow, AUTOENCODER.wide)
        crop = torch.zeros(1, 3, AUTOENCODER.crop, AUTOENCODER.crop)
        return {
            "U-Net": operations(lambda: unet(latents, torch.zeros(1), encoder_hidden_states=token)),
            "vq-f4 encoder": operations(lambda: vq.encode(torch.zeros(1, 3, size, size))),
            "vq-f4 decoder": operations(lambda: vq.decoder(latents)),
            "tactile encoder": operations(lambda: tower(torch.zeros(1, 3, side, side))),
            "background autoencoder, a crop": operations(
                lambda: ours.residual(ours.latents(crop, crop), crop)
            ),
        }


def stages() -> dict[str, float]:
    """How often the study of one seed does each duty; a training that is shorter is a part of one.

    Images are counted in sets of the test part.
    """
    with tempfile.TemporaryDirectory() as empty:
        plan = Plan(STUDIES["tag"], preset="paper", root=empty, vq=VQ)
        nodes = plan.nodes()
    named = lambda start: [n for n in nodes if n.name.startswith(start)]
    controls = len(plan.study.controls)
    judged = [len(n.options["methods"]) + controls for n in named("scores-")]
    return {
        "generators": float(sum("training" in n.options for n in nodes)),
        "sets of images": sum("make" not in n.options for n in named("images-")),
        "encoders": len(named("encoder-")),
        "background autoencoders": sum("-vq-" not in n.name for n in named("autoencoder-")),
        "sets of features": sum(judged),
    }


def duties(
    of: dict[str, float], times: dict[str, float], train: int, test: int
) -> dict[str, float]:
    """Operations of each duty on a data set."""
    both = train + test
    sample = 2 * STEPS * of["U-Net"] + of["vq-f4 decoder"]
    made = {
        "latents, once": both * of["vq-f4 encoder"],
        "one generator": 3 * EPOCHS["generator"] * train * of["U-Net"],
        f"its test images, {STEPS} steps": test * sample,
        "one tactile encoder": 3 * EPOCHS["encoder"] * train * of["tactile encoder"],
        "one background autoencoder": 3
        * AUTOENCODER.steps
        * AUTOENCODER.batch
        * of["background autoencoder, a crop"],
        "features of all images": both * of["tactile encoder"],
    }
    latents, generator, images, encoder, autoencoder, features = made.values()
    made["the study, one seed"] = (
        latents
        + times["generators"] * generator
        + times["sets of images"] * images
        + times["background autoencoders"] * autoencoder
        + times["encoders"] * (encoder + features)
        + times["sets of features"] * test * of["tactile encoder"]
    )
    return made


def hours(seconds: float) -> str:
    """``14 min``, ``3.2 h``, ``12 d``."""
    if seconds < 3600:
        return f"{seconds / 60:.0f} min" if seconds >= 60 else f"{seconds:.0f} s"
    return f"{seconds / 3600:.1f} h" if seconds < 48 * 3600 else f"{seconds / 86400:.1f} d"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--share", type=float, default=0.17, help="of the peak that is reached")
    parser.add_argument("--peak", type=float, default=989, help="of the device, TFLOP/s")
    args = parser.parse_args()
    of, rate = counted(), args.share * args.peak * 1e12
    print("| for one image, forward | GFLOP |\n|---|---|")
    for name, count in of.items():
        print(f"| {name} | {count / 1e9:.0f} |")
    times = stages()
    print("\nThe study, one seed:", ", ".join(f"{what} {n:g}" for what, n in times.items()))
    tables = {name: duties(of, times, *counts) for name, counts in DATA.items()}
    print(f"\n| | {' | '.join(f'{n}: PFLOP, one GPU, eight' for n in tables)} |")
    print("|---" * (len(tables) + 1) + "|")
    for duty in next(iter(tables.values())):
        cells = [
            f"{t[duty] / 1e15:,.0f}, {hours(t[duty] / rate)}, {hours(t[duty] / rate / 8)}"
            for t in tables.values()
        ]
        print(f"| {duty} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()

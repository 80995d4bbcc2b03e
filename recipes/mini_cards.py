"""The wording of the shipped models' cards, and the writing of ``src/palpate/mini``."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.core import read_json, write_text
from palpate.diffusion.autoencoder import AnyAutoencoder
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders.encoder_set import EncoderSet
from palpate.sim import VERSION
from palpate.training.cards import write_model_cards

NAME = "palpate/mini"
RECIPE = "python recipes/mini.py --work runs/mini --ship"
TAGS = ("synthetic",)
SUMMARIES = {
    "pair": (
        "Vision and text encoders of palpate's world",
        "A small CLIP with its tokenizer, trained on photos and captions of the procedural world,"
        " which say what is felt and name no material;"
        " its space has 128 dimensions. The vision encoder went on, with many more photos, against"
        " the text encoder as it is.",
    ),
    "encoders": (
        "Vision, text and tactile encoders of palpate's world",
        "Three small encoders with one space of 128 dimensions: a CLIP (vision and text, with"
        " its tokenizer) trained on photos and captions of the procedural world, which say "
        "what is felt and name no material; vision went on against the text encoder as it is, with "
        "many more photos. They replace the frozen CLIP of the paper where no hub is in reach. The "
        "tactile encoder sees the residual to the no-contact image, learns from many gels which "
        "touches are of one object, and is trained against photos and texts through its head.",
    ),
    "autoencoder": (
        "Background autoencoder of tactile images of palpate's world",
        "It codes the difference between a tactile image of 64 x 64 pixels and the same gel "
        "without contact as 16 x 16 positions of 8 channels, in the place of latent diffusion's "
        "vq-f4. Trained on tactile images of both looks of the sensor (with markers and without).",
    ),
    "generator": (
        "From a photo to a tactile image of palpate's world",
        "A latent diffusion model (flow matching), conditioned on captions and photos, and driven "
        "by photos, captions or both, in the space of the encoders and the autoencoder next to "
        "it. Place, area, strength, shear and depth of a touch can be asked for. Trained in three "
        "rounds, each from the rounded weights of the last: two on the same images, the third, "
        "which learns what is asked for, on a world of its own. It knows the world's twenty "
        "materials and nothing else. The image is made on a gel that is given as a picture "
        "without contact, or on a stock gel.",
    ),
}
LIMITS = (
    "Knows only the procedural world of palpate: 20 simulated materials and a simulated gel. "
    "Real photos and real tactile images are out of its range.",
    "Made to show mechanisms and to test code offline; never compare its numbers with those of "
    "real data sets.",
)
READ = {
    "pair": ("gelsight", "photos", "new gelsight"),
    "encoders": (
        *("gelsight", "photos", *(f"gel {number}" for number in range(14))),
        *("new gelsight", "new gel", "new pad", "new look"),
    ),
    "autoencoder": ("gelsight", "digit", "new gelsight", "new digit"),
    "generator": ("gelsight", "photos", "contacts", "new gelsight"),
}


def ship(
    target: Path,
    encoders: EncoderSet,
    autoencoder: AnyAutoencoder,
    pipeline: TactilePipeline,
    scores: Mapping[str, Any],
    worlds: Sequence[Mapping[str, Any]],
    flags: str = "",
) -> None:
    """Replaces what is shipped, of the parts that have scores; the models must be rounded to 16
    bits already, since the scores are theirs. ``flags``: of the recipe that made one part anew.
    """
    anew = {"--tactile": ("encoders",), "--contacts": ("generator",)}.get(flags, ())

    def card(part: str) -> dict[str, Any]:
        title, summary = SUMMARIES[part]
        scored = scores.get("encoders" if part == "pair" else part, [])
        data = [
            {**world, "used for": "scores" if world["world"].startswith("new") else "training"}
            for world in worlds
            if world["world"] in READ[part]
        ]
        return {
            "name": NAME,
            "title": title,
            "summary": summary,
            "tags": list(TAGS),
            "license": "apache-2.0",
            "data": data,
            "scores": scored,
            "limits": list(LIMITS),
            "recipe": RECIPE.replace("--ship", f"{flags} --ship") if part in anew else RECIPE,
            "world version": VERSION,
            "synthetic": True,
        }

    encoders.card = {**encoders.card, **card("encoders")}
    pair = card("pair")
    pair["scores"] = [row for row in pair["scores"] if "tactile" not in row["score"]]
    encoders.clip_card = {**encoders.clip_card, **pair}
    autoencoder.card = {**autoencoder.card, **card("autoencoder")}
    pipeline = replace(pipeline, training={**pipeline.training, **card("generator")})
    for part in scores:  # git has what was there
        shutil.rmtree(target / part, ignore_errors=True)
    if "encoders" in scores:
        encoders.save(target / "encoders", half=True)
        autoencoder.save(target / "autoencoder", half=True)
    pipeline.save(target / "generator", half=True, shared=NAME)
    write_model_cards(target)


MARKS = ("<!-- scores of the cards -->", "<!-- end of the scores -->")


def scores_table(target: Path) -> str:
    """The scores of all cards below ``target`` as one Markdown table."""
    lines = ["| part | score | value | 95 % by video | chance |", "|---|---|---|---|---|"]
    for part, key in (("encoders", "card"), ("autoencoder", "card"), ("generator", "training")):
        for row in read_json(target / part / "palpate.json", "card")[key]["scores"]:
            interval = " to ".join(f"{v:.3g}" for v in row.get("interval", ()))
            chance = f"{row['chance']:.3g}" if "chance" in row else ""
            value = f"{row['value']:.4g}"
            lines.append(f"| {part} | {row['score']} | {value} | {interval} | {chance} |")
    return "\n".join(lines)


def write_page(page: Path, target: Path) -> None:
    """Puts the table between the marks of ``docs/concepts/mini.md``."""
    text = page.read_text(encoding="utf-8")
    start, end = text.index(MARKS[0]) + len(MARKS[0]), text.index(MARKS[1])
    write_text(page, f"{text[:start]}\n{scores_table(target)}\n{text[end:]}")

"""The wording of the shipped models' cards, and the writing of ``src/palpate/mini``."""

from __future__ import annotations

import shutil
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.core import read_json, write_text
from palpate.diffusion.autoencoders import AnyAutoencoder
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders.encoder_set import EncoderSet
from palpate.sim import VERSION
from palpate.training.cards import write_model_cards

NAME = "palpate/mini"
RECIPE = "python recipes/mini.py --work runs/mini --ship"
TAGS = ("synthetic",)
SUMMARIES = {
    "encoders": (
        "Vision, text and tactile encoders of palpate's world",
        "Three small encoders with one space of 128 dimensions: a CLIP (vision and text, with"
        " its tokenizer) trained on photos and captions of the procedural world, which say "
        "what is felt and name no material, and a "
        "tactile encoder trained against it with the three-way InfoNCE; then vision went on "
        "against the text encoder as it is, with many more photos. They replace the frozen CLIP "
        "of the paper where no hub is in reach.",
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
        "it. Trained in two rounds, the second from the rounded weights of the first, on the same "
        "images. It knows the world's twenty materials and nothing else. The image is made on a "
        "gel that is given as a picture without contact, or on a stock gel.",
    ),
}
PAIR = (
    "Vision and text encoders of palpate's world",
    "A small CLIP with its tokenizer, trained on photos and captions of the procedural world,"
    " which say what is felt and name no material;"
    " its space has 128 dimensions. The tactile encoder next to it was trained against it;"
    " then the vision encoder went on, with many more photos, against the text encoder as it is.",
)
READ = {
    "encoders": ("gelsight", "photos", "new gelsight"),
    "autoencoder": ("gelsight", "digit", "new gelsight", "new digit"),
    "generator": ("gelsight", "photos", "new gelsight"),
}


def ship(
    target: Path,
    encoders: EncoderSet,
    autoencoder: AnyAutoencoder,
    pipeline: TactilePipeline,
    scores: Mapping[str, Any],
    worlds: Sequence[Mapping[str, Any]],
    limits: Sequence[str],
) -> None:
    """Replaces what is shipped; the models must be rounded to 16 bits already, since the scores are
    theirs.

    Args:
        target: the folder of the package.
        encoders: vision, text and tactile.
        autoencoder: of tactile images.
        pipeline: the generator, in the space of the other two.
        scores: rows by model under ``rounded`` and ``exact``, and the change by ``rounding``.
        worlds: rows that describe the worlds.
        limits: sentences for every card.
    """

    def card(part: str) -> dict[str, Any]:
        title, summary = SUMMARIES[part]
        rows = [dict(row) for row in scores["rounded"][part]]
        before = {row["score"]: row["value"] for row in scores["exact"][part]}
        for row in rows:
            row["in 32 bits"] = before[row["score"]]
        data = [
            {**world, "used for": _use(str(world["world"]))}
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
            "scores": rows,
            "limits": list(limits),
            "recipe": RECIPE,
            "world version": VERSION,
            "synthetic": True,
            "largest relative change by 16 bits": scores["rounding"][part],
        }

    encoders.card = {**encoders.card, **card("encoders")}
    pair = card("encoders")
    pair["title"], pair["summary"] = PAIR
    pair["scores"] = [row for row in pair["scores"] if "tactile" not in row["score"]]
    encoders.clip.card = {**encoders.clip.card, **pair}
    autoencoder.card = {**autoencoder.card, **card("autoencoder")}
    pipeline = replace(pipeline, training={**pipeline.training, **card("generator")})
    with _replacing(target):
        encoders.save(target / "encoders", half=True)
        autoencoder.save(target / "autoencoder", half=True)
        pipeline.save(target / "generator", half=True, shared=NAME)
        write_model_cards(target)


@contextmanager
def _replacing(target: Path) -> Generator[None]:
    """Puts what was at ``target`` aside, and back if the new one fails."""
    before = target.with_name(f".{target.name}.before")
    if target.exists():
        shutil.rmtree(before, ignore_errors=True)
        target.rename(before)
    try:
        yield
    except BaseException:
        shutil.rmtree(target, ignore_errors=True)
        if before.exists():
            before.rename(target)
        raise
    shutil.rmtree(before, ignore_errors=True)


def _use(world: str) -> str:
    """What a world was used for."""
    return "scores" if world.startswith("new") else "training"


MARKS = ("<!-- scores of the cards -->", "<!-- end of the scores -->")


def scores_table(target: Path) -> str:
    """The scores of all cards below ``target`` as one Markdown table."""
    lines = [
        "| part | score | value | 95 % by video | chance | in 32 bits |",
        "|---|---|---|---|---|---|",
    ]
    for part, key in (("encoders", "card"), ("autoencoder", "card"), ("generator", "training")):
        for row in read_json(target / part / "palpate.json", "card")[key]["scores"]:
            interval = " to ".join(f"{v:.3g}" for v in row.get("interval", ()))
            chance = f"{row['chance']:.3g}" if "chance" in row else ""
            exact = f"{row['in 32 bits']:.4g}" if "in 32 bits" in row else ""
            lines.append(
                f"| {part} | {row['score']} | {row['value']:.4g} | {interval} | {chance} "
                f"| {exact} |"
            )
    return "\n".join(lines)


def write_page(page: Path, target: Path) -> None:
    """Puts the table between the marks of ``docs/concepts/mini.md``."""
    text = page.read_text(encoding="utf-8")
    start, end = text.index(MARKS[0]) + len(MARKS[0]), text.index(MARKS[1])
    write_text(page, f"{text[:start]}\n{scores_table(target)}\n{text[end:]}")

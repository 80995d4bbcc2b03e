"""Model cards for people, written from the JSON beside the weights: front matter as on the Hugging Face hub, then Markdown.

``palpate.json`` of a saved model holds a card: a JSON object. These keys of it have a place on the page, all optional:

=============  ===========================================================================================================
``title``      one line
``summary``    what it is, what it was trained on, what it must not be used for; Markdown
``license``    the hub's identifier; ``apache-2.0`` where absent
``tags``       words, beside those of the format
``data``       rows (list of objects): world, seeds, version, digest, frames ...
``recipe``     the command that makes it again
``scores``     rows (list of objects): score, value, interval, chance, on, n ...
``limits``     sentences
=============  ===========================================================================================================

Everything else is the record of the training and is printed as JSON, cut where it is long.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.core.errors import PalpateError
from palpate.core.files import read_json, write_text

#: Keys of a card that the page shows in their own place.
PLACED = ("title", "summary", "license", "tags", "data", "recipe", "scores", "limits")
#: Characters of one entry of the record; loss curves and nested cards are longer, and stand in palpate.json.
LONG = 240


@dataclass(frozen=True)
class _Kind:
    """What is the same for all models of one format: defaults of the front matter, and how to load one."""

    title: str
    library: str
    task: str
    tags: tuple[str, ...]
    use: str


_KINDS = {
    "palpate-clip/1": _Kind(
        "Vision and text encoders",
        "transformers",
        "zero-shot-image-classification",
        ("clip",),
        'from palpate.encoders.encoder_set import load_clip\n\nclip = load_clip("{name}")',
    ),
    "palpate-encoders/2": _Kind(
        "Vision, text and tactile encoders",
        "transformers",
        "feature-extraction",
        ("clip", "contrastive"),
        'from palpate.encoders.encoder_set import EncoderSet\n\nencoders = EncoderSet.load("{name}")',
    ),
    "palpate-autoencoder/1": _Kind(
        "Autoencoder of touches",
        "diffusers",
        "image-to-image",
        ("vq-gan", "autoencoder"),
        'from palpate.diffusion.autoencoder import Autoencoder\n\nautoencoder = Autoencoder.load("{name}")',
    ),
    "palpate-pipeline/2": _Kind(
        "From a photo to a touch",
        "diffusers",
        "image-to-image",
        ("latent-diffusion",),
        'from palpate.diffusion.pipeline import TactilePipeline\n\npipeline = TactilePipeline.load("{name}")',
    ),
}


def model_card(about: Mapping[str, Any]) -> str:
    """The ``README.md`` of a saved model.

    Args:
        about: the content of its ``palpate.json``: ``format``, ``card`` (``training`` of a pipeline), digests.

    Returns:
        Markdown with YAML front matter (``license``, ``library_name``, ``pipeline_tag``, ``tags``); the same text for the same content.

    Raises:
        PalpateError: for the JSON of another format.
    """
    kind = _KINDS.get(str(about.get("format")))
    if kind is None:
        raise PalpateError(
            f"A model card is made of one of {', '.join(_KINDS)}",
            repr(about.get("format")),
            "Pass the JSON of palpate.json",
        )
    card: Mapping[str, Any] = about.get("card", about.get("training")) or {}
    tags = [*dict.fromkeys(("palpate", "tactile", *kind.tags, *map(str, card.get("tags", ()))))]
    head = {
        "license": card.get("license", "apache-2.0"),
        "library_name": kind.library,
        "pipeline_tag": kind.task,
    }
    lines = [
        "---",
        *(f"{key}: {json.dumps(str(value))}" for key, value in head.items()),
        "tags:",
        *(f"- {json.dumps(t)}" for t in tags),
    ]
    lines += ["---", "", f"# {card.get('title', kind.title)}", ""]
    if card.get("summary"):
        lines += [str(card["summary"]), ""]
    name = card.get("name") or about.get("name") or "FOLDER"
    lines += ["```python", *kind.use.format(name=name).splitlines(), "```", ""]
    for key, title in (("scores", "Scores"), ("data", "Data")):
        if rows := card.get(key):
            lines += [f"## {title}", "", *_table(rows if isinstance(rows, list) else [rows]), ""]
    if card.get("limits"):
        lines += ["## Limits", "", *(f"- {text}" for text in card["limits"]), ""]
    if card.get("recipe"):
        lines += ["## Made by", "", "```sh", str(card["recipe"]), "```", ""]
    if digests := _digests(about):
        lines += [
            "## Digests",
            "",
            *(f"- {part}: `{digest}`" for part, digest in digests.items()),
            "",
        ]
    if record := {
        k: _cut(v) for k, v in card.items() if k not in PLACED and v not in (None, {}, [], "")
    }:
        text = json.dumps(record, indent=1, ensure_ascii=False)
        lines += [
            "## Record",
            "",
            "The whole record stands in `palpate.json`.",
            "",
            "```json",
            *text.splitlines(),
            "```",
            "",
        ]
    return "\n".join(lines)


def write_model_cards(folder: Path) -> list[Path]:
    """Writes ``README.md`` beside every ``palpate.json`` at or below ``folder``, from that file alone.

    A folder that is no model itself but holds some gets a ``README.md`` that lists them.

    Returns:
        The files written.

    Raises:
        PalpateError: if a ``palpate.json`` is unreadable or of another format; files written before stay.
    """
    folder = Path(folder)
    cards = {
        file.parent: read_json(file, "card of the model")
        for file in sorted(folder.rglob("palpate.json"))
    }
    pages = {place: model_card(about) for place, about in cards.items()}
    if pages and folder not in pages:
        pages[folder] = _contents(folder, cards)
    for place, text in pages.items():
        write_text(place / "README.md", text)
    return [place / "README.md" for place in pages]


def _contents(folder: Path, cards: Mapping[Path, Mapping[str, Any]]) -> str:
    """A page that lists the models below ``folder`` with the size of their weights."""
    lines = [
        f"# Models in {folder.name}",
        "",
        "Apache-2.0. Each folder holds its card (`README.md`, made from `palpate.json`).",
        "",
    ]
    rows: list[dict[str, Any]] = []
    for place, about in cards.items():
        name, card = (
            place.relative_to(folder).as_posix(),
            about.get("card", about.get("training")) or {},
        )
        size = sum(file.stat().st_size for file in place.rglob("*.safetensors"))
        title = card.get("title", _KINDS[about["format"]].title)
        rows.append(
            {
                "folder": f"[{name}]({name}/README.md)",
                "what": title,
                "weights, MB": f"{size / 1e6:.1f}",
            }
        )
    return "\n".join([*lines, *_table(rows), ""])


def _table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Rows as a Markdown table over the union of their keys, in order of first use."""
    columns = [*dict.fromkeys(key for row in rows for key in row)]
    lines = [f"| {' | '.join(columns)} |", f"| {' | '.join('---' for _ in columns)} |"]
    return lines + [f"| {' | '.join(_cell(row.get(key)) for key in columns)} |" for row in rows]


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return f"[{', '.join(_cell(v) for v in value)}]"
    return str(value).replace("|", "\\|").replace("\n", " ")


def _digests(about: Mapping[str, Any]) -> dict[str, str]:
    found = dict(about.get("digests", {}))
    return found if found else {"model": str(about["digest"])} if about.get("digest") else {}


def _cut(value: Any) -> Any:
    text = json.dumps(value, ensure_ascii=False)
    return value if len(text) <= LONG else f"{text[:LONG]}..."

"""Model cards (``README.md``), written from the ``palpate.json`` of a saved model.

The ``card`` in that JSON may have these keys, each with its own place on the page:

===========  ==================================================================================
``title``    one line
``summary``  what it is, what it was trained on, what it must not be used for; Markdown
``license``  the hub's identifier; by default ``unknown`` for a pipeline, else ``apache-2.0``
``tags``     in addition to those of the format
``data``     rows (list of objects): world, seeds, version, digest, frames ...; of a pipeline
             without: its manifest, split and training samples
``ceiling``  scores (an object) of what survives the autoencoder
``recipe``   the command that makes it again
``scores``   rows (list of objects): score, value, interval, chance, on, n ...
``limits``   sentences
===========  ==================================================================================

Every other key is part of the training record, which is printed as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from palpate.core import read_json, require_choice, write_text

PLACED = (
    *("title", "summary", "license", "tags", "data", "ceiling", "recipe", "scores", "limits"),
    *("start_record", "start_card"),
)
#: Longer entries of the record (loss curves) are cut on the page.
MAX_CHARACTERS = 240


class _Format(NamedTuple):
    title: str
    library: str
    task: str
    tags: tuple[str, ...]
    usage: str


_FORMATS = {
    "palpate-clip/1": _Format(
        "Vision and text encoders",
        "transformers",
        "zero-shot-image-classification",
        ("clip",),
        'from palpate.encoders.encoder_set import load_clip\n\nclip = load_clip("{name}")',
    ),
    "palpate-encoders/1": _Format(
        "Vision, text and tactile encoders",
        "transformers",
        "feature-extraction",
        ("clip", "contrastive"),
        "import palpate as pp\n\n"
        'encoder = pp.Encoder.from_pretrained("{name}", modality="tactile")',
    ),
    "palpate-autoencoder/1": _Format(
        "Autoencoder of tactile images",
        "diffusers",
        "image-to-image",
        ("autoencoder",),
        "from palpate.diffusion.autoencoder import load_autoencoder\n\n"
        'autoencoder = load_autoencoder("{name}")',
    ),
    "palpate-pipeline/1": _Format(
        "From a photo to a tactile image",
        "diffusers",
        "image-to-image",
        ("latent-diffusion",),
        'import palpate as pp\n\npipeline = pp.TactilePipeline.from_pretrained("{name}")',
    ),
}


def model_card(about: Mapping[str, Any]) -> str:
    """Write the ``README.md`` of a saved model.

    Args:
        about: its ``palpate.json``: ``format``, ``card`` (``training`` of a pipeline), digests.

    Returns:
        Markdown with YAML front matter as on the Hugging Face hub.

    Raises:
        PalpateError: for another format.
    """
    from huggingface_hub import ModelCardData

    require_choice("format", about.get("format"), _FORMATS)
    form = _FORMATS[about["format"]]
    card, pipeline = _card(about), "training" in about
    head = ModelCardData(
        license=card.get("license", "unknown" if pipeline else "apache-2.0"),
        library_name=form.library,
        pipeline_tag=form.task,
        tags=[*dict.fromkeys(("palpate", "tactile", *form.tags, *card.get("tags", ())))],
    )
    name = card.get("name") or about.get("name") or "FOLDER"
    digests = about.get("digests") or ({"model": about["digest"]} if about.get("digest") else {})
    if pipeline:
        parts = {"autoencoder": about.get("autoencoder"), "vision encoder": about.get("encoders")}
        parts |= {k: card.get(k) for k in ("manifest", "split")}
        digests = digests | {k: v for k, v in parts.items() if v}
    record = {
        k: _cut(v) for k, v in card.items() if k not in PLACED and v not in (None, {}, [], "")
    }
    before = list(_earlier(card))
    limits = [text for model in before for text in model.get("limits", ())]
    limits = [text for text in dict.fromkeys(limits) if text not in card.get("limits", ())]
    sections = {
        "Scores": _table(card.get("scores")),
        "Ceiling: what survives the autoencoder": _table(card.get("ceiling")),
        "Data": _table(_data(card)),
        "Data of the models that it went on from": "\n\n".join(_table(_data(b)) for b in before),
        "Limits": _listed(card.get("limits", ())),
        "Limits of the models that it went on from": _listed(limits),
        "Made by": _code("sh", str(card.get("recipe", ""))),
        "Digests": _listed(f"{part}: `{digest}`" for part, digest in digests.items()),
        "Record": record
        and "The whole record is in `palpate.json`.\n\n"
        + _code("json", json.dumps(record, indent=1, ensure_ascii=False)),
    }
    parts = [f"---\n{head.to_yaml()}\n---", f"# {card.get('title', form.title)}"]
    summary = card.get("summary") or _summary(card, before[0] if before else None)
    parts += [summary] if summary else []
    parts += [_code("python", form.usage.format(name=name))]
    parts += [f"## {title}\n\n{text}" for title, text in sections.items() if text]
    return "\n\n".join(parts) + "\n"


def _earlier(card: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The cards, or records, of the models that a training went on from, the latest first."""
    while before := card.get("start_record") or card.get("start_card"):
        yield before
        card = before


def write_model_cards(folder: Path) -> None:
    """Write ``README.md`` next to every ``palpate.json`` at or below ``folder``.

    A folder that only holds models gets a ``README.md`` that lists them.

    Raises:
        PalpateError: if a ``palpate.json`` is unreadable or of another format.
    """
    models = {
        file.parent: read_json(file, "model card") for file in sorted(folder.rglob("palpate.json"))
    }
    pages = {path: model_card(about) for path, about in models.items()}
    if pages and folder not in pages:
        pages[folder] = _contents(folder, models)
    for path, text in pages.items():
        write_text(path / "README.md", text)


def _contents(folder: Path, models: Mapping[Path, Mapping[str, Any]]) -> str:
    """List the models below ``folder`` with the size of their weights."""
    rows: list[dict[str, Any]] = []
    for path, about in models.items():
        name = path.relative_to(folder).as_posix()
        size = sum(file.stat().st_size for file in path.rglob("*.safetensors"))
        rows.append(
            {
                "folder": f"[{name}]({name}/README.md)",
                "what": _card(about).get("title", _FORMATS[about["format"]].title),
                "weights, MB": f"{size / 1e6:.1f}",
            }
        )
    intro = "Apache-2.0. Each folder holds its card (`README.md`, made from `palpate.json`)."
    return f"# Models in {folder.name}\n\n{intro}\n\n{_table(rows)}\n"


def _card(about: Mapping[str, Any]) -> Mapping[str, Any]:
    return about.get("card", about.get("training")) or {}


def _data(card: Mapping[str, Any]) -> Sequence[Mapping[str, Any]] | Mapping[str, Any]:
    """What it was trained on; of a pipeline that palpate trained, as one row."""
    if card.get("data"):
        return card["data"]
    names = {"split_rule": "split", "train_samples": "training samples", "materials": "materials"}
    row = {label: card[name] for name, label in names.items() if card.get(name)}
    return {k: json.dumps(v) if isinstance(v, Mapping) else v for k, v in row.items()}


def _summary(card: Mapping[str, Any], start: Mapping[str, Any] | None) -> str:
    """What a model that palpate trained was trained on last, and before that."""
    if not card.get("train_samples"):
        return ""
    origin = "synthetic samples" if card.get("synthetic") else "samples"
    before = "" if start is None else f", after {start.get('title', 'another model')}"
    videos = f" of {card['videos']:,} videos" if card.get("videos") else ""
    sensors = f", of the sensors {', '.join(card['sensors'])}" if card.get("sensors") else ""
    return f"Trained on {card['train_samples']:,} {origin}{videos}{sensors}{before}."


def _listed(texts: Iterable[str]) -> str:
    return "\n".join(f"- {text}" for text in texts)


def _code(language: str, text: str) -> str:
    return f"```{language}\n{text}\n```" if text else ""


def _table(rows: Sequence[Mapping[str, Any]] | Mapping[str, Any] | None) -> str:
    """Rows as a Markdown table over the union of their keys, in order of first use."""
    if not rows:
        return ""
    rows = [rows] if isinstance(rows, Mapping) else rows
    names = [*dict.fromkeys(key for row in rows for key in row)]
    cells = [names, ["---"] * len(names), *([_cell(row.get(n)) for n in names] for row in rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in cells)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return f"[{', '.join(map(_cell, value))}]"
    return "" if value is None else str(value).replace("|", "\\|").replace("\n", " ")


def _cut(value: Any) -> Any:
    text = json.dumps(value, ensure_ascii=False)
    return value if len(text) <= MAX_CHARACTERS else f"{text[:MAX_CHARACTERS]}..."

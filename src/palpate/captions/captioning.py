"""``palpate.caption``: descriptions of touches, as a table that an import joins.

The output folder holds ``captions.parquet`` (id, text, adjectives, flags; one row a sample),
``record.json`` (what made them) and, where a model described them, ``replies.jsonl``. The table
depends on the samples and the replies alone, never on the order in which these arrived.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

import polars as pl

from palpate._version import __version__
from palpate.captions.columns import template_texts
from palpate.captions.prompts import Description, Prompt
from palpate.captions.querying import Photo, describe_units, pending, photos_of, query_all
from palpate.captions.replies import Question, ReplyLog
from palpate.captions.units import Per, Units, units_of
from palpate.core import (
    Note,
    PalpateError,
    Problem,
    Progress,
    fact_lines,
    locked,
    plain,
    problem_lines,
    quiet,
    require,
    short,
    write_json,
)
from palpate.core.shown import Shown
from palpate.data.manifest import Manifest
from palpate.data.reading import load
from palpate.data.texts import TABLE, TEXTS_FORMAT, image_digests, texts_digest, write_texts

RECORD, REPLIES = "record.json", "replies.jsonl"
_WORDS = pl.List(pl.String)
SCHEMA = {"id": pl.String(), "text": pl.String(), "adjectives": _WORDS, "flags": _WORDS}


class StoppedError(PalpateError):
    """The server stopped answering when part of the captions was there.

    Attributes:
        answered, total: photos that have a reply, and all.
    """

    def __init__(self, cause: PalpateError, answered: int, total: int, output: Path) -> None:
        self.answered, self.total = answered, total
        got = f"{cause.got}; {answered:,} of {total:,} photos are described and kept in {output}"
        super().__init__(cause.must, got, cause.fix, argument=cause.argument)


@dataclass(frozen=True)
class Captions(Shown):
    """Captions that were written.

    Attributes:
        table: one row a sample: ``id``, ``text`` (null without one), ``adjectives``, ``flags``.
        record: what made them; the same as ``record.json``.
        path: the table's file.
        problems: photos that could not be read, or that the server does not take.
        notes: what a reader must know.
    """

    table: pl.DataFrame
    record: Mapping[str, Any]
    path: Path
    problems: Sequence[Problem] = ()
    notes: Sequence[Note] = ()

    def to_json(self) -> dict[str, Any]:
        """Record, path, problems and notes as a JSON object."""
        return {
            **self.record,
            "path": str(self.path),
            "problems": plain(self.problems),
            "notes": plain(self.notes),
        }

    def __str__(self) -> str:
        names = ("digest", "model", "template", "per")
        rows = {"table": str(self.path), **{name: self.record.get(name) for name in names}}
        rows["prompt"] = (self.record.get("prompt") or {}).get("name")
        rows |= {**self.record["counts"], "tokens": self.record.get("tokens")}
        lines = ["Captions", *fact_lines({name: value for name, value in rows.items() if value})]
        lines += [f"Without a caption: {len(self.problems)}"] * bool(self.problems)
        return "\n".join([*lines, *problem_lines(self.problems)])


@dataclass(frozen=True)
class Estimate(Shown):
    """What captions will take: photos, and requests about those without an answer so far."""

    photos: int
    requests: int

    def to_json(self) -> dict[str, Any]:
        """The estimate as a JSON object."""
        return plain(self)

    def __str__(self) -> str:
        return f"{self.photos:,} photos need {self.requests:,} requests; no photo was sent"


def caption(  # noqa: PLR0913 (a public verb)
    data: Any,
    output: str | Path,
    *,
    server: str | None = None,
    model: str | None = None,
    template: str | None = None,
    prompt: str | Path | Prompt = "touch-adjectives/1",
    per: Per = "contact",
    concurrency: int = 8,
    timeout: float = 120.0,
    max_tokens: int = 300,
    seed: int = 0,
    body: Mapping[str, Any] | None = None,
    dry_run: bool = False,
    progress: Progress = quiet,
) -> Captions | Estimate:
    """Describe what each touch feels like, by a vision-language model or from columns.

    Run again, it asks only about photos without a reply; a killed run loses what was in flight.

    Args:
        data: a manifest, its file or folder, or anything that :func:`palpate.load` reads.
        output: folder for the table, the record and the replies.
        server: base URL of an OpenAI-compatible API (vLLM, SGLang, Ollama, llama.cpp, LM Studio,
            hosted). Its key is read from the environment variable ``PALPATE_CAPTION_KEY``.
        model: its model; None for the only one that it has.
        template: text with columns in braces (``"{material} of {object}"``), or ``""`` for
            adjectives of the material, instead of a model.
        prompt: name of a prompt that ships, a prompt file, or a :class:`Prompt`.
        per: ``contact``: its middle frame is described, and all of its frames have that caption;
            or ``frame``, or ``object``.
        concurrency: requests at once.
        timeout: longest silence of the server, in seconds.
        max_tokens: longest reply.
        seed: of the model's sampling, where it has any, and of templates.
        body: further fields of every request; None as a value removes one.
        dry_run: send nothing, return an :class:`Estimate`.
        progress: progress callback.

    Raises:
        PalpateError: on bad arguments, samples without photos, a server that does not answer or
            takes no key, model or request, or another run that writes to the folder.
        StoppedError: if the server stops in the middle; what it answered stays.
    """
    if (server is None) == (template is None):
        must, got = "Captions come from server or template", "none" if server is None else "both"
        raise PalpateError(must, got, "", example={"server": "http://localhost:8000/v1"})
    limits = {"concurrency": concurrency, "timeout": timeout, "max_tokens": max_tokens}
    for name, limit in limits.items():
        require(0 < limit < inf, name, "must be a positive number", limit)
    manifest, output = load(data, progress=progress), Path(output)
    must, fix = "must have vision images", "Map the column vision to the photos"
    usable = server is None or manifest.table["vision"].count() > 0
    require(usable, "data", must, "samples without any", fix=fix)
    units = units_of(manifest, per)
    if server is None:
        require(not dry_run, "dry_run", "must be of a model", "a template, which needs no model")
        return _of_columns(template or "", manifest, units, output, per=per, seed=seed)
    instruction = prompt if isinstance(prompt, Prompt) else Prompt.load(prompt)
    from palpate.captions.server import Server

    service = Server(server, model, timeout=timeout, connections=concurrency)
    with closing(service):
        question = Question(service.model, instruction, max_tokens, seed, body or {})
        photos = photos_of(manifest, units, question, progress)
        total = sum(photo.path is not None for photo in photos)
        if dry_run:
            return Estimate(total, len(pending(photos, ReplyLog(output / REPLIES))))
        with locked(output), closing(ReplyLog(output / REPLIES)) as log:
            left = pending(photos, log)
            try:
                failed = query_all(
                    left,
                    question,
                    service,
                    log,
                    threads=min(concurrency, len(left)),
                    progress=progress,
                    answered=any(photo.key in log.answers for photo in photos),
                )
            except PalpateError as error:
                if not log.answered:
                    raise
                done = sum(photo.key in log.answers for photo in photos)
                raise StoppedError(error, done, total, output) from None
            source = _source(question, photos, log, server) | {"per": per}
            descriptions, problems = describe_units(photos, log, instruction, failed)
            return _write(manifest, units, descriptions, output, source, problems=problems)


def _source(
    question: Question, photos: Sequence[Photo], log: ReplyLog, server: str
) -> dict[str, Any]:
    """What the record says of the model and of its replies."""
    prompt, keys = question.prompt, sorted({photo.key for photo in photos if photo.key})
    answers = [log.answers[key] for key in keys if key in log.answers]
    unused = [reply for key in keys for reply in log.unused.get(key, ())]
    inward, outward = (sum(reply.tokens[k] for reply in [*answers, *unused]) for k in (0, 1))
    return {
        "model": question.model,
        "server": server,
        "answered_as": dict(Counter(reply.model for reply in answers).most_common()),
        "prompt": {"name": prompt.name, "digest": prompt.digest, "text": prompt.body},
        "schema": prompt.schema,
        "parameters": question.parameters,
        "replies": len(answers),
        "unused": dict(Counter(str(reply.unused) for reply in unused)),
        "tokens": {"in": inward, "out": outward},
    }


def _of_columns(
    template: str, manifest: Manifest, units: Units, output: Path, *, per: str, seed: int
) -> Captions:
    """Captions from a template; never over those of a model, which cost something."""
    must, free = "must hold no replies of a model", not (output / REPLIES).exists()
    require(free, "output", must, str(output), fix="Choose another folder")
    texts = template_texts(template, manifest, units, seed)
    descriptions = [Description(text, flags=() if text else ("no-column",)) for text in texts]
    source = {"model": None, "template": template or "adjectives of the material", "prompt": None}
    with locked(output):
        return _write(manifest, units, descriptions, output, {"per": per, "seed": seed, **source})


def _write(
    manifest: Manifest,
    units: Units,
    descriptions: Sequence[Description],
    output: Path,
    source: Mapping[str, Any],
    *,
    problems: Sequence[Problem] = (),
) -> Captions:
    """Write the table and the record: every sample has the caption of its unit."""
    rows = [descriptions[number] for number in units.numbers]
    cells = [(row.text, list(row.adjectives), list(row.flags)) for row in rows]
    table = pl.DataFrame(
        [(name, *row) for name, row in zip(manifest.ids, cells, strict=True)], SCHEMA, orient="row"
    )
    digest, flags = texts_digest(table), Counter(f for d in descriptions for f in d.flags)
    texts = [d.text for d in descriptions if d.text]
    flagged = dict(sorted(flags.items()))
    record = {
        "format": TEXTS_FORMAT,
        "digest": digest,
        "manifest": manifest.digest,
        "data": dict(manifest.facts),
        **source,
        "counts": {
            "samples": len(manifest),
            "photos": len(descriptions),
            "texts": len(texts),
            "different": len(set(texts)),
            "flags": flagged,
        },
        "palpate": __version__,
    }
    prompt = (source["prompt"] or {}).get("name")
    origin = [source["model"] or f"template {source['template']!r}", prompt]
    origin = [*filter(None, origin), f"per {source['per']}", f"captions {short(digest)}"]
    path = output / TABLE
    write_texts(table, path, ", ".join(origin), image_digests(manifest))
    write_json(output / RECORD, record)
    notes: list[Note] = []
    if units.alone:
        params = {"count": units.alone, "of": len(manifest), "per": source["per"]}
        notes.append(Note("captions-alone", params))
    if source["model"] is None:
        notes.append(Note("captions-of-columns", {"template": source["template"]}))
    if not texts:
        notes.append(Note("captions-none", {"flags": flagged}))
    return Captions(table, record, path, problems, notes)

"""``palpate.caption``: descriptions of touches, as a table that an import joins.

The output folder holds ``captions.parquet`` (id, text, adjectives, flags; one row a sample),
``record.json`` (what made them) and, where a model described them, ``replies.jsonl``. The table
depends on the samples and the replies alone, never on the order in which these arrived.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from math import ceil, inf
from pathlib import Path
from typing import Any

import polars as pl

from palpate import __version__
from palpate.captions.columns import template_texts
from palpate.captions.photos import checked_crop, sent_size
from palpate.captions.prompts import Description, Prompt
from palpate.captions.querying import Pending, Photos, Question, query_all
from palpate.captions.replies import Describer, Replies, ReplyLog, read_replies
from palpate.captions.server import Server
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
from palpate.data.images import check_image, in_threads
from palpate.data.manifest import Manifest
from palpate.data.reading import load
from palpate.data.texts import TABLE, TEXTS_FORMAT, image_digests, texts_digest, write_texts

LIST = pl.List(pl.String)
RECORD, REPLIES = "record.json", "replies.jsonl"
#: Before anything is measured: seconds and tokens of a reply, and pixels a side of what becomes one
#: token of an image (Qwen's rule; other models take up to twice as many).
SECONDS, TOKENS, PATCH = 3.0, 60, 28


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
class Captions:
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
            "notes": [note.to_json() for note in self.notes],
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
class Estimate:
    """What captions will take. Print it.

    Attributes:
        photos: all of them; ``requests`` are those without an answer so far.
        unreadable: photos that no request is sent for.
        tokens: of the requests and of the replies.
        seconds: in all, with the requested number of requests at once.
        price: in all, if prices were given.
        measured: described photos that the estimate is taken from; 0 means assumptions.
    """

    photos: int
    unreadable: int
    requests: int
    tokens: tuple[int, int]
    seconds: float
    price: float | None
    measured: int

    def to_json(self) -> dict[str, Any]:
        """The estimate as a JSON object."""
        return plain(self)

    def __str__(self) -> str:
        assumed = f"assumed: a reply takes {SECONDS:g} s and {TOKENS} tokens, an image a token "
        assumed += f"for every {PATCH} x {PATCH} pixels"
        minutes = self.seconds / 60
        rows = {
            "photos": f"{self.photos:,}",
            "unreadable": f"{self.unreadable:,}" if self.unreadable else None,
            "requests": f"{self.requests:,}, none for photos that are answered or equal",
            "tokens": f"{self.tokens[0]:,} in, {self.tokens[1]:,} out",
            "time": f"{minutes / 60:.1f} h" if minutes > 90 else f"{minutes:.1f} min",
            "price": None if self.price is None else f"{self.price:.2f}",
            "from": f"{self.measured:,} photos so far" if self.measured else assumed,
        }
        kept = {name: value for name, value in rows.items() if value is not None}
        return "\n".join(["No photo was sent", *fact_lines(kept)])


def caption(  # noqa: PLR0913 (a public verb)
    data: Any,
    output: str | Path,
    *,
    server: str | None = None,
    model: str | None = None,
    local: str | None = None,
    template: str | None = None,
    prompt: str | Path | Prompt = "touch-adjectives/1",
    per: Per = "contact",
    crop: Sequence[float] | None = None,
    concurrency: int = 8,
    timeout: float = 120.0,
    max_tokens: int = 300,
    seed: int = 0,
    body: Mapping[str, Any] | None = None,
    key_variable: str | None = None,
    again: bool = False,
    prices: Sequence[float] | None = None,
    dry_run: bool = False,
    progress: Progress = quiet,
) -> Captions | Estimate:
    """Describe what each touch feels like, by a vision-language model or from columns.

    Run again, it asks only about photos without a reply; a killed run loses what was in flight.

    Args:
        data: a manifest, its file or folder, or anything that :func:`palpate.load` reads.
        output: folder for the table, the record and the replies.
        server: base URL of an OpenAI-compatible API (vLLM, SGLang, Ollama, llama.cpp, LM Studio,
            hosted).
        model: its model; None for the only one that it has.
        local: folder or hub id of a model for this process instead of a server.
        template: text with columns in braces (``"{material} of {object}"``), or ``""`` for
            adjectives of the material, instead of a model.
        prompt: name of a prompt that ships, a prompt file, or a :class:`Prompt`.
        per: ``contact``: its middle frame is described, and all of its frames have that caption;
            or ``frame``, or ``object``.
        crop: left, top, right, bottom of a second image, in shares of the photo: where the sensor
            touches.
        concurrency: requests at once.
        timeout: longest silence of the server, in seconds.
        max_tokens: longest reply.
        seed: of the model's sampling, where it has any, and of templates.
        body: further fields of every request; None as a value removes one.
        key_variable: environment variable that holds the server's key; by default
            ``PALPATE_CAPTION_KEY``, if it is set.
        again: repeat requests whose reply was a refusal or could not be used.
        prices: of a million tokens in and out, for the estimate.
        dry_run: send nothing, return an :class:`Estimate`.
        progress: progress callback.

    Raises:
        PalpateError: on bad arguments, samples without photos, a server that does not answer or
            takes no key, model or request, or another run that writes to the folder.
        StoppedError: if the server stops in the middle; what it answered stays.
    """
    _require_one(server=server, local=local, template=template)
    limits = {"concurrency": concurrency, "timeout": timeout, "max_tokens": max_tokens}
    _require_sound(limits, prices, body)
    manifest, output = load(data, progress=progress), Path(output)
    if template is None and not manifest.table["vision"].count():
        must, fix = "must have vision images", "Map the column vision to the photos"
        raise PalpateError(must, "samples without any", fix, argument="data")
    units = units_of(manifest, per)
    if template is not None:
        return _of_columns(template, manifest, units, output, per=per, seed=seed, dry_run=dry_run)
    instruction = prompt if isinstance(prompt, Prompt) else Prompt.load(prompt)
    area = checked_crop(crop)
    options = {"key_variable": key_variable, "body": body, "timeout": timeout}
    options["connections"] = concurrency
    with closing(_describer(server, model, local, **options)) as describer:
        question = Question(describer.model, instruction, area, max_tokens, seed, body or {})
        if dry_run:
            replies, _ = read_replies(output / REPLIES)
            photos = Photos.of(manifest, units, question, progress)
            pending = photos.pending(replies, instruction, again=again)
            threads = describer.threads or concurrency
            return _estimate(
                photos,
                pending,
                question,
                replies,
                threads=threads,
                prices=prices,
                progress=progress,
            )
        with locked(output), closing(ReplyLog(output / REPLIES)) as log:
            photos = Photos.of(manifest, units, question, progress)
            answers = log.replies.answers
            pending = photos.pending(log.replies, instruction, again=again)
            threads = min(describer.threads or concurrency, len(pending))
            try:
                problems = query_all(
                    pending,
                    question,
                    describer,
                    log,
                    threads=threads,
                    progress=progress,
                    answered=any(key in answers for key in photos.keys),
                )
            except PalpateError as error:
                if not log.answered:
                    raise
                done = sum(key in answers for key in photos.keys)
                raise StoppedError(error, done, len(photos), output) from None
            made = _made(question, photos, log.replies, server) | {"per": per}
            problems = photos.problems(problems)
            descriptions = photos.descriptions(answers, instruction, problems)
            return _write(manifest, units, descriptions, output, made, problems=problems)


def _require_one(**sources: str | None) -> None:
    given = [name for name, value in sources.items() if value is not None]
    if len(given) != 1:
        must = f"Captions come from one of {', '.join(sources)}"
        example = {"server": "http://localhost:8000/v1"}
        raise PalpateError(must, " and ".join(given) or "none", "", example=example)


def _require_sound(limits: Mapping[str, float], prices: Sequence[float] | None, body: Any) -> None:
    for name, limit in limits.items():
        require(0 < limit < inf, name, "must be a positive number", limit)
    sound = all(0 <= price < inf for price in prices or ())
    require(sound, "prices", "must be numbers from 0", prices)
    try:
        json.dumps(body, allow_nan=False, ensure_ascii=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        must, got = "must hold values that JSON has", f"{type(error).__name__} {str(error)[:80]}"
        raise PalpateError(must, got, "Leave out NaN and infinity", argument="body") from None


def _describer(
    server: str | None, model: str | None, local: str | None, **options: Any
) -> Describer:
    if server is not None:
        return Server(server, model, **options)
    from palpate.captions.local import Local

    assert local is not None
    return Local(local)


def _made(
    question: Question, photos: Photos, replies: Replies, server: str | None
) -> dict[str, Any]:
    """What the record says of the model and of its replies."""
    prompt, keys = question.prompt, photos.distinct
    answers = [replies.answers[key] for key in keys if key in replies.answers]
    inward, outward, _ = _spent(replies, keys)
    unused = Counter(reply.unused or "repeated" for reply in replies.others_of(keys))
    return {
        "model": question.model,
        "server": server,
        "answered_as": dict(Counter(reply.model for reply in answers).most_common()),
        "fingerprints": sorted({r.fingerprint for r in answers if r.fingerprint}),
        "prompt": {"name": prompt.name, "digest": prompt.digest, "text": prompt.body},
        "schema": prompt.schema,
        "parameters": question.parameters,
        "replies": len(answers),
        "unused": dict(sorted(unused.items())),
        "tokens": {"in": inward, "out": outward},
    }


def _of_columns(
    template: str,
    manifest: Manifest,
    units: Units,
    output: Path,
    *,
    per: str,
    seed: int,
    dry_run: bool,
) -> Captions:
    """Captions from a template; never over those of a model, which cost something."""
    if dry_run:
        got, fix = "a template, which needs no model", "Leave one of the two out"
        raise PalpateError("must be of a model", got, fix, argument="dry_run")
    if (output / REPLIES).exists():
        must, fix = "must hold no replies of a model", "Choose another folder"
        raise PalpateError(must, str(output), fix, argument="output")
    texts = template_texts(template, manifest, units, seed)
    descriptions = [Description(text, flags=() if text else ("no-column",)) for text in texts]
    made = {"model": None, "template": template or "adjectives of the material", "prompt": None}
    with locked(output):
        return _write(manifest, units, descriptions, output, {"per": per, "seed": seed, **made})


def _spent(replies: Replies, keys: Sequence[str]) -> tuple[int, int, float]:
    """Tokens in and out, and seconds, of all replies to these keys."""
    every = [replies.answers[key] for key in keys if key in replies.answers]
    every += replies.others_of(keys)
    inward, outward = (sum(reply.tokens[k] for reply in every) for k in (0, 1))
    return inward, outward, sum(reply.seconds for reply in every)


def _estimate(
    photos: Photos,
    pending: Sequence[Pending],
    question: Question,
    replies: Replies,
    *,
    threads: int,
    prices: Sequence[float] | None,
    progress: Progress,
) -> Estimate:
    """What the remaining requests take, by the replies so far or by assumptions."""
    paths = [photo.path for photo in pending]
    checked = in_threads(check_image, paths, "checking photos", progress)
    broken = [Problem(str(path), "bad-image", reason) for path, reason in checked if reason]
    unreadable, count = len(photos.problems(broken)), len(pending) - len(broken)
    known = [key for key in photos.distinct if key in replies.answers]
    if known:
        inward, outward, seconds = (n / len(known) for n in _spent(replies, known))
    else:
        sizes = sent_size(photos.first, question.crop)
        patches = sum(ceil(width / PATCH) * ceil(height / PATCH) for width, height in sizes)
        inward, outward, seconds = len(question.prompt.body) / 4 + patches, TOKENS, SECONDS
    tokens = (round(count * inward), round(count * outward))
    price = None
    if prices is not None:
        price = sum(n * each for n, each in zip(tokens, prices, strict=True)) / 1e6
    seconds *= count / threads
    return Estimate(len(photos), unreadable, count, tokens, seconds, price, len(known))


def _write(
    manifest: Manifest,
    units: Units,
    descriptions: Sequence[Description],
    output: Path,
    made: Mapping[str, Any],
    *,
    problems: Sequence[Problem] = (),
) -> Captions:
    """Write the table and the record: every sample has the caption of its unit."""
    rows = [descriptions[k] for k in units.of]
    table = pl.DataFrame(
        {
            "id": manifest.ids,
            "text": [row.text for row in rows],
            "adjectives": [list(row.adjectives) for row in rows],
            "flags": [list(row.flags) for row in rows],
        },
        schema={"id": pl.String, "text": pl.String, **dict.fromkeys(("adjectives", "flags"), LIST)},
    )
    digest, flags = texts_digest(table), Counter(f for d in descriptions for f in d.flags)
    texts = [d.text for d in descriptions if d.text]
    record = {
        "format": TEXTS_FORMAT,
        "digest": digest,
        "manifest": manifest.digest,
        "data": dict(manifest.facts),
        **made,
        "counts": {
            "samples": len(manifest),
            "photos": len(descriptions),
            "texts": len(texts),
            "different": len(set(texts)),
            "flags": dict(sorted(flags.items())),
        },
        "palpate": __version__,
    }
    prompt = (made["prompt"] or {}).get("name")
    source = [made["model"] or f"template {made['template']!r}", prompt, f"per {made['per']}"]
    source = ", ".join([*filter(None, source), f"captions {short(digest)}"])
    path = output / TABLE
    write_texts(table, path, source, image_digests(manifest))
    write_json(output / RECORD, record)
    notes = _notes(manifest, units, made)
    if not texts:
        notes.append(Note("captions-none", {"flags": dict(sorted(flags.items()))}))
    return Captions(table, record, path, problems, notes)


def _notes(manifest: Manifest, units: Units, made: Mapping[str, Any]) -> list[Note]:
    notes: list[Note] = []
    if units.alone:
        params = {"count": units.alone, "of": len(manifest), "per": made["per"]}
        notes.append(Note("captions-alone", params))
    if made["model"] is None:
        notes.append(Note("captions-of-columns", {"template": made["template"]}))
    model = str(made["model"])
    if others := [name for name in made.get("answered_as", ()) if not _same(name, model)]:
        notes.append(Note("captions-other-model", {"models": others, "model": model}))
    return notes


def _same(served: str, requested: str) -> bool:
    """Whether a server's name of a model may be the requested one: a version of it, or its path."""
    a, b = (name.lower().rstrip("/").rpartition("/")[2] for name in (served, requested))
    return a.startswith(b) or b.startswith(a)

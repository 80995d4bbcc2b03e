"""``palpate caption``: what each touch feels like, in words."""

from __future__ import annotations

import json
import sys
from dataclasses import field
from typing import Annotated, Any, Literal

import tyro

from palpate.cli.terminal import (
    Common,
    OutPath,
    PathArgument,
    Switch,
    Terminal,
    error_line,
    option_group,
)
from palpate.cli.verbs import FAILED_CHECK
from palpate.core import PalpateError


@option_group
class Source:
    """Where captions come from: --server or --template."""

    server: Annotated[str | None, tyro.conf.arg(metavar="URL")] = None
    """Base URL of an OpenAI-compatible API, e.g. http://localhost:8000/v1; its key is read from the
    environment variable PALPATE_CAPTION_KEY."""
    model: str | None = None
    """Its model (default: the only one that it has)."""
    template: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="[TEXT]")] = None
    """No model: columns in braces (`"{material} of {object}"`), or adjectives of the material."""


@option_group
class RequestOptions:
    """The instruction to the model, and its limits."""

    prompt: Annotated[str, tyro.conf.arg(metavar="NAME_OR_FILE")] = "touch-adjectives/1"
    """`touch-adjectives/1`, `touch-sentence/1`, or a prompt file."""
    per: Literal["contact", "frame", "object"] = "contact"
    """What has a description of its own; that of its middle frame is copied to the others."""
    concurrency: int = 8
    """Requests at once."""
    timeout: float = 120.0
    """Longest silence of the server, in seconds."""
    max_tokens: int = 300
    """Longest reply."""
    seed: int = 0
    """Of the model's sampling, and of templates."""
    body: Annotated[str | None, tyro.conf.arg(metavar="JSON")] = None
    """Further fields of every request, as a JSON object; null removes a field."""


@option_group
class Options(Common):
    """Describe what each touch feels like, by a vision-language model, once a contact.

    Writes captions.parquet (id, text, adjectives, flags), record.json and every reply. Stopped at
    any moment, the same command goes on. The exit status is 1 if photos are left without a
    reply, or no reply can be used. Then: palpate caption check, palpate import --text.
    """

    data: PathArgument
    """A manifest, the folder of an import, or anything that palpate reads."""
    output: OutPath
    """Folder to write."""
    source: Source = field(default_factory=Source)
    requests: RequestOptions = field(default_factory=RequestOptions)
    dry_run: Switch = False
    """Send no photo; print how many requests it takes."""


def run(options: Options, terminal: Terminal) -> Any:
    """Caption and print what was written, or the estimate."""
    from palpate.captions import Captions, StoppedError, caption

    template, body = options.source.template, _object(options.requests.body)
    text = None if template is None else " ".join(template)
    try:
        result = terminal.run(caption, **options.keywords(body=body, template=text))
    except StoppedError as stop:
        sys.stderr.write(f"palpate caption: {error_line('caption', stop)}\n")
        return stop.to_json(), FAILED_CHECK
    if not isinstance(result, Captions):
        return result
    terminal.print(str(result))
    for note in result.notes:
        terminal.note(note)
    if not result.record["counts"]["texts"]:
        return result.to_json(), FAILED_CHECK
    for command in (
        f"palpate caption check {options.output} --data {options.data}",
        f"palpate import {options.data} --text {options.output} -o captioned",
    ):
        terminal.print_line(f"Next: {command}")
    return result.to_json(), FAILED_CHECK if result.problems else 0


def _object(text: str | None) -> dict[str, Any] | None:
    """The JSON object of an option.

    Raises:
        PalpateError: if it is none.
    """
    try:
        value = None if text is None else json.loads(text)
    except ValueError:
        value = text
    must, example = "must be a JSON object", '{"temperature": null}'
    if not isinstance(value, dict | None):
        raise PalpateError(must, str(text), "", argument="body", example={"body": example})
    return value

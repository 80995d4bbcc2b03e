"""The blinded page of a study: one file without any request, from disk or from the server.

Everything that the page knows is the public form of a plan (:meth:`Plan.public`), as JSON inside
it. A content security policy allows its own script and style by their digests, images in the page,
and nothing else. Votes stay in the browser, an entry a trial, and leave it as a download::

    {"format": "palpate/preference-votes@1", "study", "rater", "viewport": [width, height],
     "votes": [{"trial", "choice", "ms", "at", "undone"}],
     "digest": SHA-256 of all else as JSON with sorted keys (palpate.core.digest_json)}
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

from jinja2 import StrictUndefined, Template
from markupsafe import Markup


def study_page(public: Mapping[str, Any], *, served: bool = False) -> str:
    """Return the page of a study as HTML.

    Args:
        public: the public form of a plan.
        served: leave the study out; the page then requests the part of its rater from the server.
    """
    study = json.dumps(None if served else public, separators=(",", ":")).replace("<", "\\u003c")
    template = Template(_part("study.html.j2"), autoescape=True, undefined=StrictUndefined)
    return template.render(
        title=public["title"],
        study=Markup(study),
        style=Markup(_part("study.css")),
        script=Markup(_part("study.js")),
        policy=policy(served=served),
        served=served,
    )


@cache
def policy(*, served: bool) -> str:
    """Return the content security policy: the page's own script and style, images inside it."""
    rules = {
        "default-src": "'none'",
        "img-src": "data:",
        "script-src": _source("study.js"),
        "style-src": _source("study.css"),
        "connect-src": "'self'" if served else "'none'",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def _source(name: str) -> str:
    digest = hashlib.sha256(_part(name).encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


@cache
def _part(name: str) -> str:
    return (resources.files("palpate.preference") / "templates" / name).read_text(encoding="utf-8")

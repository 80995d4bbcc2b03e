"""The server of ``palpate view``: one page, and nothing that is kept.

    GET  /           the page; ``?token=`` opens it, as of all others
    GET  /data.json  recordings, samples, suspicions, and whether photos can be touched
    GET  /image      a thumbnail: ``k``, the number of a sample, and ``kind``
    POST /touch      a photo -> the touch as PNG; ``gel``: number of the sample whose background it
                     is made on; of a pipeline that knows contacts ``x, y, strength, shear_x,
                     shear_y``

No request names a file; a photo is in memory alone, until it is answered.
"""

from __future__ import annotations

import base64
import hashlib
import io
import secrets
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from importlib import resources
from pathlib import Path
from threading import Lock
from typing import Any

from palpate.core import ImageError, MissingExtraError, PalpateError, Split, decoded, open_image
from palpate.core.images import image_bytes
from palpate.viewing.contents import Contents, contents

try:
    import uvicorn
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException
    from starlette.requests import Request
    from starlette.responses import HTMLResponse, JSONResponse, Response
    from starlette.routing import Route
except ImportError as error:
    name = str(error.name).partition(".")[0]
    raise MissingExtraError(name, "app", "palpate view") from None

#: Side of a thumbnail in pixels, and the most bytes of a photo.
SIDE, LARGEST_PHOTO = 160, 20_000_000
#: Seed of the touches: one photo with one setting gives one image.
SEED = 0


class _View:
    """What is served: contents, and the pipeline, which is loaded for the first photo."""

    def __init__(self, shown: Contents, model: str | Path | None, token: str) -> None:
        self.shown, self.model, self.token = shown, model, token
        self.loading, self.pipeline = Lock(), None

    def application(self) -> Starlette:
        """Return the four routes; nothing else exists."""
        routes = [
            Route("/", self.page),
            Route("/data.json", self.data),
            Route("/image", self.image),
            Route("/touch", self.touch, methods=["POST"]),
        ]
        handlers: dict[Any, Callable[[Request, Any], Response]] = {HTTPException: _error}
        return Starlette(routes=routes, exception_handlers=handlers)

    def admit(self, request: Request) -> None:
        """Raise HTTPException 403 without the token."""
        given = request.query_params.get("token", "")
        if not secrets.compare_digest(given.encode(), self.token.encode()):
            raise HTTPException(403, "open the link that palpate view printed")

    def page(self, request: Request) -> Response:
        """Answer ``GET /``."""
        self.admit(request)
        style, script = _part("view.css"), _part("view.js")
        text = _part("view.html").replace("STYLE", style).replace("SCRIPT", script)
        rules = (
            f"default-src 'none'; img-src 'self' blob: data:; connect-src 'self'; style-src "
            f"{_source(style)}; script-src {_source(script)}; base-uri 'none'; form-action 'none'; "
            "frame-ancestors 'none'"
        )
        return HTMLResponse(text, headers=HEADERS | {"Content-Security-Policy": rules})

    def data(self, request: Request) -> Response:
        """Answer ``GET /data.json``."""
        self.admit(request)
        touch = {"touch": self.model is not None, "contacts": False}
        if self.model is not None:
            touch["contacts"] = getattr(self.loaded(), "contact", None) is not None
        return JSONResponse(self.shown.to_json() | touch, headers=HEADERS)

    def image(self, request: Request) -> Response:
        """Answer ``GET /image``."""
        self.admit(request)
        path = self._path(request.query_params.get("k"), request.query_params.get("kind"))
        try:
            with open_image(path) as image:
                small = decoded(image, (SIDE, SIDE))[0]
        except ImageError as error:
            raise HTTPException(404, str(error)) from None
        small.thumbnail((SIDE, SIDE))
        return Response(image_bytes(small, "JPEG"), media_type="image/jpeg", headers=HEADERS)

    async def touch(self, request: Request) -> Response:
        """Answer ``POST /touch``."""
        self.admit(request)
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > LARGEST_PHOTO:
                raise HTTPException(413, f"a photo has at most {LARGEST_PHOTO:,} bytes")
        from starlette.concurrency import run_in_threadpool

        made = await run_in_threadpool(self._touched, body, request.query_params)
        return Response(made, media_type="image/png", headers=HEADERS)

    def _touched(self, body: bytes, settings: Mapping[str, str]) -> bytes:
        if self.model is None:
            raise HTTPException(404, "no model")
        gel = settings.get("gel")
        try:
            with open_image(io.BytesIO(body)) as image:
                photo = decoded(image)[0]
            made = self.loaded().generate(
                photo,
                ids=["photo"],
                seed=SEED,
                gel=None if gel is None else self._path(gel, "background"),
                **_contact(settings),
            )
        except (ImageError, PalpateError, ValueError, TypeError) as error:
            raise HTTPException(400, str(error)) from None
        return image_bytes(made[0], "PNG")

    def loaded(self) -> Any:
        """The pipeline."""
        from palpate.diffusion import TactilePipeline

        with self.loading:
            if self.pipeline is None:
                self.pipeline = TactilePipeline.from_pretrained(str(self.model))
                self.pipeline.set_progress_bar_config(disable=True)
        return self.pipeline

    def _path(self, number: str | None, kind: str | None) -> Path:
        with suppress(ValueError, IndexError, KeyError):
            k = int(number or "")
            if k >= 0:
                return self.shown.entries[k].images[str(kind)]
        raise HTTPException(404, "no such image")


HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
}


def _contact(settings: Mapping[str, str]) -> dict[str, Any]:
    """What a request says of the contact, as the pipeline takes it."""
    value = {name: float(text) for name, text in settings.items() if name not in ("token", "gel")}
    made: dict[str, Any] = {"strength": value["strength"]} if "strength" in value else {}
    for name, ends in (("at", ("x", "y")), ("shear", ("shear_x", "shear_y"))):
        if value.keys() >= set(ends):
            made[name] = tuple(value[end] for end in ends)
    return made


def _error(_: Request, error: HTTPException) -> Response:
    return JSONResponse({"error": error.detail}, error.status_code, headers=HEADERS)


def _source(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


@cache
def _part(name: str) -> str:
    return (resources.files("palpate.viewing") / "templates" / name).read_text(encoding="utf-8")


def view(
    source: Any,
    *,
    split: Split | str | Path | None = None,
    model: str | Path | None = "palpate/mini",
    host: str = "127.0.0.1",
    port: int = 7860,
    token: str | None = None,
    ready: Callable[[str], None] = lambda url: None,
) -> None:
    """Serve a data set or results to look at, until it is stopped (Ctrl-C, SIGTERM).

    Args:
        source: a file of results, or a data set as :func:`palpate.load` takes it.
        split: whose parts color the samples of a data set.
        model: pipeline that touches dropped photos; None for none.
        host: address to listen at; the default is reached from this machine alone.
        port: 0 for any free one.
        token: what the link must hold; default: drawn anew.
        ready: called with the link before the first request.

    Raises:
        MissingExtraError: without the extra ``app``.
        PalpateError: if there is nothing to look at, or the address is taken.
    """
    from palpate.preference.server import listening

    token = secrets.token_urlsafe(16) if token is None else token
    app = _View(contents(source, split=split), model, token).application()
    with listening(host, port) as listener:
        address = f"[{host}]" if ":" in host else host
        ready(f"http://{address}:{listener.getsockname()[1]}/?token={token}")
        config = uvicorn.Config(app, access_log=False, log_level="warning", server_header=False)
        with suppress(KeyboardInterrupt):
            uvicorn.Server(config).run(sockets=[listener])

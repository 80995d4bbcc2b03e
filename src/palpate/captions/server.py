"""Any server that speaks the OpenAI-compatible protocol: ``POST URL/chat/completions``.

Structured output is requested by the top-level ``response_format`` alone, which vLLM, SGLang,
Ollama, llama.cpp, LM Studio and hosted models share; servers may ignore it, so a reply is read as
text that may hold anything (:mod:`palpate.captions.replies`). Busy or failing servers (429, 5xx,
broken connections, time-outs) get the request again after ``Retry-After`` or a doubling pause. The
key comes from an environment variable and is in no file, log or error.
"""

from __future__ import annotations

import base64
import json
import os
import re
import threading
from collections.abc import Mapping
from typing import Any

from palpate.captions.prompts import LONGEST, valid
from palpate.captions.replies import Question, RejectedError, Reply
from palpate.core import MissingExtraError, PalpateError, few, require

try:
    import httpx2
except ImportError:
    raise MissingExtraError("httpx2", "caption", "Asking a server for captions") from None

#: Where the key is looked for.
KEY_VARIABLE = "PALPATE_CAPTION_KEY"
#: How often a request is sent to a busy or failing server.
TRIES = 6
#: Longest pause that we choose before another try, in seconds.
LONGEST_PAUSE = 60.0
#: Longest pause that a server may request, in seconds; we give up if it requests more.
LONGEST_WAIT = 600.0
#: Statuses after which the same request may well succeed, next to 5xx.
BUSY = (408, 409, 425, 429)
#: Shorter keys are stand-ins for servers without keys, and may be words of a caption.
SHORT_KEY = 8


class Server:
    """A model behind an OpenAI-compatible endpoint.

    Args:
        url: the API's base, mostly ending in ``/v1``.
        model: its name there; None for the only one that the server has.
        timeout: longest silence of the server, in seconds.
        pause: seconds before the second try; doubles with every further one.
        connections: requests at once.

    Raises:
        PalpateError: if the URL or the key is none, or the model is unknown.
    """

    def __init__(
        self,
        url: str,
        model: str | None = None,
        *,
        timeout: float = 120.0,
        pause: float = 1.0,
        connections: int = 8,
    ) -> None:
        self.url, self._key, self._pause = _checked_url(url), _key(), pause
        self._answered, self._closed = False, threading.Event()
        self._client = httpx2.Client(
            base_url=self.url,
            headers={"Authorization": f"Bearer {self._key}"} if self._key else {},
            timeout=timeout,
            limits=httpx2.Limits(max_connections=connections, keepalive_expiry=60),
        )
        self.model = model or self._only_model()

    def close(self) -> None:
        """Close all connections; threads that still run send nothing more."""
        self._closed.set()
        self._client.close()

    def describe(self, image: bytes, question: Question) -> Reply:
        """Answer a question about a JPEG file; called from several threads.

        Raises:
            RejectedError: if this one request cannot be answered.
            PalpateError: if none can.
        """
        answer = self._answer(self._payload(image, question))
        try:
            choice = answer["choices"][0]
            message, usage = choice["message"], answer.get("usage") or {}
            refusal, finish = message.get("refusal"), str(choice.get("finish_reason") or "stop")
            raw = str(message.get("content") or refusal or "")
            prompt, completion = (
                int(usage.get(name) or 0) for name in ("prompt_tokens", "completion_tokens")
            )
            return Reply(
                raw=self._cleaned(raw)[:LONGEST],
                model=self._cleaned(str(answer.get("model") or self.model)),
                refused=bool(refusal) or finish == "content_filter",
                finish=self._cleaned(finish),
                tokens=(prompt, completion),
            )
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            got = f"{type(error).__name__} at {str(error)[:80]}"
            raise RejectedError(f"the reply is no chat completion ({got})") from None

    def _payload(self, image: bytes, question: Question) -> dict[str, Any]:
        url = {"url": f"data:image/jpeg;base64,{base64.b64encode(image).decode()}"}
        content = [
            {"type": "text", "text": question.prompt.body},
            {"type": "image_url", "image_url": url},
        ]
        schema = {"name": "description", "schema": question.prompt.schema, "strict": True}
        body = {
            "model": self.model,
            "messages": [{"role": "user", "content": content}],
            "response_format": {"type": "json_schema", "json_schema": schema},
            "max_tokens": question.max_tokens,
            "temperature": question.temperature,
            "seed": question.seed,
            **question.body,
        }
        return {name: value for name, value in body.items() if value is not None}

    def _answer(self, payload: Mapping[str, Any]) -> dict[str, Any]:
        """The JSON of the reply, after as many tries as it takes.

        Raises:
            RejectedError: if the server does not take this request.
            PalpateError: if it does not answer any more, or takes no request.
        """
        failure, wait = self._unreachable("no request"), 0.0
        for k in range(TRIES):
            if wait and self._closed.wait(wait):
                break
            wait = min(LONGEST_PAUSE, self._pause * 2**k)
            try:
                response = self._request("POST", "chat/completions", json=payload)
            except httpx2.RequestError as error:
                failure = self._unreachable(self._reason(error))
                if isinstance(error, httpx2.ConnectError) and not self._answered:
                    break  # nobody is there, and nobody was
                continue
            self._answered = True
            answer = _parsed(response)
            status = _status(response.status_code, answer)
            if status in BUSY or status >= 500:
                reason = f"status {status}: {self._message(answer)}"
                failure = self._unreachable(reason)
                wait = _retry_after(response.headers.get("Retry-After", ""), wait)
                if wait > LONGEST_WAIT:
                    reason += f" (it asks to wait {wait:.0f} s)"
                    failure = self._unreachable(
                        reason, "Wait that long, or send fewer requests at once"
                    )
                    break
            elif status != 200:
                raise self._rejection(status, answer)
            elif isinstance(answer, str):
                failure = RejectedError(f"the reply is no JSON: {self._cleaned(answer)[:80]!r}")
            else:
                return answer
        raise failure

    def _request(self, method: str, path: str, **content: Any) -> Any:
        if self._closed.is_set():
            raise self._unreachable("closed")
        return self._client.request(method, path, **content)

    def _unreachable(
        self, reason: str, fix: str = "Check its address and that it runs"
    ) -> Exception:
        """The error of a server that does not answer, any more or at all."""
        must, got = "must be a server that answers", f"{self.url}: {reason}"
        fix += ", then run the same command again"
        return PalpateError(must, got, fix, argument="server")

    def _rejection(self, status: int, answer: Any) -> Exception:
        """The error that a status other than 200 means: of the server, or of this request alone."""
        got = f"status {status}: {self._message(answer)}"
        if status in (401, 403):
            where = f"the environment variable {KEY_VARIABLE}"
            fix = f"Check the key in {where}" if self._key else f"Put a key into {where}"
            must = "must be a server that accepts the key"
            return PalpateError(must, f"{self.url}: {got}", fix, argument="server")
        if status == 404:
            if (models := self._models()) and self.model not in models:
                must, fix = f"must be a model of {self.url}", f"It has {few(models)}"
                return PalpateError(must, self.model, fix, argument="model")
            must, fix = "must be an OpenAI-compatible API", "Give its base: http://HOST:PORT/v1"
            return PalpateError(must, f"{self.url}: {got}", fix, argument="server")
        if 300 <= status < 400:
            must, fix = "must be an API that does not redirect", "Give the address it redirects to"
            return PalpateError(must, f"{self.url}: {got}", fix, argument="server")
        return RejectedError(got)

    def _models(self) -> list[str]:
        """Names of the server's models; empty if it does not list them.

        Raises:
            PalpateError: if nobody is there, or the key is not accepted.
        """
        try:
            response = self._request("GET", "models")
        except httpx2.RequestError as error:
            raise self._unreachable(self._reason(error)) from None
        if response.status_code in (401, 403):
            raise self._rejection(response.status_code, _parsed(response))
        try:
            listed = _parsed(response)["data"] if response.status_code == 200 else []
            return [self._cleaned(str(model["id"])) for model in listed]
        except (LookupError, TypeError, ValueError):
            return []

    def _only_model(self) -> str:
        """The server's model, if it has one.

        Raises:
            PalpateError: if there is none, or a choice.
        """
        if len(models := self._models()) != 1:
            got = f"{len(models)} models" if models else "no list of models"
            unlisted = "Name it, or give the base of the API: http://HOST:PORT/v1"
            fix = f"Choose one of {few(models)}" if models else unlisted
            raise PalpateError(f"must be named for {self.url}", got, fix, argument="model")
        return models[0]

    def _reason(self, error: Exception) -> str:
        """What broke the connection, in words; the library's may repeat a header."""
        return f"{type(error).__name__} {self._cleaned(str(error))}".strip()

    def _cleaned(self, text: str) -> str:
        """A text without the key, which some servers repeat, and with characters that exist."""
        text = valid(text)
        return text.replace(self._key, "***") if len(self._key) >= SHORT_KEY else text

    def _message(self, answer: Any) -> str:
        """What an error reply says, in one short line."""
        try:
            error = answer.get("error", answer.get("detail", answer))
            answer = error["message"] if isinstance(error, dict) else error
        except (LookupError, AttributeError):
            pass
        return " ".join(self._cleaned(str(answer)).split())[:200] or "no message"


def _checked_url(url: str) -> str:
    """The base of the API, without a slash at its end.

    Raises:
        PalpateError: if it is no http(s) URL, or holds a password or a query, which would be kept.
    """
    must = "must be http://HOST:PORT or https://HOST and a path, without password or query"
    bare = re.sub(r"//[^/]*@", "//***@", url.partition("?")[0])
    valid_url = re.fullmatch(r"https?://[\w.\-\[\]:]+(/[^?#\s]*)?", url) is not None
    require(valid_url, "server", must, repr(bare), fix="Most servers: http://localhost:8000/v1")
    return url.rstrip("/").removesuffix("/chat/completions")


def _key() -> str:
    """The key; empty without one."""
    key = os.environ.get(KEY_VARIABLE, "").strip()
    must, got = f"{KEY_VARIABLE} must hold a key", "signs that no key has"
    printable = re.fullmatch(r"[\x21-\x7e]*", key) is not None
    require(printable, None, must, got, fix=f"export {KEY_VARIABLE}=...")
    return key


def _retry_after(value: str, default: float) -> float:
    """Seconds that the server asks to wait, where it gives a number."""
    try:
        return max(0.0, float(value))
    except ValueError:
        return default


def _status(status: int, answer: Any) -> int:
    """The status of a reply; some servers send 200 with an error, and its code if it has one."""
    if status != 200 or not isinstance(answer, dict) or "choices" in answer:
        return status
    if not (error := answer.get("error")):
        return status
    code = str(error.get("code") if isinstance(error, dict) else None)
    return int(code) if re.fullmatch("[45][0-9]{2}", code) else 400


def _parsed(response: Any) -> Any:
    """The JSON of a response, else its text."""
    try:
        return json.loads(response.content)
    except ValueError:
        return response.text

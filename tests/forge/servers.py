"""A server of captions with scripted faults, and the server of a study in its own process.

``python tests/forge/servers.py`` serves captions, prints its URL, and ends with its standard input.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

# --- captions by the OpenAI-compatible protocol


WORDS = ["rough", "smooth", "hard", "soft", "gritty", "ridged", "slick", "dry", "fibrous", "woven"]


def adjectives_of(image: bytes) -> list[str]:
    """Three to six adjectives that depend on the image alone."""
    digest = hashlib.sha256(image).digest()
    return [*dict.fromkeys(WORDS[b % len(WORDS)] for b in digest[:4]), "firm", "even"]


class FakeServer(ThreadingHTTPServer):
    """Answers every image with adjectives of its bytes.

    Attributes:
        faults: called with the number of the request, from 1; returns what goes wrong, or None.
        requests: payloads, with the key that came along.
        images: image digest -> how often it was asked about.
        busiest: most requests at once.
    """

    daemon_threads = True
    request_queue_size = 128

    def __init__(self, faults=lambda number: None, *, delay=0.0, key=None, model="fake/vlm-7b"):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.faults, self.delay, self.key, self.model = faults, delay, key, model
        self.lock, self.payloads, self.images = threading.Lock(), [], Counter()
        self.count = self.now = self.busiest = 0
        self.keep = True

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_port}/v1"

    def __enter__(self):
        threading.Thread(target=self.serve_forever, args=(0.01,), daemon=True).start()
        return self

    def __exit__(self, *error):
        self.shutdown()
        self.server_close()

    def handle_error(self, request, client_address):
        """Clients that leave are no news."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def log_message(self, *args):
        pass

    def send(self, status, body, headers=(), cut=None):
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        self.send_response(status)
        for name, value in {"Content-Type": "application/json", **dict(headers)}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data[:cut])

    def do_GET(self):
        if self.denied():
            return
        models = {"data": [{"id": self.server.model}]}
        self.send(200 if self.path == "/v1/models" else 404, models)

    def denied(self):
        """Say no to another key, and repeat it, as some servers do."""
        given = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if self.server.key is not None and given != self.server.key:
            message = f"Incorrect API key provided: {given}"
            self.send(401, {"error": {"message": message}})
            return True
        return False

    def do_POST(self):
        server = self.server
        payload = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        if self.denied():
            return
        if self.path != "/v1/chat/completions" or payload["model"] != server.model:
            self.send(404, {"error": {"message": f"no {payload['model']} at {self.path}"}})
            return
        content = payload["messages"][0]["content"]
        url = next(part["image_url"]["url"] for part in content if part["type"] == "image_url")
        image = base64.b64decode(url.partition(",")[2])
        with server.lock:
            server.count += 1
            number = server.count
            server.now += 1
            server.busiest = max(server.busiest, server.now)
            server.images[hashlib.sha256(image).hexdigest()] += 1
            if server.keep:
                server.payloads.append(payload)
        try:
            if server.delay:
                time.sleep(server.delay)
            self.reply(server.faults(number), image, payload)
        finally:
            with server.lock:
                server.now -= 1

    def reply(self, fault, image, payload):
        """Answer, with a fault or without; a tuple is the whole reply."""
        if isinstance(fault, tuple):
            self.send(*fault)
            return
        status, _, rest = str(fault or "").partition(" ")
        if status.isdigit():
            headers = {"Retry-After": rest} if rest and status == "429" else {}
            self.send(int(status), {"error": {"message": f"fault {status}"}}, headers)
            return
        if fault == "hang":
            time.sleep(3)
        answer = {"adjectives": adjectives_of(image), "surface_visible": True}
        if "sentence" in payload["response_format"]["json_schema"]["schema"]["properties"]:
            words = answer.pop("adjectives")
            answer["sentence"] = f"{', '.join(words)} surface typical of a thing"
        texts = {
            "prose": "The surface feels rough and hard.",
            "fenced": f"Here you are:\n```json\n{json.dumps(answer)}\n```",
            "truncated": json.dumps(answer)[:25],
            "refusal": "I'm sorry, but I can't help with that.",
            "hidden": json.dumps(answer | {"surface_visible": False}),
        }
        message = {"role": "assistant", "content": texts.get(fault, json.dumps(answer))}
        if fault == "flagged":
            message = {"role": "assistant", "content": None, "refusal": "No."}
        body = {
            "model": "other/model" if fault == "other-model" else self.server.model,
            "choices": [
                {"message": message, "finish_reason": "length" if fault == "truncated" else "stop"}
            ],
            "usage": {"prompt_tokens": 700, "completion_tokens": 30},
        }
        body = {"no-completion": {"answer": 42}, "page": b"<html>"}.get(fault, body)
        self.send(200, body, cut=20 if fault == "reset" else None)
        if fault == "reset":
            with suppress(OSError):
                self.wfile.flush()
                linger = struct.pack("ii", 1, 0)
                self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            self.close_connection = True


# --- a study in a process of its own, to be asked, filled up and killed


_PROGRAM = """
import json, pathlib, sys, types
from palpate.preference import server

def ready(url, tokens):
    print(json.dumps({"url": url, "tokens": dict(tokens)}), flush=True)

def load(study):
    public = json.loads((pathlib.Path(study) / "public.json").read_text())
    return types.SimpleNamespace(public=lambda: public)

server.Plan.load = load
server.LONGEST_WAIT = float(sys.argv[3])
server.serve(sys.argv[1], ready=ready, **json.loads(sys.argv[2]))
"""
#: A time as a browser writes it.
AT = "2030-01-31T12:00:00.000Z"


class Serving:
    """A server process; its ``tokens`` by rater also hold those of earlier processes.

    Args:
        folder: where the study and the votes lie.
        public: the public form of a plan.
        verb: serve the plan that lies in the folder, by the command line.
        wait: the longest wait for a request, in seconds.
        **options: of :func:`palpate.preference.server.serve`.
    """

    def __init__(self, folder, public, *, verb=False, wait=10.0, **options):
        self.folder, self.public, self.tokens = folder, public, {}
        self.verb, self.wait = verb, wait
        (folder / "public.json").write_text(json.dumps(public))
        self.database = folder / "study.db"
        self.start(**{"port": 0, "invite": len(public["raters"])} | options)

    def start(self, **options):
        command = ["-c", _PROGRAM, self.folder, json.dumps(options), str(self.wait)]
        if self.verb:
            words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
            command = ["-m", "palpate", "preference", "serve", self.folder, *words]
        self.process = subprocess.Popen(
            [sys.executable, *command], stdout=subprocess.PIPE, text=True
        )
        if self.verb:
            self.url = self.process.stdout.readline().split()[-1]
            lines = [self.process.stdout.readline().split() for _ in range(options["invite"])]
            self.tokens |= {rater: link.partition("token=")[2] for rater, link in lines}
        else:
            ready = json.loads(self.process.stdout.readline())
            self.url, self.tokens = ready["url"], self.tokens | ready["tokens"]
        self.port = int(self.url.rsplit(":", 1)[1].strip("/"))

    def kill(self, number=signal.SIGKILL):
        os.kill(self.process.pid, number)
        self.process.wait()
        self.process.stdout.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.kill(signal.SIGINT)

    def request(self, method, path, rater=None, body=None, headers=()):
        """The answer as (status, headers, body); a body that is no text or bytes goes as JSON."""
        connection = HTTPConnection("127.0.0.1", self.port, timeout=20)
        headers = dict(headers)
        if rater:
            headers["Authorization"] = f"Bearer {self.tokens.get(rater, rater)}"
        if isinstance(body, dict | list):
            body = json.dumps(body)
        try:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            content = answer.read()
        finally:
            connection.close()
        return answer.status, dict(answer.getheaders()), content

    def json(self, *call, **options):
        """Status and JSON of an answer."""
        status, _, content = self.request(*call, **options)
        return status, json.loads(content)

    def vote(self, rater, trial=0, choice="left", **changes):
        """A vote of a rater on the trial at this place."""
        trial = self.public["raters"][rater][trial]["trial"]
        vote = {"study": self.public["study"], "rater": rater, "trial": trial, "choice": choice}
        return vote | {"ms": 900, "at": AT, "undone": 0} | changes

    def send(self, rater, *given, **changes):
        """Status and JSON of the answer to a vote."""
        return self.json("POST", "/vote", rater, self.vote(rater, *given, **changes))


if __name__ == "__main__":
    with FakeServer(delay=float((sys.argv[1:] or ["0"])[0])) as running:
        running.keep = False
        print(running.url, flush=True)
        sys.stdin.read()

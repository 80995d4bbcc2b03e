"""The server of a study in a process of its own, to be asked, filled up and killed."""

import json
import os
import signal
import subprocess
import sys
from http.client import HTTPConnection

_PROGRAM = """
import json, pathlib, sys
from palpate.preference.server import serve

def ready(url, tokens):
    print(json.dumps({"url": url, "tokens": dict(tokens)}), flush=True)

public, database = map(pathlib.Path, sys.argv[1:3])
serve(json.loads(public.read_text()), database, ready=ready, **json.loads(sys.argv[3]))
"""
#: A time as a browser writes it.
AT = "2030-01-31T12:00:00.000Z"


class Serving:
    """A server process; its ``tokens`` by rater also hold those of earlier processes.

    Args:
        folder: where the study and the votes lie.
        public: the public form of a plan.
        **options: of :func:`palpate.preference.server.serve`.
    """

    def __init__(self, folder, public, **options):
        self.folder, self.public, self.tokens = folder, public, {}
        (folder / "public.json").write_text(json.dumps(public))
        self.database = folder / "study.db"
        self.start(**{"port": 0, "invite": len(public["raters"])} | options)

    def start(self, **options):
        files = [self.folder / "public.json", self.database]
        command = [sys.executable, "-c", _PROGRAM, *files, json.dumps(options)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
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

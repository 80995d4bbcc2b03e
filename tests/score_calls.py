"""``palpate score`` called by a test: status and streams, or the scores by (metric, subject, preset)."""

import json

from palpate.cli import main


def call(capsys, *args):
    status = main(["score", *map(str, args)])
    said = capsys.readouterr()
    return status, said.out, said.err


def score(capsys, *args):
    status, out, err = call(capsys, *args, "--json")
    assert status == 0, err
    data = json.loads(out)
    return {
        (s["metric"], s["subject"], s["settings"].get("preset")): s for s in data["scores"]
    }, data

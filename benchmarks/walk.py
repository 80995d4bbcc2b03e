"""How many files of palpate a command runs through: what a newcomer has to open to follow it.

::

    python benchmarks/walk.py -- palpate score --generated a/ --reference b/ --encoder palpate/mini
    python benchmarks/walk.py --source OTHER/CHECKOUT/src -- palpate generate photo.jpg -o t.png

Counts the project files in which at least one function ran, bodies of modules and classes left out,
with ``sys.setprofile`` in all threads of the command's own process. ``--source`` measures another
checkout with the same script.
"""

from __future__ import annotations

import argparse
import collections
import inspect
import json
import sys
import threading
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1] / "src"


def walk(arguments: list[str], source: Path) -> tuple[int, dict[str, int]]:
    """Runs ``palpate ARGUMENTS`` from ``source``.

    Returns:
        the exit status, and the number of calls by file, in order of first use.
    """
    sys.path.insert(0, str(source))
    root = str(source / "palpate") + "/"
    calls: dict[str, int] = collections.defaultdict(int)

    def profile(frame: Any, event: str, _: object) -> None:
        code = frame.f_code
        function = code.co_flags & inspect.CO_OPTIMIZED  # bodies of modules and classes are not
        if event == "call" and function and code.co_filename.startswith(root):
            calls[code.co_filename[len(root) :]] += 1

    from palpate.cli import main

    threading.setprofile(profile)
    sys.setprofile(profile)
    try:
        status = main(arguments)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]
    return status, dict(calls)


def run() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--source", type=Path, default=HERE, help="folder that holds palpate/")
    parser.add_argument("--json", type=Path, help="also write the calls by file as JSON")
    parser.add_argument("command", nargs=argparse.REMAINDER, help="-- palpate VERB ...")
    options = parser.parse_args()
    words = [word for k, word in enumerate(options.command) if k or word != "--"]
    status, calls = walk(words[words[0] == "palpate" :], options.source.resolve())
    for name, count in calls.items():
        print(f"{count:8d}  {name}", file=sys.stderr)
    lines = sum(len((options.source / "palpate" / f).read_text().splitlines()) for f in calls)
    print(f"{len(calls)} files of {lines} lines, exit status {status}", file=sys.stderr)
    if options.json:
        options.json.write_text(json.dumps(calls, indent=1) + "\n")
    return status


if __name__ == "__main__":
    sys.exit(run())

"""The command ``palpate``: a verb a stage.

This file is all that ``palpate --help`` loads: neither torch nor polars. Each verb lives in the module of its
name and is imported when it is called.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

#: Exit statuses.
OK, FAILED_CHECK, USER_ERROR, BUG, INTERRUPTED = 0, 1, 2, 70, 130


@dataclass(frozen=True)
class Verb:
    """A verb: the module that runs it, what it does, an example."""

    module: str
    help: str
    example: str


VERBS: dict[str, Verb] = {
    "import": Verb(
        "importing",
        "Turn a data set on disk into a manifest",
        "palpate import touch_and_go/ -o tag/",
    ),
    "validate": Verb(
        "validate",
        "Tell what is missing, invalid or suspicious in a data set",
        "palpate validate touch_and_go/",
    ),
    "export": Verb(
        "export",
        "Write a manifest as a Hugging Face data set or a table",
        "palpate export tag/ --to hf -o tag_hf/",
    ),
    "audit": Verb(
        "audit",
        "Tell whether a train/test split leaks",
        "palpate audit train.txt test.txt --fail-over 0.01",
    ),
    "split": Verb(
        "split",
        "Make a split that does not leak, stratified by material",
        "palpate split tag/ -o noleak.json",
    ),
    "world": Verb(
        "world", "Write the procedural world: a small synthetic data set", "palpate world -o world/"
    ),
    "encoder": Verb(
        "encoder",
        "Train the tactile encoder against frozen vision and text encoders",
        "palpate encoder tag/ --split noleak.json -o encoders/",
    ),
    "train": Verb(
        "train",
        "Train a generator of tactile images",
        "palpate train tag/ --split noleak.json --encoder encoders/ -o model/",
    ),
    "generate": Verb(
        "generate", "Make tactile images for photos", "palpate generate photo.jpg -o touch.png"
    ),
    "score": Verb(
        "score",
        "Score generated tactile images",
        "palpate score --generated out/ --reference real/ --encoder palpate/mini",
    ),
    "report": Verb(
        "report",
        "Write the page: audit, gallery, scores, settings",
        "palpate report audit.json scores.json -o page.html",
    ),
    "demo": Verb(
        "demo", "Run everything once, from photos to a page", "palpate demo --data touch_and_go/"
    ),
}


def usage() -> str:
    """The text of ``palpate --help``."""
    from palpate import __version__

    width = max(map(len, VERBS))
    verbs = "\n".join(f"  {name:<{width}}  {verb.help}" for name, verb in VERBS.items())
    return (
        f"palpate {__version__}: from a photo to the touch it would give, and honest scores for how well.\n\n"
        f"usage: palpate VERB [options]\n\n{verbs}\n\n"
        "  palpate VERB --help    options and an example of one verb\n"
        "  palpate --version      the version\n\n"
        f"Start here: palpate demo      Is my split leaking? {VERBS['audit'].example}\n"
    )


def main(argv: list[str] | None = None) -> int:
    """Runs the command line.

    Returns:
        0 done; 1 a check failed (``audit --fail-over``); 2 a user's mistake, told in one line; 70 a bug of ours;
        130 stopped by Ctrl-C.
    """
    from palpate.cli.streams import steady

    with steady():
        try:
            try:
                return _run(sys.argv[1:] if argv is None else argv)
            finally:
                sys.stdout.flush()
        except OSError as error:  # files that fail are told by their verb
            got = f"standard output must take what is printed. Got {error.strerror}. Free some space, or send it elsewhere."
            sys.stderr.write(f"palpate: {got}\n")
            return USER_ERROR


def _run(args: list[str]) -> int:
    if not args or args[0] in ("-h", "--help", "help"):
        sys.stdout.write(usage())
        return OK if args else USER_ERROR
    if args[0] == "--version":
        from palpate import __version__

        sys.stdout.write(f"palpate {__version__}\n")
        return OK
    from palpate.cli.terminal import run_verb

    return run_verb(args[0], args[1:])

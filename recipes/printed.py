"""The printed answers in README and docs: each command is run, and what it prints written below it.

    python recipes/printed.py            # writes; `make docs` does
    python recipes/printed.py --check    # changes nothing, exits 1 where a page is not current

A block is a ``console`` fence below the line ``<!-- printed -->``. Its lines that begin with ``$``
are run in order, in one folder for all pages, which holds what :func:`prepare` makes of palpate's
world; notes and progress, which go to standard error, are left out. Lines are folded at 100 columns
as a terminal folds them. Two answers are the same if their words are, and their numbers within 5 %:
processors differ in the last digits. A pipe into ``head`` is understood, no other.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import math
import os
import re
import shlex
import shutil
import sys
import tempfile
import textwrap
from pathlib import Path

TOP = Path(__file__).resolve().parents[1]
PAGES = ("README.md", *(f"docs/start/{name}.md" for name in ("audit", "score", "generate")))
BLOCK = re.compile(r"(?<=^<!-- printed -->\n\n)```console\n(.*?)^```", re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,]*(?:\.\d+)?(?![\w])")
WIDTH = 100


def prepare(folder: Path, quick: bool = False) -> None:
    """Write what the pages assume into ``folder``: lists, a photo, and folders of images.

    ``tag/`` is a world of six materials with ``train.txt`` and ``test.txt``; ``real/`` holds the
    tactile images of other objects than those of train, ``generated/`` what the shipped generator
    makes of their photos. ``quick``: without these two.
    """
    run(
        "palpate world -o tag -q --materials 6 --objects-per-material 6 --set contacts_per_video=3"
        " frames_per_contact=2 test=0.4 --workers 1",
        folder,
    )
    for part in ("train", "test"):
        shutil.copy(folder / "tag" / f"{part}.txt", folder)
    photos = sorted((folder / "tag" / "dataset").glob("*/video_frame/*.jpg"))
    shutil.copy(photos[len(photos) // 2], folder / "photo.jpg")
    if quick:
        return
    run("palpate split tag --by object -o apart.json -q", folder)
    run("palpate generate tag -o made --split apart.json -q", folder)
    from palpate import load
    from palpate.diffusion import Generated

    manifest, made = load(folder / "tag"), Generated.load(folder / "made")
    for name in ("real", "generated"):
        (folder / name).mkdir()
    files = dict(zip(manifest.ids, manifest.paths("tactile"), strict=True))
    for sample in made.ids:
        name = re.sub(r"\W+", "_", sample)
        shutil.copy(files[sample], folder / "real" / f"{name}.jpg")
        shutil.copy(made.path(sample), folder / "generated" / f"{name}.png")


def run(line: str, folder: Path) -> str:
    """What a command prints on standard output, folded."""
    from palpate.cli import main

    line, _, head = line.partition(" | head -")
    words = shlex.split(line, comments=True)
    assert words[0] == "palpate", line
    said, here = io.StringIO(), Path.cwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
            code = main(words[1:])
    finally:
        os.chdir(here)
    assert code in (0, 1, 3), (line, code, said.getvalue())
    return "".join(fold(each) for each in said.getvalue().splitlines()[: int(head or 1000)])


def fold(line: str) -> str:
    """A line as the lines that fit the page, the later ones indented."""
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    parts = (
        [line.rstrip()]
        if len(line) <= WIDTH
        else textwrap.wrap(
            line, WIDTH, subsequent_indent=indent, drop_whitespace=True, break_on_hyphens=False
        )
    )
    return "".join(f"{part}\n" for part in parts or [""])


def printed(block: str, folder: Path) -> str:
    """A block with the answers that its commands print now."""
    lines = [line for line in block.splitlines() if line.startswith("$ ")]
    answers = [f"{line}\n{run(line[2:], folder)}" for line in lines]
    return "".join(answers)


def alike(a: str, b: str) -> bool:
    """Whether two answers have the same words, and numbers that differ by 5 % or less."""
    values = [[float(x.replace(",", "")) for x in NUMBER.findall(text)] for text in (a, b)]
    words = [NUMBER.sub("#", text).split() for text in (a, b)]
    near = lambda x, y: math.isclose(x, y, rel_tol=0.05, abs_tol=0.05)
    return words[0] == words[1] and all(map(near, *values))


def update(page: Path, folder: Path) -> str:
    """The text of a page with the answers of now; those that are alike stay as they are."""

    def answer(match: re.Match[str]) -> str:
        new = printed(match[1], folder)
        return match[0] if alike(match[1], new) else f"```console\n{new}```"

    return BLOCK.sub(answer, page.read_text(encoding="utf-8"))


def main() -> int:
    """Write or check the pages."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--check", action="store_true", help="change nothing; exit 1 where one differs"
    )
    options, stale = parser.parse_args(), []
    with tempfile.TemporaryDirectory() as name:
        prepare(Path(name))
        for page in (TOP / each for each in PAGES):
            text = update(page, Path(name))
            if text != page.read_text(encoding="utf-8"):
                stale.append(str(page.relative_to(TOP)))
                if not options.check:
                    page.write_text(text, encoding="utf-8")
    done = "differs" if options.check else "written"
    sys.stdout.writelines(f"{name}: {done}\n" for name in stale)
    return int(options.check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())

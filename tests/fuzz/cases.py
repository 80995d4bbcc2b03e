"""One case: a command on inputs that were broken at random, and what may come of it.

Allowed is exit 0, 1, 3, or 2 with a message of one line (and its indented list), and nothing but
whole files in the output folder. Everything else is a failure.
"""

import contextlib
import getpass
import io
import json
import os
import re
import shlex
import shutil
import stat
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import polars as pl
from PIL import Image

from fuzz import mutations
from fuzz.bare import EXTRAS
from fuzz.seeds import COMMANDS
from palpate.cli import main

#: What one case may take.
SECONDS, BYTES = 60, 2 << 30
#: Addresses that the process has asked for.
NETWORK: list[str] = []


def random_case(seed: int, number: int, base: Path, folder: Path) -> list[str]:
    """The arguments of a case, whose inputs now lie below ``folder``."""
    rng = np.random.default_rng([seed, number])
    weights = np.array(list(COMMANDS.values()), float)
    command = list(COMMANDS)[rng.choice(len(COMMANDS), p=weights / weights.sum())]
    args = prepare(command, base, folder)
    files, own = (
        sorted(p for p in (folder / name).rglob("*") if p.is_file()) for name in ("in", "out")
    )
    places = [str(p) for p in (*files[:3], *files[-2:], folder / "in", folder / "out" / "none")]
    long = "OUT/" + "x" * 300
    outputs = ["", ".", "..", "/", "OUT/a/b/c", "OUT/x.json", "OUT/\udcff", long, *places]
    outputs = [o.replace("OUT", str(folder / "out")) for o in (*outputs, "OUT", "OUT/f", "OUT/\n")]
    outputs += [str(folder / "in" / "null")]
    with contextlib.suppress(PermissionError):  # a /dev/null of the case's own
        os.mknod(folder / "in" / "null", 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    for _ in range(int(rng.integers(1, 4))):
        if own and rng.random() < 0.7:
            mutations.change_content(rng, own)
        elif rng.random() < 0.25 or not files:
            mutations.change_arguments(rng, args, places, outputs)
        else:
            change = mutations.change_content if rng.random() < 0.8 else mutations.change_place
            small = [p for p in files if p.is_file() and p.stat().st_size < mutations.SPARSE]
            if kept := [p for p in small if not p.is_symlink()]:
                change(rng, kept)
    return [arg.replace("\0", "") for arg in args]  # no shell can pass one


def prepare(command: str, base: Path, folder: Path) -> list[str]:
    """Link the inputs that a command names, copy what it goes on from; return its arguments."""
    for name in sorted(set(re.findall(r"\bIN/([\w-]+)", command))):
        shutil.copytree(base / name, folder / "in" / name, copy_function=os.link)
    for name in sorted(set(re.findall(r"\bKEPT/([\w-]+)", command))):
        shutil.copytree(base / "kept" / name, folder / "out" / name)
    for name in ("in", "out", "cwd", "tmp"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    places = {"IN": folder / "in", "OUT": folder / "out", "KEPT": folder / "out"}
    return [
        re.sub(r"\b(IN|OUT|KEPT)\b", lambda m: str(places[m[1]]), a) for a in shlex.split(command)
    ]


def failures(args: Sequence[str], folder: Path, ending: tuple[int, ...] = ()) -> list[str]:
    """Run a command in this process; return what is wrong with how it ended.

    Args:
        args: of the command.
        folder: of the case.
        ending: the exit statuses that are right, if not all that the fuzzer allows; 2 is then only
            for a package that is not installed.
    """
    NETWORK.clear()
    before = snapshot(folder / "in") | snapshot(folder / "out")
    status, out, err = run(args, folder)
    as_json = "--json" in args and not {"-h", "--help"} & {*args}
    named = {os.path.normpath(folder / "cwd" / arg) for arg in args}  # "-o .."
    wrong = [*_ending(status, out, err, as_json), *_traces(folder, before, named)]
    if ending and NETWORK:
        wrong.append(f"a connection to {NETWORK}")
    lacking = status == 2 and re.search(r"the extra (\w+) brings it", err)
    if ending and status not in ending and not (lacking and lacking[1] in EXTRAS):
        wrong.append(f"status {status}: {err[-300:]}")
    return wrong


def run(args: Sequence[str], folder: Path) -> tuple[int | str, str, str]:
    """Return (exit status or exception, standard output, standard error)."""
    out, err, here = io.StringIO(), io.StringIO(), Path.cwd()
    old = dict(os.environ)
    os.environ |= {"TMPDIR": str(folder / "tmp"), "HOME": str(folder.parent / "home")}
    tempfile.tempdir = None
    os.chdir(folder / "cwd")
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status: int | str = main(list(args))
    except SystemExit as stop:
        status = stop.code or 0
    except BaseException:  # an oracle looks at everything
        status = traceback.format_exc()
    finally:
        os.chdir(here)
        os.environ.clear()
        os.environ.update(old)
        tempfile.tempdir = None
    return status, out.getvalue(), err.getvalue()


def _ending(status: int | str, out: str, err: str, as_json: bool) -> Iterator[str]:
    if status not in (0, 1, 2, 3):
        yield f"status {status}: {place(err if isinstance(status, int) else status)}"
        return
    if "Traceback" in err:
        yield f"traceback: {place(err)}"
    if status == 2:
        _, found, message = f"\n{err}".partition("\npalpate ")
        lines = message.rstrip("\n").split("\n")[1:]
        if not found:
            yield f"no message: {err[-200:]!r}"
        elif extra := [line for line in lines if not line.startswith("  ")]:
            yield f"a message of several lines: {extra[0][:60]!r}"
    if as_json and out:
        try:
            json.loads(out, parse_constant=lambda name: 1 / 0)
        except (ValueError, ArithmeticError) as error:
            yield f"standard output is no JSON: {type(error).__name__}"


def place(trace: str) -> str:
    """Exception and innermost line of palpate in a traceback: what failures are grouped by."""
    frames = re.findall(r'/(palpate/[^"]+)", line (\d+), in (\w+)', trace)
    lines = trace.strip().split("\n")
    last = [line for line in lines if re.match(r"[\w.]+(Error|Exception|\w+)\b(:|$)", line)]
    at = "{}:{} {}".format(*frames[-1]) if frames else "?"
    return f"{(last or ['?'])[-1][:90]} at {at}"


def snapshot(folder: Path) -> dict[str, tuple[int, ...]]:
    found = {}
    for path in [folder, *folder.rglob("*")]:
        facts = path.lstat()
        times = (facts.st_size, facts.st_mtime_ns) if path.is_file() else ()
        found[os.fsdecode(path)] = (facts.st_mode, *times)
    return found


def _traces(folder: Path, before: dict[str, tuple[int, ...]], named: set[str]) -> Iterator[str]:
    """What was changed, left behind or half written; ``named`` are paths that the command names."""
    after = snapshot(folder / "in")
    inside = [path for path in before if Path(path).is_relative_to(folder / "in")]
    if changed := [path for path in inside if after.get(path) != before[path]]:
        yield f"an input was changed: {Path(changed[0]).name!r}"
    for name in ("in", "out", "cwd", "tmp", ""):
        parts = ("in", "out", "cwd", "tmp", f"torchinductor_{getpass.getuser()}")
        left = [p.name for p in (folder / name).iterdir() if p.name not in parts]
        resumed = (".work", ".part")  # the same command goes on from these
        strange = [n for n in left if n.startswith(".") and not n.endswith(resumed)]
        free = name in ("tmp", "") and os.path.normpath(folder / name) not in named
        if strange or (left and free):
            yield f"left behind in {name or 'the folder above'}: {(strange or left)[0]!r}"
    own = snapshot(folder / "out")
    for file in (folder / "out").rglob("*"):
        changed = before.get(os.fsdecode(file)) != own[os.fsdecode(file)]
        if file.is_file() and changed and (reason := broken(file)):
            yield f"a broken {file.suffix}: {reason}"


def broken(file: Path) -> str:
    """Why an output is not whole, or ''."""
    try:
        if file.suffix == ".json":
            json.loads(file.read_text(encoding="utf-8"))  # diffusers' hold Infinity
        elif file.suffix == ".parquet":
            pl.read_parquet(file, glob=False)
        elif file.suffix in (".png", ".jpg"):
            Image.open(file).load()
        elif file.suffix == ".html" and not file.read_text("utf-8").rstrip().endswith("</html>"):
            return "no end"
    except Exception as error:
        return repr(error)[:80]
    return ""


def check(seed: int, job: int | str, base: Path, work: Path) -> tuple[list[str], list[str]]:
    """Run a random case below ``work``, or a command on whole inputs.

    Returns:
        Its arguments and failures.
    """
    folder = work / f"{seed}-{job if isinstance(job, int) else os.getpid()}"
    try:
        if isinstance(job, int):
            args = random_case(seed, job, base, folder)
            return args, failures(args, folder)
        args = prepare(job, base, folder)
        # The demo is given data without images: it stops before its minutes of training.
        return args, failures(args, folder, (2,) if job.startswith("demo") else (0, 1, 3))
    finally:
        shutil.rmtree(folder, ignore_errors=True)

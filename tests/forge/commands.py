"""Commands run in this process or in one of their own."""

import subprocess
import sys

from palpate.cli import main


def call(capsys, *args):
    """Status, standard output and standard error of a command run in this process."""
    status = main([*map(str, args)])
    return status, *capsys.readouterr()


def mistake(capsys, words, *args):
    """A user's mistake: status 2, nothing printed, one line (and its list) with these words."""
    status, out, err = call(capsys, *args)
    lines = [line for line in err.splitlines() if line.startswith("palpate ")]
    assert (status, out, len(lines), "Traceback" in err) == (2, "", 1, False), (args, err)
    assert words in err, (args, err)


def python(code, **options):
    """What lines of Python print in a process of their own, which must succeed."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, **options)
    assert done.returncode == 0, done.stderr
    return done.stdout

"""Commands run in this process or in one of their own."""

import subprocess
import sys

from palpate.cli import main


def call(capsys, *args):
    """Status, standard output and standard error of a command run in this process."""
    status = main([*map(str, args)])
    return status, *capsys.readouterr()


def python(code, **options):
    """What lines of Python print in a process of their own, which must succeed."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, **options)
    assert done.returncode == 0, done.stderr
    return done.stdout

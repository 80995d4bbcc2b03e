"""The command ``palpate``.

This file is all that ``palpate --help`` loads: neither torch nor polars. Each verb is a module that
is imported when it is called.
"""

from __future__ import annotations

import sys

from palpate.cli.verbs import INTERRUPTED, OK, USER_ERROR, VERBS


def usage(group: str = "") -> str:
    """Return the text of ``palpate --help``, or of one group of verbs (``"train"``)."""
    from palpate._version import __version__

    verbs = {name: verb for name, verb in VERBS.items() if name.startswith(group)}
    width = max(map(len, verbs))
    listed = "\n".join(f"  {name:<{width}}  {verb.help}" for name, verb in verbs.items())
    if group:
        return f"usage: palpate {group}VERB [options]\n\n{listed}\n"
    return (
        f"palpate {__version__}: tactile images from photos, splits that do not leak, scores "
        "with intervals.\n\n"
        f"usage: palpate VERB [options]\n\n{listed}\n\n"
        "  palpate VERB --help    options and an example of one verb\n"
        "  palpate --version      the version\n\n"
        f"Start here: palpate demo      Is my split leaking? {VERBS['audit'].example}\n"
    )


def main(argv: list[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0 done; 1 a check failed (``audit --fail-over``); 2 a user's mistake, explained in one line;
        70 a bug in palpate; 130 stopped by Ctrl-C.
    """
    try:
        from palpate.cli.streams import resilient_streams

        with resilient_streams():
            try:
                return _run(sys.argv[1:] if argv is None else argv)
            finally:
                sys.stdout.flush()
    except KeyboardInterrupt:  # also while the libraries load
        sys.stderr.write(
            "\npalpate: stopped. Run the same command again: with an output or a cache it "
            "resumes.\n"
        )
        return INTERRUPTED
    except OSError as error:  # a full disk behind standard output; verbs explain their own files
        sys.stderr.write(
            f"palpate: standard output must be writable. Got {error.strerror}. "
            "Free some space, or redirect it elsewhere.\n"
        )
        return USER_ERROR


def _run(args: list[str]) -> int:
    if not args or args[0] in ("-h", "--help", "help"):
        sys.stdout.write(usage())
        return OK if args else USER_ERROR
    if args[0] == "--version":
        from palpate._version import __version__

        sys.stdout.write(f"palpate {__version__}\n")
        return OK
    if " ".join(args[:2]) in VERBS:
        args = [" ".join(args[:2]), *args[2:]]
    group = f"{args[0]} "
    grouped = args[0] not in VERBS and any(name.startswith(group) for name in VERBS)
    if grouped and args[1:] in ([], ["-h"], ["--help"]):
        sys.stdout.write(usage(group))
        return OK if args[1:] else USER_ERROR
    from palpate.cli.terminal import run_verb

    return run_verb(args[0], args[1:])

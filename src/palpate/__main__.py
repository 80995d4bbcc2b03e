"""``python -m palpate``: the same command as the ``palpate`` console script."""

from palpate.cli import main

if __name__ == "__main__":
    raise SystemExit(main())

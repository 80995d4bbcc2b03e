"""Run random cases and list the failures by kind."""

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fuzz.workers import run


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=int, help="run this one alone")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--bare", action="store_true", help="in an environment without extras")
    options = parser.parse_args()
    one = options.case
    numbers = range(options.cases) if one is None else range(one, one + 1)
    start, kinds = time.monotonic(), dict[str, list[int]]()
    for number, args, failures in run(
        numbers, options.seed, min(options.workers, len(numbers)), bare=options.bare
    ):
        for failure in failures:
            kinds.setdefault(failure, []).append(number)
            if len(kinds[failure]) == 1:
                print(
                    f"case {number}: {failure}\n    palpate {' '.join(map(ascii, args))[:300]}",
                    flush=True,
                )
        if (number + 1) % 500 == 0:
            print(f"{number + 1} cases, {time.monotonic() - start:.0f} s", flush=True)
    for failure, at in sorted(kinds.items(), key=lambda kind: -len(kind[1])):
        print(f"{len(at)} times: {failure} (cases {', '.join(map(str, at[:5]))})")
    print(f"{len(numbers)} cases, {len(kinds)} kinds of failure, {time.monotonic() - start:.0f} s")
    return 1 if kinds else 0


if __name__ == "__main__":
    raise SystemExit(main())

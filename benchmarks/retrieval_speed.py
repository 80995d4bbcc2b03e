"""Time and memory of retrieval among many samples, both directions, without a matrix of all pairs.

    python benchmarks/retrieval_speed.py --write docs/studies/retrieval_speed.md

Random unit vectors, whose pairs correlate; all keys are ranked. `strict` is both directions with
the sample's own key right; `similar text` counts keys whose text has a cosine above 0.6356 as well,
all texts being distinct (the slowest case: three products of all pairs instead of one). Each row
runs in a process of its own, whose peak resident memory, packages and inputs included, is shown.
Time is the processor's: with one thread, what it takes on a core that nothing else uses. Rows of
width 128, that of palpate/mini, pass under 60 s and 1,024 MB.
"""

import argparse
import datetime
import json
import os
import platform
import resource
import subprocess
import sys
import time
from pathlib import Path

ROWS = [
    (10_000, 128, False),
    (40_000, 128, False),
    (40_000, 128, True),
    (40_000, 768, False),
    (40_000, 768, True),
]
HEAD = "| samples | width | right keys | CPU seconds | elapsed seconds | peak memory, MB |"


def measure(n, width, similar):
    """Time one call in this process."""
    import numpy as np

    from palpate.core import FeatureSet
    from palpate.metrics.retrieval import retrieval

    rng = np.random.default_rng(0)
    a = rng.standard_normal((n, width), np.float32)
    b = a + 3 * rng.standard_normal((n, width), np.float32)
    ids, groups = [f"s{k}" for k in range(n)], [f"v{k // 50}" for k in range(n)]
    sets = [FeatureSet(ids, x, None, groups, "e") for x in (a, b)]
    options = {"texts": b, "threshold": 0.6356} if similar else {}
    start, cpu = time.perf_counter(), time.process_time()
    forth, back = retrieval(*sets, **options)
    return {
        "seconds": time.perf_counter() - start,
        "cpu": time.process_time() - cpu,
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "top-1": [way.top[0].score.value for way in (forth, back)],
    }


def page(lines, command):
    """The whole Markdown file."""
    about = "\n".join(__doc__.splitlines()[4:])
    return f"""# Retrieval: speed and memory

Made by a committed command; do not edit by hand. {platform.machine()}, {os.cpu_count()} cores that
others used as well; {datetime.date.today().isoformat()}.

    python benchmarks/{command}

{about}

{chr(10).join(lines)}
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    parser.add_argument("--row", type=json.loads, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.row:
        print(json.dumps(measure(*chosen.row)))
        return
    lines, passed = [HEAD, "|---|---|---|---|---|---|"], True
    threads = {f"{x}_NUM_THREADS": "1" for x in ("OMP", "OPENBLAS")}
    for n, width, similar in ROWS:
        row = json.dumps([n, width, int(similar)])
        command = [sys.executable, __file__, "--row", row]
        done = subprocess.run(
            command, env=os.environ | threads, check=True, capture_output=True, text=True
        )
        result = json.loads(done.stdout)
        kind = "similar text" if similar else "strict"
        numbers = f"{result['cpu']:.1f} | {result['seconds']:.1f} | {result['memory']:.0f}"
        lines.append(f"| {n:,} | {width} | {kind} | {numbers} |")
        print(lines[-1], flush=True)
        if width == 128:
            passed = passed and result["cpu"] < 60 and result["memory"] < 1024
    if chosen.write:
        chosen.write.write_text(page(lines, f"{Path(__file__).name} {' '.join(sys.argv[1:])}"))
    sys.exit(not passed)


if __name__ == "__main__":
    main()

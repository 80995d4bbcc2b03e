"""Time and memory of retrieval among many samples, both directions, without a matrix of all pairs.

    python benchmarks/retrieval_speed.py --write docs/studies/retrieval_speed.md

Random unit vectors, whose pairs correlate; all keys are ranked. `strict` is both directions with
the sample's own key right; `similar text` counts keys whose text has a cosine above 0.6356 as well,
all texts being distinct and few of them similar (one and a half products of all pairs instead of
one, and a bit for each pair); in `half of all texts`, the worst case, every second pair is similar.
Each row runs in a process of its own, whose peak resident memory, packages and inputs included, is
shown. Time is the processor's: with one thread, what it takes on a core that nothing else uses. A
row passes under 60 s and 1,024 MB; the worst case is shown as it is.
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
    (10_000, 128, "strict"),
    (40_000, 128, "strict"),
    (40_000, 128, "similar text"),
    (40_000, 128, "half of all texts"),
    (40_000, 768, "strict"),
    (40_000, 768, "similar text"),
    (40_000, 768, "half of all texts"),
]
HEAD = "| samples | width | right keys | CPU seconds | elapsed seconds | peak memory, MB |"


def measure(n, width, kind):
    """Time one call in this process."""
    import numpy as np

    from palpate.core import FeatureSet
    from palpate.metrics.retrieval import retrieval

    rng = np.random.default_rng(0)
    a = rng.standard_normal((n, width), np.float32)
    b = a + 3 * rng.standard_normal((n, width), np.float32)
    ids, groups = [f"s{k}" for k in range(n)], [f"v{k // 50}" for k in range(n)]
    sets = [FeatureSet(ids, x, None, groups, "e") for x in (a, b)]
    texts = b
    if kind == "half of all texts":  # the part that all share gives cosines of about the threshold
        shared = rng.standard_normal(width, np.float32)
        unit = b / np.linalg.norm(b, axis=1, keepdims=True)
        texts = unit + 1.32 * shared / np.linalg.norm(shared)
    options = {} if kind == "strict" else {"texts": texts, "threshold": 0.6356}
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
    for n, width, kind in ROWS:
        command = [sys.executable, __file__, "--row", json.dumps([n, width, kind])]
        done = subprocess.run(
            command, env=os.environ | threads, check=True, capture_output=True, text=True
        )
        result = json.loads(done.stdout)
        numbers = f"{result['cpu']:.1f} | {result['seconds']:.1f} | {result['memory']:.0f}"
        lines.append(f"| {n:,} | {width} | {kind} | {numbers} |")
        print(lines[-1], flush=True)
        if not kind.startswith("half"):
            passed = passed and result["cpu"] < 60 and result["memory"] < 1024
    if chosen.write:
        chosen.write.write_text(page(lines, f"{Path(__file__).name} {' '.join(sys.argv[1:])}"))
    sys.exit(not passed)


if __name__ == "__main__":
    main()

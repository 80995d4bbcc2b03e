"""The metrics' speed and memory beside the peers', on the same features in one run.

    python benchmarks/metrics.py                                       # n = m = 14,000, d = 768: about ten minutes on one core
    python benchmarks/metrics.py --n 4000 --repeats 3                  # a first look
    python benchmarks/metrics.py --parts disk --disk-rows 1000000      # 2 x 3 GB of features streamed from a temporary folder
    python benchmarks/metrics.py --parts gpu --device cuda --n 100000  # 100,000 x 768 blocked on a GPU, share of its peak
    python benchmarks/metrics.py --write docs/studies/metric_speed.md

Every line runs in a process of its own, which makes the same features from the same seed first; peak memory is the process's largest resident set minus
what it had with the features made. Ratios are of CPU time where all run on one thread (``--threads 1``, the default), which other work on the
machine disturbs least. cmmd-pytorch's formula is written out here as published: whole kernel matrices in float32, norms from the diagonal of
n x n products, means over all entries. torchmetrics and torch-fidelity are run where they are installed.
"""

import argparse
import datetime
import importlib.metadata
import importlib.util
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

VIDEOS, CLASSES = 100, 20


def features(n, d, seed, start=0):
    """(n, d) unit rows, float32, with a common mean, class and video effects; rows ``start`` to ``start + n`` of the set ``seed``."""
    out = np.empty((n, d), np.float32)
    fixed = np.random.default_rng(0)
    base, classes, videos = (
        fixed.normal(size=d) + 1,
        0.4 * fixed.normal(size=(CLASSES, d)),
        0.3 * fixed.normal(size=(VIDEOS, d)),
    )
    for k in range(0, n, 10_000):
        rng = np.random.default_rng([seed, start + k])
        video = (start + k + np.arange(min(10_000, n - k))) % VIDEOS
        x = (
            base
            + classes[video % CLASSES]
            + videos[video]
            + 0.3 * rng.normal(size=(len(video), d))
            + 0.1 * seed * np.linspace(-1, 1, d)
        )
        out[k : k + len(x)] = x / np.linalg.norm(x, axis=1, keepdims=True)
    return out


def bare_products(x, y):
    """The floor: every block of the symmetric pair matrix once, nothing else."""
    z, k = np.concatenate([x, y]), np.empty((1024, 1024), np.float32)
    for i in range(0, len(z), 1024):
        for j in range(i, len(z), 1024):
            a, b = z[i : i + 1024], z[j : j + 1024]
            np.matmul(a, b.T, out=k[: len(a), : len(b)])
    return


def cmmd_formula(x, y):
    """Three whole kernel matrices in float32, as cmmd-pytorch publishes it."""
    gamma = np.float32(1 / 200)
    x_sq, y_sq = np.diag(x @ x.T), np.diag(y @ y.T)

    def mean(a, b, p, q):
        return np.mean(np.exp(-gamma * (-2 * (a @ b.T) + p[:, None] + q[None, :])))

    return float(
        np.float32(1000)
        * (mean(x, x, x_sq, x_sq) + mean(y, y, y_sq, y_sq) - 2 * mean(x, y, x_sq, y_sq))
    )


def ours(backend, estimator="biased"):
    from palpate.metrics import distance

    return lambda x, y: distance(x, y, backend=backend, estimator=estimator, scale=1000.0).value


def four_metrics(x, y):
    """All four metrics, leave-one-video-out intervals, 1,000 permutations of whole videos."""
    from palpate.core import FeatureSet
    from palpate.metrics import four_scores

    ids, video = [f"{k:06d}" for k in range(len(x))], np.arange(len(x)) % VIDEOS
    sets = [
        FeatureSet(
            ids[: len(v)],
            v,
            [f"c{g % CLASSES:02d}" for g in video[: len(v)]],
            [f"v{g:03d}" for g in video[: len(v)]],
        )
        for v in (x, y)
    ]
    scores = four_scores(*sets, permutations=1000, backend="blocked")
    assert all(s.value is not None and s.interval for s in scores)
    return scores[0].value


def torchmetrics_polynomial(x, y):
    import torch
    from torchmetrics.image.kid import poly_mmd

    return float(poly_mmd(torch.from_numpy(x), torch.from_numpy(y)))


def torch_fidelity(kernel):
    def run(x, y):
        from torch_fidelity.metric_kid import kernel_mmd

        options = {
            "kid_kernel_poly_degree": 3,
            "kid_kernel_poly_gamma": None,
            "kid_kernel_poly_coef0": 1,
            "kid_kernel_rbf_sigma": 10.0,
        }
        return float(kernel_mmd(x, y, kid_kernel=kernel, **options))

    return run


RUNS = {
    "bare matrix products (floor)": (bare_products, None),
    "palpate, blocked": (ours("blocked"), None),
    "palpate, moments": (ours("moments"), None),
    "palpate, four metrics with intervals and 1,000 permutations": (four_metrics, None),
    "cmmd-pytorch's formula": (cmmd_formula, None),
    "torchmetrics, polynomial": (torchmetrics_polynomial, "torchmetrics"),
    "torch-fidelity, polynomial": (torch_fidelity("poly"), "torch_fidelity"),
    "torch-fidelity, RBF": (torch_fidelity("rbf"), "torch_fidelity"),
}


def resident():
    """MiB in memory now (Linux)."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 2**20


class Peak:
    """Largest resident set inside, over what there was at the start; sampled every 5 ms."""

    def __enter__(self):
        self.start = self.most = resident()
        self.over = threading.Event()
        self.thread = threading.Thread(target=self._watch, daemon=True)
        self.thread.start()
        return self

    def _watch(self):
        while not self.over.wait(0.005):
            self.most = max(self.most, resident())

    def __exit__(self, *_):
        self.over.set()
        self.thread.join()
        self.most = max(self.most, resident())

    @property
    def extra(self):
        return self.most - self.start


def measure(name, n, m, d, repeats):
    """One line, in this process."""
    run = RUNS[name][0]
    x, y = features(n, d, 0), features(m, d, 1)
    run(x[:600], y[:600])  # imports and first-use costs
    best, wall, value = np.inf, np.inf, None
    with Peak() as peak:
        for _ in range(repeats):
            cpu, clock = time.process_time(), time.perf_counter()
            value = run(x, y)
            best, wall = (
                min(best, time.process_time() - cpu),
                min(wall, time.perf_counter() - clock),
            )
    return {"name": name, "cpu": best, "wall": wall, "mib": peak.extra, "value": value}


def truth(x, y, rows=512):
    """The biased value by float64 slabs."""

    def mean(a, b):
        total, sq = 0.0, (b.astype(np.float64) ** 2).sum(1)
        wide = b.astype(np.float64)
        for i in range(0, len(a), rows):
            s = a[i : i + rows].astype(np.float64)
            total += np.expm1(-((s * s).sum(1)[:, None] + sq - 2 * (s @ wide.T)) / 200).sum()
        return total / (len(a) * len(b))

    return 1000 * (mean(x, x) + mean(y, y) - 2 * mean(x, y))


def in_a_process(arguments, threads):
    """Runs this file again and reads its last line."""
    env = os.environ | {
        "OMP_NUM_THREADS": str(threads),
        "OPENBLAS_NUM_THREADS": str(threads),
        "MKL_NUM_THREADS": str(threads),
    }
    done = subprocess.run(
        [sys.executable, __file__, *arguments], env=env, capture_output=True, text=True, check=False
    )
    if done.returncode:
        return {
            "error": done.stderr.strip().splitlines()[-1]
            if done.stderr.strip()
            else f"exit {done.returncode}"
        }
    return json.loads(done.stdout.strip().splitlines()[-1])


def beside_the_peers(chosen):
    """Rows of the table: each run, with ratios to the blocked back end and the error against float64."""
    found = []
    for name, (_, needs) in RUNS.items():
        if needs and importlib.util.find_spec(needs) is None:
            print(f"{name}: {needs} is not installed, skipped", flush=True)
            found.append({"name": name, "error": "not installed"})
            continue
        row = in_a_process(
            [
                "--one",
                name,
                "--n",
                str(chosen.n),
                "--m",
                str(chosen.m or chosen.n),
                "--d",
                str(chosen.d),
                "--repeats",
                str(chosen.repeats),
            ],
            chosen.threads,
        )
        row["name"] = (
            name
            if needs is None
            else f"{name} ({importlib.metadata.version(needs.replace('_', '-'))})"
        )
        found.append(row)
        print(
            row.get("error")
            or f"{name}: {row['cpu']:.2f} CPU s, {row['wall']:.2f} s, {row['mib']:.0f} MiB, {row['value']}",
            flush=True,
        )
    return found


def disk(chosen):
    """Moments from two files that do not fit: seconds, resident memory, bound."""
    rows, d = chosen.disk_rows, chosen.d
    with tempfile.TemporaryDirectory(dir=chosen.folder) as folder:
        paths = []
        for seed in (0, 1):
            paths.append(str(Path(folder) / f"{seed}.npy"))
            out = np.lib.format.open_memmap(paths[-1], mode="w+", dtype=np.float32, shape=(rows, d))
            for k in range(0, rows, 50_000):
                out[k : k + 50_000] = features(min(50_000, rows - k), d, seed, k)
            out.flush()
            del out
        return in_a_process(["--one-disk", *paths], chosen.threads)


def one_disk(paths):
    from palpate.metrics import distance

    x, y = (np.load(p, mmap_mode="r") for p in paths)
    with Peak() as peak:
        start, cpu = time.perf_counter(), time.process_time()
        found = distance(x, y)
        wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    return {
        "rows": len(x),
        "wall": wall,
        "cpu": cpu,
        "mib": peak.most,
        "value": found.value,
        "bound": found.bound,
        "backend": found.backend,
    }


def gpu(chosen):
    """Blocked sums of tensors on a device: seconds and share of the device's float32 peak in matrix products measured beside it."""
    import torch

    from palpate.metrics import distance

    x, y = (
        torch.from_numpy(features(chosen.n, chosen.d, seed)).to(chosen.device) for seed in (0, 1)
    )
    wait = torch.cuda.synchronize if chosen.device.startswith("cuda") else lambda: None
    side, flops = 8192, 0.0
    a = torch.rand(side, side, device=chosen.device)
    for _ in range(3):
        wait()
        start = time.perf_counter()
        for _ in range(5):
            a @ a
        wait()
        flops = max(flops, 5 * 2 * side**3 / (time.perf_counter() - start))
    best, value = np.inf, 0.0
    for _ in range(3):
        wait()
        start = time.perf_counter()
        value = distance(x, y, backend="blocked", block=8192).value
        wait()
        best = min(best, time.perf_counter() - start)
    needed = (2 * chosen.n) ** 2 * chosen.d  # half of all pairs, two operations each
    name = (
        torch.cuda.get_device_name() if chosen.device.startswith("cuda") else platform.processor()
    )
    return {
        "device": name,
        "n": chosen.n,
        "d": chosen.d,
        "seconds": best,
        "share": needed / best / flops,
        "tflops": flops / 1e12,
        "value": value,
    }


def table(rows, exact):
    """Markdown of :func:`beside_the_peers`."""
    base = next(r["cpu"] for r in rows if r["name"] == "palpate, blocked")
    lines = [
        "| run | CPU s | x blocked | extra MiB | value | error against float64 |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        if "error" in r:
            lines.append(f"| {r['name']} | {r['error']} | | | | |")
            continue
        same = (
            r["value"] is not None
            and "polynomial" not in r["name"]
            and "RBF" not in r["name"]
            and "four" not in r["name"]
        )
        error = f"{r['value'] - exact:+.1e}" if same else "-"
        value = "-" if r["value"] is None else f"{r['value']:.6g}"
        lines.append(
            f"| {r['name']} | {r['cpu']:.2f} | {r['cpu'] / base:.2f} | {r['mib']:.0f} | {value} | {error} |"
        )
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n", type=int, default=14_000)
    parser.add_argument("--m", type=int, help="default: as n")
    parser.add_argument("--d", type=int, default=768)
    parser.add_argument("--repeats", type=int, default=2, help="the best counts")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--parts", nargs="+", default=["peers"], choices=("peers", "disk", "gpu"))
    parser.add_argument("--disk-rows", type=int, default=1_000_000)
    parser.add_argument("--folder", help="where the files of --parts disk go for a while")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    parser.add_argument("--one", choices=tuple(RUNS), help=argparse.SUPPRESS)
    parser.add_argument("--one-disk", nargs=2, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        print(
            json.dumps(
                measure(chosen.one, chosen.n, chosen.m or chosen.n, chosen.d, chosen.repeats)
            )
        )
        return
    if chosen.one_disk:
        print(json.dumps(one_disk(chosen.one_disk)))
        return
    command = f"python benchmarks/metrics.py {' '.join(a for a in sys.argv[1:] if not a.startswith(chosen.folder or chr(0)) and a != '--folder')}".strip()
    parts = [
        "# Speed and memory of the metrics\n\nMade by a committed command; do not edit by hand.\n\n    "
        + command,
        f"{platform.machine()}, {chosen.threads} thread(s), NumPy {np.__version__}, {datetime.date.today().isoformat()}.",
    ]
    if "peers" in chosen.parts:
        rows = beside_the_peers(chosen)
        m = chosen.m or chosen.n
        parts.append(
            f"n = {chosen.n}, m = {m}, d = {chosen.d}, {VIDEOS} videos, {CLASSES} classes, float32; best of {chosen.repeats}, each in a process of its own.\n\n"
            + table(rows, truth(features(chosen.n, chosen.d, 0), features(m, chosen.d, 1)))
        )
    if "disk" in chosen.parts:
        found = disk(chosen)
        print(found, flush=True)
        parts.append(
            f"From disk, n = m = {found['rows']:,}, d = {chosen.d}, float32, {chosen.threads} thread(s): {found['wall']:.0f} s ({found['cpu']:.0f} CPU s), at most "
            f"{found['mib']:.0f} MiB resident with Python itself, back end {found['backend']}, value {found['value']:.6g}, bound {found['bound']:.1e}."
            if "error" not in found
            else f"From disk: {found['error']}"
        )
    if "gpu" in chosen.parts:
        found = gpu(chosen)
        print(found, flush=True)
        parts.append(
            f"On {found['device']}: {found['n']:,} x {found['d']} against as many, blocked, {found['seconds']:.2f} s: {100 * found['share']:.0f} % of what bare float32 "
            f"products of 8,192 x 8,192 reach there ({found['tflops']:.1f} TFLOP/s)."
        )
    text = "\n\n".join(parts) + "\n"
    print(text)
    if chosen.write:
        chosen.write.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()

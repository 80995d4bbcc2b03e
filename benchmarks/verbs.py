"""Every verb next to its bare work, written plainly with numpy, scipy, torch, polars, faiss.

    python benchmarks/verbs.py                              # all rows; about half an hour
    python benchmarks/verbs.py --only tmmd ssim --turns 1   # a first look
    python benchmarks/verbs.py --write docs/studies/costs.md

Both sides of a row run in fresh processes on one thread, one after the other, ``--turns`` times on
n samples and once on 4 n; the least CPU seconds count. Verbs and starts are measured from the start
of the process to its end, imports included on both sides; metrics (numbers in, numbers out) after
imports and a first call, since a process computes many of them. Memory is the largest resident set.
"""

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SIDE, WIDTH, VIDEOS = 128, 512, 100
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS")


# --- data ---------------------------------------------------------------------------------------


def features(n, seed):
    """(n, 512) float32 of unit length, with a common mean and effects of videos."""
    fixed, rng = np.random.default_rng(0), np.random.default_rng(seed + 1)
    x = fixed.normal(size=WIDTH) + 1 + 0.1 * seed * np.linspace(-1, 1, WIDTH)
    videos = 0.3 * fixed.normal(size=(VIDEOS, WIDTH))
    x = (x + videos[np.arange(n) % VIDEOS] + 0.3 * rng.normal(size=(n, WIDTH))).astype(np.float32)
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def smooth_images(n, seed):
    """(128, 128, 3) bytes each: a few bumps, and noise."""
    rng, grid = np.random.default_rng(seed), np.mgrid[:SIDE, :SIDE][..., None]
    for _ in range(n):
        image = np.full((SIDE, SIDE, 3), 128.0)
        for _ in range(5):
            y, x, width = rng.uniform(8, 120, 2), rng.uniform(8, 120, 2), rng.uniform(4, 20)
            distance = (grid[0] - y[0]) ** 2 + (grid[1] - x[0]) ** 2
            image += rng.normal(0, 40, 3) * np.exp(-distance / (2 * width**2))
        yield (image + rng.normal(0, 2, image.shape)).clip(0, 255).astype(np.uint8)


def image_folders(folder, n):
    """Two folders of n images in recordings of 20."""
    from PIL import Image

    for seed, part in enumerate(("a", "b")):
        for k, image in enumerate(smooth_images(n, seed)):
            path = folder / part / f"video{k // 20:03d}" / f"{k:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(image).save(path)


def tables(folder, n):
    """The images as two tables of samples."""
    image_folders(folder, n)
    for part in ("a", "b"):
        files = sorted((folder / part).rglob("*.png"))
        rows = [f"{f.parent.name},{int(f.stem)},{f.relative_to(folder)}" for f in files]
        (folder / f"{part}.csv").write_text("\n".join(["video,frame,tactile", *rows]))


def lists(folder, n):
    """Two lists of 3 n / 4 and n / 4 rows over n / 1000 videos, in runs of 27 frames, shuffled."""
    rng, rows = np.random.default_rng(0), []
    while len(rows) < n:
        start, video = len(rows) * 2, rng.integers(0, max(20, n // 1000))
        rows += [f"video{video:05d}/{start + k:010d}.jpg,{video % 19}" for k in range(27)]
    rng.shuffle(rows)
    for part, some in (("a", rows[: 3 * n // 4]), ("b", rows[3 * n // 4 : n])):
        (folder / f"{part}.txt").write_text("\n".join(some))
    (folder / "all.txt").write_text("\n".join(rows[:n]))


def nothing(folder, n):
    """What needs no files."""


# --- bare work ----------------------------------------------------------------------------------


def bare_forward(files):
    """Decode, subtract a gel, resize, and the forward pass of the shipped ruler in plain torch."""
    import torch
    from PIL import Image
    from safetensors.torch import load_file
    from torch.nn import functional

    import palpate  # for its folder alone

    file = Path(palpate.__file__).parent / "mini" / "encoders" / "tactile" / "model.safetensors"
    w = {k.removeprefix("gel."): v.float() for k, v in load_file(file).items()}
    side, layers = int(w["side"]), []
    for k, stride in enumerate((2, 2, 2, 2, 1)):
        name = f"layers.{k}"
        flat = w[f"{name}.weight"].flatten(1)
        flat = (flat - flat.mean(1, keepdim=True)) / flat.std(1, correction=0, keepdim=True)
        scale = w[f"{name}.gain"] * 1.713 / flat.shape[1] ** 0.5
        weight = (flat * scale[:, None]).view_as(w[f"{name}.weight"])
        layers.append((weight, 1.713 * w[f"{name}.bias"], stride, weight.shape[2] // 2))

    def encode(x):
        x = torch.asinh((x - x[:, :, ::4, ::4].flatten(2).median(2).values[..., None, None]) / 3)
        for layer in layers:
            x = functional.conv2d(x, *layer).relu_()
        x = torch.cat([x.mean((2, 3)), x.var((2, 3)).add(1e-4).sqrt()], 1)
        return functional.normalize((x - w["center"]) / w["spread"], dim=1)

    rows, gel = [], None
    with torch.inference_mode():
        for start in range(0, len(files), 128):
            images = []
            for file in files[start : start + 128]:
                with Image.open(file) as image:
                    small = image.convert("RGB").resize((side, side), Image.Resampling.BILINEAR)
                    images.append(np.asarray(small, np.float32))
            gel = np.median(images, axis=0) if gel is None else gel
            rows.append(encode(torch.from_numpy(np.stack(images) - gel).permute(0, 3, 1, 2)))
    return torch.cat(rows).numpy()


def bare_products(x, y, of_block=lambda k: k):
    """Every block of the symmetric pair matrix once."""
    z, total = np.concatenate([x, y]), 0.0
    for i in range(0, len(z), 1024):
        for j in range(i, len(z), 1024):
            total += float(of_block(z[i : i + 1024] @ z[j : j + 1024].T)[0, 0])
    return total


def bare_score(folder):
    x, y = (bare_forward(sorted((folder / part).rglob("*.png"))) for part in ("a", "b"))
    bare_products(x, y, lambda k: np.expm1(-0.01 * (1 - k)))


def bare_polynomial(x, y):
    bare_products(x, y, lambda k: (k / WIDTH + 1) ** 3)


def bare_fid(x, y):
    from scipy import linalg

    (a, s), (b, t) = ((v.mean(0), np.cov(v, rowvar=False)) for v in (x, y))
    root = linalg.sqrtm(s @ t)
    return ((a - b) ** 2).sum() + np.trace(s) + np.trace(t) - 2 * np.trace(root).real


def bare_ssim(x, y):
    """SSIM and MS-SSIM as torch's packages have it: grouped convolution in float32."""
    import torch
    from torch.nn import functional

    line = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    line = torch.tensor(line / line.sum(), dtype=torch.float32)

    def blur(x):
        c = x.shape[1]
        x = functional.conv2d(x, line.view(1, 1, -1, 1).expand(c, 1, -1, 1), groups=c)
        return functional.conv2d(x, line.view(1, 1, 1, -1).expand(c, 1, 1, -1), groups=c)

    def maps(a, b):
        ma, mb, aa, bb, ab = (blur(v) for v in (a, b, a * a, b * b, a * b))
        cs = (2 * (ab - ma * mb) + 9e-4) / (aa - ma * ma + bb - mb * mb + 9e-4)
        return cs * (2 * ma * mb + 1e-4) / (ma * ma + mb * mb + 1e-4), cs

    a, b = (torch.from_numpy(v).permute(0, 3, 1, 2).float() / 255 for v in (x, y))
    scales, ssim = [], None
    while min(a.shape[2:]) >= 11:
        similarity, structure = maps(a, b)
        ssim = similarity.mean((1, 2, 3)) if ssim is None else ssim
        scales.append((similarity.mean((2, 3)), structure.mean((2, 3))))
        a, b = functional.avg_pool2d(a, 2), functional.avg_pool2d(b, 2)
    return ssim, torch.stack([s[1] for s in scales[:-1]] + [scales[-1][0]]).prod(0)


def bare_audit(folder):
    import faiss
    from PIL import Image

    faiss.omp_set_num_threads(1)
    sets = []
    for part in ("a", "b"):
        rows = []
        for file in sorted((folder / part).rglob("*.png")):
            with Image.open(file) as image:
                small = image.convert("RGB").resize((32, 32), Image.Resampling.BOX)
            rows.append(np.asarray(small, np.float32).ravel())
        x = np.stack(rows)
        x -= x.mean(1, keepdims=True)
        sets.append(x / np.linalg.norm(x, axis=1, keepdims=True))
    index = faiss.IndexFlatIP(sets[0].shape[1])
    index.add(sets[0])
    index.search(sets[1], 1)


def read_list(path):
    import polars as pl

    table = pl.read_csv(path, has_header=False, new_columns=["path", "label"])
    name = pl.col("path").str.split_exact("/", 1)
    table = table.with_columns(video=name.struct[0], frame=name.struct[1].str.head(10).cast(int))
    return table.group_by("video").agg(pl.len()), table


def bare_audit_lists(folder):
    (_, a), (videos, b) = (read_list(folder / f"{part}.txt") for part in ("a", "b"))
    b.sort("frame").join_asof(a.sort("frame"), on="frame", by="video", strategy="nearest")
    videos.join(a, on="video", how="semi")


def bare_split(folder):
    import polars as pl

    videos, table = read_list(folder / "all.txt")
    shares = pl.col("len").cum_sum() / pl.col("len").sum()
    part = pl.when(shares < 0.8).then(pl.lit("train")).otherwise(pl.lit("test"))
    parts = videos.sort("len", "video").with_columns(part=part)
    table.join(parts, on="video").select("path", "part").write_csv(folder / "bare.csv")


def bare_torch(folder):
    import torch  # noqa: F401


# --- ours ---------------------------------------------------------------------------------------


def score(folder):
    import palpate

    palpate.score(folder / "a", folder / "b", encoder="palpate/mini")


def audit_images(folder):
    import palpate

    palpate.audit(folder / "a.csv", folder / "b.csv")


def audit_lists(folder):
    import palpate

    palpate.audit(folder / "a.txt", folder / "b.txt")


def split_lists(folder):
    import palpate

    palpate.split(folder / "all.txt").save(folder / "split.json")


def start_score(folder):
    from palpate.core import quiet
    from palpate.encoders.guard import load_encoders
    from palpate.evaluation import scoring  # noqa: F401

    load_encoders("palpate/mini", quiet, alone=True)


def start_probe(folder):
    from palpate.core import quiet
    from palpate.encoders.guard import load_encoders
    from palpate.evaluation import probing  # noqa: F401

    load_encoders("palpate/mini", quiet)


def start_generate(folder):
    from palpate.diffusion.pipeline import TactilePipeline

    TactilePipeline.from_pretrained("palpate/mini")


def tmmd(**options):
    def run(x, y):
        from palpate.metrics import tmmd

        return tmmd(x, y, permutations=0, **options).value

    return run


def tmmd_in_groups(x, y):
    from palpate.metrics import tmmd

    sides = zip(("groups", "reference_groups"), "xy", (x, y), strict=True)
    groups = {name: [f"{s}{k % VIDEOS}" for k in range(len(v))] for name, s, v in sides}
    return tmmd(x, y, permutations=999, **groups).value


def kid(x, y):
    from palpate.metrics import kid

    return kid(x, y).value


def fid(x, y):
    from palpate.metrics import fid

    return fid(x, y).value


def ssim(x, y):
    from palpate.metrics.images import per_image, scale_means

    means = scale_means(x, y)
    return [per_image(name, x, y, means).score().value for name in ("SSIM", "MS-SSIM")]


# --- rows ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        words: what it is.
        bare_words: what the bare work is.
        ours, bare: functions of a folder that ``prepare`` filled, or of two arrays.
        n: samples a side; 0 where nothing grows.
        wanted: ratio.
        prepare: makes the files; None for arrays of features, ``"images"`` for arrays of images.
    """

    words: str
    bare_words: str
    ours: Any
    bare: Any
    n: int
    wanted: float
    prepare: Any = None


PRODUCTS = "every product once"
ROWS = {
    "score": Row(
        "`score` of images of 128 px",
        "decode, resize, forward, one MMD",
        score,
        bare_score,
        2000,
        1.6,
        image_folders,
    ),
    "tmmd": Row(
        "TMMD with interval, no groups", PRODUCTS, tmmd(backend="blocked"), bare_products, 2000, 1.4
    ),
    "multi": Row("the same, `multi`", PRODUCTS, tmmd(sigma="multi"), bare_products, 2000, 2.0),
    "groups": Row(
        "TMMD, 200 groups, 999 permutations", PRODUCTS, tmmd_in_groups, bare_products, 2000, 1.3
    ),
    "kid": Row("KID with interval", "all pairs", kid, bare_polynomial, 2000, 1.0),
    "fid": Row("FID with interval, d = 512", "one distance, sqrtm", fid, bare_fid, 2000, 1.3),
    "ssim": Row(
        "SSIM and MS-SSIM of pairs", "grouped convolution", ssim, bare_ssim, 200, 1.0, "images"
    ),
    "audit": Row(
        "`audit` of images", "thumbnails, faiss flat", audit_images, bare_audit, 2000, 1.6, tables
    ),
    "audit-lists": Row(
        "`audit` of lists, rows in all",
        "polars: read, join",
        audit_lists,
        bare_audit_lists,
        250_000,
        3.0,
        lists,
    ),
    "split": Row(
        "`split` of a list",
        "polars: read, group, write",
        split_lists,
        bare_split,
        250_000,
        4,
        lists,
    ),
    "start-score": Row(
        "start of `score`", "`import torch`", start_score, bare_torch, 0, 1.6, nothing
    ),
    "start-probe": Row(
        "start of `probe`", "`import torch`", start_probe, bare_torch, 0, 1.6, nothing
    ),
    "start-generate": Row(
        "start of `generate`", "`import torch`", start_generate, bare_torch, 0, 1.6, nothing
    ),
}


def inputs(row, n):
    """Two arrays of a metric."""
    if row.prepare == "images":
        return [np.stack([*smooth_images(n, seed)]) for seed in (0, 1)]
    return [features(n, seed) for seed in (0, 1)]


def run_here(name, side, folder, n):
    """One side of a row, in this process: CPU seconds of a metric, 0 for all of the process."""
    row = ROWS[name]
    work = getattr(row, side)
    if callable(row.prepare):
        work(Path(folder))
        return 0.0
    x, y = inputs(row, n)
    work(x[:600], y[:600])  # imports and first-use costs
    start = time.process_time()
    work(x, y)
    return time.process_time() - start


def in_a_process(name, side, folder, n):
    """(CPU seconds, MiB) of one side of a row."""
    env = os.environ | dict.fromkeys(THREADS, "1") | {"HF_HUB_OFFLINE": "1"}
    command = [sys.executable, __file__, "--one", name, side, str(folder), str(n)]
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        out, errors = run.stdout.read(), run.stderr.read()
        _, status, usage = os.wait4(run.pid, 0)
        run.returncode = os.waitstatus_to_exitcode(status)
    if run.returncode:
        raise RuntimeError(f"{name}, {side}: {errors.decode()[-2000:]}")
    inside = float(out.decode().split()[-1])
    return inside or usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def measure(name, turns, growth):
    """Numbers of a row."""
    row, sides, least = ROWS[name], ("ours", "bare"), {}
    for n in (row.n, 4 * row.n)[: 1 + (growth and row.n > 0)]:
        with tempfile.TemporaryDirectory() as folder:
            if callable(row.prepare):
                row.prepare(Path(folder), n)
            each = [
                [in_a_process(name, side, folder, n) for side in sides]
                for _ in range(turns if n == row.n else 1)
            ]
        least[n] = np.min(each, axis=0)
    (ours, mib), (bare, bare_mib) = least[row.n].tolist()
    grown = (least[4 * row.n] / least[row.n])[:, 0].tolist() if len(least) > 1 else [None, None]
    return {
        "name": name,
        "ours": ours,
        "bare": bare,
        "ratio": ours / bare,
        "growth": grown,
        "mib": [mib, bare_mib],
    }


def table(results):
    lines = [
        "| work | n | bare | ours, s | bare, s | ratio | wanted | n to 4 n | MiB: ours, bare |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for r in results:
        row = ROWS[r["name"]]
        grown = ", ".join("-" if g is None else f"{g:.1f}" for g in r["growth"])
        memory = ", ".join(f"{m:.0f}" for m in r["mib"])
        n = f"{row.n:,}" if row.n else "-"
        lines.append(
            f"| {row.words} | {n} | {row.bare_words} | {r['ours']:.2f} | {r['bare']:.2f} "
            f"| {r['ratio']:.2f} | {row.wanted:.1f} | {grown} | {memory} |"
        )
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=tuple(ROWS), default=tuple(ROWS))
    parser.add_argument("--turns", type=int, default=3, help="the least counts")
    parser.add_argument("--no-growth", action="store_true", help="n alone")
    parser.add_argument("--write", type=Path, help="Markdown file to write")
    parser.add_argument("--one", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        name, side, folder, n = options.one
        print(run_here(name, side, folder, int(n)))
        return
    results = []
    for name in options.only:
        results.append(measure(name, options.turns, not options.no_growth))
        print(json.dumps(results[-1]), flush=True)
    print(table(results))
    if options.write:
        today = datetime.date.today().isoformat()
        head = f"{platform.machine()}, one thread, NumPy {np.__version__}, {today}."
        text = ["# What it costs", "    python benchmarks/verbs.py", head, table(results)]
        options.write.write_text("\n\n".join(text) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

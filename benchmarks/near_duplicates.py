"""Near-duplicate search against scikit-learn's and imagededup's brute force, on the same feature vectors, side by side.

    python benchmarks/near_duplicates.py                      # N = 50,000, one and two threads
    python benchmarks/near_duplicates.py --scaling            # 10,000 / 50,000 / 100,000, and faiss at 200,000

imagededup is optional: `pip install --no-deps imagededup` (its search needs neither torch nor torchvision; only those modules are
imported here), or unpack its wheel and pass `--imagededup FOLDER`.

Features (all unit float32 vectors, d = 64 unless said):
  videos      DCT coefficients of smooth random images, spectrum 1/f^1.5, 126 videos, each a slow drift: what frames of recordings look
              like
  images      the same, every image independent: nothing is a near-duplicate of anything
  images-128  the same with d = 128
  clips       the 64 lowest DCT coefficients of the real clips' vision frames, each with random shifts up to 4 of 64 pixels, brightness
              +-5 % and noise (needs the shared data and PyAV)
  descriptors the audit's own vectors, d = 327 (palpate.leakage.descriptors.search_vectors), of the real clips' vision frames with random
              shifts up to 4 of 36 pixels, brightness +-5 % and noise: what an audit really searches
  isotropic   Gaussian directions with no structure at all: no search prunes these

Tasks, each with its rival on the same float32 vectors, every run in a process of its own with the threads named:
  k=1     the nearest other row of each row: nearest(x, x, self_join=True) / NearestNeighbors(algorithm="brute").kneighbors()
  k=1 <= radius  the same, but only rows within the radius printed: what a scan for near-duplicates asks. scikit-learn has no such search;
                 its k=1 is the rival
  radius  all pairs within the radius printed: pairs_within(x, r) /
          NearestNeighbors(algorithm="brute").radius_neighbors(sort_results=False)

Both exact; the answers are compared. Seconds are wall time and (cpu) the processor time of all threads, the best of --repeats; the ratio
is of processor time with one thread (steadier on a shared machine) and of wall time else. Peak is the resident memory of the whole process
at its highest: interpreter, libraries, features, search.

imagededup searches 64-bit hashes, not vectors: it is given the signs (against the median) of the first 64 coefficients of the same
features, at its default tolerance of 10 bits. Its cost is the same for every query, so some queries against all N are timed and
multiplied by N / queries; the output says so. Its own Hamming function lives in a module that imports torchvision and formats strings; an
integer popcount, which is faster, stands in for it.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ALL = ("videos", "images", "images-128", "clips", "descriptors", "isotropic")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=50_000)
    parser.add_argument("--kinds", nargs="+", default=ALL, choices=ALL)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--queries",
        type=int,
        default=40,
        help="queries timed for imagededup's compiled search; a tenth of them for its Python search",
    )
    parser.add_argument(
        "--imagededup", type=Path, help="folder of the unpacked wheel, if it is not installed"
    )
    parser.add_argument("--scaling", action="store_true")
    parser.add_argument(
        "--child", nargs=4, metavar=("TASK", "FEATURES", "RADIUS", "OUT"), help=argparse.SUPPRESS
    )
    args = parser.parse_args()
    if args.child:
        child(args)
        return
    print(
        f"numpy {np.__version__}, {platform.machine()}, {os.cpu_count()} cores, seed {args.seed}, {time.strftime('%Y-%m-%d')}; load {os.getloadavg()[0]:.1f} at the start",
        flush=True,
    )
    with tempfile.TemporaryDirectory() as folder:
        (scaling if args.scaling else compare)(args, Path(folder))


# ---- features


def features(kind, n, seed):
    """(n, d) unit float32 vectors, or None where the kind's data is missing."""
    rng = np.random.default_rng(seed)
    if kind in ("clips", "descriptors"):
        x = (clip_features if kind == "clips" else audit_vectors)(n, rng)
        if x is None:
            return None
    elif kind == "isotropic":
        x = rng.normal(size=(n, 64))
    else:
        d = 128 if kind == "images-128" else 64
        f = np.hypot(*np.meshgrid(np.arange(16), np.arange(16))).ravel()
        spectrum = np.sort(f)[1 : d + 1] ** -1.5
        x = rng.normal(size=(n, d)) if kind != "videos" else drift(rng, n, d)
        x *= spectrum
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def drift(rng, n, d, videos=126, step=0.05):
    """A stationary walk in each video: consecutive frames correlate at sqrt(1 - step^2)."""
    frames = -(-n // videos)
    x = np.empty((videos, frames, d))
    x[:, 0] = rng.normal(size=(videos, d))
    for t in range(1, frames):
        x[:, t] = np.sqrt(1 - step**2) * x[:, t - 1] + step * rng.normal(size=(videos, d))
    return x.reshape(-1, d)[:n]


def clip_frames(size, mode):
    """The real clips' vision frames at a small size, or None where data or PyAV are missing."""
    from PIL import Image

    root = Path(
        os.environ.get(
            "PALPATE_SHARED_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"
        )
    )
    files = sorted(root.glob("touch_and_go/clips/dataset/*/video.mp4"))
    try:
        import av
    except ImportError:
        return None
    frames = []
    for file in files:
        with av.open(str(file)) as video:
            frames += [
                np.asarray(
                    Image.fromarray(f.to_ndarray(format="rgb24"))
                    .convert(mode)
                    .resize((size, size), Image.Resampling.BOX),
                    np.float32,
                )
                for f in video.decode(video=0)
            ]
    return np.stack(frames) if frames else None


def varied(frames, n, side, rng):
    """Blocks of n frames in turn, each shifted, brighter or darker, and noisy."""
    room = frames.shape[1] - side
    for start in range(0, n, 1000):
        which = np.arange(start, min(start + 1000, n)) % len(frames)
        shift = rng.integers(0, room + 1, size=(len(which), 2))
        cut = np.stack(
            [frames[w, a : a + side, b : b + side] for w, (a, b) in zip(which, shift, strict=True)]
        )
        gain = rng.uniform(0.95, 1.05, size=(len(which),) + (1,) * (cut.ndim - 1))
        yield start, cut * gain + rng.normal(scale=2, size=cut.shape)


def clip_features(n, rng):
    """Low DCT coefficients of varied real frames."""
    from scipy.fft import dctn

    frames = clip_frames(72, "L")
    if frames is None:
        return None
    order = np.argsort(np.add.outer(np.arange(11) ** 2, np.arange(11) ** 2).ravel(), kind="stable")[
        1:65
    ]
    out = np.empty((n, 64))
    for start, cut in varied(frames, n, 64, rng):
        out[start : start + len(cut)] = dctn(cut, axes=(1, 2), norm="ortho")[:, :11, :11].reshape(
            len(cut), -1
        )[:, order]
    return out


def audit_vectors(n, rng):
    """What the audit searches: vectors of band-passed thumbnails of varied real frames."""
    from palpate.leakage.background import planar
    from palpate.leakage.descriptors import search_vectors
    from palpate.leakage.pool import quantized
    from palpate.leakage.verify import band_pass

    frames = clip_frames(36, "YCbCr")
    if frames is None:
        return None
    return np.concatenate(
        [
            search_vectors(quantized(band_pass(planar(np.clip(cut, 0, 255).astype(np.uint8)))))
            for _, cut in varied(frames, n, 32, rng)
        ]
    )


# ---- one measurement, in a process of its own


def child(args):
    task, file, radius, out = args.child
    x, radius = np.load(file), float(radius)
    call = TASKS[task]
    if args.imagededup:
        sys.path.insert(0, str(args.imagededup))
    call(
        x[:2000] if not task.startswith("imagededup") else x[:50], radius, args
    )  # imports, warm-up
    times = []
    for _ in range(1 if task.startswith("imagededup") else args.repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        answer = call(x, radius, args)
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
        if "seconds" in answer:
            times[-1] = answer.pop("seconds")
    arrays = {key: value for key, value in answer.items() if isinstance(value, np.ndarray)}
    np.savez(out, **arrays)
    best = [min(column) for column in zip(*times, strict=True)]
    peak = peak_memory()
    print(
        json.dumps(
            {"wall": best[0], "cpu": best[1], "peak": peak}
            | {k: v for k, v in answer.items() if k not in arrays}
        )
    )


def peak_memory():
    """MiB; Linux keeps ru_maxrss of the parent across a fork, but not VmHWM."""
    status = Path("/proc/self/status")
    if status.exists():
        return (
            next(
                int(line.split()[1])
                for line in status.read_text().splitlines()
                if line.startswith("VmHWM")
            )
            / 2**10
        )
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def ours_nearest(x, radius, args, backend="exact"):
    from palpate.leakage.search import nearest

    found = nearest(x, x, self_join=True, backend=backend)
    return {"index": found.index[:, 0], "distance": found.distance[:, 0], "backend": found.backend}


def ours_nearest_within(x, radius, args):
    from palpate.leakage.search import nearest

    found = nearest(x, x, self_join=True, radius=radius, backend="exact")
    return {"index": found.index[:, 0], "distance": found.distance[:, 0]}


def ours_radius(x, radius, args):
    from palpate.leakage.search import pairs_within

    return {"pairs": sum(len(i) for i, _, _ in pairs_within(x, radius))}


def ours_clusters(x, radius, args):
    from palpate.leakage.search import clusters_within

    return {"clusters": len(np.unique(clusters_within(x, radius)))}


def sklearn_nearest(x, radius, args):
    from sklearn.neighbors import NearestNeighbors

    distance, index = NearestNeighbors(n_neighbors=1, algorithm="brute").fit(x).kneighbors()
    return {"index": index[:, 0], "distance": distance[:, 0]}


def sklearn_radius(x, radius, args):
    from sklearn.neighbors import NearestNeighbors

    _, index = (
        NearestNeighbors(radius=radius, algorithm="brute")
        .fit(x)
        .radius_neighbors(sort_results=False)
    )
    return {"pairs": sum(map(len, index)) // 2}


def hashes(x):
    bits = x[:, :64] > np.median(x[:, :64], axis=0)
    packed = np.packbits(bits, axis=1)
    return {f"{i}.jpg": row.tobytes().hex() for i, row in enumerate(packed)}


def popcount(a, b):
    return (int(a, 16) ^ int(b, 16)).bit_count()


def imagededup_python(x, radius, args):
    from imagededup.handlers.search.brute_force import BruteForce

    table = hashes(x)
    return timed_queries(
        BruteForce(table, popcount).search, list(table.values()), max(2, args.queries // 10)
    )


def imagededup_compiled(x, radius, args):
    from imagededup.handlers.search.brute_force_cython import BruteForceCython

    table = hashes(x)
    return timed_queries(
        BruteForceCython(table, popcount).search, list(table.values()), args.queries
    )


def imagededup_kernel(x, radius, args):
    """The compiled loop alone, its two lists made once instead of once a query."""
    import brute_force_cython_ext

    table = hashes(x)
    names, values = [name.encode() for name in table], [int(value, 16) for value in table.values()]
    return timed_queries(
        lambda query, tol: brute_force_cython_ext.query(names, values, int(query, 16), tol),
        list(table.values()),
        args.queries,
    )


def timed_queries(search, values, count):
    chosen = values[:: max(1, len(values) // count)][:count]
    wall, cpu = time.perf_counter(), time.process_time()
    for value in chosen:
        search(query=value, tol=10)
    scale = len(values) / len(chosen)
    return {
        "seconds": ((time.perf_counter() - wall) * scale, (time.process_time() - cpu) * scale),
        "timed": len(chosen),
    }


TASKS = {
    "palpate k=1": ours_nearest,
    "palpate k=1 <= radius": ours_nearest_within,
    "palpate radius": ours_radius,
    "palpate clusters": ours_clusters,
    "palpate faiss k=1": lambda x, radius, args: ours_nearest(x, radius, args, "faiss"),
    "sklearn k=1": sklearn_nearest,
    "sklearn radius": sklearn_radius,
    "imagededup python": imagededup_python,
    "imagededup compiled": imagededup_compiled,
    "imagededup kernel": imagededup_kernel,
}


# ---- tables


def run(args, folder, task, file, radius, threads):
    """The child's numbers, or None with a line saying why."""
    out = folder / "answer.npz"
    limits = {
        name: str(threads)
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    }
    command = [
        sys.executable,
        __file__,
        "--child",
        task,
        str(file),
        str(radius),
        str(out),
        "--repeats",
        str(args.repeats),
        "--queries",
        str(args.queries),
    ]
    if args.imagededup:
        command += ["--imagededup", str(args.imagededup.resolve())]
    done = subprocess.run(
        command, env=os.environ | limits, capture_output=True, text=True, check=False
    )
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "killed"
        print(f"    {task:22s} skipped: {reason}", flush=True)
        return None
    with np.load(out) as answer:
        return json.loads(done.stdout.splitlines()[-1]) | dict(answer)


def line(task, threads, found, rest=""):
    print(
        f"    {task:22s} {threads} thread{'s' * (threads > 1)}  {found['wall']:8.2f} s ({found['cpu']:8.2f} cpu)  peak {found['peak']:5.0f} MiB  {rest}",
        flush=True,
    )


def ratio(rival, mine, threads):
    clock = "cpu" if threads == 1 else "wall"
    return f"{rival[clock] / mine[clock]:.1f} x palpate's {'cpu ' if threads == 1 else ''}time"


def compare(args, folder):
    for kind in args.kinds:
        x = features(kind, args.n, args.seed)
        if x is None:
            print(f"{kind}: skipped, no clips found or PyAV missing", flush=True)
            continue
        file = folder / "features.npy"
        np.save(file, x)
        radius = None
        for threads in args.threads:
            mine = run(args, folder, "palpate k=1", file, 0, threads)
            if radius is None:
                radius = float(np.quantile(mine["distance"], 0.25)) * (
                    1 + 1e-6
                )  # between distances: they are rounded to float32
                print(
                    f"{kind}: N = {len(x):,}, d = {x.shape[1]}, nearest other row at {np.median(mine['distance']):.3f} (median); radius {radius:.4f}",
                    flush=True,
                )
            line("palpate k=1", threads, mine)
            rival = run(args, folder, "sklearn k=1", file, 0, threads)
            if rival:
                agree = (rival["index"] == mine["index"]).mean()
                worst = np.abs(rival["distance"] - mine["distance"]).max()
                line(
                    "sklearn k=1",
                    threads,
                    rival,
                    f"{ratio(rival, mine, threads)}; same row {agree:.2%}, distances differ by {worst:.0e} at most",
                )
            other = run(args, folder, "palpate faiss k=1", file, 0, threads)
            if other:
                line(
                    "palpate faiss k=1",
                    threads,
                    other,
                    f"{ratio(other, mine, threads)}; recall {(other['index'] == mine['index']).mean():.4f}; {other['backend']}",
                )
            near = run(args, folder, "palpate k=1 <= radius", file, radius, threads)
            same = np.array_equal(
                near["index"], np.where(mine["distance"] <= np.float32(radius), mine["index"], -1)
            )
            note = f"; sklearn k=1 takes {ratio(rival, near, threads)}" if rival else ""
            line(
                "palpate k=1 <= radius",
                threads,
                near,
                f"{(near['index'] >= 0).mean():.1%} of rows have one; same as k=1 cut at the radius: {same}{note}",
            )
            pairs = run(args, folder, "palpate radius", file, radius, threads)
            line("palpate radius", threads, pairs, f"{pairs['pairs']:,} pairs")
            rival = run(args, folder, "sklearn radius", file, radius, threads)
            if rival:
                line(
                    "sklearn radius",
                    threads,
                    rival,
                    f"{ratio(rival, pairs, threads)}; {rival['pairs']:,} pairs",
                )
            joined = run(args, folder, "palpate clusters", file, radius, threads)
            line("palpate clusters", threads, joined, f"{joined['clusters']:,} clusters")
            if threads == 1 and kind == args.kinds[0]:
                for task in ("imagededup kernel", "imagededup compiled", "imagededup python"):
                    rival = run(args, folder, task, file, radius, 1)
                    if rival:
                        note = f"{rival['timed']} of {len(x):,} queries timed, scaled up"
                        line(
                            task,
                            1,
                            rival,
                            f"{ratio(rival, mine, 1)} (k=1), {rival['cpu'] / pairs['cpu']:.0f} x (radius); {note}",
                        )


def scaling(args, folder):
    for kind in [k for k in args.kinds if k in ("videos", "images")]:
        for n in (10_000, 50_000, 100_000, 200_000):
            x = features(kind, n, args.seed)
            file = folder / "features.npy"
            np.save(file, x)
            print(f"{kind}: N = {n:,}, d = {x.shape[1]}", flush=True)
            mine = run(args, folder, "palpate k=1", file, 0, 1)
            line("palpate k=1", 1, mine, "exact")
            radius = float(np.quantile(mine["distance"], 0.25))
            pairs = run(args, folder, "palpate radius", file, radius, 1)
            line("palpate radius", 1, pairs, f"{pairs['pairs']:,} pairs within {radius:.4f}")
            other = run(args, folder, "palpate faiss k=1", file, 0, 1)
            if other:
                line(
                    "palpate faiss k=1",
                    1,
                    other,
                    f"{ratio(other, mine, 1)}; recall {(other['index'] == mine['index']).mean():.4f}; {other['backend']}",
                )


if __name__ == "__main__":
    main()

"""What must stay while palpate gets smaller: numbers, verdicts, pixels, steps, cost.

    python benchmarks/frozen.py --write              # once, before the first cut
    python benchmarks/frozen.py --compare            # prints what differs, exit status 1 if any
    python benchmarks/frozen.py --compare --only metrics lists

``frozen.json`` is never written over: a later change that means to change a figure deletes that
part of the file and runs ``--write --only PART`` again, with its reason in the commit. Values of
the metrics are compared with ``frozen.json`` and with double loops over pairs, which stand here.
Digests of formats, names of fields and times may differ. The lists of Touch and Go are looked for
in ``../shared/data``, or in ``$PALPATE_SHARED_DATA``.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import hashlib
import itertools
import json
import math
import os
import re
import statistics
import subprocess
import sys
import tempfile
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import stats

from palpate.core import Score
from palpate.report.labels import label_of, subject_of

TOP = Path(__file__).resolve().parents[1]
FROZEN = Path(__file__).with_suffix(".json")
LISTS = Path(os.environ.get("PALPATE_SHARED_DATA", TOP.parent / "shared" / "data"))
#: Rows that went with what they measured: a pattern of names, and why.
GONE: dict[str, str] = {}
#: How far a number may be from the frozen one, relative to it: rounding alone.
NEAR = 1e-9
#: Arithmetic of torch and of JPEG files differs between processors; levels of 255.
NEAR_PIXELS, NEAR_TORCH = 4, 1e-4
#: So do the fitted limits of near-duplicates in the world's JPEG frames: one commit gave .8315 and
#: .8321 on two processors. Counts of leaks are exact.
NEAR_WORLD = 2e-3
#: CPU seconds and memory, as multiples of the fixed work, may grow by this share.
COST = 0.15


def palpate(*words, cwd, expect=(0,)):
    """The JSON that a command prints."""
    command = [sys.executable, "-m", "palpate", *map(str, words), "--json"]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
    assert done.returncode in expect, f"{command}: {done.stderr[-2000:]}"
    return json.loads(done.stdout) | {"exit": done.returncode}


# ---- metrics: double loops over pairs, by the equations of the paper -------------------------


def samples(seed, draw, classes, videos, frames, width=5):
    """Unit rows with effects of class and video: features, classes, videos, ids."""
    fixed, rng = np.random.default_rng(seed), np.random.default_rng([seed, draw])
    rows, labels, groups, ids = [], [], [], []
    for c, v in itertools.product(range(classes), range(videos)):
        center = 1.5 + (fixed if v == 0 else rng).normal(size=width) + c
        for f in range(frames[v % len(frames)]):
            rows.append(center + 0.4 * rng.normal(size=width))
            labels.append(f"m{c}")
            groups.append(f"c{c}v{v}")
            ids.append(f"c{c}v{v}/{f}")
    x = np.array(rows)
    return x / np.linalg.norm(x, axis=1, keepdims=True), labels, groups, ids


def kernel(a, b, sigma=10.0):
    return math.exp(
        -sum((float(p) - float(q)) ** 2 for p, q in zip(a, b, strict=True)) / 2 / sigma**2
    )


def loop_mmd(x, y, estimator, of_x=None, of_y=None):
    """Eq. 2, times 1000: pairs of equal rows (unbiased) or of one video (grouped) left out."""

    def mean(a, b, of_a, of_b, same):
        terms = [
            kernel(a[i], b[j])
            for i, j in itertools.product(range(len(a)), range(len(b)))
            if not (estimator == "unbiased" and same and i == j)
            and not (estimator == "grouped" and of_a[i] == of_b[j])
        ]
        return math.fsum(terms) / len(terms)

    within = mean(x, x, of_x, of_x, True) + mean(y, y, of_y, of_y, True)
    return 1000 * (within - 2 * mean(x, y, of_x, of_y, False))


def excess(x, groups):
    """Mean kernel within videos less that between them, videos of the same weight, x 1000."""
    size, sums = Counter(groups), {True: [], False: []}
    for i, j in itertools.permutations(range(len(x)), 2):
        weight = 1 / size[groups[i]] / size[groups[j]]
        sums[groups[i] == groups[j]].append((kernel(x[i], x[j]) * weight, weight))
    within, between = (
        math.fsum(k for k, _ in sums[same]) / math.fsum(w for _, w in sums[same])
        for same in (True, False)
    )
    return 1000 * (within - between)


def share(groups):
    """Mean of Eq. 3 over all halvings into whole videos, as a multiple of the excess."""
    sizes, half = np.array(list(Counter(groups).values())), len(groups) / 2
    return (sizes * (sizes - 1)).sum() / (half * (half - 1))


def jackknife(value, replicates):
    """The 95 % interval from leaving each video out."""
    n, values = len(replicates), np.array(replicates)
    error = math.sqrt((n - 1) / n * ((values - values.mean()) ** 2).sum())
    reach = stats.t.ppf(0.975, n - 1) * error
    return [value - reach, value + reach]


def free_by_loops(x, labels, groups, shares):
    """I-, CI-, D-TMMD in halves of whole videos: Eqs. 3, 5 and 7."""
    names = sorted(shares["class"])
    part = {c: np.array(labels) == c for c in names}
    of = {c: [g for g, k in zip(groups, part[c], strict=True) if k] for c in names}
    own = {c: shares["class"][c] * excess(x[part[c]], of[c]) for c in names}
    matrix = [
        [
            own[a] if a == b else loop_mmd(x[part[a]], x[part[b]], "grouped", of[a], of[b])
            for b in names
        ]
        for a in names
    ]
    return [
        shares["all"] * excess(x, groups),
        statistics.fmean(own.values()),
        statistics.fmean(own.values()) / statistics.fmean(map(sum, matrix)),
    ]


def ordered_by_loops(x, labels, ids):
    """The same by the paper's letter, halves in the order of the ids."""

    def halves(rows):
        rows = sorted(rows, key=lambda i: ids[i])
        cut = (len(rows) + 1) // 2
        return x[rows[:cut]], x[rows[cut:]]

    rows = {c: [i for i, v in enumerate(labels) if v == c] for c in sorted(set(labels))}
    own = [loop_mmd(*halves(r), "unbiased") for r in rows.values()]
    ratios = []
    for c, (a, value) in enumerate(zip(rows, own, strict=True)):
        others = [loop_mmd(x[rows[a]], x[rows[b]], "unbiased") for b in rows if b != a]
        ratios.append(value / (own[c] + sum(others)))
    return [loop_mmd(*halves(range(len(x))), "unbiased"), *map(statistics.fmean, (own, ratios))]


def metric_case(k):
    """Four scores of one pair of sets: rows, and what the double loops give for them."""
    from palpate.metrics import ci_tmmd, d_tmmd, i_tmmd, tmmd

    classes, videos, frames = (2, 3)[k % 2], (3, 4, 5)[k % 3], ((3,), (2, 4), (2, 3, 3))[k // 5]
    preset = ("grouped", "grouped", "grouped", "paper", "cmmd")[k % 5]
    x, labels, groups, ids = samples(k, 1, classes, videos, frames)
    y, _, real_groups, real_ids = samples(k, 2, classes, videos + k % 2, frames)
    whole = {"ids": ids, "labels": labels, "groups": groups}
    real = {"reference_ids": real_ids, "reference_groups": real_groups}
    first = tmmd(x, y, **whole, **real, preset=preset)
    halves = {} if preset == "grouped" else {"preset": "paper", "halves": "ordered"}
    scores = [first, *(f(x, **whole, **halves) for f in (i_tmmd, ci_tmmd, d_tmmd))]

    estimator = {"grouped": "grouped", "paper": "unbiased", "cmmd": "biased"}[preset]
    names, oracle = sorted({*groups, *real_groups}), []

    def without(name):
        a, b = (np.array(g) != name for g in (groups, real_groups))
        kept = [[g for g in side if g != name] for side in (groups, real_groups)]
        return loop_mmd(x[a], y[b], estimator, *kept)

    value = loop_mmd(x, y, estimator, groups, real_groups)
    oracle.append([value, *jackknife(value, [without(name) for name in names])])
    if preset == "grouped":
        by_class = {c: [g for g, v in zip(groups, labels, strict=True) if v == c] for c in labels}
        shares = {"all": share(groups), "class": {c: share(g) for c, g in by_class.items()}}
        values, replicates = free_by_loops(x, labels, groups, shares), []
        for name in sorted(set(groups)):
            keep = [i for i, g in enumerate(groups) if g != name]
            kept = [labels[i] for i in keep], [groups[i] for i in keep]
            replicates.append(free_by_loops(x[keep], *kept, shares))
        sides = zip(values, zip(*replicates, strict=True), strict=True)
        oracle += [[v, *jackknife(v, r)] for v, r in sides]
    else:  # which half a sample is in stays when a video is left out: the values alone
        oracle += [[v] for v in ordered_by_loops(x, labels, ids)]
    return scores, oracle


def metrics(_):
    """15 pairs of sets x 4 metrics: value, interval, p (TMMD) or z (I, CI), null."""
    rows = {}
    for k in range(15):
        for score, oracle in zip(*metric_case(k), strict=True):
            got = [score.value, *score.interval]
            np.testing.assert_allclose(got[: len(oracle)], oracle, rtol=1e-7, atol=1e-9)
            test = [score.details[n] for n in ("p_value", "z") if score.details.get(n) is not None]
            rows[f"{k} {score.metric}"] = [*got, *test, *(score.null or ())]
    return rows


# ---- lists and splits ------------------------------------------------------------------------


def parts(split):
    """A digest of id -> part in a split file, and the sizes of the parts."""
    table = json.loads(split.read_text())["parts"]
    assignment = {i: part for part, ids in table.items() for i in ids}
    text = "\n".join(f"{i}\t{p}" for i, p in sorted(assignment.items()))
    return [
        hashlib.sha256(text.encode()).hexdigest(),
        *sorted(Counter(assignment.values()).items()),
    ]


FACTS = (
    "train_samples",
    "test_samples",
    "groups_train",
    "groups_test",
    "groups_shared",
    "test_samples_in_shared_groups",
    "leaking_samples",
    "gap_min",
    "gap_median",
    "gap_max",
)


def lists(work):
    """What a correct audit finds in the official lists, and who is where in NoLeak splits."""
    folder, rows = LISTS / "touch_and_go" / "lists", {}
    for train, test in (("train", "test"), ("train_rough", "test_rough")):
        found = palpate(
            "audit", folder / f"{train}.txt", folder / f"{test}.txt", cwd=work, expect=(0, 1)
        )
        rows[f"{train}/{test}"] = [found[name] for name in FACTS] + [found["exit"]]
        split = work / f"{train}.json"
        command = ("split", folder / f"{train}.txt", folder / f"{test}.txt", "-o", split)
        palpate(*command, cwd=work)
        rows[f"{train}/{test} NoLeak"] = parts(split)
    published = json.loads((TOP / "src/palpate/leakage/tag_noleak.json").read_text())
    text = json.dumps(published["splits"], sort_keys=True)
    rows["TaG-NoLeak"] = hashlib.sha256(text.encode()).hexdigest()
    return rows


def world_of(work, *options):
    name = "world-" + "-".join(options)
    if not (work / name).exists():
        palpate("world", *options, "-o", work / name, cwd=work)
    return work / name


def world(work):
    """Verdicts on the demo's world, its NoLeak split, and pixels of both looks."""
    folder, rows = world_of(work, "--preset", "demo"), {}
    split = work / "noleak.json"
    for name, more in (("Orig", ()), ("NoLeak", ("--split", split))):
        if name == "NoLeak":
            palpate("split", folder, "-o", split, cwd=work)
            rows["NoLeak parts"] = parts(split)
        found = palpate("audit", folder, *more, cwd=work, expect=(0, 1, 3))
        rows[name] = [found["verdict"], found["exit"]] + [found[f] for f in FACTS]
        rows[f"{name} signals"] = {
            s["kind"]: [s["flagged"], s["threshold"]] for s in found["signals"]
        }
    for look in ("gelsight", "digit"):
        tiny = world_of(work, "--preset", "tiny", "--look", look)
        for kind in ("video_frame", "gelsight_frame"):
            files = sorted(tiny.glob(f"dataset/*/{kind}/*.jpg"))[::40][:3]
            rows[f"{look} {kind}"] = pixels(files)
    return rows


# ---- pixels and weights ----------------------------------------------------------------------


def pixels(files):
    """Images of one size as text."""
    array = np.array([np.asarray(Image.open(f).convert("RGB")) for f in files])
    data = base64.b64encode(zlib.compress(array.tobytes(), 9)).decode()
    return {"shape": list(array.shape), "pixels": data}


def unpacked(row):
    data = zlib.decompress(base64.b64decode(row["pixels"]))
    return np.frombuffer(data, np.uint8).reshape(row["shape"]).astype(int)


def generated(work):
    """Eight photos of the demo's world through the shipped generator."""
    folder = world_of(work, "--preset", "demo")
    photos = sorted(folder.glob("dataset/*/video_frame/*.jpg"))[::397][:8]
    (work / "photos").mkdir(exist_ok=True)
    for k, photo in enumerate(photos):
        (work / "photos" / f"{k}.jpg").write_bytes(photo.read_bytes())
    palpate("generate", "photos", "-o", "touches", "--seed", 3, cwd=work)
    return {"eight": pixels([next((work / "touches").rglob(f"{k}_jpg-*.png")) for k in range(8)])}


def weights(_):
    """A digest of every tensor that ships, by file, without the header that holds formats."""
    from safetensors.numpy import load_file

    rows, mini = {}, TOP / "src" / "palpate" / "mini"
    for path in sorted(mini.rglob("*.safetensors")):
        sha = hashlib.sha256()
        for name, tensor in sorted(load_file(path).items()):
            sha.update(f"{name} {tensor.dtype} {tensor.shape}".encode() + tensor.tobytes())
        rows[path.relative_to(mini).as_posix()] = sha.hexdigest()
    return rows


def engine(work):
    """Losses of a small training, and whether an interrupted one ends with the same bytes."""
    import torch
    from torch import nn

    from palpate.core import quiet
    from palpate.training.engine import Losses, Task, fit
    from palpate.training.options import Compute, LoopOptions

    torch.manual_seed(3)
    x, y = torch.randn(23, 5), torch.randn(23, 1)

    def run(folder, stop=None):
        torch.manual_seed(7)
        net = nn.Sequential(nn.Linear(5, 7), nn.Tanh(), nn.Linear(7, 1))

        def load(step):
            return {
                "rows": torch.from_numpy(step.rows),
                "noise": 0.1 * step.randn(5),
                "n": torch.tensor(step.number),
            }

        def loss(module, batch):
            if stop is not None and int(batch["n"]) == stop:
                raise KeyboardInterrupt
            error = (module(x[batch["rows"]] + batch["noise"]) - y[batch["rows"]]).square()
            return Losses(error.mean(), {}, error.detach())

        options = LoopOptions(steps=14, batch=4, lr=1e-2, warmup=3, ema=0.9, seed=5)
        task = Task("training", len(x), load, loss, "")
        log = fit(
            net, task, options, work / folder, compute=Compute(checkpoint_minutes=0), progress=quiet
        )
        state = b"".join(v.numpy().tobytes() for v in net.state_dict().values())
        return hashlib.sha256(state).hexdigest(), [line["loss"] for line in log]

    (work / "whole").mkdir(exist_ok=True)
    (work / "resumed").mkdir(exist_ok=True)
    whole, losses = run("whole")
    with contextlib.suppress(KeyboardInterrupt):
        run("resumed", stop=6)
    return {"resumed is whole": run("resumed")[0] == whole, "losses": losses}


def demo(work):
    """Every number on the demo's page: value, interval, floor by table row."""
    subprocess.run(
        [sys.executable, "-m", "palpate", "demo", "-o", "demo", "-q"], cwd=work, check=True
    )
    results = json.loads((work / "demo" / "page.json").read_text())
    rows, count = {}, Counter()
    for s in map(Score.from_json, results["scores"]):
        name = f"{subject_of(s)}: {label_of(s)}"
        count[name] += 1
        rows[f"{name} ({count[name]})"] = [s.value, *(s.interval or ()), s.floor]
    return rows


# ---- length of the paths and cost ------------------------------------------------------------


def two_folders(work):
    """300 real touches of the demo's world twice: videos apart."""
    folder = world_of(work, "--preset", "demo")
    for name, videos in (("a", slice(0, None, 2)), ("b", slice(1, None, 2))):
        (work / name).mkdir(exist_ok=True)
        for video in sorted((folder / "dataset").iterdir())[videos]:
            for file in sorted((video / "gelsight_frame").iterdir())[:12:2]:
                (work / name / f"{video.name}_{file.name}").write_bytes(file.read_bytes())
    first = sorted((folder / "dataset").iterdir())[0]
    (work / "photo.jpg").write_bytes(sorted((first / "video_frame").iterdir())[9].read_bytes())


def flows(work):
    two_folders(work)
    official = LISTS / "touch_and_go" / "lists"
    return {
        "audit": ["audit", str(official / "train.txt"), str(official / "test.txt")],
        "score": ["score", "--generated", "a", "--reference", "b", "--encoder", "palpate/mini"],
        "generate": ["generate", "photo.jpg", "-o", "touch.png"],
    }


def walk(work):
    """Files that a function of three flows runs in."""
    rows = {}
    for name, words in flows(work).items():
        script = [
            sys.executable,
            TOP / "benchmarks" / "walk.py",
            "--json",
            "walk.json",
            "--",
            "palpate",
        ]
        subprocess.run([*script, *words], cwd=work, capture_output=True)
        rows[name] = len(json.loads((work / "walk.json").read_text()))
    return rows


WORK = """
import numpy as np, zlib
x = np.random.default_rng(0).normal(size=(1500, 1500))
for _ in range(3): x = x @ x / np.abs(x).max() / 40
data = bytes(range(256)) * 40000
for _ in range(2): zlib.compress(data, 6)
table = {f"{k:07d}": k * k for k in range(600000)}
sum(table[k] for k in sorted(table, key=lambda k: k[::-1]))
"""


def measured(command, cwd):
    """CPU seconds and peak memory of a process, one thread."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    null = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command, cwd=cwd, env=environment, **null)
    _, _, usage = os.wait4(process.pid, 0)
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss


def cost(work):
    """CPU seconds and memory of three flows as multiples of a fixed work in the same turn."""
    rows, table = {}, flows(work)
    for name, words in table.items():
        turns = []
        for _ in range(3):
            fixed = measured([sys.executable, "-c", WORK], work)
            verb = measured([sys.executable, "-m", "palpate", *words], work)
            turns.append([a / b for a, b in zip(verb, fixed, strict=True)])
        rows[name] = [statistics.median(side) for side in zip(*turns, strict=True)]
    return rows


# ---- comparing -------------------------------------------------------------------------------

PARTS = (metrics, lists, world, generated, weights, engine, demo, walk, cost)


def numbers(value):
    """The numbers and words inside a row, in order."""
    if isinstance(value, dict):
        value = [item for pair in sorted(value.items()) for item in pair]
    if isinstance(value, list | tuple):
        return [v for item in value for v in numbers(item)]
    return [value]


def differs(part, old, new):
    """What is other than it was, or an empty string."""
    if isinstance(old, dict) and "pixels" in old:
        if old["shape"] != new["shape"]:
            return f"shape {old['shape']} -> {new['shape']}"
        worst = np.abs(unpacked(old) - unpacked(new)).max()
        return f"pixels by up to {worst} of 255" if worst > NEAR_PIXELS else ""
    a, b = numbers(old), numbers(new)
    if part == "walk":
        return f"{a} -> {b} files" if b > a else ""
    if part == "cost":
        more = [y / x - 1 for x, y in zip(a, b, strict=True)]
        return f"CPU {more[0]:+.0%}, memory {more[1]:+.0%}" if max(more) > COST else ""
    near = {"metrics": NEAR, "lists": NEAR, "world": NEAR_WORLD}.get(part, NEAR_TORCH)

    def equal(x, y):
        whole = part == "world" and isinstance(x, int)  # counts of samples and leaks are exact
        if whole or isinstance(x, bool | str | None) or isinstance(y, bool | str | None):
            return x == y
        return math.isclose(x, y, rel_tol=near, abs_tol=near)

    if len(a) != len(b) or not all(map(equal, a, b)):
        return f"{a} -> {b}"
    return ""


def compare(part, old, new):
    """Print the rows of a part that differ; returns how many that is not allowed of."""
    count = 0
    for name, row in old.items():
        gone = next(
            (why for pattern, why in GONE.items() if re.search(pattern, f"{part} {name}")), ""
        )
        if name not in new:
            text = f"gone: {gone}" if gone else "gone"
        else:
            text = differs(part, row, new[name])
        if text:
            print(f"{part}: {name}: {text}", flush=True)
            count += not gone
    return count


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    choice = parser.add_mutually_exclusive_group(required=True)
    choice.add_argument("--write", action="store_true", help="measure the parts that are missing")
    choice.add_argument("--compare", action="store_true")
    parser.add_argument("--only", nargs="+", choices=[p.__name__ for p in PARTS])
    parser.add_argument("--work", type=Path, help="keep what is made in this folder")
    args = parser.parse_args()
    frozen = json.loads(FROZEN.read_text()) if FROZEN.exists() else {}
    differing = 0
    with tempfile.TemporaryDirectory() as temporary:
        work = (args.work or Path(temporary)).resolve()
        work.mkdir(parents=True, exist_ok=True)
        for part in PARTS:
            name = part.__name__
            if (args.only and name not in args.only) or (args.write and name in frozen):
                continue
            if name in ("lists", "walk", "cost") and not LISTS.is_dir():
                print(f"{name}: skipped, no lists in {LISTS}", flush=True)
                continue
            rows = json.loads(json.dumps(part(work)))
            if args.write:
                frozen[name] = rows
                lines = [
                    f'"{p}": {{\n'
                    + ",\n".join(f"{json.dumps(k)}: {json.dumps(v)}" for k, v in r.items())
                    + "\n}"
                    for p, r in frozen.items()
                ]
                FROZEN.write_text("{\n" + ",\n".join(lines) + "\n}\n")
            else:
                differing += compare(name, frozen[name], rows)
    return int(differing > 0)


if __name__ == "__main__":
    sys.exit(main())

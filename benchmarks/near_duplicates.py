"""How well near-duplicates are found, on real clips and on worlds, beside twenty lines of NumPy.

    python benchmarks/near_duplicates.py --half report --seeds 0 1 2 --json

A row is a kind of data. Its videos are divided: of the *mixed* ones some frames of each press are
train and others test (1 or 2, 4 and 7 frames away), the *clean* ones are test alone. A test sample
of a mixed video leaks, one of a clean video does not. Settings are chosen on ``--half tune`` (other
worlds, the other presses of the real clips), figures are those of ``--half report``.

  auc             area under the ROC curve of the score
  recall_at_p95   leaks found at precision .95 of the ranking
  slipped_recall  leaks at least 4 frames from train that are found at a false positive rate of .01
  promised        rate at which unrelated samples may be flagged
  measured        share of the clean samples that are flagged; None where the verdict cannot tell
  verdicts        of each seed: on the mixed test part, and on the clean samples alone
  edits           share of edited copies of train images that are flagged

``--usual`` prints instead the table of the README: test samples that a perceptual hash of whole
images flags (at most 5 of 64 bits from a train image, the common setting), and those that palpate
flags, among samples that leak and samples that do not.

``twenty`` is cosine on gray 80 x 60 thumbnails minus the background (else minus the median image),
``phash`` the agreement of 64-bit perceptual hashes, ``--encoder DIR`` adds a frozen encoder.
Files are kept in ``--work`` and made once; a row takes about 10 s a seed after that.
"""

import argparse
import io
import json
import os
import sys
import time
from pathlib import Path

import numpy as np
import polars as pl
from PIL import Image
from scipy.fft import dctn

from palpate.core import quiet
from palpate.data.manifest import Manifest
from palpate.leakage.near import near_duplicates

#: Frames of a press in the worlds: train, and test by distance to train.
TRAIN, TEST = (2, 3), {4: 1, 7: 4, 10: 7}
#: The same in the real clips, whose presses are longer: position modulo 12.
REAL_TRAIN, REAL_TEST = (0, 1, 2, 3), {4: 1, 7: 4, 8: 4}
VIDEOS, CLEAN = 120, 40
#: Copies of each edit.
COPIES = 12
METADATA = ("video", "contact", "object", "session", "material", "sensor", "domain")
#: Row -> world (or ``real``), modality, and what is known: background, videos, order.
ROWS = {
    "real, backgrounds": ("real", "tactile", "bvo"),
    "real, no backgrounds": ("real", "tactile", "vo"),
    "real, no metadata": ("real", "tactile", "o"),
    "gelsight, backgrounds": ("gelsight", "tactile", "bvo"),
    "gelsight, no backgrounds": ("gelsight", "tactile", "vo"),
    "gelsight, no metadata": ("gelsight", "tactile", "o"),
    "gelsight, shuffled": ("gelsight", "tactile", ""),
    "no markers, backgrounds": ("plain", "tactile", "bvo"),
    "no markers, no backgrounds": ("plain", "tactile", "vo"),
    "digit, backgrounds": ("digit", "tactile", "bvo"),
    "digit, no backgrounds": ("digit", "tactile", "vo"),
    "photos, real": ("real", "vision", "vo"),
    "photos, worlds": ("gelsight", "vision", "vo"),
    "photos, no metadata": ("gelsight", "vision", "o"),
}


def jpeg(quality):
    def edit(image):
        file = io.BytesIO()
        image.save(file, "JPEG", quality=quality)
        return Image.open(io.BytesIO(file.getvalue())).convert("RGB")

    return edit


def crop(share, down=0.5, right=0.5):
    def edit(image):
        w, h = image.size
        x, y = (1 - share) * w * right, (1 - share) * h * down
        return image.crop((round(x), round(y), round(x + share * w), round(y + share * h)))

    return edit


def lit(change):
    return lambda image: Image.fromarray(
        np.clip(change(np.asarray(image, np.float32)) + 0.5, 0, 255).astype(np.uint8)
    )


def turned(degrees):
    return lambda image: crop(0.92)(image.rotate(degrees, Image.Resampling.BICUBIC))


#: Of these nine in ten must be found.
FIRST = {
    "mirror": lambda i: i.transpose(Image.Transpose.FLIP_LEFT_RIGHT),
    "turn 90": lambda i: i.transpose(Image.Transpose.ROTATE_90),
    "turn 180": lambda i: i.transpose(Image.Transpose.ROTATE_180),
    "darker": lit(lambda x: x * 0.6),
    "brighter": lit(lambda x: x * 1.3),
    "gray": lambda i: i.convert("L").convert("RGB"),
    "bgr": lambda i: Image.fromarray(np.asarray(i)[..., ::-1].copy()),
    "3 degrees": lambda i: i.rotate(3, Image.Resampling.BICUBIC),
    "half size": lambda i: i.resize((i.width // 2, i.height // 2), Image.Resampling.BOX),
    "crop .9": crop(0.9),
}
OTHERS = {
    "jpeg 25": jpeg(25),
    "corner crop .9": crop(0.9, 0.0, 1.0),
    "5 degrees, cropped": turned(5),
    "contrast": lit(lambda x: (x - x.mean()) * 1.3 + x.mean()),
}
EDITS = FIRST | OTHERS


# ---- data: manifests with a column ``part`` beside them


def world(work, name, half, seed):
    """The rows of a world, whose images are written once."""
    folder = work / f"{name}-{half}-{seed}"
    table = folder / "rows.json"
    if not table.is_file():
        from palpate.sim import Video, WorldOptions, plan_world

        options = WorldOptions(
            seed=1000 * (half == "report") + 10 * seed + ("gelsight", "plain", "digit").index(name),
            size=128,
            look="digit" if name == "digit" else "gelsight",
            markers=0 if name == "plain" else 8,
            objects_per_material=VIDEOS // 20,
            contacts_per_video=2,
            frames_per_contact=12,
            phases="spaced",  # as in the recorded page
            mixed=0.0,
        )
        clean = set(np.random.default_rng(seed).permutation(VIDEOS)[:CLEAN].tolist())
        rows = []
        for k, plan in enumerate(plan_world(options)):
            video = Video(options, plan)
            for contact in range(2):
                first = contact * (options.free_frames + 12) + options.free_frames
                back = folder / plan.name / f"{contact}.png"
                back.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(video.background_of(contact)).save(back)
                for at in (*TRAIN, *TEST):
                    row = {"frame": first + at, "video": plan.name, "contact": contact}
                    for kind in ("tactile", "vision"):
                        if kind == "vision" and name != "gelsight":
                            continue
                        file = back.parent / f"{kind}{first + at}.jpg"
                        image = Image.fromarray(getattr(video, kind)(first + at))
                        image.save(file, quality=95)
                        row[kind] = str(file.relative_to(folder))
                    row["background"] = str(back.relative_to(folder))
                    row["clean"], row["gap"] = k in clean, 0 if at in TRAIN else TEST[at]
                    rows.append(row)
        table.write_text(json.dumps(rows))
    return folder, json.loads(table.read_text())


def real(work, half, seed):
    """The presses of one half of the real clips; one clip is clean."""
    from palpate.data import import_dataset

    folder, data = work / "real", Path(os.environ.get("PALPATE_SHARED_DATA", "../shared/data"))
    if not (folder / "manifest.parquet").is_file():
        import_dataset(data / "touch_and_go" / "clips", folder, format="touch-and-go")
    table = Manifest.load(folder / "manifest.parquet").table
    videos = sorted(table["video"].unique())
    clean, rows = videos[seed % len(videos)], []
    for (contact,), part in table.sort("frame").group_by("contact", maintain_order=True):
        if int(contact[-4:]) % 2 != (half == "report"):
            continue
        for k, row in enumerate(part.iter_rows(named=True)):
            used = k % 12 in REAL_TRAIN or k % 12 in REAL_TEST
            if used or row["video"] == clean:
                gap = REAL_TEST.get(k % 12, 0)
                rows.append(row | {"clean": row["video"] == clean, "gap": gap})
    return folder, rows


def parts(folder, rows, modality, known, seed):
    """Train, test, whether a test sample leaks, and its distance to train."""
    rows = [dict(r, id=f"{r['video']}/{r['frame']}") for r in rows]
    train = [r for r in rows if not r["clean"] and not r["gap"]]
    test = [r for r in rows if r["clean"] or r["gap"]]
    if "o" not in known:
        np.random.default_rng(seed).shuffle(train)

    def manifest(rows):
        keep = ["id", modality] + ["background"] * ("b" in known)
        keep += ["video", "frame", "contact"] * ("v" in known)
        return Manifest.from_rows(
            [{k: str(r[k]) if k == "contact" else r[k] for k in keep} for r in rows], folder
        )

    leaks = np.array([not r["clean"] for r in test])
    return manifest(train), manifest(test), leaks, np.array([r["gap"] for r in test])


def copies(train, modality, folder, seed):
    """Edited copies of some train samples, with their backgrounds edited in the same way."""
    rng, rows = np.random.default_rng(seed), []
    for name, edit in EDITS.items():
        for k in rng.choice(len(train), COPIES, replace=False).tolist():
            row = {"id": f"{name}/{k}"}
            for column in (modality, "background"):
                if train.table[column][k] is None:
                    continue
                source = train.table["id"][k].replace("/", "-")
                file = folder / "edits" / name.replace(" ", "_") / f"{column}-{source}.png"
                if not file.is_file():
                    file.parent.mkdir(parents=True, exist_ok=True)
                    edit(Image.open(train.path(train.table[column][k])).convert("RGB")).save(file)
                row[column] = str(file.relative_to(folder))
            rows.append(row)
    return rows


# ---- rivals


def rival_scores(name, train, test, modality, encoder=None):
    """(n_test,) the highest similarity with train."""
    if name == "encoder":
        from palpate.encoders.embed import embed
        from palpate.encoders.guard import load_encoders
        from palpate.leakage.descriptors import unit

        encoders = load_encoders(encoder, quiet)
        a, b = (unit(embed(m, encoders, modality).features) for m in (train, test))
        return (b @ a.T).max(1)
    size = (80, 60) if name == "twenty" else (32, 32)

    def gray(manifest, column):
        return np.stack(
            [
                np.asarray(
                    Image.open(p).convert("L").resize(size, Image.Resampling.BOX), np.float32
                )
                for p in manifest.paths(column)
            ]
        )

    x = [gray(m, modality) for m in (train, test)]
    if train.table["background"].count():
        x = [a - gray(m, "background") for a, m in zip(x, (train, test), strict=True)]
    elif modality == "tactile":
        middle = np.median(np.concatenate(x), axis=0)
        x = [a - middle for a in x]
    if name == "phash":
        low = [dctn(a, axes=(1, 2))[:, :8, :8].reshape(len(a), -1) for a in x]
        x = [np.where(a > np.median(a, axis=1, keepdims=True), 1.0, -1.0) for a in low]
    else:
        x = [a.reshape(len(a), -1) for a in x]
        x = [a - a.mean(1, keepdims=True) for a in x]
    x = [a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-9) for a in x]
    return (x[1] @ x[0].T).max(1)


def usual_hash(files):
    """(n, 64) bits of the perceptual hash as it is commonly computed: the median of the lowest
    8 x 8 cosine coefficients of the gray 32 x 32 image."""
    gray = [
        np.asarray(Image.open(f).convert("L").resize((32, 32), Image.Resampling.LANCZOS), float)
        for f in files
    ]
    low = dctn(np.stack(gray), axes=(1, 2))[:, :8, :8].reshape(len(gray), -1)
    return low > np.median(low, axis=1, keepdims=True)


def usual(rows, half, seeds, args, bits=5):
    """The rows of the README's table: shares of leaking and of clean samples that are flagged."""
    for row in rows:
        source, modality, known = ROWS[row]
        flagged, total = np.zeros((2, 2), int), np.zeros(2, int)
        for seed in seeds:
            folder, samples = (
                real(args.work, half, seed)
                if source == "real"
                else world(args.work, source, half, seed)
            )
            train, test, leaks, _ = parts(folder, samples, modality, known, seed)
            a, b = (usual_hash(m.paths(modality)).astype(np.int64) for m in (train, test))
            near = (64 - (b @ a.T + (1 - b) @ (1 - a).T)).min(1) <= bits
            options = {"false_positives": args.promised, "cache": args.work / "thumbnails"}
            own = near_duplicates(train, test, modality, **options).flag
            for k, part in enumerate((leaks, ~leaks)):
                flagged[:, k] += near[part].sum(), own[part].sum()
                total[k] += part.sum()
        cells = [f"{100 * x:.1f} %" for x in (flagged / total).ravel()]
        print(f"| {row} | {' | '.join(cells)} | {total[0]:,} / {total[1]:,} |", flush=True)


# ---- figures


def figures(score, leaks, gap):
    """AUC, recall at precision .95, recall of slipped pairs at a false positive rate of .01."""
    score = np.nan_to_num(score, nan=-1.0)
    order = np.argsort(-score, kind="stable")
    right = np.cumsum(leaks[order])
    precise = right[right / np.arange(1, len(order) + 1) >= 0.95]
    clean = np.sort(score[~leaks])
    ranks = (
        np.searchsorted(clean, score[leaks]) + np.searchsorted(clean, score[leaks], "right")
    ) / 2
    slipped = score[leaks & (gap >= 4)]
    return {
        "auc": ranks.mean() / len(clean),
        "recall_at_p95": (precise.max() if len(precise) else 0) / leaks.sum(),
        "slipped_recall": (slipped > np.quantile(clean, 0.99)).mean(),
    }


def run(row, half, seed, args):
    """One row with one seed."""
    source, modality, known = ROWS[row]
    folder, rows = (
        real(args.work, half, seed) if source == "real" else world(args.work, source, half, seed)
    )
    train, test, leaks, gap = parts(folder, rows, modality, known, seed)
    options = {"false_positives": args.promised, "cache": args.work / "thumbnails"}
    start = time.process_time()
    flags = near_duplicates(train, test, modality, **options)
    result = {"cpu": time.process_time() - start, "samples": [len(train), len(test)]}
    result |= figures(flags.score, leaks, gap)
    alone = Manifest(test.table.filter(pl.Series(~leaks)), test.root)
    unrelated = near_duplicates(train, alone, modality, **options)
    result["verdicts"] = [flags.verdict, unrelated.verdict]
    result["flagged"] = [
        int(flags.flag[~leaks].sum()),
        int((~leaks).sum()),
        int(flags.flag[leaks].sum()),
    ]
    result["own"] = flags.measured
    if args.edits:
        more = copies(train, modality, folder, seed)
        both = Manifest.from_rows([*alone.table.iter_rows(named=True), *more], folder)
        flag = near_duplicates(train, both, modality, **options).flag[len(alone) :]
        result["edits"] = dict(
            zip(EDITS, flag.reshape(len(EDITS), -1).mean(1).tolist(), strict=True)
        )
    if args.notes:
        print(row, seed, [str(n) for n in flags.notes], flags.threshold, file=sys.stderr)
    for name in args.rivals:
        score = rival_scores(name, train, test, modality, args.encoder)
        result[name] = figures(score, leaks, gap)
    return result


def pooled(results, promised):
    """Seeds together: means of the figures, and the clean samples of all seeds."""
    mean = lambda rows: {
        k: mean([r[k] for r in rows])
        if isinstance(rows[0][k], dict)
        else round(float(np.mean([r[k] for r in rows])), 3)
        for k in rows[0]
    }
    skipped = ("verdicts", "flagged", "samples", "own")
    out = mean([{k: v for k, v in r.items() if k not in skipped} for r in results])
    out["verdicts"] = [r["verdicts"] for r in results]
    wrong, clean, right = np.sum([r["flagged"] for r in results], axis=0).tolist()
    told = all("cannot tell" not in r["verdicts"][0] for r in results)
    out |= {"promised": promised, "measured": round(wrong / clean, 4) if told else None}
    out |= {
        "clean": clean,
        "clean_flagged": wrong,
        "leaks_flagged": right,
        "samples": results[0]["samples"],
    }
    return out


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--half", choices=("tune", "report"), default="report")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--rows", nargs="+", default=list(ROWS), help="beginnings of names")
    parser.add_argument("--promised", type=float, default=0.01)
    parser.add_argument("--work", type=Path, default=Path("runs/near_duplicates"))
    parser.add_argument("--encoder", help="folder or hub id of a frozen encoder")
    parser.add_argument("--no-edits", dest="edits", action="store_false")
    parser.add_argument(
        "--no-rivals", dest="rivals", action="store_const", const=[], default=["twenty", "phash"]
    )
    parser.add_argument("--usual", action="store_true", help="the README's table")
    parser.add_argument("--notes", action="store_true")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    args.rivals = [*args.rivals, *(["encoder"] if args.encoder else [])]
    table, rows = {}, [r for r in ROWS if r.startswith(tuple(args.rows))]
    if args.usual:
        usual(rows, args.half, args.seeds, args)
        return
    for row in rows:
        table[row] = pooled([run(row, args.half, seed, args) for seed in args.seeds], args.promised)
        if args.json:
            continue
        r = table[row]
        cells = [f"{r[k]:.3f}" for k in ("auc", "recall_at_p95", "slipped_recall")]
        for name in args.rivals:
            cells += [f"| {name}", *(f"{v:.3f}" for v in r[name].values())]
        rate = "cannot tell" if r["measured"] is None else f"{r['measured']:.4f}"
        print(
            f"{row:28s}",
            *cells,
            "| measured",
            rate,
            f"of {r['clean']}; {r['cpu']:.1f} s",
            r["verdicts"],
            flush=True,
        )
        if args.edits:
            print("   ", ", ".join(f"{k} {v:.2f}" for k, v in r["edits"].items()), flush=True)
    if args.json:
        print(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()

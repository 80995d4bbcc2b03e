"""Valid inputs of every verb and reader, as small as they can be, and the commands that read them.

A command is a line; ``IN`` is the folder of inputs, ``OUT`` an empty one, ``KEPT`` one with what
the same command has written before, which it goes on from. Only the folders that the line names are
copied for it.
"""

import json
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import polars as pl

import palpate
from forge.formats import TREES
from forge.people import Crowd
from forge.pictures import gel, photo, put, write_csv, write_video
from palpate import preference
from palpate.cli import main
from palpate.data.manifest import Manifest
from palpate.preference.store import VoteStore

MINI = Path(palpate.__file__).parent / "mini"
SCORE = "score --generated IN/manifest --reference IN/manifest --split IN/split/split.json "
SCORE += "--encoder IN/models/encoders --permutations 9"
TRAIN = "train encoder IN/manifest --split IN/split/split.json --clip IN/models/encoders/clip "
TRAIN += "--epochs 1 --preset tiny --checkpoint-minutes 0"
GENERATE = "generate IN/manifest --model IN/models/generator --steps 1"
CAPTION = "caption IN/manifest --template {material} --per frame"
#: Command -> how often it is drawn next to the others; those that load models are slow. ``demo``
#: gets no further than its data, since its other stages are the other verbs.
COMMANDS: dict[str, int] = {
    "import IN/touch-and-go -o OUT/m": 3,
    "import IN/touch-and-go -o OUT/m --labels IN/touch-and-go/train.txt --max-per-contact 2": 1,
    "import IN/hct -o OUT/m": 2,
    "import IN/ssvtp -o OUT/m": 3,
    "import IN/tarf -o OUT/m": 2,
    "import IN/objectfolder-generation -o OUT/m": 2,
    "import IN/objectfolder -o OUT/m": 2,
    "import IN/ycb-slide -o OUT/m": 2,
    "import IN/intervals/contacts.csv -o OUT/m": 3,
    "import IN/pairs -o OUT/m": 2,
    "import IN/hf --format hf --map vision=rgb tactile=gel material=kind -o OUT/m": 3,
    "import IN/video -o OUT/m": 5,
    "import IN/videos --every 2 -o OUT/m": 3,
    "import IN/videos --tactile {video}/gel.npy --every 2 -o OUT/m": 2,
    "background IN/manifest -o OUT/m": 2,
    "validate IN/videos": 1,
    "import IN/table/rows.csv -o OUT/m": 4,
    "import IN/table/rows.tsv -o OUT/m --map frame=frame": 2,
    "import IN/table/rows.jsonl -o OUT/m": 3,
    "import IN/table/rows.json -o OUT/m": 3,
    "import IN/table/rows.parquet -o OUT/m --skip-bad": 4,
    "import IN/pairs --vision vision/{video}/{frame:d}.jpg "
    "--tactile tactile/{video}/{frame:d}.jpg -o OUT/m": 3,
    "import IN/video/dataset --vision {video}/video.mp4 --tactile {video}/gelsight.mp4 "
    "--every 4 -o OUT/m": 3,
    "validate IN/video/dataset --tactile {video}/gelsight.mp4": 2,
    "caption check IN/captions/captions.csv --data IN/manifest -o OUT/s.json --page OUT/p.html": 2,
    "audit IN/pairs/tactile IN/manifest --as tactile -o OUT/a.csv": 1,
    "validate IN/touch-and-go": 2,
    "validate IN/hct": 1,
    "validate IN/table/rows.csv": 2,
    "validate IN/pairs --json": 1,
    "audit IN/lists/train.txt IN/lists/test.txt -o OUT/b.json --page OUT/a.html": 6,
    "audit IN/table/rows.csv IN/table/rows.jsonl --fail-over 0.5": 2,
    "audit IN/manifest --split IN/split/split.json -o OUT/a.json --page OUT/p.html": 6,
    "audit IN/manifest IN/manifest --no-images -o OUT/a.parquet": 2,
    "audit IN/pairs/vision IN/pairs/tactile --json": 1,
    "split IN/manifest -o OUT/s.json --train 0.5": 4,
    "split IN/table/rows.csv -o OUT/s.json --by video --train 0.5": 3,
    "split IN/lists/train.txt IN/lists/test.txt -o OUT/f --folds 2": 2,
    "split IN/touch-and-go -o OUT/s.json --lists OUT/lists --train 0.5": 1,
    "score --generated IN/vectors/a.npy --reference IN/vectors/b.npy --permutations 9": 5,
    "score --generated IN/vectors/a.npz --reference IN/vectors/b.npz -o OUT/s.json": 4,
    "score --generated IN/vectors/a.npy --reference IN/vectors/b.npz "
    "--labels IN/vectors/labels.csv --page OUT/t.html --permutations 0": 4,
    "score --generated IN/generated --reference IN/manifest -o OUT/s.json "
    "--companions ssim psnr --permutations 0": 4,
    f"{SCORE} --cache KEPT/scored": 1,
    "verify IN/results/audit.json --tolerance 1e-3": 4,
    "verify IN/results/scores.json --json": 4,
    "report IN/results/audit.json IN/results/scores.json -o OUT/page.html": 8,
    "world -o OUT/w --preset tiny --size 16 --materials 2 --workers 1": 1,
    "probe IN/manifest --split IN/split/split.json --encoder IN/models/encoders -o OUT/s.json": 1,
    "generate IN/pairs/vision/rec0/0.jpg -o OUT/t.png --model IN/models/generator --steps 1": 1,
    "generate IN/manifest -o OUT/g --model IN/models/generator --steps 1 "
    "--split IN/split/split.json": 1,
    f"{TRAIN} -o KEPT/stopped/model": 1,
    "train autoencoder IN/manifest --split IN/split/split.json --preset tiny "
    "--set autoencoder.steps_free=1 -o OUT/a": 1,
    "train generator IN/manifest --split IN/split/split.json --clip IN/models/encoders "
    "--autoencoder IN/models/autoencoder --steps 1 --preset tiny -o OUT/g": 1,
    f"{GENERATE} -o KEPT/generated": 1,
    f"{CAPTION} -o OUT/c": 2,
    f"{CAPTION} -o KEPT/captions": 1,
    "presets mini": 1,
    "audit IN/photos IN/photos -o OUT/x": 1,
    "split IN/touches -o OUT/x --train 0.5": 1,
    "score --generated IN/touches --reference IN/touches -o OUT/x --permutations 0 "
    "--companions ssim": 1,
    "validate IN/photos": 1,
    "caption IN/manifest --server http://127.0.0.1:9/v1 --model x "
    "--per frame --dry-run -o OUT/c": 1,
    "preference make --reference IN/manifest --generated IN/manifest IN/generated --names a b "
    "--raters 1 --size 32 -o OUT/study": 3,
    "embed IN/manifest --encoder palpate/handcrafted -o OUT/e --slice 1/2": 1,
    "preference score IN/study IN/study/votes --replicates 100 -o OUT/s.json --latex OUT/t.tex": 4,
    "demo --data IN/vectors --preset tiny -o OUT/d": 1,
}


#: Further commands for an environment without extras: with them they take long, or do not end.
BARE = (
    "reproduce world-gelsight -o OUT/r",
    "preference serve IN/study",
    "run embed IN/manifest --encoder palpate/handcrafted -o OUT/e --slices 2",
    "view IN/manifest --model none",
)


def build(folder: Path) -> None:
    """Write all inputs below ``folder``, the same bytes every time."""
    for name, make in TREES.items():
        source = make(folder / f".{name}").source
        (source if source.is_dir() else source.parent).rename(folder / name)
        shutil.rmtree(folder / f".{name}")
    for make in (_videos, _tables, _vectors, _results, _kept):
        make(folder)
    program = folder / "bin" / "gs"  # what no image may start
    program.parent.mkdir()
    program.write_text('#!/bin/sh\ntouch "$TMPDIR/a program that an image started"\n')
    program.chmod(0o755)


def _videos(folder: Path) -> None:
    """Two recordings of twelve frames as video files, with a list of frames."""
    frames: list[str] = []
    for name in ("20220601_182052", "20220602_090000"):
        for side in ("video", "gelsight"):
            write_video(folder / "video" / "dataset" / name / f"{side}.mp4", 12)
        frames += [f"{name}/{k:010d}.jpg,3" for k in (6, 7, 8)]
    (folder / "video" / "label.txt").write_text("\n".join(frames))


def _tables(folder: Path) -> None:
    """Eight rows with images in every form of a table and as a manifest; frame lists."""
    table = folder / "table"
    rows: list[dict[str, Any]] = []
    for k in range(8):
        row = {
            "id": f"s{k}",
            "video": f"v{k // 2}",
            "frame": k,
            "material": ("Wood", "Rock")[k % 2],
        }
        for side, make in (("vision", photo), ("tactile", gel)):
            row[side] = f"{side}/{k}.png"
            put(table / row[side], make(k))
        rows.append(row)
    shutil.copytree(table, folder / "manifest")
    Manifest.from_rows(rows, folder / "manifest").save(folder / "manifest" / "manifest.parquet")
    for name, side in (("photos", "tactile"), ("touches", "vision")):
        shutil.copytree(table, folder / name)
        shutil.rmtree(folder / name / side)
        part = [{k: v for k, v in row.items() if k != side} for row in rows]
        Manifest.from_rows(part, folder / name).save(folder / name / "manifest.parquet")
    cells = [list(map(str, row.values())) for row in rows]
    write_csv(table / "rows.csv", list(rows[0]), cells)
    lines = ["\t".join(line) for line in (list(rows[0]), *cells)]
    (table / "rows.tsv").write_text("\n".join(lines))
    (table / "rows.json").write_text(json.dumps(rows))
    (table / "rows.jsonl").write_text("\n".join(map(json.dumps, rows)))
    pl.DataFrame(rows).write_parquet(table / "rows.parquet")
    (folder / "captions").mkdir()
    texts = [["id", "text"], *([f"s{k}", f"Hard, smooth and cold, {k}."] for k in range(8))]
    write_csv(folder / "captions" / "captions.csv", None, texts)
    (folder / "lists").mkdir()
    for part, videos, start in (("train", "abc", 0), ("test", "cd", 40)):
        lines = [f"{v}/{k:010d}.jpg,{k % 3}" for v in videos for k in range(start, start + 3)]
        (folder / "lists" / f"{part}.txt").write_text("\n".join(lines))


def _vectors(folder: Path) -> None:
    """Embeddings of twelve samples in both forms, twice."""
    place = folder / "vectors"
    place.mkdir()
    ids = [f"s{k}" for k in range(12)]
    labels = ["Wood" if k % 2 else "Rock" for k in range(12)]
    for seed, name in enumerate("ab"):
        x = np.random.default_rng(seed).normal(size=(12, 4)).astype(np.float32)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        np.save(place / f"{name}.npy", x)
        np.savez(place / f"{name}.npz", features=x, ids=np.array(ids), labels=np.array(labels))
    rows = [[i, label, f"v{k // 3}"] for k, (i, label) in enumerate(zip(ids, labels, strict=True))]
    write_csv(place / "labels.csv", ("id", "material", "video"), rows)


def _results(folder: Path) -> None:
    """What the other verbs leave behind: a split, an audit, scores, a world, images, models."""
    manifest, split = folder / "manifest", folder / "split" / "split.json"
    models, results = folder / "models", folder / "results"
    call("split", manifest, "-o", split, "--train", "0.5")
    shutil.copytree(manifest, results)  # a report shows images next to the results alone
    shutil.copy(split, results / "split.json")  # what is verified lies next to its inputs
    call("audit", results, "--split", results / "split.json", "-o", results / "audit.json")
    for name in ("encoders", "autoencoder", "generator"):
        shutil.copytree(MINI / name, models / name)
    call("generate", manifest, "-o", folder / "generated", "--steps", "1")
    shutil.copytree(folder / "generated", results / "generated")
    scored = ("--generated", results / "generated", "--reference", results)
    call("score", *scored, "--companions", "psnr", "-o", results / "scores.json")
    with patch("secrets.token_hex", return_value=64 * "0"):
        reference, methods = folder / "manifest", {"a": folder / "manifest", "b": results}
        plan = preference.make(reference, methods, folder / "study", raters=2, size=32)
    Crowd({"a": 1.0, "b": 0.0}).write(plan, folder / "study" / "votes")
    with closing(VoteStore(folder / "study" / "study.db", plan.study)) as store:
        votes = Crowd({"a": 0.0, "b": 1.0}).download(plan, "r01")["votes"]
        store.store([vote | {"rater": "r01", "received": ""} for vote in votes])
    options = ("--preset", "tiny", "--size", "16", "--materials", "2", "--workers", "1")
    call("world", "-o", folder / "made", *options)
    (folder / "world").mkdir()
    (folder / "made" / "world.json").rename(folder / "world" / "world.json")
    shutil.rmtree(folder / "made")


def _kept(folder: Path) -> None:
    """What commands go on from: caches, a stopped training, images and captions."""
    kept = folder / "kept"

    def words(line: str) -> list[str]:
        return [word.replace("IN/", f"{folder}/") for word in line.split()]

    call(*words(SCORE), "--cache", kept / "scored")
    call(*words(GENERATE), "-o", kept / "generated")
    call(*words(CAPTION), "-o", kept / "captions")
    with patch("palpate.training.engine._Run.draw", side_effect=KeyboardInterrupt):
        main([*words(TRAIN), "-o", str(kept / "stopped" / "model"), "-q"])


def call(*args: str | Path) -> None:
    """Run a command that must succeed; tiny sets have too few images to tell whether they leak."""
    status = main([*map(str, args), "-q"])
    if status not in (0, 3 if args[0] == "audit" else 0):
        raise RuntimeError(f"{args} ended with {status}")

"""Contacts found in tactile videos, and faults planted in them, on real clips and worlds.

    python benchmarks/contacts.py ../shared/data/touch_and_go/clips world_gelsight world_digit

Each folder has the layout of Touch and Go with videos and ``label.txt``; worlds are made with
``palpate world --layout videos --materials 4 --objects-per-material 2 --frames-per-contact 12
--free-frames 10 --size 128``. Per video: precision and recall of frames, contacts that share at
least half of their frames with a label and the reverse, backgrounds in a labeled contact. Per
folder: findings on the untouched streams, and how many planted faults are found: the second half of
another video (of another sensor, where ``manifest.parquet`` names them), 30 frames frozen, every
press cut open at frame 0, and a lag of 12 frames between the changes of the tactile stream and the
same with noise of half their deviation.
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path

import numpy as np
import polars as pl

from palpate.data.contacts import SIZE, find_contacts
from palpate.data.streams import changes_of, findings, lag_of
from palpate.data.video import VideoReader


def read(folder: Path):
    """Video -> its tactile and vision thumbnails, and which frames are labeled."""
    frames = defaultdict(set)
    for line in (folder / "label.txt").read_text().split():
        video, name = line.split(",")[0].split("/")
        frames[video].add(int(name[:10]))
    for place in sorted((folder / "dataset").iterdir()):
        images = []
        for name in ("gelsight.mp4", "video.mp4"):
            with VideoReader(place / name) as reader:
                images.append(reader.thumbnails(SIZE))
        yield place.name, *images, np.isin(np.arange(len(images[0])), list(frames[place.name]))


def runs_of(labeled):
    edges = np.flatnonzero(np.diff(np.pad(labeled.astype(int), 1))).reshape(-1, 2)
    return [(int(a), int(b) - 1) for a, b in edges]


def half(run, others):
    """Whether a run shares half of the joint frames with one of the others."""
    shared = [
        (min(run[1], b) - max(run[0], a) + 1) / (max(run[1], b) - min(run[0], a) + 1)
        for a, b in others
    ]
    return max(shared, default=0) >= 0.5


def measure(tactile, labeled):
    contacts = find_contacts(tactile)
    found = np.zeros(len(labeled), bool)
    for first, last in contacts.runs:
        found[first : last + 1] = True
    true, both = runs_of(labeled), (found & labeled).sum()
    return {
        "precision": both / max(found.sum(), 1),
        "recall": both / max(labeled.sum(), 1),
        "labeled": len(true),
        "found_of_labeled": sum(half(run, contacts.runs) for run in true),
        "found": len(contacts.runs),
        "labeled_of_found": sum(half(run, true) for run in contacts.runs),
        "backgrounds_in_contact": int(labeled[contacts.backgrounds].sum()),
    }


def planted(videos, sensors):
    """Fault -> [found, planted]."""
    counts = defaultdict(lambda: [0, 0])

    def add(fault, found):
        counts[fault][0] += bool(found)
        counts[fault][1] += 1

    rng = np.random.default_rng(0)
    for name, (tactile, _, labeled) in videos.items():
        frozen = tactile.copy()
        frozen[30:60] = frozen[30]
        add("frozen", "frozen-stream" in dict(findings({"tactile": frozen}, {})))
        change = changes_of(tactile)
        noisy = change + rng.normal(0, change.std() / 2, len(change))
        add("lag", lag_of(change[12:], noisy[:-12]))
        for first, last in runs_of(labeled):
            cut = (first + last) // 2
            if labeled[cut:].all():
                continue
            reference = find_contacts(tactile[cut:]).reference
            add("pressed at frame 0", not labeled[cut + reference])
        for other, (images, _, _) in videos.items():
            if other != name and (not sensors or sensors[other] != sensors[name]):
                both = np.concatenate([tactile[: len(tactile) // 2], images[len(images) // 2 :]])
                add("changed gel", "changed-gel" in dict(findings({"tactile": both}, {})))
    return dict(counts)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path)
    for folder in parser.parse_args().folders:
        videos = {name: tuple(rest) for name, *rest in read(folder)}
        rows = {name: measure(tactile, labeled) for name, (tactile, _, labeled) in videos.items()}
        manifest, sensors = folder / "manifest.parquet", {}
        if manifest.is_file():
            table = pl.read_parquet(manifest, columns=["video", "sensor"]).unique()
            sensors = dict(table.iter_rows())
        for name, row in rows.items():
            print(folder.name, name, json.dumps({k: round(float(v), 3) for k, v in row.items()}))
        total = {
            name: sum(row[name] for row in rows.values()) for name in next(iter(rows.values()))
        }
        total |= {name: total[name] / len(rows) for name in ("precision", "recall")}
        print(folder.name, "all", json.dumps({k: round(float(v), 3) for k, v in total.items()}))
        false = {
            name: found
            for name, (tactile, vision, _) in videos.items()
            if (found := findings({"tactile": tactile, "vision": vision}, {}))
        }
        print(folder.name, "suspected without a fault", json.dumps(false))
        print(folder.name, "planted, [found, of]", json.dumps(planted(videos, sensors)))


if __name__ == "__main__":
    main()

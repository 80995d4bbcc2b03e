"""The files of a world in each layout, so that ids are those that ``palpate import`` gives.

=============  ===========================
================================================================= layout         id
         vision image, tactile image, background
=============  ===========================
================================================================= ``frames``
``20260101_000000/``         ``dataset/<video>/video_frame/0000000012.jpg``,
               ``0000000012``               ``gelsight_frame/``; background: the frame 4 before the
               contact
``videos``     as above                     none: frames lie in ``video.mp4`` and ``gelsight.mp4``
``hct``        ``data2/4-1702596295.70/12`` ``data2/4-1702596295.70/vision/12-0.0207.jpg``,
``tactile/``,
                                            ``background.png``
=============  ===========================
=================================================================

HCT names a recording by a number that is used again and its start in Unix seconds, and a frame by
its number and a latency in seconds. Its rigs ``data1, data2 ...`` are our gel units. Its lists, one
set a rig:

- ``train.csv``, ``test.csv``: ``url,tactile,tactile_background,caption``, shuffled.
- ``contact.json``, ``not_contact.json``: ``{"tactile": [..], "vision": [..], "background": [..]}``.
- ``finetune.json``: the training rows again, ``[{image, tactile, tactile_background,
  conversations}]``.

Touch and Go's lists: ``label.txt``, ``train.txt``, ``test.txt`` (``<video>/0000000012.jpg,3``; the
latter two shuffled and without a final newline, as the official ones), ``category_reference.txt``,
and our own ``objects.csv`` and ``captions.csv``.
"""

from __future__ import annotations

import csv
import datetime
import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image

from palpate.sim.materials import MATERIALS
from palpate.sim.options import BACKGROUND_OFFSET, WorldOptions
from palpate.sim.plan import Row, VideoPlan, contact_rows, first_contact, written_frames
from palpate.sim.video import Video

#: Frames a second of videos.
FPS = 30
#: HCT's numbers of recordings run from 1 to this and begin again.
_HCT_NUMBERS = 7
_HCT_QUESTION = (
    "<image>\nThis is a tactile image of a synthetic surface. Describe how it feels, in adjectives."
)


def rig_of(plan: VideoPlan) -> str:
    """``data1`` for the first gel unit: HCT's rig, the manifest's domain."""
    return f"data{plan.sensor + 1}"


def video_id(options: WorldOptions, plan: VideoPlan) -> str:
    """The video as the manifest names it."""
    if options.layout != "hct":
        return plan.name
    start = datetime.datetime.strptime(plan.name, "%Y%m%d_%H%M%S").replace(tzinfo=datetime.UTC)
    number = plan.index % _HCT_NUMBERS + 1
    return f"{rig_of(plan)}/{number}-{int(start.timestamp())}.{plan.index % 100:02d}"


def sample_id(options: WorldOptions, plan: VideoPlan, frame: int) -> str:
    """The id of a contact frame."""
    number = str(frame) if options.layout == "hct" else f"{frame:010d}"
    return f"{video_id(options, plan)}/{number}"


def contact_id(options: WorldOptions, plan: VideoPlan, contact: int) -> str:
    """The contact as the manifest names it; unique across videos, counted from 1."""
    return f"{video_id(options, plan)}#{contact + 1:04d}"


def manifest_root(options: WorldOptions, folder: Path) -> Path:
    """The folder that image paths start at."""
    return folder / "hct" if options.layout == "hct" else folder


def video_folder(options: WorldOptions, plan: VideoPlan) -> str:
    """The folder of a video, relative to the manifest's root."""
    return video_id(options, plan) if options.layout == "hct" else f"dataset/{plan.name}"


def _frame_name(options: WorldOptions, plan: VideoPlan, frame: int) -> str:
    if options.layout == "hct":
        return f"{frame}-{options.rng('latency', plan.index, frame).uniform(0.005, 0.06):.4f}.jpg"
    return f"{frame:010d}.jpg"


def _image_folders(options: WorldOptions) -> tuple[str, str]:
    return ("vision", "tactile") if options.layout == "hct" else ("video_frame", "gelsight_frame")


def image_paths(options: WorldOptions, row: Row) -> dict[str, str]:
    """Paths of ``vision``, ``tactile``, ``background`` relative to the manifest's root; {} for
    videos.
    """
    if options.layout == "videos":
        return {}
    folder, (vision, tactile) = video_folder(options, row.video), _image_folders(options)
    name = _frame_name(options, row.video, row.frame)
    if options.layout == "hct":
        background = f"{folder}/background.png"
    else:
        passive = first_contact(options, row.contact) - BACKGROUND_OFFSET
        background = f"{folder}/{tactile}/{_frame_name(options, row.video, passive)}"
    return {
        "vision": f"{folder}/{vision}/{name}",
        "tactile": f"{folder}/{tactile}/{name}",
        "background": background,
    }


def write_video_files(options: WorldOptions, video: Video, folder: Path) -> None:
    """Render all written frames of a video into its folder."""
    frames, renders = written_frames(options), (video.vision, video.tactile)
    if options.layout == "videos":
        for name, render in zip(("video.mp4", "gelsight.mp4"), renders, strict=True):
            _write_mp4(folder / name, map(render, frames), options.size)
        return
    if options.layout == "hct":
        Image.fromarray(video.background()).save(folder / "background.png")
    for name, render in zip(_image_folders(options), renders, strict=True):
        (folder / name).mkdir()
        for frame in frames:
            path = folder / name / _frame_name(options, video.plan, frame)
            Image.fromarray(render(frame)).save(path, "JPEG", quality=95, subsampling=0)


def _write_mp4(path: Path, images: Iterable[np.ndarray], size: int) -> None:
    """Write uint8 images (size, size, 3) as H.264, constant rate factor 18, so that bytes repeat.

    One thread; x264 without the code whose rounding depends on the processor; frames converted
    before they reach the encoder, because its own conversion makes its decisions differ from run to
    run.
    """
    import av

    with av.open(str(path), "w", format="mp4") as file:
        settings = {"crf": "18", "preset": "veryfast", "x264-params": "cpu-independent=1"}
        stream = file.add_stream("libx264", rate=FPS, options=settings)
        stream.width = stream.height = size
        stream.pix_fmt, stream.thread_count = "yuv420p", 1
        stream.time_base = Fraction(1, FPS)
        for image in images:
            frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="yuv420p")
            file.mux(stream.encode(frame))
        file.mux(stream.encode())


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """CSV with bare line feeds."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()


def list_files(
    options: WorldOptions,
    plans: list[VideoPlan],
    train: Sequence[Row],
    test: Sequence[Row],
    captions: Mapping[str, Sequence[str]],
) -> dict[str, str]:
    """The lists of the layout by path.

    Args:
        options: the world's.
        plans: all videos.
        train: rows for training in the order of the list.
        test: the others.
        captions: video name -> one caption a contact.
    """
    if options.layout == "hct":
        return _hct_lists(options, plans, train, test, captions)
    rows = list(contact_rows(options, plans))
    path: Callable[[Row], str] = lambda row: f"{row.video.name}/{row.frame:010d}.jpg"  # noqa: E731
    lines = {
        name: [f"{path(r)},{MATERIALS[r.object.material].label}" for r in part]
        for name, part in (("label", rows), ("train", train), ("test", test))
    }
    texts = ((path(row), captions[row.video.name][row.contact]) for row in rows)
    return {
        "label.txt": "".join(f"{line}\n" for line in lines["label"]),
        "category_reference.txt": "".join(f"{n}: {m.label}\n" for n, m in MATERIALS.items()),
        "train.txt": "\n".join(lines["train"]),
        "test.txt": "\n".join(lines["test"]),
        "objects.csv": csv_text(("frame", "object"), ((path(r), r.object.name) for r in rows)),
        "captions.csv": csv_text(("frame", "text"), texts),
    }


def _hct_lists(
    options: WorldOptions,
    plans: list[VideoPlan],
    train: Sequence[Row],
    test: Sequence[Row],
    captions: Mapping[str, Sequence[str]],
) -> dict[str, str]:
    files: dict[str, str] = {}
    touching = {row.frame for row in contact_rows(options, plans[:1])}
    for rig in sorted({rig_of(plan) for plan in plans}):
        cells = {
            name: [
                (*_hct_paths(options, r.video, r.frame), captions[r.video.name][r.contact])
                for r in part
                if rig_of(r.video) == rig
            ]
            for name, part in (("train", train), ("test", test))
        }
        header = ("url", "tactile", "tactile_background", "caption")
        lists = {f"{name}.csv": csv_text(header, rows) for name, rows in cells.items() if rows}
        for name, wanted in (("contact", True), ("not_contact", False)):
            frames = [f for f in written_frames(options) if (f in touching) is wanted]
            paths = [_hct_paths(options, p, f) for p in plans if rig_of(p) == rig for f in frames]
            keys = (("tactile", 1), ("vision", 0), ("background", 2))
            lists[f"{name}.json"] = json.dumps({k: [p[at] for p in paths] for k, at in keys}) + "\n"
        lists["finetune.json"] = (
            json.dumps([_conversation(*cell) for cell in cells["train"]]) + "\n"
        )
        files |= {f"hct/{rig}/{name}": text for name, text in lists.items()}
    return files


def _conversation(vision: str, tactile: str, background: str, caption: str) -> dict[str, object]:
    turns = [{"from": "human", "value": _HCT_QUESTION}, {"from": "gpt", "value": caption}]
    images = {"image": vision, "tactile": tactile, "tactile_background": background}
    return {**images, "conversations": turns}


def _hct_paths(options: WorldOptions, plan: VideoPlan, frame: int) -> tuple[str, str, str]:
    """Vision, tactile and background relative to the rig."""
    folder, name = video_id(options, plan).split("/", 1)[1], _frame_name(options, plan, frame)
    return f"{folder}/vision/{name}", f"{folder}/tactile/{name}", f"{folder}/background.png"

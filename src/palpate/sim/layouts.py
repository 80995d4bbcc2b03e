"""The files of a world in each layout, so that ids are those that ``palpate import`` gives.

- ``frames``, ids ``20260101_000000/0000000012``: Touch and Go's tree
  ``dataset/<video>/video_frame/0000000012.jpg`` and ``gelsight_frame/``. The background is the
  tactile frame 4 before the contact.
- ``videos``: the same ids; the frames are in ``video.mp4`` and ``gelsight.mp4``.
- ``hct``, ids ``data2/4-1702596295.70/12``: ``data2/4-1702596295.70/vision/12-0.0207.jpg``,
  ``tactile/`` and ``background.png``. HCT names a recording by a number that is used again and its
  start in Unix seconds, and a frame by its number and a latency in seconds. Its rigs ``data1,
  data2 ...`` are our gel units.

Touch and Go's lists: ``label.txt``, ``train.txt``, ``test.txt`` (``<video>/0000000012.jpg,3``; the
latter two shuffled and without a final newline, as the official ones), ``category_reference.txt``,
and the additional ``objects.csv`` and ``captions.csv``. HCT's lists, a set for each rig:

- ``train.csv``, ``test.csv``: ``url,tactile,tactile_background,caption``, shuffled.
- ``contact.json``, ``not_contact.json``: ``{"tactile": [..], "vision": [..], "background": [..]}``.
- ``finetune.json``: the training rows again, ``[{image, tactile, tactile_background,
  conversations}]``.
"""

from __future__ import annotations

import datetime
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image

from palpate.data.tables import csv_text
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
#: Rows of the lists of train and test.
Parts = Mapping[str, Sequence[Row]]


def rig_of(plan: VideoPlan) -> str:
    """Return HCT's rig, the manifest's domain: ``data1`` for the first gel unit."""
    return f"data{plan.sensor + 1}"


def video_id(options: WorldOptions, plan: VideoPlan) -> str:
    """Return the video as the manifest names it."""
    if options.layout != "hct":
        return plan.name
    start = datetime.datetime.strptime(plan.name, "%Y%m%d_%H%M%S").replace(tzinfo=datetime.UTC)
    number = plan.index % _HCT_NUMBERS + 1
    return f"{rig_of(plan)}/{number}-{int(start.timestamp())}.{plan.index % 100:02d}"


def sample_id(options: WorldOptions, plan: VideoPlan, frame: int) -> str:
    """Return the id of a contact frame."""
    number = str(frame) if options.layout == "hct" else f"{frame:010d}"
    return f"{video_id(options, plan)}/{number}"


def contact_id(options: WorldOptions, plan: VideoPlan, contact: int) -> str:
    """Return the contact as the manifest names it; unique across videos, counted from 1."""
    return f"{video_id(options, plan)}#{contact + 1:04d}"


def manifest_root(options: WorldOptions, folder: Path) -> Path:
    """Return the folder that image paths start at."""
    return folder / "hct" if options.layout == "hct" else folder


def video_folder(options: WorldOptions, plan: VideoPlan) -> str:
    """Return the folder of a video, relative to the manifest's root."""
    return video_id(options, plan) if options.layout == "hct" else f"dataset/{plan.name}"


def _frame_name(options: WorldOptions, plan: VideoPlan, frame: int) -> str:
    if options.layout == "hct":
        return f"{frame}-{options.rng('latency', plan.index, frame).uniform(0.005, 0.06):.4f}.jpg"
    return f"{frame:010d}.jpg"


def _image_folders(options: WorldOptions) -> tuple[str, str]:
    return ("vision", "tactile") if options.layout == "hct" else ("video_frame", "gelsight_frame")


def image_paths(options: WorldOptions, plan: VideoPlan, frame: int, contact: int) -> dict[str, str]:
    """Return paths of vision, tactile and background under the manifest's root; {} for videos."""
    if options.layout == "videos":
        return {}
    folder, sides = video_folder(options, plan), _image_folders(options)
    name = _frame_name(options, plan, frame)
    background = "background.png"
    if options.layout != "hct":
        free = first_contact(options, contact) - BACKGROUND_OFFSET
        background = f"{sides[1]}/{_frame_name(options, plan, free)}"
    paths = (f"{sides[0]}/{name}", f"{sides[1]}/{name}", background)
    keys = ("vision", "tactile", "background")
    return {key: f"{folder}/{path}" for key, path in zip(keys, paths, strict=True)}


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
    before they reach the encoder, because its conversion makes its decisions differ from run to
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


def list_files(
    options: WorldOptions,
    plans: list[VideoPlan],
    parts: Parts,
    captions: Mapping[str, Sequence[str]],
) -> dict[str, str]:
    """Return the lists of the layout by path.

    Args:
        options: the world's.
        plans: all videos.
        parts: rows of ``train`` and ``test`` in the order of the lists.
        captions: video name -> a caption for each contact.
    """
    if options.layout == "hct":
        rigs = sorted({rig_of(plan) for plan in plans})
        files = {rig: _rig_lists(options, plans, parts, captions, rig) for rig in rigs}
        return {f"hct/{rig}/{name}": text for rig in rigs for name, text in files[rig].items()}
    rows = list(contact_rows(options, plans))
    path: Callable[[Row], str] = lambda row: f"{row.video.name}/{row.frame:010d}.jpg"
    line = {row: f"{path(row)},{MATERIALS[row.object.material].label}" for row in rows}
    objects = ((path(row), row.object.name) for row in rows)
    texts = ((path(row), captions[row.video.name][row.contact]) for row in rows)
    return {
        "label.txt": "".join(f"{text}\n" for text in line.values()),
        "category_reference.txt": "".join(f"{n}: {m.label}\n" for n, m in MATERIALS.items()),
        **{f"{name}.txt": "\n".join(line[row] for row in part) for name, part in parts.items()},
        "objects.csv": csv_text(("frame", "object"), objects),
        "captions.csv": csv_text(("frame", "text"), texts),
    }


def _rig_lists(
    options: WorldOptions,
    plans: list[VideoPlan],
    parts: Parts,
    captions: Mapping[str, Sequence[str]],
    rig: str,
) -> dict[str, str]:
    def paths(plan: VideoPlan, frame: int) -> dict[str, str]:
        """Return image paths relative to the rig."""
        full = image_paths(options, plan, frame, 0)
        return {key: path.removeprefix(f"{rig}/") for key, path in full.items()}

    files: dict[str, str] = {}
    talks: list[dict[str, object]] = []
    for name, part in parts.items():
        rows: list[tuple[str, ...]] = []
        for row in part:
            if rig_of(row.video) == rig:
                caption = captions[row.video.name][row.contact]
                rows.append((*paths(row.video, row.frame).values(), caption))
        if rows:
            header = ("url", "tactile", "tactile_background", "caption")
            files[f"{name}.csv"] = csv_text(header, rows)
        talks += [_conversation(*row) for row in rows if name == "train"]
    in_contact = {row.frame for row in contact_rows(options, plans[:1])}
    for name, wanted in (("contact", True), ("not_contact", False)):
        frames = [frame for frame in written_frames(options) if (frame in in_contact) is wanted]
        images = [paths(plan, k) for plan in plans if rig_of(plan) == rig for k in frames]
        keys = ("tactile", "vision", "background")
        files[f"{name}.json"] = json.dumps({k: [p[k] for p in images] for k in keys}) + "\n"
    return files | {"finetune.json": json.dumps(talks) + "\n"}


def _conversation(vision: str, tactile: str, background: str, caption: str) -> dict[str, object]:
    turns = [{"from": "human", "value": _HCT_QUESTION}, {"from": "gpt", "value": caption}]
    images = {"image": vision, "tactile": tactile, "tactile_background": background}
    return {**images, "conversations": turns}

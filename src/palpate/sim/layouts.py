"""The files of a world, in the layout of Touch and Go.

- ``frames``, ids ``20260101_000000/0000000012``: Touch and Go's tree
  ``dataset/<video>/video_frame/0000000012.jpg`` and ``gelsight_frame/``. The background is the
  tactile frame 4 before the contact.
- ``videos``: the same ids; the frames are in ``video.mp4`` and ``gelsight.mp4``.

Lists: ``label.txt``, ``train.txt``, ``test.txt`` (``<video>/0000000012.jpg,3``; the latter two
shuffled and without a final newline, as the official ones), ``category_reference.txt``, and the
additional ``objects.csv`` and ``captions.csv``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

from palpate.core import image_bytes
from palpate.data.tables import csv_text
from palpate.data.video import write_video
from palpate.sim.materials import MATERIALS
from palpate.sim.options import BACKGROUND_OFFSET, WorldOptions
from palpate.sim.plan import Row, first_contact, written_frames
from palpate.sim.video import Video

#: Frames a second of videos.
FPS = 30
#: Rows of the lists of train and test.
Parts = Mapping[str, Sequence[Row]]


def image_paths(options: WorldOptions, row: Row) -> dict[str, str]:
    """Return paths of vision, tactile and background under the world; {} for videos."""
    if options.layout == "videos":
        return {}
    folder = f"dataset/{row.video.name}"
    free = first_contact(options, row.contact) - BACKGROUND_OFFSET
    return {
        "vision": f"{folder}/video_frame/{row.frame:010d}.jpg",
        "tactile": f"{folder}/gelsight_frame/{row.frame:010d}.jpg",
        "background": f"{folder}/gelsight_frame/{free:010d}.jpg",
    }


def write_video_files(video: Video, folder: Path) -> None:
    """Render all written frames of a video into its folder."""
    frames = written_frames(video.options)
    of_touch = video.options.quality
    for name, render, quality in (
        ("video", video.vision, 95),
        ("gelsight", video.tactile, of_touch),
    ):
        if video.options.layout == "videos":
            write_video(folder / f"{name}.mp4", map(render, frames), Fraction(FPS))
            continue
        (folder / f"{name}_frame").mkdir()
        for frame in frames:
            data = image_bytes(render(frame), "JPEG", quality=quality, subsampling=0)
            (folder / f"{name}_frame" / f"{frame:010d}.jpg").write_bytes(data)


def list_files(
    rows: Sequence[Row], parts: Parts, captions: Mapping[str, Sequence[str]]
) -> dict[str, str]:
    """Return the lists of a world by name.

    Args:
        rows: all contact frames.
        parts: rows of ``train`` and ``test`` in the order of the lists.
        captions: video name -> a caption for each contact.
    """
    line = {row: f"{row.id}.jpg,{row.material.label}" for row in rows}
    objects = ((f"{row.id}.jpg", row.object.name) for row in rows)
    texts = ((f"{row.id}.jpg", captions[row.video.name][row.contact]) for row in rows)
    return {
        "label.txt": "".join(f"{text}\n" for text in line.values()),
        "category_reference.txt": "".join(f"{n}: {m.label}\n" for n, m in MATERIALS.items()),
        **{f"{name}.txt": "\n".join(line[row] for row in part) for name, part in parts.items()},
        "objects.csv": csv_text(("frame", "object"), objects),
        "captions.csv": csv_text(("frame", "text"), texts),
    }

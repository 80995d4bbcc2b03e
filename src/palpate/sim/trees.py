"""The files of one video in each layout.

``frames``, ``videos``: ``dataset/<video>/video_frame/0000000012.jpg`` and ``gelsight_frame/``, or ``video.mp4`` and ``gelsight.mp4``, as Touch and Go.
``hct``: ``hct/data2/4-1702596295.70/vision/12-0.0207.jpg``, ``tactile/`` and ``background.png``. ``raw``: rows of arrays, see
:mod:`palpate.sim.raw`. What stands in the file system is a whole video or nothing of it.
"""

from __future__ import annotations

from pathlib import Path

from palpate.core import PalpateError, atomic_folder, write_json
from palpate.core.files import NO_ROOM
from palpate.sim.encode import write_jpeg, write_mp4, write_png
from palpate.sim.naming import frame_name, manifest_root, sides, video_folder
from palpate.sim.options import WorldOptions
from palpate.sim.plan import VideoPlan, written_frames
from palpate.sim.raw import write_rows
from palpate.sim.video import Video

#: Folder within an unfinished world: its state, and the captions of each finished video.
WORK = ".work"


def captions_path(part: Path, plan: VideoPlan) -> Path:
    """The captions of a video, in an unfinished world."""
    return part / WORK / f"{plan.name}.json"


def place(options: WorldOptions, part: Path, plan: VideoPlan) -> Path:
    """The folder of a video."""
    return manifest_root(options, part) / video_folder(options, plan)


def is_written(options: WorldOptions, part: Path, plan: VideoPlan) -> bool:
    """Whether a video is there, whole."""
    return captions_path(part, plan).is_file() and (
        options.layout == "raw" or place(options, part, plan).is_dir()
    )


def write_video(options: WorldOptions, part: Path, plan: VideoPlan) -> str:
    """Renders one video into ``part``, whole or not at all.

    Returns:
        Its name.

    Raises:
        PalpateError: if a material draws something invalid, or the disk is full or not to be written.
    """
    try:
        video = Video(options, plan)
        captions = [video.text(touch) for touch in range(options.touches_per_video)]
        if options.layout == "raw":  # whichever is written last marks the video as whole
            write_rows(part, options, plan, video)
            write_json(captions_path(part, plan), captions)
        else:
            write_json(captions_path(part, plan), captions)
            with atomic_folder(place(options, part, plan)) as folder:
                _fill(options, plan, video, folder)
    except OSError as error:
        raise disk_error(error, part.parent) from error
    return plan.name


def _fill(options: WorldOptions, plan: VideoPlan, video: Video, folder: Path) -> None:
    frames = written_frames(options)
    if options.layout == "videos":
        write_mp4(folder / "video.mp4", map(video.vision, frames), options.size)
        write_mp4(folder / "gelsight.mp4", map(video.tactile, frames), options.size)
        return
    if options.layout == "hct":
        write_png(folder / "background.png", video.background())
    for side, render in zip(sides(options), (video.vision, video.tactile), strict=True):
        (folder / side).mkdir()
        for frame in frames:
            write_jpeg(folder / side / frame_name(options, plan, frame), render(frame))


def disk_error(error: OSError, folder: Path) -> PalpateError:
    """What the disk refused, in words. The world's finished videos stay, and the same call goes on with the others."""
    got = error.strerror or str(error)
    if error.errno in NO_ROOM:
        fix = "Free some space and run the same command again: it goes on where it stopped"
        return PalpateError(f"The disk of {folder} must have room for the world", got, fix)
    fix = "Mend that and run the same command again: it goes on where it stopped"
    return PalpateError(f"{folder} must be writable", got, fix)

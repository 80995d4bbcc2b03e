"""The lists of a world in the layout of HCT, one set a rig, paths relative to it.

- ``train.csv``, ``test.csv``: ``url,tactile,tactile_background,caption``, shuffled; a rig that has no frame of a part has no list of it.
- ``contact.json``, ``not_contact.json``: ``{"tactile": [..], "vision": [..], "background": [..]}``, every written frame in one of them.
- ``finetune.json``: the training rows again, ``[{image, tactile, tactile_background, conversations}]``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from palpate.sim.lists import table
from palpate.sim.naming import Row, frame_name, rig_of, video_id
from palpate.sim.options import WorldOptions
from palpate.sim.plan import VideoPlan, contact_frames, written_frames

COLUMNS = ("url", "tactile", "tactile_background", "caption")
_QUESTION = (
    "<image>\nThis is a tactile image of a synthetic surface. Describe how it feels, in adjectives."
)


def hct_list_files(
    options: WorldOptions,
    plans: Sequence[VideoPlan],
    train: Sequence[Row],
    test: Sequence[Row],
    captions: Mapping[str, Sequence[str]],
) -> dict[str, str]:
    """HCT's lists by path below ``hct/``.

    Args:
        options: the world's.
        plans: all videos.
        train: the rows for training, in the order of the list.
        test: the others.
        captions: video name -> one caption a touch.
    """
    files: dict[str, str] = {}
    touching = {
        frame
        for touch in range(options.touches_per_video)
        for frame in contact_frames(options, touch)
    }
    for rig in sorted({rig_of(plan) for plan in plans}):
        listed = {
            part: [row for row in rows if rig_of(row.video) == rig]
            for part, rows in (("train", train), ("test", test))
        }
        cells = {
            part: [
                (*_paths(options, row.video, row.frame), captions[row.video.name][row.touch])
                for row in rows
            ]
            for part, rows in listed.items()
        }
        files |= {f"{rig}/{part}.csv": table(COLUMNS, rows) for part, rows in cells.items() if rows}
        for name, wanted in (("contact", True), ("not_contact", False)):
            frames = [
                _paths(options, plan, frame)
                for plan in plans
                if rig_of(plan) == rig
                for frame in written_frames(options)
                if (frame in touching) is wanted
            ]
            columns = {
                key: [paths[k] for paths in frames]
                for key, k in (("tactile", 1), ("vision", 0), ("background", 2))
            }
            files[f"{rig}/{name}.json"] = json.dumps(columns) + "\n"
        talks = [
            {
                "image": vision,
                "tactile": tactile,
                "tactile_background": background,
                "conversations": [
                    {"from": "human", "value": _QUESTION},
                    {"from": "gpt", "value": text},
                ],
            }
            for vision, tactile, background, text in cells["train"]
        ]
        files[f"{rig}/finetune.json"] = json.dumps(talks) + "\n"
    return files


def _paths(options: WorldOptions, plan: VideoPlan, frame: int) -> tuple[str, str, str]:
    """Photo, touch and background relative to the rig."""
    folder, name = video_id(options, plan).split("/", 1)[1], frame_name(options, plan, frame)
    return f"{folder}/vision/{name}", f"{folder}/tactile/{name}", f"{folder}/background.png"

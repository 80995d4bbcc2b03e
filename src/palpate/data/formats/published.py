"""Published layouts that templates say, a row each; :mod:`palpate.data.formats.pairs` reads them.

A row has the templates of its sides, map expressions over their fields, and the facts. Tables next
to the images (materials, the split of the benchmark) are joined as for anyone's folder. Of a side
that is not at hand there is nothing; that the first image of a trial shows the untouched gel is
inferred.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from itertools import islice
from pathlib import Path

from palpate.core import Progress, quiet
from palpate.data.formats import pairs
from palpate.data.formats.layout import require_folder
from palpate.data.scanning import Facts, Format, Scan
from palpate.data.templates import Template

#: Folders that ``detect`` opens.
PEEKS = 60
OBJECTFOLDER = (
    "R. Gao et al.: The ObjectFolder Benchmark: Multisensory Learning with Neural and Real "
    "Objects. CVPR, 2023"
)
OBJECTFOLDER_LICENSE = "unknown for ObjectFolder-Real (CC BY 4.0 is stated for ObjectFolder 2.0)"
OBJECTFOLDER_SENSOR = "GelSight (T3 says black, Sparsh says Mini, AnyTouch files it with GelSlim)"


def detect(source: Path, templates: Mapping[str, str]) -> bool:
    """Whether the tactile template matches one of the first files, and constants are there."""
    constant = (text for text in templates.values() if "{" not in text)
    if not all((source / text).is_file() for text in constant):
        return False
    tactile = Template.parse(templates["tactile"])
    folders = islice(os.walk(source, followlinks=True), PEEKS)
    paths = (Path(folder, name) for folder, _, names in folders for name in names)
    return any(tactile.match(path.relative_to(source).as_posix()) for path in paths)


def _scan(
    source: Path, templates: Mapping[str, str], columns: Mapping[str, str], progress: Progress
) -> Scan:
    """Read a folder by the templates of a row."""
    result = Scan(require_folder(source, "a published data set"))
    progress("reading rows", 0, 1)
    pairs.read_folder(result, dict(templates), None, columns, None, published=True)
    result.facts.pop("templates", None)
    worded = any("text" in row for _, row in result.rows)
    result.facts |= {"layout": templates["tactile"], "text_source": "table" if worded else "none"}
    result.facts |= {} if "template_vision" in result.facts else {"vision": "none in this layout"}
    progress("reading rows", 1, 1)
    return result


def _row(facts: Facts, templates: Mapping[str, str], **columns: str) -> Format:
    """The format of a row."""

    def scan(source: Path, *, progress: Progress = quiet) -> Scan:
        return _scan(source, templates, columns, progress)

    looks_for = " and ".join(templates.values())
    return Format(facts, partial(detect, templates=templates), looks_for, scan)


TARF = _row(
    Facts(
        name="TaRF",
        citation="Y. Dou, F. Yang, Y. Liu, A. Loquercio, A. Owens: Tactile-Augmented Radiance "
        "Fields. CVPR, 2024",
        license="no license found",
        url="https://github.com/Dou-Yiming/TaRF",
        sensor="DIGIT",
        image_size=(640, 480),
        samples="not published; 13 scenes (named in the public code)",
        group="video (= scene); there are few, so leave whole scenes out in turn",
    ),
    {
        "vision": "vision/{video}_40_30/{frame}.jpg",
        "tactile": "touch/{video}_40_30/{frame}.jpg",
        "background": "touch_bg/{video}_40_30/bg.jpg",
    },
    id="video || '_40_30/' || frame",  # as split_interval.json names it
    sensor="'DIGIT'",
)
OBJECTFOLDER_REAL = _row(
    Facts(
        name="ObjectFolder-Real",
        citation=OBJECTFOLDER,
        license=OBJECTFOLDER_LICENSE,
        url="https://github.com/objectfolder",
        sensor=OBJECTFOLDER_SENSOR,
        samples="1,417,600 touch frames of 100 objects (counted by T3)",
        group="object",
        group_column="object",
    ),
    {
        "tactile": "{object:d}/tactile_data/{video}/0/gelsight/{frame}.png",
        "background": "{object:d}/tactile_data/{video}/0/gelsight/0.png",
    },
    sensor="'GelSight'",
)
OBJECTFOLDER_GENERATION = _row(
    Facts(
        name="ObjectFolder-Real, visuo-tactile cross-generation",
        citation=OBJECTFOLDER,
        license=OBJECTFOLDER_LICENSE,
        url="https://github.com/objectfolder/visuo-tactile-cross-generation",
        sensor=OBJECTFOLDER_SENSOR,
        samples="50,000 pairs: 1,000 of each of 50 objects (stated by the benchmark)",
        group="object; cross-contact shares every object, cross-object none",
        group_column="object",
    ),
    {
        "vision": "vision/{object:d}/{contact:d}.png",
        "tactile": "touch/{object:d}/{contact:d}.png",
        "background": "touch_ref/touch_ref.png",
    },
    sensor="'GelSight'",
)
YCB_SLIDE = _row(
    Facts(
        name="YCB-Slide",
        citation="S. Suresh, Z. Si, S. Anderson, M. Kaess, M. Mukadam: MidasTouch: Monte-Carlo "
        "inference over distributions across sliding touch. CoRL, 2022",
        license="CC BY-SA 4.0 (the code: MIT)",
        url="https://github.com/rpl-cmu/YCB-Slide",
        sensor="DIGIT",
        samples="10 objects x 5 logs x 60 s at 30 Hz, real; 5 simulated trajectories an object "
        "(stated by the authors)",
        group="object; at least the log (= video)",
        group_column="object",
    ),
    {
        "vision": "real/{object}/{video}/webcam_frames/frame_{frame}.jpg",
        "tactile": "real/{object}/{video}/frames/frame_{frame}.jpg",
    },
    sensor="'DIGIT'",
)

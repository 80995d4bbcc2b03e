"""Published layouts that templates say, a row each; :mod:`palpate.data.formats.pairs` reads them.

A row has the templates of its sides, map expressions over their fields, and the facts. Tables next
to the images (materials, the split of the benchmark) are joined as for anyone's folder. Of a side
that is not at hand there is nothing; that the first image of a trial shows the untouched gel is
inferred.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from palpate.data.scanning import Facts


@dataclass(frozen=True)
class Layout:
    """A published layout."""

    facts: Facts
    templates: Mapping[str, str]  # column of images -> template
    columns: Mapping[str, str]  # manifest column -> map expression over the fields


OBJECTFOLDER = (
    "R. Gao et al.: The ObjectFolder Benchmark: Multisensory Learning with Neural and Real "
    "Objects. CVPR, 2023"
)
OBJECTFOLDER_LICENSE = "unknown for ObjectFolder-Real (CC BY 4.0 is stated for ObjectFolder 2.0)"
OBJECTFOLDER_SENSOR = "GelSight (T3 says black, Sparsh says Mini, AnyTouch files it with GelSlim)"
TARF = Layout(
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
    # The id is as split_interval.json names it.
    {"id": "video || '_40_30/' || frame", "sensor": "'DIGIT'"},
)
OBJECTFOLDER_REAL = Layout(
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
    {"sensor": "'GelSight'"},
)
OBJECTFOLDER_GENERATION = Layout(
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
    {"sensor": "'GelSight'"},
)
YCB_SLIDE = Layout(
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
    {"sensor": "'DIGIT'"},
)
#: Name of the format -> its layout, in the order in which they are tried.
LAYOUTS = {
    "tarf": TARF,
    "objectfolder-generation": OBJECTFOLDER_GENERATION,
    "objectfolder": OBJECTFOLDER_REAL,
    "ycb-slide": YCB_SLIDE,
}

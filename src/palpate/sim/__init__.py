"""The procedural visuo-tactile world: videos of a gel sensor pressed on and sliding over materials, in the layout of Touch and Go.

Synthetic, and it says so everywhere: it shows mechanisms (leakage, background reward, guidance); its numbers are never compared with
real data. ``write_world(out, PRESETS["demo"])`` writes a tree; ``Video(options, 0).tactile(7)`` renders one frame alone.
"""

from palpate.sim.materials import MATERIALS, Material, Surface
from palpate.sim.options import VERSION, WorldOptions
from palpate.sim.plan import VideoPlan, plan_world
from palpate.sim.presets import PRESETS
from palpate.sim.sheet import render_contact_sheet
from palpate.sim.tile import Tile
from palpate.sim.video import Video
from palpate.sim.writer import WorldRecord, write_world

__all__ = [
    "MATERIALS",
    "PRESETS",
    "VERSION",
    "Material",
    "Surface",
    "Tile",
    "Video",
    "VideoPlan",
    "WorldOptions",
    "WorldRecord",
    "plan_world",
    "render_contact_sheet",
    "write_world",
]

"""The procedural visuo-tactile world: videos of a gel sensor pressed on and sliding over materials, in the layout of Touch and Go.

Synthetic, and it says so everywhere: it shows mechanisms (leakage, background reward, guidance); its numbers are never compared with
real data. ``write_world(out, PRESETS["demo"])`` writes a tree; ``World(PRESETS["demo"])[7]`` renders one sample without files.
"""

from palpate.sim.materials import MATERIALS, Material, Surface
from palpate.sim.options import VERSION, WorldOptions
from palpate.sim.plan import VideoPlan, plan_world
from palpate.sim.presets import DEFAULT, MINI_SEEDS, PRESETS, seen_by_mini
from palpate.sim.raw import Arrays, open_arrays
from palpate.sim.saved import load_options, save_options
from palpate.sim.sheet import render_contact_sheet
from palpate.sim.tile import Tile
from palpate.sim.video import Video
from palpate.sim.world import World
from palpate.sim.writer import WorldRecord, write_world

__all__ = [
    "DEFAULT",
    "MATERIALS",
    "MINI_SEEDS",
    "PRESETS",
    "VERSION",
    "Arrays",
    "Material",
    "Surface",
    "Tile",
    "Video",
    "VideoPlan",
    "World",
    "WorldOptions",
    "WorldRecord",
    "load_options",
    "open_arrays",
    "plan_world",
    "render_contact_sheet",
    "save_options",
    "seen_by_mini",
    "write_world",
]

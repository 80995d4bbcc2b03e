"""The procedural visuo-tactile world: videos of a gel sensor pressed on and sliding over materials.

Synthetic: it shows mechanisms (leakage, background reward, guidance); its numbers are never
compared with real data.

``write_world(folder, PRESETS["demo"])`` writes a tree in the layout of Touch and Go;
``World("demo")[7]`` renders a sample without files.
"""

from palpate.sim.materials import MATERIALS, Material, Surface
from palpate.sim.options import VERSION, WorldOptions
from palpate.sim.plan import VideoPlan, plan_world
from palpate.sim.presets import DEFAULT, MINI_SEEDS, PRESETS, SEEN_WARNING
from palpate.sim.tile import Tile
from palpate.sim.video import Video
from palpate.sim.world import World
from palpate.sim.writer import WorldRecord, write_world

__all__ = [
    "DEFAULT",
    "MATERIALS",
    "MINI_SEEDS",
    "PRESETS",
    "SEEN_WARNING",
    "VERSION",
    "Material",
    "Surface",
    "Tile",
    "Video",
    "VideoPlan",
    "World",
    "WorldOptions",
    "WorldRecord",
    "plan_world",
    "write_world",
]

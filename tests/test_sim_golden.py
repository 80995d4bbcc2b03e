"""Images of every material as they were when VERSION was last raised; within 2/255 on any CPU.

``PALPATE_GOLDEN=write pytest tests/test_sim_golden.py`` draws them anew: raise VERSION in the same
commit.
"""

import os
from pathlib import Path

import numpy as np

from palpate.sim import MATERIALS, VERSION, Video, WorldOptions
from palpate.sim.plan import ObjectRef, VideoPlan

GOLDEN = Path(__file__).parent / "golden" / "sim_world.npz"


def draw():
    """Render photo and tactile image of an object of each material: uint8 (20, 2, 20, 20, 3)."""
    images = []
    for k, name in enumerate(MATERIALS):
        options = WorldOptions(size=20, look=("gelsight", "digit")[k % 2], phases="spaced")
        video = Video(options, VideoPlan(k, "golden", k % 3, (ObjectRef(name, 0),), (0, 0, 0, 0)))
        images.append([video.vision(6), video.tactile(6)])
    return np.array(images)


def test_images_have_not_changed():
    images = draw()
    if os.environ.get("PALPATE_GOLDEN") == "write":
        GOLDEN.parent.mkdir(exist_ok=True)
        np.savez_compressed(GOLDEN, images=images, version=VERSION)
    with np.load(GOLDEN, allow_pickle=False) as data:
        assert int(data["version"]) == VERSION
        difference = np.abs(images.astype(int) - data["images"])
    names = [name for name, d in zip(MATERIALS, difference, strict=True) if d.max() > 2]
    assert not names, f"changed images: {names}"
    assert GOLDEN.stat().st_size < 60_000

"""A world without files: any of its samples rendered when asked for.

``World(options)[k]`` gives the arrays that ``write_world`` writes as row k of its manifest, pixel for pixel (before JPEG; row k of the arrays with
``layout="raw"``). It is a map-style data set: it has a length, takes an index, can be pickled and sent to the workers of a data loader. A few videos are
kept ready; nothing else grows with what was rendered. In order, a sample costs its three images; in random order it costs the set-up of its object and
its video too, which takes several times longer.
"""

from __future__ import annotations

import operator
from collections import OrderedDict
from collections.abc import Iterator
from functools import cached_property
from typing import Any, SupportsIndex

from palpate.core import PalpateError, Progress, Split, quiet
from palpate.data.manifest import Manifest
from palpate.sim.lists import cut
from palpate.sim.materials import MATERIALS
from palpate.sim.naming import Row, contact_row, contact_rows, sample_id, touch_id, video_id
from palpate.sim.options import WorldOptions
from palpate.sim.plan import VideoPlan, plan_world
from palpate.sim.ranges import is_number, shown
from palpate.sim.table import world_manifest, world_split
from palpate.sim.video import Video


class NoSampleError(PalpateError, IndexError):
    """There is no sample of that number; also an IndexError, as sequences raise."""


class World:
    """The contact frames of a world, by video and frame.

    Args:
        options: the world, default ``WorldOptions()``.
        cache: videos kept ready (about 1 MB each at 64 px, 4 MB at 128 px).

    Raises:
        PalpateError: if ``cache`` is no whole number from 1.
    """

    def __init__(self, options: WorldOptions | None = None, *, cache: int = 4) -> None:
        if not is_number(cache, whole=True) or cache < 1:
            raise PalpateError(
                "cache must be a whole number, at least 1", shown(cache), "Pass cache=4"
            )
        self.options, self.cache = options or WorldOptions(), cache
        self._videos: OrderedDict[int, Video] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        """Options alone: a copy in another process renders for itself."""
        return {"options": self.options, "cache": self.cache}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """The inverse of :meth:`__getstate__`."""
        self.__init__(state["options"], cache=state["cache"])

    def __repr__(self) -> str:
        """Length and digest."""
        return f"World({len(self)} samples, options {self.options.digest[:12]})"

    @cached_property
    def plans(self) -> list[VideoPlan]:
        """All videos."""
        return plan_world(self.options)

    def __len__(self) -> int:
        """Number of contact frames."""
        return len(self.plans) * self.options.touches_per_video * self.options.frames_per_touch

    @property
    def ids(self) -> list[str]:
        """The ids, in order: those of the manifest."""
        return [
            sample_id(self.options, row.video, row.frame)
            for row in contact_rows(self.options, self.plans)
        ]

    def row(self, k: SupportsIndex) -> Row:
        """Video, touch and frame of sample ``k``; negative numbers count from the end.

        Raises:
            NoSampleError: if there is no such sample.
        """
        number = operator.index(k)
        if not -len(self) <= number < len(self):
            raise NoSampleError(
                f"A sample of this world must be 0 to {len(self) - 1}",
                shown(number),
                "Choose another sample",
            )
        return contact_row(self.options, self.plans, number % len(self))

    def sample(self, k: SupportsIndex) -> dict[str, Any]:
        """Renders one sample.

        Returns:
            ``vision``, ``tactile``, ``background``: uint8 (size, size, 3); ``id``, ``video``, ``touch``, ``object``, ``material``, ``text``, ``sensor``:
            text; ``frame``, ``label``: integers. The columns mean what they mean in the manifest; ``label`` is the material's number.

        Raises:
            NoSampleError: if there is no such sample.
            PalpateError: if a material draws something invalid.
        """
        row = self.row(k)
        video = self._video(row.video)
        material = row.video.object_of(row.touch).material
        return {
            "id": sample_id(self.options, row.video, row.frame),
            "video": video_id(self.options, row.video),
            "frame": row.frame,
            "contact": touch_id(self.options, row.video, row.touch),
            "object": row.object,
            "material": material,
            "label": MATERIALS[material].label,
            "text": video.text(row.touch),
            "sensor": f"{self.options.look}-{row.video.sensor}",
            "vision": video.vision(row.frame),
            "tactile": video.tactile(row.frame),
            "background": video.background_of(row.touch),
        }

    def __getitem__(self, k: SupportsIndex) -> dict[str, Any]:
        """:meth:`sample`."""
        return self.sample(k)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """All samples, in order."""
        return map(self.sample, range(len(self)))

    def manifest(self, progress: Progress = quiet) -> Manifest:
        """The world's manifest, without images; draws every object once for the captions, so it takes a while.

        Args:
            progress: told after each video.
        """
        captions: dict[str, list[str]] = {}
        for count, plan in enumerate(self.plans, 1):
            video = self._video(plan)
            captions[plan.name] = [
                video.text(touch) for touch in range(self.options.touches_per_video)
            ]
            progress("wording videos", count, len(self.plans))
        return world_manifest(self.options, self.plans, captions, None)

    def split(self, manifest: Manifest | None = None) -> Split:
        """The world's own cut into train and test, which leaks as ``options.leak`` says.

        Args:
            manifest: of this world, to enter its digest into the split.

        Raises:
            PalpateError: if the world is too small to cut.
        """
        train, test = cut(self.options, self.plans, list(contact_rows(self.options, self.plans)))
        return world_split(self.options, train, test, None if manifest is None else manifest.digest)

    def _video(self, plan: VideoPlan) -> Video:
        if plan.index not in self._videos:
            self._videos[plan.index] = Video(self.options, plan)
            while len(self._videos) > self.cache:
                self._videos.popitem(last=False)
        self._videos.move_to_end(plan.index)
        return self._videos[plan.index]

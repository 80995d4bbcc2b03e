"""A world without files: any of its samples rendered when requested.

``World(options)[k]`` gives the arrays that :func:`palpate.sim.write_world` writes as row k of its
manifest, pixel for pixel (before JPEG). It is a map-style data set, and can be pickled and sent to
the workers of a data loader. A few videos are kept ready. In order a sample costs its three images;
at random also the set-up of its object and video, several times as much.
"""

from __future__ import annotations

import json
import operator
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, SupportsIndex

from palpate.core import PalpateError, Split, require, require_choice
from palpate.data.formats.touch_and_go import CATEGORIES
from palpate.data.manifest import Manifest
from palpate.sim.layouts import Parts, image_paths
from palpate.sim.leak import cut
from palpate.sim.materials import MATERIALS
from palpate.sim.motion import make_contacts, state_at
from palpate.sim.options import VERSION, WorldOptions
from palpate.sim.plan import Row, VideoPlan, contact_rows, plan_world
from palpate.sim.presets import PRESETS
from palpate.sim.video import Video


class NoSampleError(PalpateError, IndexError):
    """There is no sample of that number; also an IndexError, as sequences raise."""


class World:
    """The contact frames of a world, by video and frame.

    Args:
        options: the world, or the name of a preset (``"tiny"``, ``"small"``, ...); default
            ``WorldOptions()``.
        cache: videos kept ready (about 1 MB each at 64 px, 4 MB at 128 px).

    Raises:
        PalpateError: for an unknown preset, or a cache below 1.
    """

    def __init__(self, options: WorldOptions | str | None = None, *, cache: int = 4) -> None:
        if isinstance(options, str):
            require_choice("options", options, PRESETS)
        require(cache >= 1, "cache", "must be at least 1", cache)
        self.options = PRESETS[options] if isinstance(options, str) else options or WorldOptions()
        self.cache = cache
        self.video = lru_cache(cache)(partial(Video, self.options))
        self.contacts = lru_cache(1)(partial(make_contacts, self.options))

    def __reduce__(self) -> Any:
        """Pickle the options alone: a copy in another process renders for itself."""
        return partial(World, self.options, cache=self.cache), ()

    @cached_property
    def plans(self) -> list[VideoPlan]:
        """All videos."""
        return plan_world(self.options)

    @cached_property
    def rows(self) -> list[Row]:
        """The samples in order."""
        return list(contact_rows(self.options, self.plans))

    @cached_property
    def parts(self) -> Parts:
        """The samples of ``train`` and ``test``, in the order of the lists.

        Raises:
            PalpateError: if the world is too small for its cut.
        """
        return cut(self.options, self.rows)

    def __len__(self) -> int:
        """Count the contact frames."""
        return len(self.rows)

    @property
    def ids(self) -> list[str]:
        """The ids in order: those of the manifest."""
        return [row.id for row in self.rows]

    def __getitem__(self, k: SupportsIndex) -> dict[str, Any]:
        """Render a sample; negative numbers count from the end.

        Returns:
            ``vision``, ``tactile``, ``background``: uint8 (size, size, 3); ``id``, ``video``,
            ``contact``, ``object``, ``material``, ``text``, ``sensor``: text; ``frame``, ``label``:
            integers; ``depth``: float. They mean what they mean in the manifest; ``label`` is the
            material's number.

        Raises:
            NoSampleError: if there is no such sample.
            PalpateError: if a material draws something invalid.
        """
        number = operator.index(k)
        if not -len(self) <= number < len(self):
            must = f"A sample of this world must be 0 to {len(self) - 1}"
            raise NoSampleError(must, str(number), "Choose another sample")
        row = self.rows[number]
        video = self.video(row.video)
        return self._cells(row, video.text(row.contact)) | {
            "label": row.material.label,
            "vision": video.vision(row.frame),
            "tactile": video.tactile(row.frame),
            "background": video.background_of(row.contact),
        }

    def _cells(self, row: Row, text: str) -> dict[str, Any]:
        """Return what the world knows of a contact frame, in the manifest's columns."""
        return {
            "id": row.id,
            "video": row.video.name,
            "frame": row.frame,
            "contact": row.contact_id,
            "object": row.object.name,
            "material": row.object.material,
            "text": text,
            "sensor": f"{self.options.look}-{row.video.sensor}",
            "depth": state_at(self.options, row.video, self.contacts(row.video), row.frame).load,
        }

    def manifest(self, captions: Mapping[str, Sequence[str]], folder: Path) -> Manifest:
        """Return the manifest of all contact frames, by video and frame.

        It has the ids, videos, contacts and image paths that ``palpate import`` reads from the
        tree, and more: the object, the gel unit and the depth.

        Args:
            captions: video name -> a caption for each contact.
            folder: of the world, where the manifest is rooted.
        """
        rows = [
            self._cells(row, captions[row.video.name][row.contact]) | image_paths(self.options, row)
            for row in self.rows
        ]
        facts = {  # it must never pass for a real data set
            "dataset": "palpate's procedural world",
            "synthetic": "yes",
            "world_version": str(VERSION),
            "world_options": self.options.digest,
            "text_source": "measured surface",
            "layout": self.options.layout,
            "format": "touch-and-go",
        }
        classes = {material.label: name for name, material in MATERIALS.items()}
        if classes != CATEGORIES:
            facts["classes"] = json.dumps({str(label): name for label, name in classes.items()})
        return Manifest.from_rows(rows, folder, facts, ["depth"])

    def split(self, manifest: str) -> Split:
        """Return ``Orig``: the cut over the ids of the manifest of that digest, in list order."""
        names = ("leak", "test", "seed")
        rule = {"method": "world"} | {name: getattr(self.options, name) for name in names}
        return Split.from_ids(
            rule=rule | {"world_version": VERSION},
            manifest=manifest,
            train=[row.id for row in self.parts["train"]],
            test=[row.id for row in self.parts["test"]],
        )

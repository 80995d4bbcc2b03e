"""The saved pipeline: everything needed to turn a photo into a touch, in one folder that needs nothing else.

::

    unet/          the denoiser, diffusers' format, and condition.safetensors (modality means, learned null)
    autoencoder/   the VQModel, diffusers' format, and its palpate.json
    encoders/      the vision encoder (and text encoder) whose embeddings the denoiser knows
    scheduler/     scheduler_config.json, diffusers' format: for programs that read only the parts
    palpate.json   preset, condition policy, schedule, sampler, latent statistics, background flag, training record, digest
    README.md      the card for people

A pipeline that was trained on the encoders and the autoencoder of a shipped model may refer to them instead of carrying copies: then
``autoencoder/`` and ``encoders/`` are absent, and ``"shared"`` in ``palpate.json`` names the model. Their digests stand there in either
case and are checked on loading.

The *digest* names weights, condition policy, schedule and latent statistics: what the pictures depend on beside
seed, sampler settings and input.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from palpate import __version__
from palpate.core import (
    PalpateError,
    Progress,
    atomic_folder,
    digest_json,
    quiet,
    reading_entry,
    write_json,
)
from palpate.core.shipped import SHIPPED, is_shipped
from palpate.diffusion.autoencoder import Autoencoder
from palpate.diffusion.card import FORMAT, FORMAT_1, SamplerOptions, read_card
from palpate.diffusion.denoiser import ConditionPolicy, Denoiser, Source
from palpate.diffusion.latents import LatentStats
from palpate.diffusion.pixels import architecture, digest_tensors, to_unit
from palpate.diffusion.sampling import build_scheduler, require_sampling, sample_latents
from palpate.diffusion.training import Schedule
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.hub import find_model
from palpate.training.cards import write_model_cards

SYNTHETIC = "Made by a generator that was trained on synthetic data alone (palpate's procedural world), not on a real sensor."
#: Photos embedded at once, always: an embedding does not depend on its neighbors.
EMBED = 32


@dataclass(frozen=True)
class TactilePipeline:
    """A generator of touches.

    Attributes:
        autoencoder, denoiser: frozen, on one device.
        stats: of the training latents.
        schedule: that the denoiser was trained with.
        sampler: the default sampling settings.
        size: side of the touches in pixels.
        encoders: give the vision embeddings of photos; None for a pipeline driven by embeddings alone.
        preset: name of the preset.
        training: JSON record: digests of manifest, split and encoder, steps, seed, source of the conditions, versions.
    """

    autoencoder: Autoencoder
    denoiser: Denoiser
    stats: LatentStats
    schedule: Schedule
    sampler: SamplerOptions
    size: int
    encoders: EncoderSet | None = None
    preset: str = ""
    training: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all that the pictures depend on beside seed, sampler and input."""
        parts = [
            asdict(self.stats),
            asdict(self.schedule),
            asdict(self.denoiser.policy),
            self.size,
            self.autoencoder.digest,
        ]
        parts.append(architecture(self.denoiser.unet.config))
        return digest_json(
            [
                FORMAT_1,
                *parts,
                digest_tensors(self.denoiser.state_dict()),
                self.encoders.digest("vision") if self.encoders else None,
            ]
        )

    @property
    def background(self) -> bool:
        """Whether each touch needs an image of the sensor touching nothing."""
        return self.denoiser.background

    @property
    def vision_size(self) -> int:
        """Side in pixels at which photos are best given; they are resized to the encoder's input anyway."""
        return self._encoders().preprocess("vision").resize

    def _encoders(self) -> EncoderSet:
        if self.encoders is None:
            raise PalpateError(
                "Photos need the pipeline's vision encoder",
                "a pipeline without encoders",
                "Save it with its encoders",
            )
        return self.encoders

    def sampler_with(
        self, *, guidance: float | None = None, steps: int | None = None, batch: int | None = None
    ) -> SamplerOptions:
        """The default sampler with some settings replaced.

        Raises:
            PalpateError: on settings that this pipeline cannot sample with.
        """
        given = {"guidance": guidance, "steps": steps, "batch": batch}
        sampler = replace(self.sampler, **{k: v for k, v in given.items() if v is not None})
        require_sampling(sampler, self.schedule, self.denoiser)
        return sampler

    def embed(self, vision: np.ndarray) -> Tensor:
        """Photos, bytes (n, h, w, 3), -> L2-normalized vision embeddings (n, d), on the CPU."""
        encoders, parts = self._encoders(), list[Tensor]()
        transform = encoders.preprocess("vision")
        with torch.no_grad():
            for start in range(0, len(vision), EMBED):
                stop = min(start + EMBED, len(vision))
                # The last batch repeats its last row: every batch runs the same kernels.
                pixels = transform.fit(
                    vision[[min(k, stop - 1) for k in range(start, start + EMBED)]]
                )
                unit = to_unit(pixels).add(1.0).div(2.0).to(encoders.device)
                embedded = encoders.encode("vision", transform.normalize(transform.crop(unit)))
                parts.append(embedded[: stop - start].cpu())
        return torch.cat(parts) if parts else torch.empty(0, encoders.dim)

    def touch(
        self,
        vision: np.ndarray,
        ids: Sequence[str],
        *,
        seed: int,
        guidance: float | None = None,
        steps: int | None = None,
        background: np.ndarray | None = None,
        progress: Progress = quiet,
    ) -> np.ndarray:
        """The touches that photos promise.

        Args:
            vision: bytes (n, h, w, 3).
            ids: n sample ids; with ``seed`` they decide the noise.
            seed: of the noise.
            guidance: s; default: the sampler's.
            steps: of the solver; default: the sampler's.
            background: bytes (n, size, size, 3), for a pipeline w/ BG.
            progress: called with the number of touches done.

        Returns:
            Bytes (n, size, size, 3).

        Raises:
            PalpateError: if lengths differ, a background is missing, or guidance is asked of a model without dropout.
        """
        sampler = self.sampler_with(guidance=guidance, steps=steps)
        return self.touch_from_embeddings(
            self.embed(vision),
            ids,
            seed=seed,
            sampler=sampler,
            background=background,
            progress=progress,
        )

    def touch_from_embeddings(
        self,
        conditions: Tensor | np.ndarray,
        ids: Sequence[str],
        *,
        seed: int,
        source: Source = "vision",
        sampler: SamplerOptions | None = None,
        background: np.ndarray | None = None,
        progress: Progress = quiet,
    ) -> np.ndarray:
        """Like :meth:`touch`, from embeddings (n, d) of either source."""
        options = sampler or self.sampler
        ground = None
        if background is not None:
            if background.shape[1:3] != (self.size, self.size):
                got = f"{background.shape[1]} x {background.shape[2]}"
                raise PalpateError(
                    f"Background images must be {self.size} pixels square", got, "Resize them"
                )
            ground = self.stats.normalize(self.autoencoder.encode(background))
        tokens = self.denoiser.tokens(torch.as_tensor(conditions), source)
        latents = sample_latents(
            self.denoiser,
            tokens,
            ids,
            size=self.size // self.autoencoder.factor,
            schedule=self.schedule,
            options=options,
            seed=seed,
            background=ground,
            progress=progress,
        )
        return self.autoencoder.decode(self.stats.restore(latents))

    def to(self, device: str | torch.device) -> TactilePipeline:
        """Moves all parts to a device, in place; returns the pipeline."""
        self.autoencoder.to(device)
        self.denoiser.to(device)
        if self.encoders is not None:
            self.encoders.to(str(device))
        return self

    @property
    def notice(self) -> str:
        """What everyone who looks at its touches must know; empty for a pipeline trained on real data."""
        if not self.training.get("synthetic"):
            return ""
        records = (self.training, self.training.get("start_record") or {})
        known = sorted({str(name) for record in records for name in record.get("materials", ())})
        return (
            f"{SYNTHETIC} It knows only these materials: {', '.join(known)}."
            if known
            else SYNTHETIC
        )

    def save(self, folder: Path, *, half: bool = False, shared: str | None = None) -> None:
        """Writes the pipeline; the folder appears whole or not at all.

        Args:
            folder: must be new or empty.
            half: round the weights to 16 bits first (of this object too: its digest changes), and write 16-bit weights.
            shared: a shipped name whose encoders and autoencoder this pipeline uses: they are then referred to, not written.

        Raises:
            PalpateError: if the folder exists and is not empty, a weight is too large for 16 bits, or the shared model differs.
        """
        if shared is not None:
            self._require_shared(shared)
        with atomic_folder(Path(folder)) as part:
            self.denoiser.save(part / "unet", half=half)
            if shared is None:
                self.autoencoder.save(part / "autoencoder", half=half)
                if self.encoders is not None:
                    self.encoders.save(part / "encoders", half=half)
            self.__dict__.pop("digest", None)  # of the weights before rounding
            build_scheduler(self.schedule, self.sampler.method).save_pretrained(part / "scheduler")
            write_json(
                part / "palpate.json",
                self.to_json() | ({} if shared is None else {"shared": shared}),
            )
            write_model_cards(part)

    def _require_shared(self, name: str) -> None:
        autoencoder, encoders = _shared_parts(name)
        here = (self.autoencoder.digest, self.encoders.digest("vision") if self.encoders else None)
        if here != (autoencoder.digest, encoders.digest("vision")):
            raise PalpateError(
                f"A pipeline that refers to {name} must use its autoencoder and vision encoder",
                "others",
                "Leave out shared, or train on these",
            )

    def to_json(self) -> dict[str, Any]:
        """The content of ``palpate.json``."""
        return {
            "format": FORMAT,
            "digest": self.digest,
            "preset": self.preset,
            "size": self.size,
            "background": self.background,
            "condition": asdict(self.denoiser.policy),
            "schedule": asdict(self.schedule),
            "sampler": asdict(self.sampler),
            "latents": asdict(self.stats) | {"factor": self.autoencoder.factor},
            "autoencoder": self.autoencoder.digest,
            "encoders": self.encoders.digest("vision") if self.encoders else None,
            "training": dict(self.training),
            "palpate": __version__,
        }

    @classmethod
    def load(cls, source: str | Path) -> TactilePipeline:
        """Reads a saved pipeline and checks its digest.

        Args:
            source: a shipped name (``palpate/mini``), a folder or a hub id; see :mod:`palpate.core.shipped`.

        Raises:
            PalpateError: if the folder is no pipeline, is of another format, holds or refers to other weights than it says, or the
                hub cannot be reached.
        """
        folder = find_model(source, "generator", "pipeline", "Make one with: palpate train")
        note = folder / "palpate.json"
        about = read_card(folder)
        settings = _settings(note, about)
        if "shared" in about:
            autoencoder, encoders = _shared_parts(str(about["shared"]))
            if (autoencoder.digest, encoders.digest("vision")) != (
                about["autoencoder"],
                about["encoders"],
            ):
                must = f"{folder} must find the parts of {about['shared']} that it was trained on"
                raise PalpateError(
                    must,
                    "those of another version of palpate",
                    "Install the version that it names, or train again",
                )
        else:
            autoencoder = Autoencoder.load(folder / "autoencoder")
            place = folder / "encoders"
            place = place if place.is_dir() else folder / "towers"  # format 1
            encoders = EncoderSet.load(place) if about["encoders"] else None
        with reading_entry(note, "condition"):
            policy = ConditionPolicy(**about["condition"])
        pipeline = cls(
            autoencoder=autoencoder,
            denoiser=Denoiser.load(folder / "unet", policy),
            encoders=encoders,
            **settings,
        )
        if pipeline.digest != about["digest"]:
            raise PalpateError(
                f"The weights in {folder} must match its palpate.json",
                "other weights",
                "Copy the whole folder again",
            )
        return pipeline


def _settings(note: Path, about: Mapping[str, Any]) -> dict[str, Any]:
    """The pipeline's settings in a card; those that the digest covers are only read, the others must make sense.

    Raises:
        PalpateError: naming the entry that cannot be used.
    """
    settings: dict[str, Any] = {}
    with reading_entry(note, "latents"):
        stats = about["latents"]
        settings["stats"] = LatentStats(
            tuple(map(float, stats["mean"])), tuple(map(float, stats["std"])), stats["scale"]
        )
    with reading_entry(note, "schedule"):
        settings["schedule"] = Schedule(**about["schedule"])
    with reading_entry(note, "sampler"):
        settings["sampler"] = SamplerOptions(**about["sampler"])
        require_sampling(settings["sampler"], settings["schedule"])
    with reading_entry(note, "size"):
        settings["size"] = int(about["size"])
    with reading_entry(note, "training"):
        settings["training"] = dict(about["training"].items())
    return settings | {"preset": str(about["preset"])}


def _shared_parts(name: str) -> tuple[Autoencoder, EncoderSet]:
    """Autoencoder and encoders of a shipped model; a folder or hub id is refused, as it would mean another thing elsewhere.

    Raises:
        PalpateError: if the name is none of the shipped ones.
    """
    if not is_shipped(name):
        raise PalpateError(
            f"A pipeline may refer to {', '.join(SHIPPED)}",
            repr(name),
            "Save it with its own encoders and autoencoder",
        )
    return Autoencoder.load(name), EncoderSet(load_clip(name))

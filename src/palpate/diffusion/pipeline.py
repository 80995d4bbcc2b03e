"""The pipeline: from a photo to a tactile image, in memory and as a self-contained folder.

    c = vision encoder(photo);  z^T ~ N(0, 1);  z^0 = solver(guided eps_theta);  image = D(z^0)

    eps = eps_theta(z, t, null) + s (eps_theta(z, t, c) - eps_theta(z, t, null))    (s = 7.5)

Both passes of guidance run as one batch; s = 1 needs the conditional pass alone, s = 0 the
unconditional one. The solvers are diffusers': DDIM without added noise (eta = 0; the paper's 200
steps) and second-order DPM-Solver++ for few steps. The starting noise of a sample comes from
``rng_for(seed, "noise", id)`` and batches always have one size (the last is filled up), so that an
image depends on (seed, id) and not on what else is generated.

::

    unet/          the denoiser, diffusers' format, and condition.safetensors (means, learned null)
    autoencoder/   the VQModel, diffusers' format, and its palpate.json
    encoders/      the vision (and text) encoder whose embeddings the denoiser knows
    scheduler/     scheduler_config.json, diffusers' format: for programs that read only the parts
    palpate.json   preset, condition policy, schedule, sampler, latent statistics, record, digest
    README.md      the card for people

A pipeline trained on the encoders and autoencoder of a shipped model may refer to them instead of
carrying copies: ``"shared"`` in ``palpate.json`` names the model. Their digests are recorded in
either case and checked on loading.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from palpate import __version__
from palpate.core import (
    PalpateError,
    Progress,
    atomic_folder,
    digest_json,
    quiet,
    read_record,
    rng_for,
    write_json,
)
from palpate.diffusion.autoencoder import Autoencoder, LatentStats
from palpate.diffusion.denoiser import Denoiser
from palpate.diffusion.options import ConditionPolicy, SamplerOptions, Schedule, Source
from palpate.encoders.encoder import list_images, squares
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.models import (
    FIX_MODEL,
    SHIPPED,
    architecture,
    digest_tensors,
    find_model,
    pick_device,
)
from palpate.encoders.preprocess import to_unit
from palpate.training.cards import write_model_cards

FORMAT = "palpate-pipeline/2"
#: Format 1 called the encoders ``towers``; it is still read, and the digest still covers its name.
FORMAT_1 = "palpate-pipeline/1"
KEYS = ("digest", "preset", "size", "condition", "schedule", "sampler", "latents", "autoencoder")
COPY_AGAIN = "Copy the whole folder again"
SYNTHETIC = (
    "Made by a generator that was trained on synthetic data alone (palpate's procedural world), "
    "not on a real sensor."
)
#: Photos embedded at once, always: an embedding does not depend on the others of its batch.
EMBED = 32
#: (z_t (n, c, h, w), t (n,), tokens (n, k, d), background or None) -> prediction (n, c, h, w).
Predictor = Callable[[Tensor, Tensor, Tensor, Tensor | None], Tensor]


@dataclass(frozen=True)
class TactileImages:
    """What a pipeline returns.

    Attributes:
        images: one PIL image per photo.
    """

    images: list[Image.Image]


@dataclass(frozen=True)
class TactilePipeline:
    """A generator of tactile images.

    ::

        pipeline = TactilePipeline.from_pretrained("palpate/mini")
        image = pipeline("photo.jpg", seed=0).images[0]

    Attributes:
        autoencoder, denoiser: frozen, on one device.
        stats: of the training latents.
        schedule: that the denoiser was trained with.
        sampler: the default sampling settings.
        size: side of the tactile images in pixels.
        encoders: give the vision embeddings of photos; None for a pipeline driven by embeddings
            alone.
        preset: name of the preset.
        training: JSON record: digests of manifest, split and encoder, steps, seed, source of the
            conditions.
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

    def __call__(
        self,
        photos: Any,
        *,
        ids: Sequence[str] | None = None,
        seed: int = 0,
        guidance: float | None = None,
        steps: int | None = None,
        background: Any = None,
        progress: Progress = quiet,
    ) -> TactileImages:
        """Tactile images for photos.

        Args:
            photos: a file or a folder of them, a PIL image, a list of files or PIL images, a uint8
                array (n, h, w, 3), or a tensor (n, 3, h, w).
            ids: one name per photo; with ``seed`` they decide the noise. Default: the file names,
                and ``"0"``, ``"1"``, ... for images in memory.
            seed: of the noise.
            guidance: s; default: the sampler's.
            steps: of the solver; default: the sampler's.
            background: no-contact images, one per photo, for a pipeline w/ BG.
            progress: called with the number of images done.

        Raises:
            PalpateError: if a photo is unreadable, a background is missing, or settings do not fit.
        """
        images = list_images(photos)
        if ids is None:
            ids = [i.name if isinstance(i, Path) else str(k) for k, i in enumerate(images)]
        sampler = self.sampler_with(guidance=guidance, steps=steps)
        if len(images) == 1:  # not among the copies that fill a batch: a fraction of the time
            sampler = replace(sampler, batch=1)
        ground = None if background is None else squares(list_images(background), self.size)
        embedded = self.embed(squares(images, self.vision_size))
        made: list[Image.Image] = []
        for start in range(0, len(ids), sampler.batch):
            rows = slice(start, start + sampler.batch)
            arrays = self.sample(
                embedded[rows],
                ids[rows],
                seed=seed,
                sampler=sampler,
                background=None if ground is None else ground[rows],
            )
            made += map(Image.fromarray, arrays)
            progress("generating", len(made), len(ids))
        return TactileImages(made)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all that the images depend on, except seed, sampler and input."""
        parts = [
            FORMAT_1,
            asdict(self.stats),
            asdict(self.schedule),
            asdict(self.denoiser.policy),
            self.size,
            self.autoencoder.digest,
            architecture(self.denoiser.unet.config),
            digest_tensors(self.denoiser.state_dict()),
        ]
        return digest_json([*parts, self.encoders.digest("vision") if self.encoders else None])

    @property
    def background(self) -> bool:
        """Whether each image needs one of the sensor without contact."""
        return self.denoiser.background

    @property
    def vision_size(self) -> int:
        """Side in pixels of the squares that photos are resized to."""
        return self._encoders().preprocess("vision").resize

    def _encoders(self) -> EncoderSet:
        if self.encoders is None:
            must, got = "Photos need the pipeline's vision encoder", "a pipeline without encoders"
            raise PalpateError(must, got, "Save it with its encoders")
        return self.encoders

    def sampler_with(
        self, *, guidance: float | None = None, steps: int | None = None, batch: int | None = None
    ) -> SamplerOptions:
        """The default sampler with some settings replaced.

        Raises:
            PalpateError: on settings that this pipeline cannot sample with.
        """
        requested = {"guidance": guidance, "steps": steps, "batch": batch}
        given = {k: v for k, v in requested.items() if v is not None}
        sampler = replace(self.sampler, **given)
        most, dropout = self.schedule.steps, self.denoiser.policy.dropout
        if not 1 <= sampler.steps <= most:
            must, example = f"must lie in 1 to {most}", {"steps": 50}
            raise PalpateError(must, str(sampler.steps), "", argument="steps", example=example)
        if sampler.batch < 1:
            example = {"batch": 16}
            raise PalpateError(
                "must be at least 1", str(batch), "", argument="batch", example=example
            )
        if not (math.isfinite(sampler.guidance) and sampler.guidance >= 0):
            must, fix = "must be a finite number from 0 on", "Choose e.g. 2; 1 is none"
            raise PalpateError(must, str(sampler.guidance), fix, argument="guidance")
        if sampler.guidance != 1 and not dropout:
            must, fix = "must be 1 for a generator trained without condition dropout", "Choose 1"
            raise PalpateError(must, f"{sampler.guidance:g}", fix, argument="guidance")
        return sampler

    def embed(self, photos: NDArray[np.uint8]) -> Tensor:
        """Photos, bytes (n, h, w, 3), -> L2-normalized vision embeddings (n, d), on the CPU."""
        encoders = self._encoders()
        preprocess, parts = encoders.preprocess("vision"), [torch.empty(0, encoders.dim)]
        with torch.no_grad():
            for rows, count in _batches(len(photos), EMBED):
                unit = to_unit(preprocess.fit(photos[rows]), encoders.device, signed=True)
                pixels = preprocess(unit.add(1.0).div(2.0))
                parts.append(encoders.encode("vision", pixels)[:count].cpu())
        return torch.cat(parts)

    def sample(
        self,
        conditions: Tensor | NDArray[Any],
        ids: Sequence[str],
        *,
        seed: int,
        source: Source = "vision",
        sampler: SamplerOptions | None = None,
        background: NDArray[np.uint8] | None = None,
    ) -> NDArray[np.uint8]:
        """Tactile images (n, size, size, 3), uint8, from embeddings (n, d) of either source.

        Args:
            conditions: one row per id.
            ids: with ``seed`` they decide the noise.
            seed: of the noise.
            source: of the embeddings.
            sampler: default: the pipeline's.
            background: bytes (n, size, size, 3) of the sensor without contact, for a pipeline w/
                BG.

        Raises:
            PalpateError: if there is not one condition per id, or a background is missing or of
                another size.
        """
        if len(conditions) != len(ids):
            got, fix = f"{len(ids)} ids, {len(conditions)} conditions", "Pass one row per id"
            raise PalpateError("Every id needs one condition", got, fix)
        if self.background != (background is not None):
            must = "must be given for a generator w/ BG, and only for one"
            raise PalpateError(
                must, "none" if self.background else "one", "", argument="background"
            )
        ground = None
        if background is not None:
            if background.shape[:3] != (len(ids), self.size, self.size):
                must = f"must hold one image of {self.size} pixels square per photo"
                raise PalpateError(must, str(background.shape), "", argument="background")
            ground = self.stats.normalize(self.autoencoder.encode(background))
        side = self.size // self.autoencoder.factor
        latents = sample(
            self.denoiser,
            self.denoiser.tokens(torch.as_tensor(conditions), source),
            self.denoiser.null_tokens(1),
            ids,
            shape=(self.denoiser.channels, side, side),
            schedule=self.schedule,
            options=sampler or self.sampler_with(),
            seed=seed,
            background=ground,
        )
        return self.autoencoder.decode(self.stats.restore(latents))

    def to(self, device: str | torch.device) -> TactilePipeline:
        """Move all parts to a device, in place; return the pipeline."""
        for part in (self.autoencoder, self.denoiser):
            part.to(pick_device(device))
        if self.encoders is not None:
            self.encoders.to(device)
        return self

    @property
    def notice(self) -> str:
        """What every viewer of its images must know; empty for a pipeline trained on real data."""
        if not self.training.get("synthetic"):
            return ""
        records = (self.training, self.training.get("start_record") or {})
        known = sorted({str(name) for record in records for name in record.get("materials", ())})
        only = f" It knows only these materials: {', '.join(known)}." if known else ""
        return SYNTHETIC + only

    def save(self, folder: Path, *, half: bool = False, shared: str | None = None) -> None:
        """Write the pipeline; the folder appears whole or not at all.

        Args:
            folder: must be new or empty.
            half: round the weights to 16 bits first (of this object too: its digest changes), and
                write 16-bit weights.
            shared: a shipped name whose encoders and autoencoder this pipeline uses: they are
                referred to, not written.

        Raises:
            PalpateError: if the folder is not empty, a weight is too large for 16 bits, or the
                shared model differs.
        """
        if shared is not None and self._digests() != _digests(*_shared_parts(shared)):
            must = f"A pipeline that refers to {shared} must use its autoencoder and vision encoder"
            raise PalpateError(must, "others", "Leave out shared, or train on these")
        with atomic_folder(Path(folder)) as part:
            self.denoiser.save(part / "unet", half=half)
            if shared is None:
                self.autoencoder.save(part / "autoencoder", half=half)
                if self.encoders is not None:
                    self.encoders.save(part / "encoders", half=half)
            self.__dict__.pop("digest", None)  # of the weights before rounding
            build_scheduler(self.schedule, self.sampler.method).save_pretrained(part / "scheduler")
            about = self.to_json() | ({} if shared is None else {"shared": shared})
            write_json(part / "palpate.json", about)
            write_model_cards(part)

    def _digests(self) -> tuple[str, str | None]:
        return _digests(self.autoencoder, self.encoders)

    def to_json(self) -> dict[str, Any]:
        """The content of ``palpate.json``."""
        autoencoder, vision = self._digests()
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
            "autoencoder": autoencoder,
            "encoders": vision,
            "training": dict(self.training),
            "palpate": __version__,
        }

    @classmethod
    def from_pretrained(cls, source: str | Path, *, device: str = "auto") -> TactilePipeline:
        """Read a saved pipeline and check its digest.

        Args:
            source: a shipped name (``palpate/mini``), a folder of ``palpate train generator`` or a
                hub id.
            device: ``auto``, ``cpu``, ``cuda`` or ``mps``.

        Raises:
            PalpateError: if the folder is no pipeline, holds or refers to other weights than it
                says, or the hub is out of reach.
        """
        folder = find_model(source, "generator", "pipeline", FIX_MODEL)
        note, forms = folder / "palpate.json", (FORMAT, FORMAT_1)
        about = read_record(note, "card of the pipeline", form=forms, keys=KEYS)
        vision = about.get("encoders", about.get("towers"))  # format 1
        if "shared" in about:
            autoencoder, encoders = _shared_parts(str(about["shared"]))
            if _digests(autoencoder, encoders) != (about["autoencoder"], vision):
                must = f"{folder} must find the parts of {about['shared']} that it was trained on"
                fix = "Install the version that it names, or train again"
                raise PalpateError(must, "those of another version of palpate", fix)
        else:
            autoencoder = Autoencoder.load(folder / "autoencoder")
            place = folder / ("encoders" if about["format"] == FORMAT else "towers")
            encoders = EncoderSet.load(place) if vision else None
        try:
            latents = about["latents"]
            pipeline = cls(
                autoencoder=autoencoder,
                denoiser=Denoiser.load(folder / "unet", ConditionPolicy(**about["condition"])),
                stats=LatentStats(tuple(latents["mean"]), tuple(latents["std"]), latents["scale"]),
                schedule=Schedule(**about["schedule"]),
                sampler=SamplerOptions(**about["sampler"]),
                size=int(about["size"]),
                encoders=encoders,
                preset=str(about["preset"]),
                training=dict(about["training"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            must = f"The entries of {note} must be as palpate writes them"
            raise PalpateError(must, f"{type(error).__name__}: {error}", COPY_AGAIN) from None
        if pipeline.digest != about["digest"]:
            must = f"The weights in {folder} must match its palpate.json"
            raise PalpateError(must, "other weights", COPY_AGAIN)
        return pipeline.to(device)


def _digests(autoencoder: Autoencoder, encoders: EncoderSet | None) -> tuple[str, str | None]:
    return autoencoder.digest, encoders.digest("vision") if encoders else None


def _shared_parts(name: str) -> tuple[Autoencoder, EncoderSet]:
    """Load autoencoder and encoders of a shipped model; a folder would differ elsewhere."""
    if name not in SHIPPED:
        must, fix = f"must be one of {', '.join(SHIPPED)}", "Save the pipeline with its parts"
        raise PalpateError(must, repr(name), fix, argument="shared")
    return Autoencoder.load(name), EncoderSet(load_clip(name))


def build_scheduler(
    schedule: Schedule, method: Literal["ddim", "dpm"]
) -> DDIMScheduler | DPMSolverMultistepScheduler:
    """The diffusers scheduler for a trained model; latents are not clipped."""
    common: dict[str, Any] = {
        "num_train_timesteps": schedule.steps,
        "beta_start": schedule.beta_start,
        "beta_end": schedule.beta_end,
        "beta_schedule": "scaled_linear",
        "prediction_type": schedule.prediction,
        # Trailing steps start at t = T, where the starting noise belongs, for any number of steps.
        "timestep_spacing": "trailing",
    }
    if method == "ddim":
        return DDIMScheduler(clip_sample=False, set_alpha_to_one=True, **common)
    # Steps uniform in log(a / (1 - a)). Uniform in t, 20 steps leave one wide gap before t = 0
    # under this
    # schedule, and Gaussian data of spread 0.4 (0.2) come out with 80 % (55 %) of it; now with 100
    # % (99 %).
    common |= {"algorithm_type": "dpmsolver++", "solver_order": 2, "use_lu_lambdas": True}
    return DPMSolverMultistepScheduler(**common)


def starting_noise(ids: Sequence[str], shape: tuple[int, int, int], seed: int) -> Tensor:
    """z^T of each sample: float32 (n, c, h, w), a function of (seed, id) alone."""
    draws = [rng_for(seed, "noise", i).standard_normal(shape, dtype=np.float32) for i in ids]
    return torch.from_numpy(np.stack(draws))


@torch.no_grad()
def sample(
    predict: Predictor,
    tokens: Tensor,
    null: Tensor,
    ids: Sequence[str],
    *,
    shape: tuple[int, int, int],
    schedule: Schedule,
    options: SamplerOptions,
    seed: int,
    background: Tensor | None = None,
) -> Tensor:
    """Normalized latents (n, c, h, w) of ``ids``, on the CPU.

    Args:
        predict: the network, or any function of its form.
        tokens: conditions (n, k, d), on the network's device.
        null: the unconditional tokens (1, k, d).
        ids: n sample ids.
        shape: (c, h, w) of a latent.
        schedule: the network's.
        options: see :class:`SamplerOptions`.
        seed: of the starting noise.
        background: normalized background latents (n, c, h, w), or None.
    """
    parts = [torch.empty(0, *shape)]
    for rows, count in _batches(len(ids), options.batch):
        z = starting_noise([ids[k] for k in rows], shape, seed).to(tokens.device)
        ground = None if background is None else background[rows].to(tokens.device)
        given = tokens[rows]
        scheduler = build_scheduler(schedule, options.method)
        scheduler.set_timesteps(options.steps, device=z.device)
        z = z * scheduler.init_noise_sigma
        for t in scheduler.timesteps:
            times, empty = t.expand(len(z)), null.expand(given.shape)
            prediction = guided(predict, z, times, given, empty, ground, options)
            step: Any = scheduler.step(prediction, t, z, return_dict=False)  # pyright: ignore[reportArgumentType]
            z = step[0]
        parts.append(z[:count].cpu())
    return torch.cat(parts)


def guided(  # noqa: PLR0917 - in the order of the network's arguments
    predict: Predictor,
    z: Tensor,
    t: Tensor,
    tokens: Tensor,
    null: Tensor,
    background: Tensor | None,
    options: SamplerOptions,
) -> Tensor:
    """Return the guided prediction; the formula holds for v as well, which is linear in eps."""
    s = options.guidance
    if s in (0.0, 1.0):
        return predict(z, t, tokens if s else null, background)
    twice = None if background is None else torch.cat([background, background])
    both = predict(torch.cat([z, z]), torch.cat([t, t]), torch.cat([null, tokens]), twice)
    without, given = both.chunk(2)
    prediction = without + s * (given - without)
    if options.rescale:
        std = given.std((1, 2, 3), keepdim=True) / prediction.std((1, 2, 3), keepdim=True)
        prediction = options.rescale * prediction * std + (1 - options.rescale) * prediction
    return prediction


def _batches(n: int, size: int) -> list[tuple[list[int], int]]:
    """Return the rows of each batch and how many count: the last batch repeats its last row."""
    starts = range(0, n, size)
    rows = [[min(k, n - 1) for k in range(start, start + size)] for start in starts]
    return [(row, min(size, n - start)) for row, start in zip(rows, starts, strict=True)]

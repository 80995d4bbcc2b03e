"""The pipeline: from a photo to a tactile image, in memory and as a self-contained folder.

    c = vision encoder(photo);  z^T ~ N(0, 1);  z^0 = solver(guided eps_theta);  image = D(z^0)

Its folder is described in ``saving``.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from diffusers.pipelines.pipeline_utils import DiffusionPipeline, ImagePipelineOutput
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn

from palpate.core import PalpateError, digest_json, read_record, require, require_choice, rng_for
from palpate.core.hub import at_revision
from palpate.data.images import Preprocess, load_images, read_image, square
from palpate.diffusion.autoencoder import (
    AnyAutoencoder,
    Autoencoder,
    BackgroundAutoencoder,
    LatentStats,
    load_autoencoder,
)
from palpate.diffusion.contact import ContactScale, drawn, has_markers, maps_of, marks_of, reach
from palpate.diffusion.denoiser import (
    Denoiser,
    OnStep,
    batches,
    build_scheduler,
    sample,
    scale_at,
    starting_noise,
)
from palpate.diffusion.options import ConditionPolicy, SamplerOptions, Schedule
from palpate.diffusion.requested import Requested
from palpate.diffusion.saving import FORMAT, KEYS, write_pipeline
from palpate.diffusion.training_range import TrainingRange
from palpate.encoders.embed import embed_texts, list_images
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.models import (
    FIX_MODEL,
    SHIPPED,
    architecture,
    digest_tensors,
    find_model,
    pick_device,
    to_unit,
)
from palpate.metrics.conditions import CONDITIONS
from palpate.training.cards import write_model_cards

COPY_AGAIN = "Copy the whole folder again"
SYNTHETIC = (
    "Made by a generator that was trained on synthetic data alone (palpate's procedural world), "
    "not on a real sensor. Real photos show another scale: docs/start/generate.md says what was "
    "measured on them."
)
#: How far beyond the strengths of training touches of such surfaces one goes without a note.
TOLERATED = 0.1
#: Photos embedded at once, always: an embedding does not depend on the others of its batch.
EMBED = 32
MODULES = ("autoencoder", "scheduler", "unet")


@dataclass(eq=False, repr=False)
class TactilePipeline(DiffusionPipeline):
    """A generator of tactile images; a pipeline of diffusers.

    ::

        pipeline = TactilePipeline.from_pretrained("palpate/mini")
        image = pipeline("photo.jpg", seed=0).images[0]

    ``scheduler`` may be replaced as in any pipeline of diffusers; by default it is that of the
    sampler's method. ``dataclasses.replace`` makes a pipeline with other parts.

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
        gel: a no-contact image (size, size, 3) of the training part, for photos without one.
        seen: what photos and texts of the training look like; None of a pipeline without it.
        contact: what strength, force and depth mean, of a denoiser that knows contacts.
    """

    autoencoder: AnyAutoencoder
    denoiser: Denoiser
    stats: LatentStats
    schedule: Schedule
    sampler: SamplerOptions
    size: int
    encoders: EncoderSet | None = None
    preset: str = ""
    training: Mapping[str, Any] = field(default_factory=dict)
    gel: NDArray[np.uint8] | None = None
    seen: TrainingRange | None = None
    contact: ContactScale | None = None

    def __post_init__(self) -> None:
        """Name the parts for diffusers.

        Raises:
            PalpateError: if the U-Net and the autoencoder do not fit.
        """
        code, seen = self.autoencoder, self.denoiser.gel_channels
        latent = {self.denoiser.channels, len(self.stats.mean), len(self.stats.std)}
        fits = (
            latent == {code.channels}
            and seen in (0, code.gel_channels)
            and self.size % code.factor == 0
        )
        must = (
            f"The denoiser must be one for the autoencoder: {code.channels} channels (and "
            f"{code.gel_channels} of the gel), sides that are multiples of {code.factor}"
        )
        got = f"{sorted(latent)} channels (and {seen}), sides of {self.size}"
        require(fits, None, must, got, fix="Use the autoencoder that it was trained on")
        self.scheduler = build_scheduler(self.schedule, self.sampler.method)
        parts = (code.net if isinstance(code, Autoencoder) else code, self.scheduler, self.unet)
        self.register_to_config(**dict(zip(MODULES, map(_class_of, parts), strict=True)))

    @classmethod
    def _get_signature_keys(cls, obj: Any) -> tuple[list[str], list[str]]:
        """The names of the parts that diffusers knows, and of the others."""
        return [*MODULES], [f.name for f in fields(cls) if f.name not in MODULES]

    @property
    def unet(self) -> Any:
        """The denoiser's network."""
        return self.denoiser.unet

    @property
    def device(self) -> torch.device:
        """Where the parts are."""
        return self.denoiser.device

    @property
    def dtype(self) -> torch.dtype:
        """The type that the U-Net computes in."""
        return self.denoiser.dtype

    def __call__(
        self,
        image: Any = None,
        prompt: str | Sequence[str] | None = None,
        *,
        num_inference_steps: int | None = None,
        guidance_scale: float | None = None,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
        output_type: str = "pil",
        num_images_per_prompt: int = 1,
        **options: Any,
    ) -> ImagePipelineOutput:
        """Tactile images for photos, under the names that pipelines of diffusers use.

        Args:
            image: a file or a folder of them, a PIL image, a list of files or PIL images, an array
                (n, h, w, c) or (h, w, c), or a tensor (n, c, h, w) or (c, h, w), of bytes or of
                floats in [0, 1], with c of 1, 3 or 4; (h, w) is gray. None: of the prompt alone.
            prompt: what is felt, for all photos, or one for each.
            num_inference_steps: of the solver; default: the sampler's.
            guidance_scale: s; default: the sampler's.
            generator: of the starting noise instead of seed and ids; one for all, or one per image.
            output_type: ``pil``; ``np``: float32 (n, size, size, 3); ``pt``: (n, 3, size, size),
                both in [0, 1].
            num_images_per_prompt: images of each photo, or prompt, one after the other.
            options: further ones of :meth:`generate`.

        Returns:
            The images in ``images``.

        Raises:
            PalpateError: if a photo is unreadable, a gel is missing, or settings do not fit.
        """
        require_choice("output_type", output_type, ("pil", "np", "pt"))
        arrays = self.generate(
            image,
            generator=generator,
            copies=num_images_per_prompt,
            **cast(
                "dict[str, Any]",
                {"text": prompt, "steps": num_inference_steps, "guidance": guidance_scale}
                | options,
            ),
        )
        if output_type == "pil":
            return ImagePipelineOutput(images=[Image.fromarray(array) for array in arrays])
        unit = arrays.astype(np.float32) / 255
        tensor = torch.from_numpy(unit).permute(0, 3, 1, 2)
        made: Any = unit if output_type == "np" else tensor
        return ImagePipelineOutput(images=made)

    def generate(  # noqa: PLR0913 - each is a setting that users name
        self,
        photos: Any = None,
        *,
        text: str | Sequence[str] | None = None,
        weight: float = 0.5,
        ids: Sequence[str] | None = None,
        seed: int = 0,
        guidance: float | None = None,
        steps: int | None = None,
        gel: Any = None,
        at: tuple[float, float] | None = None,
        area: float | None = None,
        strength: float | None = None,
        shear: tuple[float, float] | None = None,
        force: float | None = None,
        depth: float | None = None,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
        callback_on_step_end: Callable[[Any, int, Tensor, dict[str, Any]], Any] | None = None,
        copies: int = 1,
    ) -> NDArray[np.uint8]:
        """Tactile images (n, size, size, 3), bytes, for photos.

        Args:
            photos: as ``image`` of :meth:`__call__`; None: one image of each text alone.
            text: what is felt; next to photos, one for all or one for each.
            weight: with both, the share of the photo where the two take one place.
            ids: one name per photo; with ``seed`` they decide the noise. Default: the file names,
                and ``"0"``, ``"1"``, ... for images in memory.
            seed: of the noise.
            guidance: s; default: the sampler's.
            steps: of the solver; default: the sampler's.
            gel: no-contact image of the gel, one for all or one per photo; default: the stock gel.
            at: place of the contact, in shares of width and height from the top left; default, as
                of the others: drawn among the training touches of surfaces like these.
            area: share of the gel in contact.
            strength: from 0 to 1, as its quantile among the training contacts.
            shear: motion of the markers, right and down [% of the width].
            force: in place of a strength, if training knew forces [N].
            depth: in place of a strength, if training knew depths [mm].
            generator: of the starting noise instead of seed and ids; one for all, or one per image.
            callback_on_step_end: called as ``(pipeline, step, timestep, {"latents": ...})`` after
                each step of each batch; ``latents`` of the dictionary that it returns replace them.
            copies: images of each photo, one after the other; the first is the one that it has
                alone.

        Several threads may call one pipeline at a time.
        ``set_progress_bar_config(disable=True)`` turns the progress bar off.

        Raises:
            PalpateError: if a photo is unreadable, a gel is missing, or settings do not fit.
        """
        touch = Requested(at, area, strength, shear, force, depth).row(self.contact)
        images = [] if photos is None else list_images(photos)
        must, fix = "There must be at least one photo, or a text alone", "Pass one of them"
        enough = bool(images) or (photos is None and text is not None)
        require(enough, None, must, "no photo", fix=fix)
        whole = isinstance(copies, int) and copies >= 1
        require(whole, "num_images_per_prompt", "must be a whole number from 1 on", copies, 1)
        texts = [] if text is None else [text] if isinstance(text, str) else list(text)
        if ids is None:
            ids = [i.name if isinstance(i, Path) else str(k) for k, i in enumerate(images)]
            ids = ids if images else list(map(str, texts))
        ids = [i if k == 0 else f"{i}#{k}" for i in ids for k in range(copies)]
        sampler = self.sampler_with(guidance=guidance, steps=steps)
        if len(ids) == 1:  # not among the copies that fill a batch: a fraction of the time
            sampler = replace(sampler, batch=1)
        ground = None if gel is None else load_images(list_images(gel), self.size)
        if ground is not None and len(ground) == 1:
            ground = np.broadcast_to(ground, (len(ids), *ground.shape[1:]))
        elif ground is not None:
            ground = np.repeat(ground, copies, axis=0)
        embedded = words = None
        if images:
            photo = self.embed(load_images(images, self.vision_size))
            embedded = photo.repeat_interleave(copies, dim=0)
        if texts:
            words = torch.cat([self.embed_text(each) for each in texts])
            words = words if len(words) == 1 else words.repeat_interleave(copies, dim=0)
        noise = None if generator is None else self._noise(generator, len(ids))
        scheduler = copy.deepcopy(self.scheduler)
        scheduler.set_timesteps(sampler.steps)
        total = math.ceil(len(ids) / sampler.batch) * len(scheduler.timesteps)
        bars: Any = self.progress_bar  # wrongly typed in diffusers
        with bars(total=total) as bar:

            def on_step(step: int, t: Tensor, latents: Tensor) -> Tensor:
                bar.update()
                callback = callback_on_step_end
                answer = callback(self, step, t, {"latents": latents}) if callback else None
                return (answer or {}).get("latents", latents)

            return self.sample(
                embedded,
                ids,
                texts=words,
                weight=weight,
                seed=seed,
                sampler=sampler,
                background=ground,
                touches=np.tile(touch, (len(ids), 1)),
                noise=noise,
                on_step=on_step,
            )

    def _noise(self, generator: torch.Generator | Sequence[torch.Generator], n: int) -> Tensor:
        """The starting noise of n images, drawn on the generators' own device."""
        each = [generator] * n if isinstance(generator, torch.Generator) else generator
        must, fix = "must be one per image", "Pass one generator, or one per image"
        require(len(each) == n, "generator", must, f"{len(each)} for {n} images", fix=fix)
        draws = [torch.randn(self._latent, generator=g, device=g.device) for g in each]
        return torch.stack([draw.cpu() for draw in draws])

    @property
    def other_scheduler(self) -> dict[str, Any] | None:
        """Class and settings of the scheduler, if it is not the one of the sampler."""
        own = build_scheduler(self.schedule, self.sampler.method)
        default, used = (json.loads(s.to_json_string()) for s in (own, self.scheduler))
        return None if default == used else used

    @property
    def _latent(self) -> tuple[int, int, int]:
        side = self.size // self.autoencoder.factor
        return self.denoiser.channels, side, side

    @property
    def digest(self) -> str:
        """SHA-256 of all that the images depend on, except seed, sampler, type and input."""
        weights = {
            # torch.compile puts a prefix before the names.
            name.replace("_orig_mod.", ""): value.float()
            for name, value in self.denoiser.state_dict().items()
        }
        gel = None if self.gel is None else torch.from_numpy(np.array(self.gel))
        parts = [
            FORMAT,
            asdict(self.stats),
            asdict(self.schedule),
            {k: v for k, v in asdict(self.denoiser.policy).items() if k != "contact" or v},
            self.size,
            *_digests(self.autoencoder, self.encoders),
            architecture(self.denoiser.unet.config),
            digest_tensors(weights),
            None if gel is None else digest_tensors({"gel": gel}),
            *([] if self.contact is None else [asdict(self.contact)]),
        ]
        return digest_json(parts)

    @property
    def records(self) -> list[Mapping[str, Any]]:
        """How it was trained, then that of the generator which it went on from, and so on."""
        records: list[Mapping[str, Any]] = [self.training]
        while before := records[-1].get("start_record"):
            records.append(before)
        return records

    @property
    def earlier_splits(self) -> list[str]:
        """Digests of other splits of the same data that a generator it went on from trained on."""
        own, *before = self.records
        data = own.get("manifest")
        same = {str(r["split"]) for r in before if r.get("split") and r.get("manifest") == data}
        return sorted(same - {own.get("split")})

    @property
    def background(self) -> bool:
        """Whether each image is made on one of the gel without contact."""
        return self.denoiser.background or self.gel is not None

    @property
    def vision_size(self) -> int:
        """Side in pixels of the squares that photos are resized to."""
        return self._preprocess.resize

    @property
    def _preprocess(self) -> Preprocess:
        if "photos" not in self.denoiser.maps:
            return self._encoders().preprocess("vision")
        return Preprocess(self.denoiser.policy.photo_size, self.denoiser.policy.photo_size)

    def _encoders(self) -> EncoderSet:
        must, got = "Photos need the pipeline's vision encoder", "a pipeline without encoders"
        require(self.encoders is not None, None, must, got, fix="Save it with its encoders")
        assert self.encoders is not None
        return self.encoders

    def sampler_with(
        self, *, guidance: float | None = None, steps: int | None = None, batch: int | None = None
    ) -> SamplerOptions:
        """The default sampler with some settings replaced.

        Raises:
            PalpateError: on settings that this pipeline cannot sample with.
        """
        default = self.sampler
        sampler = replace(
            default,
            guidance=default.guidance if guidance is None else guidance,
            steps=default.steps if steps is None else steps,
            batch=default.batch if batch is None else batch,
        )
        most, scale = self.schedule.steps, sampler.guidance
        fits = 1 <= sampler.steps <= most
        require(fits, "steps", f"must lie in 1 to {most}", sampler.steps, 50)
        require(sampler.batch >= 1, "batch", "must be at least 1", sampler.batch, 16)
        must, fix = "must be a finite number from 0 on", "Choose e.g. 2; 1 is none"
        require(math.isfinite(scale) and scale >= 0, "guidance", must, scale, fix=fix)
        must = "must be 1 for a generator trained without condition dropout"
        fits = scale == 1 or self.denoiser.policy.dropout > 0
        require(fits, "guidance", must, f"{scale:g}", fix="Choose 1")
        return sampler

    def evaluations(self, sampler: SamplerOptions) -> int:
        """Rows that the network sees for one image; guidance takes two a step."""
        scheduler = copy.deepcopy(self.scheduler)
        scheduler.set_timesteps(sampler.steps)
        scales = [scale_at(t, scheduler, sampler) for t in scheduler.timesteps]
        return sum(1 + (scale not in (0.0, 1.0)) for scale in scales)

    def embed(self, photos: NDArray[np.uint8]) -> Tensor:
        """Photos, bytes (n, h, w, 3), -> what conditions on them, on the CPU.

        L2-normalized vision embeddings (n, d), with tokens of their patches (n, 1 + p, d), or of
        GVST tokens (n, 64, d).
        """
        parts = [
            self._embed(self._preprocess.fit(photos[rows]))[:n].cpu()
            for rows, n in batches(len(photos), EMBED)
        ]
        return torch.cat(parts) if parts else self.denoiser.null_tokens(0)[:, 0]

    @torch.no_grad()
    def _embed(self, photos: NDArray[np.uint8]) -> Tensor:
        maps, count = self.denoiser.maps, self.denoiser.policy.patches
        if "photos" in maps:
            return maps["photos"](torch.from_numpy(photos).to(self.device))
        encoders = self._encoders()
        unit = to_unit(photos, encoders.device, signed=True)
        pixels = self._preprocess(unit.add(1.0).div(2.0))
        embedding = encoders.encode("vision", pixels)
        if "patches" not in maps:
            return embedding
        states = maps["patches"](encoders.patches(pixels, count))
        return torch.cat([embedding[:, None], states], dim=1)

    @torch.no_grad()
    def embed_text(self, text: str) -> Tensor:
        """One text -> its L2-normalized embedding (1, d), on the CPU.

        Raises:
            PalpateError: if the pipeline has no text encoder, or the text is empty or no string.
        """
        must, fix = "must be one string, for all images", "Call it once for each text"
        require(isinstance(text, str), "text", must, type(text).__name__, fix=fix)
        fits = self.encoders is not None and "text" in self.encoders.modalities
        must = "must be left out for a generator without text encoder"
        require(fits, "text", must, repr(text), fix="Pass a photo")
        fix = "Say what is felt, e.g. rough, porous"
        require(bool(text.strip()), "text", "must not be empty", repr(text), fix=fix)
        return torch.from_numpy(embed_texts([text], self._encoders()))

    def sample(
        self,
        conditions: Tensor | NDArray[Any] | None,
        ids: Sequence[str],
        *,
        seed: int,
        texts: Tensor | NDArray[Any] | None = None,
        weight: float = 0.5,
        sampler: SamplerOptions | None = None,
        background: NDArray[np.uint8] | None = None,
        touches: NDArray[np.floating[Any]] | None = None,
        noise: Tensor | None = None,
        on_step: OnStep | None = None,
    ) -> NDArray[np.uint8]:
        """Tactile images (n, size, size, 3), uint8, from embeddings (n, d) of photos or texts.

        Args:
            conditions: embeddings of photos, one row per id, or None.
            ids: with ``seed`` they decide the noise.
            seed: of the noise.
            texts: embeddings of texts, one row per id or one for all, or None.
            weight: with both, the share of the photo where the two take one place.
            sampler: default: the pipeline's.
            background: bytes (n, size, size, 3) of the gel without contact; default: the stock gel,
                which a pipeline w/ BG and a VQ autoencoder lacks.
            touches: (n, 6) what is requested, in the order of
                :data:`palpate.metrics.conditions.CONDITIONS` and strength from 0 to 1; NaN, and
                default: drawn among the training touches of surfaces like these.
            noise: the starting noise (n, c, h, w) instead of that of seed and ids.
            on_step: called after each step of each batch.

        Raises:
            PalpateError: if there is not one condition per id, or a background is missing or of
                another size.
        """
        photos, words = (
            None if c is None else torch.as_tensor(np.asarray(c)) for c in (conditions, texts)
        )
        if words is not None and len(words) == 1:
            words = words.expand(len(ids), *words.shape[1:])
        for n in (len(rows) for rows in (photos, words) if rows is not None):
            got, fix = f"{len(ids)} ids, {n} conditions", "Pass one row per id"
            require(len(ids) == n, None, "Every id needs one condition", got, fix=fix)
        if background is None and self.gel is not None:
            background = np.broadcast_to(self.gel, (len(ids), *self.gel.shape))
        must = "must be given for a generator that sees the gel, and only for one"
        fits, got = (
            self.background == (background is not None),
            "none" if self.background else "one",
        )
        require(fits, "background", must, got)
        must = f"must hold one image of {self.size} pixels square per photo"
        shape = (len(ids), self.size, self.size)
        fits = background is None or background.shape[:3] == shape
        require(fits, "background", must, None if background is None else background.shape)
        code, seen, maps = self.autoencoder, list[Tensor](), list[Tensor]()
        if background is not None and self.denoiser.background:
            if isinstance(code, BackgroundAutoencoder):
                seen.append(code.gel(background))
            else:
                seen.append(self.stats.normalize(code.encode(background)))
        if self.denoiser.policy.contact:
            assert isinstance(code, BackgroundAutoencoder)
            assert background is not None
            requested = self.touches(touches, photos, words, ids, seed)
            requested[~has_markers(background), 4:] = np.nan
            if self.contact is not None and self.contact.gain:
                mean = self.denoiser.touch_scale[0].numpy()
                requested = mean + np.array(self.contact.gain, np.float32) * (requested - mean)
            marks = self.stats.scaled(marks_of(code, background, requested[:, 4:6]))
            each = torch.from_numpy(requested)
            for touch in (torch.full_like(each, torch.nan), each):  # guidance is on both
                maps.append(maps_of(touch, marks, self.denoiser.touch_scale))
        # Schedulers of diffusers keep where they are; of one pipeline several threads may sample.
        options, scheduler = sampler or self.sampler_with(), copy.deepcopy(self.scheduler)
        if options.method != self.sampler.method:
            scheduler = build_scheduler(self.schedule, options.method)
        latents = sample(
            self.denoiser,
            self.denoiser.condition(photos, words, weight),
            starting_noise(ids, self._latent, seed) if noise is None else noise,
            options,
            scheduler,
            generator=lambda row: _step_noise(seed, ids[row]),
            background=torch.cat([*seen, *maps[1:]], dim=1) if seen or maps else None,
            bare=torch.cat([*seen, maps[0]], dim=1) if maps else None,
            on_step=on_step,
        )
        return code.decode(self.stats.restore(latents), background, batch=options.batch)

    def touches(
        self,
        requested: NDArray[np.floating[Any]] | None,
        photos: Tensor | None,
        texts: Tensor | None,
        ids: Sequence[str],
        seed: int,
    ) -> NDArray[np.float32]:
        """Touches (n, 6) as requested, the rest of them drawn; arguments of :meth:`sample`."""
        requested = np.full((len(ids), len(CONDITIONS)), np.nan) if requested is None else requested
        similar = self._similar(photos, texts)
        return drawn(requested, self.denoiser.touches.cpu().numpy(), similar, ids, seed)

    def unlikely(
        self, strengths: NDArray[np.float64], photos: Any, texts: Tensor | None
    ) -> list[tuple[float, float]]:
        """Ranges of the strengths of training touches of surfaces like these, of those samples
        whose strength (n,), if there is one, lies outside.
        """
        if not np.isfinite(strengths).any() or not self.denoiser.pairs:
            return []
        photos = None if photos is None else torch.as_tensor(photos)
        kept, similar = self.denoiser.touches[:, 3].cpu().numpy(), self._similar(photos, texts)
        assert similar is not None
        low, high = np.broadcast_to(reach(kept, similar), (len(strengths), 2)).T
        off = (strengths < low - TOLERATED) | (strengths > high + TOLERATED)
        return [(float(a), float(b)) for a, b in zip(low[off], high[off], strict=True)]

    def _similar(self, photos: Tensor | None, texts: Tensor | None) -> NDArray[np.float64] | None:
        """Cosines (n, m) with the photos, or texts, of the training touches that are kept."""
        if not self.denoiser.pairs:
            return None
        near = self.denoiser.similar(photos, texts)[:, self.denoiser.likeness]
        return near.cpu().double().numpy()

    def to(  # pyright: ignore[reportIncompatibleMethodOverride] - its forms with one or two
        self, device: str | torch.device | torch.dtype | None = None, dtype: Any = None
    ) -> TactilePipeline:
        """Move all parts to a device, and the U-Net to a type, in place; return the pipeline.

        The encoders and the autoencoder stay float32.
        """
        if isinstance(device, torch.dtype):
            device, dtype = None, device
        if device is not None:
            for part in (self.autoencoder, self.denoiser):
                nn.Module.to(part, pick_device(device))
            if self.encoders is not None:
                self.encoders.to(device)
        if dtype is not None:
            nn.Module.to(self.unet, dtype)
        return self

    @property
    def notice(self) -> str:
        """What every viewer of its images must know; empty for a pipeline trained on real data."""
        real = any(record.get("synthetic") is False for record in self.records)
        if real or not self.training.get("synthetic"):
            return ""
        names = sorted({str(n) for record in self.records for n in record.get("materials", ())})
        only = f" It knows only these materials: {', '.join(names)}." if names else ""
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
            PalpateError: if the folder is not empty, a weight is too large for 16 bits, the shared
                model differs, or the scheduler is not the sampler's.
        """
        must, got = (
            "A saved pipeline must have its sampler's scheduler",
            type(self.scheduler).__name__,
        )
        require(self.other_scheduler is None, None, must, got, fix="Set it back")
        must = f"A pipeline that refers to {shared} must use its autoencoder and vision encoder"
        own = _digests(self.autoencoder, self.encoders)
        same = shared is None or own == _digests(*_shared_parts(shared))
        require(same, None, must, "others", fix="Leave out shared, or train on these")
        write_pipeline(self, Path(folder), half=half, shared=shared)

    def save_pretrained(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, save_directory: str | Path, **options: Any
    ) -> None:
        """:meth:`save` under diffusers' name, for ``push_to_hub``; always as safetensors.

        Args:
            save_directory: must be new or empty.
            options: of diffusers; they change nothing.
        """
        self.save(Path(save_directory))

    def _upload_folder(self, working_dir: str | Path, *args: Any, **options: Any) -> Any:
        """Upload palpate's cards: before this call diffusers replaces them by a blank one."""
        write_model_cards(Path(working_dir))
        return super()._upload_folder(working_dir, *args, **options)

    @classmethod
    def from_pretrained(  # pyright: ignore[reportIncompatibleMethodOverride]
        cls, source: str | Path, *, device: str = "auto", revision: str | None = None
    ) -> TactilePipeline:
        """Read a saved pipeline and check its digest.

        Args:
            source: a shipped name (``palpate/mini``), a folder of ``palpate train generator`` or a
                hub id.
            device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
            revision: branch, tag or commit of a hub id; ``owner/name@revision`` is the same.

        Raises:
            PalpateError: if the folder is no pipeline, holds or refers to other weights than it
                says, or the hub is out of reach.
        """
        source = source if revision is None else at_revision(source, revision)
        folder = find_model(source, "generator", "pipeline", FIX_MODEL)
        note = folder / "palpate.json"
        about = read_record(note, "card of the pipeline", form=FORMAT, keys=KEYS)
        if "shared" in about:
            autoencoder, encoders = _shared_parts(str(about["shared"]))
            same = _digests(autoencoder, encoders) == (about["autoencoder"], about["encoders"])
            must = f"{folder} must find the parts of {about['shared']} that it was trained on"
            fix = "Install the version that it names, or train again"
            require(same, None, must, "those of another version of palpate", fix=fix)
        else:
            autoencoder = load_autoencoder(folder / "autoencoder")
            encoders = EncoderSet.load(folder / "encoders") if about["encoders"] else None
        gel = folder / "gel.png"
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
                gel=square(read_image(gel), int(about["size"])) if gel.is_file() else None,
                seen=TrainingRange.load(folder),
                contact=ContactScale(**about["contact"]) if about.get("contact") else None,
            )
        except (KeyError, TypeError, ValueError) as error:
            must = f"The entries of {note} must be as palpate writes them"
            raise PalpateError(must, f"{type(error).__name__}: {error}", COPY_AGAIN) from None
        must = f"The weights in {folder} must match its palpate.json"
        require(pipeline.digest == about["digest"], None, must, "other weights", fix=COPY_AGAIN)
        return pipeline.to(device)


def _step_noise(seed: int, sample_id: str) -> torch.Generator:
    """The noise that a scheduler adds while it samples."""
    return torch.Generator().manual_seed(int(rng_for(seed, "steps", sample_id).integers(2**62)))


def _class_of(part: Any) -> tuple[str, str]:
    """Library (of palpate: module) and class, as ``model_index.json`` names them."""
    name = type(part).__module__
    return name if name.startswith("palpate.") else name.split(".")[0], type(part).__name__


def _digests(autoencoder: AnyAutoencoder, encoders: EncoderSet | None) -> tuple[str, str | None]:
    return autoencoder.digest, encoders.digest("vision") if encoders else None


def _shared_parts(name: str) -> tuple[AnyAutoencoder, EncoderSet]:
    """Load autoencoder and encoders of a shipped model; a folder would differ elsewhere."""
    must, fix = f"must be one of {', '.join(SHIPPED)}", "Save the pipeline with its parts"
    require(name in SHIPPED, "shared", must, repr(name), fix=fix)
    return load_autoencoder(name), load_clip(name)

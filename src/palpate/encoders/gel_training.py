"""Training of the learned ruler (:mod:`palpate.encoders.gel`).

A step takes rows and a partner of each: another frame of its contact, or another contact of its
object. Both are changed at random in what tells nothing of the object (angle, hue, zoom, strength,
blur, noise), and four losses are added:

- contrast (InfoNCE) of a touch with its partner against all touches of other objects;
- smooth L1 to the 149 numbers of ``palpate/handcrafted`` of the unchanged residual: area and
  strength of the contact, bands and directions of the surface;
- cross entropy of the material, where samples have one;
- InfoNCE with the frozen embeddings of photo and text, where samples have them (paper section 3).

The preset ``self`` learns from touches alone, by the first two.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn
from torch.nn.functional import (
    affine_grid,
    avg_pool2d,
    cross_entropy,
    grid_sample,
    layer_norm,
    normalize,
    relu,
    smooth_l1_loss,
)

from palpate.core import (
    Split,
    decoded,
    digest_json,
    digest_lines,
    image_bytes,
    open_image,
    require,
    rng_for,
)
from palpate.core.features import is_missing
from palpate.data.images import Preprocess, cached_images, load_images, read_image
from palpate.data.manifest import Manifest
from palpate.data.residuals import Residual, with_gels
from palpate.encoders.courses import facts_of, fitted, require_held_out, require_rows, stamps
from palpate.encoders.embed import embed, texts_of
from palpate.encoders.encoder_set import EncoderSet
from palpate.encoders.gel import CODECS, GelEncoder
from palpate.encoders.losses import LOG_SCALE_START, clamped_scale, info_nce, soft_targets
from palpate.encoders.models import digest_images, pick_device, to_unit, union
from palpate.encoders.presets import EncoderPreset, Gel
from palpate.encoders.rows import Rows, bytes_to_unit, evenly_spaced, factorize, train_part
from palpate.training.engine import Batch, Losses, Task
from palpate.training.processes import agreed, connect, first_alone, gather_rows
from palpate.training.run import TrainingRun
from palpate.training.steps import Step, seeded

#: The ruler whose numbers are targets.
HANDCRAFTED = "palpate/handcrafted"
#: Factors of the four losses.
CONTRAST, NUMBERS, NAMES, PHOTOS = 0.5, 4.0, 0.5, 2.0
#: Temperature of the contrast, and width of what it is taken of and of the layer before.
TEMPERATURE, NARROW, HIDDEN = 0.15, 64, 128
#: Share of partners that are another contact of the object.
FAR = 0.5
#: Largest size of a standardized target.
LARGEST = 5.0
#: Images whose numbers are averaged for center and spread.
STATISTICS = 4096
#: Images by which the directions of codecs are found; rows and quality of their JPEG.
CODED, ROWS, QUALITY = 512, (160, 240, 320), (20, 90)
#: Of the head's fit, as a share of the mean square of what it takes.
RIDGE = 1e-4
#: Objects or videos that are held out, at least.
LEAST_HELD = 3
#: Recordings that a card lists by name, at most.
LISTED = 1000
#: Range of the zoom; deviations of shift [share of the side], and of the logarithms of saturation
#: and strength; largest deviation of the noise [gray levels].
ZOOM, SHIFT, SATURATION, STRENGTH, NOISE = (0.7, 1.45), 0.12, 0.3, 0.35, 1.0


class Touches:
    """The touches of the train part and of the held-out part, as training reads them.

    Attributes:
        rows: images, captions and what photos and texts are embedded as, of both parts.
        unit: number of the object of each sample, else of its video, within its part (n,).
        numbers: targets of each, standardized (n, 149).
        names: number of each material (n,), -1 without one; ``classes`` in all.
    """

    def __init__(
        self, train: Manifest, held: Manifest, clip: EncoderSet | None, run: TrainingRun, side: int
    ) -> None:
        """Decode and embed the samples; without ``clip`` their touches alone.

        Raises:
            PalpateError: if no two touches of the train part are of one video or object.
        """
        part = replace(train, table=pl.concat([train.table, held.table]))
        self.rows = Rows(part, clip, Residual(side, side), run.cache, run.progress)
        self.unit = factorize(units_of(train, "train") + units_of(held, "val")).numpy()
        must = "The train part must hold two touches of one object, contact or video"
        fix = "Fill the column video, object or contact"
        several = len({*self.unit[: len(train)].tolist()}) < len(train)
        require(several, None, must, "none", fix=fix)
        contacts = part.column("contact")
        keys = [f"{unit}\n{c}" for unit, c in zip(self.unit.tolist(), contacts, strict=True)]
        contact = factorize(keys).numpy()
        self._order = np.lexsort((contact, self.unit))
        self._place = np.argsort(self._order)
        starts = (np.flatnonzero(np.diff(v[self._order], prepend=-1)) for v in (self.unit, contact))
        self._blocks = [np.append(first, len(part)) for first in starts]
        rulers = EncoderSet.load(HANDCRAFTED)
        numbers = embed(part, rulers, raw=True, cache=run.cache, progress=run.progress).features
        numbers = (numbers - numbers.mean(axis=0)) / np.maximum(numbers.std(axis=0), 1e-3)
        self.numbers = torch.from_numpy(numbers.clip(-LARGEST, LARGEST))
        materials = ["" if is_missing(v) else str(v) for v in part.column("material")]
        known = sorted({*materials} - {""}) if clip is not None else []
        number = {name: k for k, name in enumerate(known)}
        self.names = torch.tensor([number.get(name, -1) for name in materials])
        self.classes = len(known)

    def partners(self, rows: NDArray[np.int64], u: NDArray[np.float64]) -> NDArray[np.int64]:
        """A partner of each row, by two uniform numbers (n, 2); the row itself if it has none."""
        at = self._place[rows]
        (top, end), (low, high) = (
            (block[k := np.searchsorted(block, at, "right") - 1], block[k + 1])
            for block in self._blocks
        )
        near, others = high - low - 1, (end - top) - (high - low)
        within = low + (at - low + 1 + (u[:, 1] * near).astype(int)) % (high - low)
        beyond = top + (u[:, 1] * others).astype(int)
        beyond = beyond + (beyond >= low) * (high - low)
        far = (others > 0) & ((u[:, 0] < FAR) | (near == 0))
        return self._order[np.where(far, beyond, within)]

    def load(self, step: Step, first: int = 0) -> Batch:
        """The batch of a step: b rows of this process and B of all, then as many partners.

        Args:
            step: which rows, and their random numbers.
            first: row of the part that the step's rows are counted from.

        Returns:
            ``images`` float16 (2b, s, s, 3) and the random numbers of :func:`views`; ``unit``,
            ``name`` (2B,), ``numbers`` (2B, 149), and what there is of ``photo`` bool, ``vision``,
            ``text``, ``caption``.
        """
        rows = first + step.all_rows
        u = torch.rand(len(rows), 2, generator=step.generator).double().numpy()
        partners = self.partners(rows, u)
        images = self.rows.images[np.concatenate([rows[step.mine], partners[step.mine]])]
        every = torch.from_numpy(np.concatenate([rows, partners]))
        batch = {
            "images": torch.from_numpy(np.array(images)),
            "uniform": step.rand(2, 7).transpose(0, 1).flatten(0, 1),
            "normal": step.randn(2, 4).transpose(0, 1).flatten(0, 1),
            "noise": step.randn(2, 3, *images.shape[1:3]).transpose(0, 1).flatten(0, 1).half(),
            "unit": torch.from_numpy(self.unit)[every],
            "numbers": self.numbers[every],
            "name": self.names[every],
        }
        if self.rows.text is not None:
            batch |= {"text": self.rows.text[every], "caption": self.rows.caption_ids[every]}
        if self.rows.vision is not None:
            photo = self.rows.photo[every]
            batch |= {"photo": photo >= 0, "vision": self.rows.vision[photo.clamp(min=0)]}
        return batch


def units_of(part: Manifest, name: str) -> list[str]:
    """What the touches of a part are of: object, else video, else each alone."""
    columns = zip(part.column("object"), part.column("video"), part.ids, strict=True)
    return [f"{name}\n{o or v or k}" for o, v, k in columns]


def views(images: Tensor, batch: Batch) -> Tensor:
    """Residuals (n, 3, h, w) in gray levels, changed by the random numbers of a batch.

    Any angle, mirror, zoom and shift; colors turned about gray by any angle and mirrored, their
    saturation, and the strength of all; blur of half of the images; noise.
    """
    u, normal = batch["uniform"], batch["normal"]
    angle, hue = 2 * math.pi * u[:, 0], 2 * math.pi * u[:, 1]
    zoom = torch.exp(math.log(ZOOM[0]) + u[:, 2] * math.log(ZOOM[1] / ZOOM[0]))
    mirror, cos, sin = zoom * (1 - 2 * (u[:, 3] < 0.5).float()), angle.cos(), angle.sin()
    across = torch.stack([mirror * cos, -zoom * sin, SHIFT * normal[:, 0]], 1)
    down = torch.stack([mirror * sin, zoom * cos, SHIFT * normal[:, 1]], 1)
    grid = affine_grid(torch.stack([across, down], 1), list(images.shape), align_corners=False)
    images = grid_sample(images, grid, padding_mode="reflection", align_corners=False)
    images = torch.einsum("nkc,nchw->nkhw", _recolored(hue, u[:, 4], normal[:, 2:]), images)
    blur = (2 * u[:, 5] - 1).clamp(min=0).view(-1, 1, 1, 1)
    images = images + blur * (avg_pool2d(images, 3, 1, 1, count_include_pad=False) - images)
    return images + batch["noise"].float() * (NOISE * u[:, 6]).view(-1, 1, 1, 1)


def _recolored(hue: Tensor, swap: Tensor, normal: Tensor) -> Tensor:
    """Matrices (n, 3, 3) of colors: turned about gray, mirrored, less or more saturated, scaled."""
    eye, gray = torch.eye(3, device=hue.device), torch.full((3, 3), 1 / 3, device=hue.device)
    cross = eye[[1, 2, 0]] - eye[[2, 0, 1]]
    cross = cross / math.sqrt(3)
    sin, cos = hue.sin().view(-1, 1, 1), hue.cos().view(-1, 1, 1)
    turned = eye + sin * cross + (1 - cos) * (cross @ cross)
    turned = torch.where((swap < 0.5).view(-1, 1, 1), turned @ eye[[1, 0, 2]], turned)
    saturation, strength = torch.exp(normal * normal.new_tensor([SATURATION, STRENGTH])).unbind(1)
    colors = saturation.view(-1, 1, 1) * turned @ (eye - gray) + turned @ gray
    return strength.view(-1, 1, 1) * colors


class GelModel(nn.Module):
    """What trains: the ruler, and heads that are thrown away."""

    def __init__(self, ruler: GelEncoder, targets: int, classes: int) -> None:
        super().__init__()
        self.ruler = ruler
        self.hidden = nn.Linear(ruler.dim, HIDDEN)
        self.narrow, self.numbers = nn.Linear(HIDDEN, NARROW), nn.Linear(HIDDEN, targets)
        self.names = nn.Linear(HIDDEN, classes) if classes else None
        self.log_scale = nn.Parameter(torch.tensor(LOG_SCALE_START))


@dataclass
class GelLoss:
    """The loss of a batch of :class:`Touches`."""

    preprocess: Preprocess

    def __call__(self, module: nn.Module, batch: Batch) -> Losses:
        """Return the sum of the losses, and each of them to log."""
        assert isinstance(module, GelModel)
        images = self.preprocess(bytes_to_unit(batch["images"]))
        numbers = module.ruler.numbers(views(images, batch))
        pairs = numbers.unflatten(0, (2, -1)).transpose(0, 1)  # rows of all processes, together
        pairs = gather_rows(pairs.contiguous(), batch=len(batch["unit"]) // 2)
        with torch.autocast(numbers.device.type, enabled=False):
            pooled = pairs.transpose(0, 1).flatten(0, 1).float()
            hidden = relu(module.hidden(layer_norm(pooled, pooled.shape[1:])))
            losses = {
                "contrast": contrast(module.narrow(hidden), batch["unit"]),
                "numbers": smooth_l1_loss(module.numbers(hidden), batch["numbers"]),
            }
            total = CONTRAST * losses["contrast"] + NUMBERS * losses["numbers"]
            if module.names is not None and (named := batch["name"] >= 0).any():
                losses["names"] = cross_entropy(module.names(hidden[named]), batch["name"][named])
                total = total + NAMES * losses["names"]
            scale, shared = clamped_scale(module.log_scale), module.ruler.shared(pooled)
            if "text" in batch:
                same = soft_targets(batch["caption"])
                losses["text"] = info_nce(shared, batch["text"], scale, same)
                total = total + PHOTOS / 2 * losses["text"]
            if "vision" in batch:
                some = batch["photo"]
                losses["vision"] = info_nce(shared[some], batch["vision"][some], scale)
                total = total + PHOTOS / 2 * losses["vision"]
        rows = numbers.detach().sum(dim=1).unflatten(0, (2, -1)).sum(dim=0)
        return Losses(total, {k: v.detach() for k, v in losses.items()}, rows)


def contrast(embedded: Tensor, unit: Tensor) -> Tensor:
    """InfoNCE of rows with their partners, against rows of other objects (Chen et al. 2020).

    Args:
        embedded: (2n, d); row k + n is the partner of row k.
        unit: number of the object of each row (2n,).
    """
    n = len(embedded) // 2
    z = normalize(embedded, dim=1)
    rows = torch.arange(2 * n, device=z.device)
    partner, hidden = rows.roll(n), unit[:, None] == unit
    hidden[rows, partner] = False
    return cross_entropy((z @ z.T / TEMPERATURE).masked_fill(hidden, -1e9), partner)


def train_ruler(
    manifest: Manifest, split: Split, clip: EncoderSet, preset: EncoderPreset, run: TrainingRun
) -> EncoderSet:
    """Train the learned ruler on the train part of a split; run again to resume.

    Args:
        manifest: samples with tactile images.
        split: its parts ``train`` and ``val`` are read. A preset that learns from touches alone
            holds a tenth of the recordings of ``train`` out where there is no ``val``.
        clip: vision and text to learn from, moved to the run's device; for touches alone the set
            whose ruler goes on.
        preset: size and course.
        run: folders, seed and machine.

    Returns:
        The ruler with a card, which names the objects or videos that it saw and what was
        subtracted; with vision and text, unless it learned from touches alone: its head then leads
        nowhere.

    Raises:
        PalpateError: if the train part is empty or too small, a sample lacks its image, or there is
            no ruler of the preset's size to go on from.
    """
    assert isinstance(preset.tactile, Gel)
    where = pick_device(connect(str(run.device)))
    train, held = train_part(manifest, split), manifest.part(split, "val")
    if preset.alone and not len(held):
        train, held = held_out(train, run.seed)
    with first_alone():
        kind, (backed,) = with_gels(manifest, [], run.folder / "gels")
    with seeded(run.seed, "tactile encoder"):
        width = clip.shared_width if preset.alone else clip.dim
        ruler = GelEncoder(preset.tactile.widths, width, preset.image)
    if preset.alone:
        old = clip.tactile
        shapes = [{k: v.shape for k, v in m.state_dict().items()} for m in (old, ruler) if m]
        same = isinstance(old, GelEncoder) and old.preprocess == ruler.preprocess
        same = same and shapes[0] == shapes[1]
        must, fix = "must have a learned ruler of the preset's size", "Train one: --preset gel"
        require(same, "clip", must, "another", fix=fix)
        assert old is not None
        ruler.load_state_dict(old.state_dict())
        ruler.center.zero_()
        ruler.spread.fill_(1)
        ruler.codecs.zero_()
    options = preset.tactile_course.options(len(train), run.seed)
    with agreed():
        require_rows(train, options.batch)
        require_held_out(held, options)
    clip.to(where)
    with first_alone():
        teacher = None if preset.alone else clip
        parts = backed.take(train.ids), backed.take(held.ids)
        touches = Touches(*parts, teacher, run, preset.image)
    facts = facts_of(preset, train, split, texts_of(train), options)
    facts |= {m: clip.digest(m) for m in clip.modalities if m != "tactile"}
    facts |= {"held_out": held.digest} if len(held) else {}
    facts |= {"background_kind": kind, "start": clip.digest("tactile") if preset.alone else None}
    with seeded(run.seed, "heads of the ruler"):
        model = GelModel(ruler, touches.numbers.shape[1], touches.classes).to(where)
    task = Task(
        "training the ruler",
        len(train),
        touches.load,
        GelLoss(ruler.preprocess),
        digest_json([facts, stamps(train)]),
        train.ids,
        (len(held), partial(touches.load, first=len(train))) if len(held) else None,
    )
    card = fitted(model, task, options, facts, run)
    card |= {"clip": clip.name, "clip_card": clip.clip_card}
    start = clip if preset.alone else EncoderSet()
    card["start_card"] = start.card
    card["synthetic"] = train.synthetic if start.card.get("synthetic", True) else False
    card["seen_in_part"] = preset.alone and not start.knows_seen("tactile")
    names = sorted({name.partition("\n")[2] for name in units_of(train, "")})
    card["recordings"] = {"count": len(names), "digest": digest_lines(names)}
    card["recordings"] |= {"names": names} if len(names) <= LISTED else {}
    standardize(ruler, touches, parts[0], run.seed)
    plain = ruler.preprocess.plainly
    seen = digest_images(cached_images(train, "tactile", plain, run.cache, run.progress))
    seen = union(seen, start.seen.get("tactile"))
    alone = EncoderSet(tactile=ruler, preprocesses={"tactile": ruler.preprocess}, card=card)
    alone.seen["tactile"] = seen
    return alone if preset.alone else clip.with_tactile(alone)


def held_out(train: Manifest, seed: int) -> tuple[Manifest, Manifest]:
    """The train part without a tenth of its recordings, at least :data:`LEAST_HELD`, and those.

    Raises:
        PalpateError: if there are fewer than twice as many: rows are compared with other objects.
    """
    units = units_of(train, "")
    names = rng_for(seed, "held-out recordings").permutation(sorted({*units}))
    must = (
        f"The train part must hold touches of {2 * LEAST_HELD} objects or videos, to hold some out"
    )
    require(len(names) >= 2 * LEAST_HELD, None, must, len(names), fix="Record more")
    held = {*names[: max(LEAST_HELD, len(names) // 10)].tolist()}
    rows = list(zip(train.ids, units, strict=True))
    kept = [name for name, unit in rows if unit not in held]
    return train.take(kept), train.take([name for name, unit in rows if unit in held])


@torch.no_grad()
def standardize(ruler: GelEncoder, touches: Touches, train: Manifest, seed: int) -> None:
    """Set center and spread to those of images of the train part, and the directions of codecs.

    The head is fitted anew to what they leave.
    """
    images = touches.rows.images[evenly_spaced(len(train), STATISTICS)]
    numbers = _numbers(ruler, images)
    ruler.center.copy_(numbers.mean(0))
    ruler.spread.copy_(numbers.std(0).clamp(min=1e-3))
    frames, rng = ruler.preprocess.frames(train, "tactile").files, rng_for(seed, "codecs")
    frames = [frames[k] for k in evenly_spaced(len(train), CODED)]
    coded = [(_coded(image, rng), *gel) for image, *gel in frames]
    plain, moved = (_numbers(ruler, load_images(f, ruler.preprocess)) for f in (frames, coded))
    moved = (moved - plain) / ruler.spread
    axes = torch.linalg.svd(moved, full_matrices=False).Vh[:CODECS]
    aims = ruler.head(ruler.normed(ruler.standardized(numbers)))
    ruler.codecs[: len(axes)] = axes * torch.sign(axes @ moved.mean(0))[:, None]
    left = ruler.normed(ruler.standardized(numbers)).double()  # leads where the whole led
    ridge = RIDGE * len(left) * torch.eye(ruler.dim, device=left.device, dtype=left.dtype)
    ruler.head.weight.copy_(torch.linalg.solve(left.T @ left + ridge, left.T @ aims.double()).T)


def _numbers(ruler: GelEncoder, images: NDArray[Any]) -> Tensor:
    """Prepared residuals (n, h, w, 3) to the ruler's numbers (n, dim), in batches."""
    parts = np.array_split(images, math.ceil(len(images) / 128))
    to = ruler.center.device
    return torch.cat([ruler.numbers(ruler.preprocess(to_unit(x, to))) for x in parts])


def _coded(image: Path | Image.Image, rng: np.random.Generator) -> Image.Image:
    """An image as JPEG of another size and quality holds it."""
    image = read_image(image) if isinstance(image, Path) else image
    rows, quality = int(rng.choice(ROWS)), int(rng.integers(*QUALITY))
    small = image.resize((round(image.width * rows / image.height), rows))
    with open_image(io.BytesIO(image_bytes(small, "JPEG", quality=quality))) as read:
        return decoded(read)[0]

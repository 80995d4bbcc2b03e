"""Touches of the procedural world, degraded in controlled ways at growing strengths: what ``metric_degradations.py`` scores.

A :class:`Scene` is one world: reference, perfect generator, empty gel and training touches, with features of the shipped tactile encoder. What a
degradation draws depends on the world and its kind alone, so that a stronger one changes what the weaker one changed, and more.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from palpate.core import rng_for
from palpate.encoders.embed import embed_images
from palpate.sim import Video, WorldOptions, plan_world
from palpate.sim.plan import contact_frames, first_contact

MATERIALS, VIDEOS = 10, 4  # as many videos of a material for testing as for training
STRENGTHS = {
    "mean shift": (0.1, 0.2, 0.4, 0.7, 1.0),
    "less spread": (0.1, 0.25, 0.4, 0.6, 0.8),
    "unstable over videos": (0.25, 0.5, 1.0, 1.5, 2.0),
    "dropped materials": (0.1, 0.2, 0.4, 0.6, 0.8),
    "wrong material": (0.1, 0.25, 0.5, 0.75, 1.0),
    "new videos": (0.1, 0.25, 0.5, 0.75, 1.0),
    "memorized videos": (0.1, 0.25, 0.5, 0.75, 1.0),
    "empty gel": (0.1, 0.25, 0.5, 0.75, 1.0),
    "faint contact": (0.1, 0.25, 0.5, 0.75, 0.9),
    "blur": (0.5, 0.75, 1.0, 2.0, 4.0),
    "class collapse": (0.1, 0.25, 0.5, 0.75, 1.0),
    "full collapse": (0.1, 0.25, 0.5, 0.75, 1.0),
}
MEANING = {
    "mean shift": "all features moved along one direction, by this many of their standard deviations",
    "less spread": "features drawn towards the mean of their set, by this share",
    "unstable over videos": "all features of a video moved by a random vector of its own, of this many standard deviations",
    "dropped materials": "this share of the materials is never shown; touches of the others stand for them",
    "wrong material": "this share of the touches is of another material; over all, each material is as frequent as before",
    "new videos": "no degradation: this share of the touches is of other videos of the right material; what ranks it takes other objects for worse ones",
    "memorized videos": "this share of the touches is replayed from one training video of the right material",
    "empty gel": "this share of the touches is the empty gel of the right video",
    "faint contact": "contact minus background is this much weaker in all touches",
    "blur": "Gaussian blur, sigma in pixels of 64",
    "class collapse": "this share of the touches is one touch of the right material",
    "full collapse": "this share of the touches is one touch",
}
FEATURES_ONLY = ("mean shift", "less spread", "unstable over videos")


@dataclass(frozen=True)
class Scene:
    """Reference and perfect generator of a world, sample by sample, and what degradations are made of."""

    seed: int
    made: np.ndarray  # (n, 64, 64, 3) uint8
    real: np.ndarray
    empty: np.ndarray  # the background of each sample of ``real``
    own: np.ndarray  # the background of each sample of ``made``
    train: np.ndarray  # (MATERIALS, VIDEOS * 6, 64, 64, 3), video by video
    label: np.ndarray  # (n,)
    video: np.ndarray  # (n,)
    features: dict = field(default_factory=dict)  # name of an image array -> embeddings
    compared: dict = field(default_factory=dict)  # pair -> what its pictures score


def make_scene(seed, encoders, materials=MATERIALS, videos=VIDEOS, size=64):
    """Renders and embeds a world; a material's last videos are the training ones."""
    options = WorldOptions(
        seed=seed,
        size=size,
        materials=materials,
        objects_per_material=2 * videos,
        contacts_per_video=6,
        frames_per_contact=2,
        sensors=2,
    )
    found = {name: [] for name in ("made", "real", "empty", "own", "label", "video")}
    train, seen = {name: [] for name in options.names}, dict.fromkeys(options.names, 0)
    for plan in plan_world(options):
        video, material = Video(options, plan), plan.object_of(0).material
        seen[material] += 1
        if seen[material] > videos:
            train[material] += [
                video.tactile(f) for touch in range(3) for f in contact_frames(options, touch)
            ]
            continue
        for touch in range(0, options.contacts_per_video, 2):
            pairs = zip(
                contact_frames(options, touch), contact_frames(options, touch + 1), strict=True
            )
            backs = [video.tactile(first_contact(options, t) - 4) for t in (touch, touch + 1)]
            for a, b in pairs:
                row = (
                    video.tactile(b),
                    video.tactile(a),
                    *backs,
                    options.names.index(material),
                    plan.index,
                )
                for name, value in zip(found, row, strict=True):
                    found[name].append(value)
    arrays = {name: np.array(values) for name, values in found.items()}
    scene = Scene(seed, train=np.array([train[m] for m in options.names]), **arrays)
    for name in ("made", "real"):
        scene.features[name] = embed_images(getattr(scene, name), encoders)
    backs, of = np.unique(scene.own, axis=0, return_inverse=True)
    scene.features["own"] = embed_images(backs, encoders)[of.reshape(-1)]
    scene.features["train"] = embed_images(
        scene.train.reshape(-1, *scene.real.shape[1:]), encoders
    ).reshape(*scene.train.shape[:2], -1)
    return scene


def degraded(scene, kind, strength, encoders):
    """(features, images or None) of a degraded generator; what is drawn depends on the world and the kind alone, so that strengths are nested."""
    rng = rng_for(scene.seed, "metric degradations", kind)
    images, f, n = scene.made, scene.features["made"].astype(np.float64), len(scene.label)
    spread = float(np.sqrt(((f - f.mean(axis=0)) ** 2).sum(axis=1).mean()))
    unit = lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True)  # noqa: E731
    chosen = np.argsort(np.argsort(rng.random(n))) < round(strength * n)
    if kind == "mean shift":
        return unit(f + strength * spread * unit(rng.normal(size=f.shape[1]))), None
    if kind == "less spread":
        return unit(f.mean(axis=0) + (1 - strength) * (f - f.mean(axis=0))), None
    if kind == "unstable over videos":
        names, of = np.unique(scene.video, return_inverse=True)
        return unit(
            f + strength * spread * unit(rng.normal(size=(len(names), f.shape[1])))[of]
        ), None
    if kind == "faint contact":
        images = np.clip(
            np.rint(scene.own + (1 - strength) * (images.astype(np.float64) - scene.own)), 0, 255
        ).astype(np.uint8)
        return embed_images(images, encoders), images
    if kind == "blur":
        images = np.stack([ndimage.gaussian_filter(i, (strength, strength, 0)) for i in images])
        return embed_images(images, encoders), images
    if kind == "empty gel":
        return np.where(chosen[:, None], scene.features["own"], f), np.where(
            chosen[:, None, None, None], scene.own, images
        )
    material, touch = scene.label.copy(), rng.integers(scene.train.shape[1], size=n)
    if kind == "dropped materials":
        order = rng.permutation(scene.train.shape[0])
        left = order[round(strength * len(order)) :]
        chosen = ~np.isin(scene.label, left)
        material = rng.choice(left, size=n)
    elif kind == "wrong material":
        material[chosen] = scene.label[exchange(rng, scene.label, np.flatnonzero(chosen))]
    elif kind == "memorized videos":
        touch %= scene.train.shape[1] // VIDEOS  # of the first training video
    elif kind in ("class collapse", "full collapse"):
        touch[:] = 0
        material = (
            material if kind == "class collapse" else np.full(n, rng.integers(scene.train.shape[0]))
        )
    return np.where(chosen[:, None], scene.features["train"][material, touch], f), np.where(
        chosen[:, None, None, None], scene.train[material, touch], images
    )


def exchange(rng, label, rows):
    """For each of ``rows`` another of them, each once, of another label: sorted by label, turned by the largest class."""
    rows = np.sort(rng.permutation(rows))
    order = np.argsort(label[rows], kind="stable")
    out = np.empty_like(rows)
    out[order] = rows[np.roll(order, int(np.bincount(label[rows]).max()))]
    return out

"""Tactile images of the world, degraded at growing strengths, for ``metric_degradations.py``.

A :class:`Scene` is one world: reference, perfect generator, gel without contact and training
images, with features of the shipped tactile encoder. What a degradation draws depends on the world
and its kind only, so that a stronger one changes what the weaker one changed, and more.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from palpate.core import rng_for
from palpate.encoders.embed import embed_images
from palpate.sim import Video, WorldOptions, plan_world
from palpate.sim.plan import contact_frames, first_contact

MATERIALS, VIDEOS = 10, 4  # as many videos of a material for testing as for training
SHARES = (0.1, 0.25, 0.5, 0.75, 1.0)
DEGRADATIONS = {  # kind -> strengths, meaning
    "mean shift": (
        (0.1, 0.2, 0.4, 0.7, 1.0),
        "all features moved along one direction, by this many of their standard deviations",
    ),
    "less spread": (
        (0.1, 0.25, 0.4, 0.6, 0.8),
        "features drawn towards the mean of their set, by this share",
    ),
    "unstable over videos": (
        (0.25, 0.5, 1.0, 1.5, 2.0),
        "all features of a video moved by one random vector, of this many standard deviations",
    ),
    "dropped materials": (
        (0.1, 0.2, 0.4, 0.6, 0.8),
        "this share of the materials is never shown, images of the others instead",
    ),
    "wrong material": (
        SHARES,
        "this share of the images is of another material; each material is as frequent as before",
    ),
    "new videos": (
        SHARES,
        "no degradation: this share of the images is of other videos of the right material; what "
        "ranks it takes other objects for worse ones",
    ),
    "memorized videos": (
        SHARES,
        "this share of the images is replayed from one training video of the right material",
    ),
    "empty gel": (SHARES, "this share of the images is the empty gel of the right video"),
    "faint contact": (
        (0.1, 0.25, 0.5, 0.75, 0.9),
        "image minus background is this much weaker in all images",
    ),
    "blur": ((0.5, 0.75, 1.0, 2.0, 4.0), "Gaussian blur, sigma in pixels of 64"),
    "class collapse": (SHARES, "this share of the images is one image of the right material"),
    "full collapse": (SHARES, "this share of the images is one image"),
}
STRENGTHS = {kind: strengths for kind, (strengths, _) in DEGRADATIONS.items()}
FEATURES_ONLY = ("mean shift", "less spread", "unstable over videos")


@dataclass(frozen=True)
class Scene:
    """Reference and perfect generator of a world, sample by sample, and training images.

    Images are (n, 64, 64, 3) uint8: ``generated``, ``real``, and the background of each
    (``generated_gel``, ``real_gel``); ``train`` is (materials, videos * 6, 64, 64, 3).
    """

    seed: int
    generated: np.ndarray
    real: np.ndarray
    generated_gel: np.ndarray
    real_gel: np.ndarray
    label: np.ndarray
    video: np.ndarray
    train: np.ndarray
    features: dict = field(default_factory=dict)  # name of an image array -> embeddings
    compared: dict = field(default_factory=dict)  # pair of images -> scores


def make_scene(seed, encoders, materials=MATERIALS, videos=VIDEOS, size=64):
    """Render and embed a world; a material's last videos are the training ones."""
    options = WorldOptions(
        seed=seed,
        size=size,
        materials=materials,
        objects_per_material=2 * videos,
        contacts_per_video=6,
        frames_per_contact=2,
        sensors=2,
    )
    rows, train, seen = [], {m: [] for m in options.names}, dict.fromkeys(options.names, 0)
    for plan in plan_world(options):
        video, material = Video(options, plan), plan.object_of(0).material
        seen[material] += 1
        if seen[material] > videos:
            frames = [f for contact in range(3) for f in contact_frames(options, contact)]
            train[material] += map(video.tactile, frames)
            continue
        for contact in range(0, options.contacts_per_video, 2):
            both = (contact + 1, contact)  # generated, real
            gels = [video.tactile(first_contact(options, c) - 4) for c in both]
            about = (*gels, options.names.index(material), plan.index)
            for frames in zip(*(contact_frames(options, c) for c in both), strict=True):
                rows.append((*map(video.tactile, frames), *about))
    columns = map(np.array, zip(*rows, strict=True))
    scene = Scene(seed, *columns, train=np.array([train[m] for m in options.names]))
    embed = lambda images: embed_images(images, encoders)
    for name in ("generated", "real"):
        scene.features[name] = embed(getattr(scene, name))
    gels, row = np.unique(scene.generated_gel, axis=0, return_inverse=True)
    scene.features["generated_gel"] = embed(gels)[row.reshape(-1)]
    train = embed(scene.train.reshape(-1, *scene.real.shape[1:]))
    scene.features["train"] = train.reshape(*scene.train.shape[:2], -1)
    return scene


def degraded(scene, kind, strength, encoders):
    """(features, images or None) of a degraded generator."""
    rng = rng_for(scene.seed, "metric degradations", kind)
    n = len(scene.label)
    chosen = np.argsort(np.argsort(rng.random(n))) < round(strength * n)
    if kind in FEATURES_ONLY:
        return degraded_features(scene, kind, strength, rng), None
    if kind in ("faint contact", "blur"):
        images = scene.generated
        if kind == "blur":
            images = np.stack([ndimage.gaussian_filter(i, (strength, strength, 0)) for i in images])
        else:
            images = scene.generated_gel + (1 - strength) * (
                images.astype(np.float64) - scene.generated_gel
            )
            images = np.clip(np.rint(images), 0, 255).astype(np.uint8)
        return embed_images(images, encoders), images
    if kind == "empty gel":
        features, images = scene.features["generated_gel"], scene.generated_gel
    else:
        material, image, chosen = drawn_from_train(scene, kind, strength, chosen, rng)
        features, images = scene.features["train"][material, image], scene.train[material, image]
    return (
        np.where(chosen[:, None], features, scene.features["generated"].astype(np.float64)),
        np.where(chosen[:, None, None, None], images, scene.generated),
    )


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def degraded_features(scene, kind, strength, rng):
    f = scene.features["generated"].astype(np.float64)
    mean = f.mean(axis=0)
    spread = float(np.sqrt(((f - mean) ** 2).sum(axis=1).mean()))
    if kind == "mean shift":
        return unit(f + strength * spread * unit(rng.normal(size=f.shape[1])))
    if kind == "less spread":
        return unit(mean + (1 - strength) * (f - mean))
    videos, row = np.unique(scene.video, return_inverse=True)
    return unit(f + strength * spread * unit(rng.normal(size=(len(videos), f.shape[1])))[row])


def drawn_from_train(scene, kind, strength, chosen, rng):
    """Material and number of a training image for each sample, and which samples it replaces."""
    n, materials = len(scene.label), scene.train.shape[0]
    material, image = scene.label.copy(), rng.integers(scene.train.shape[1], size=n)
    if kind == "dropped materials":
        order = rng.permutation(materials)
        kept = order[round(strength * materials) :]
        chosen, material = ~np.isin(scene.label, kept), rng.choice(kept, size=n)
    elif kind == "wrong material":
        material[chosen] = scene.label[exchange(rng, scene.label, np.flatnonzero(chosen))]
    elif kind == "memorized videos":
        image %= scene.train.shape[1] // VIDEOS  # of the first training video
    elif kind in ("class collapse", "full collapse"):
        image[:] = 0
        if kind == "full collapse":
            material = np.full(n, rng.integers(materials))
    return material, image, chosen


def exchange(rng, label, rows):
    """For each of ``rows`` another of them, each once, of another label.

    Sorted by label and shifted by the size of the largest class.
    """
    rows = np.sort(rng.permutation(rows))
    order = np.argsort(label[rows], kind="stable")
    partner = np.empty_like(rows)
    partner[order] = rows[np.roll(order, int(np.bincount(label[rows]).max()))]
    return partner

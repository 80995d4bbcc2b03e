"""What several benchmarks share: worlds and judges of generated images, and lines of tables."""

import itertools
import math
import time
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import nn

from palpate.core import FeatureSet, rng_for
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.diffusion.gels import gels_of
from palpate.diffusion.presets import MINI
from palpate.encoders.embed import embed, embed_images
from palpate.encoders.encoder_set import EncoderSet
from palpate.metrics import tmmd
from palpate.metrics.probe import fit_probe, material_accuracy
from palpate.sim import PRESETS, write_world
from palpate.training.engine import Losses, Task, fit
from palpate.training.options import Compute, LoopOptions
from palpate.training.steps import seeded

#: Samples that are judged, one image of as many videos.
JUDGED = 1600
#: Train judges on the first, judge on the second; other units, objects and videos.
WORLDS = {
    "train": {
        "seed": 61,
        "objects_per_material": 75,
        "sensors": 4,
        "contacts_per_video": 3,
        "frames_per_contact": 2,
    },
    "many": {"seed": 65, "sensors": 8, "contacts_per_video": 1, "frames_per_contact": 1},
}
JUDGE = LoopOptions(2500, 32, 2e-3, warmup=100, weight_decay=1e-3, ema=0.99)
BFLOAT = Compute(precision="bf16")  # float32 on x86 processors without it


class Judge(nn.Module):
    """A small CNN that names the material of a tactile image."""

    def __init__(self, classes):
        super().__init__()
        widths = (3, 32, 64, 96, 128)
        blocks = [
            (nn.Conv2d(a, b, 3, 2 if a > 3 else 1, 1), nn.GroupNorm(8, b), nn.SiLU())
            for a, b in itertools.pairwise(widths)
        ]
        self.body = nn.Sequential(*(layer for block in blocks for layer in block))
        self.head = nn.Linear(2 * widths[-1], classes)

    def forward(self, x):
        """Bytes (n, h, w, 3) -> logits; the mean color of an image is removed."""
        x = x.permute(0, 3, 1, 2).float() / 64
        y = self.body(x - x.mean((2, 3), keepdim=True))
        return self.head(torch.cat([y.mean((2, 3)), y.amax((2, 3))], 1))

    @torch.no_grad()
    def names(self, images):
        parts = [
            self(torch.from_numpy(np.array(images[k : k + 64]))).argmax(1)
            for k in range(0, len(images), 64)
        ]
        return torch.cat(parts).numpy()


class JudgeLoss:
    """Cross-entropy of mirrored images."""

    def __init__(self, images, labels):
        self.images, self.labels = images, torch.from_numpy(labels)

    def load(self, step):
        x = torch.from_numpy(np.array(self.images[step.rows]))
        across, down = (step.rand(2) < 0.5).reshape(-1, 2, 1, 1, 1).unbind(1)
        x = torch.where(across, x.flip(2), x)
        return {"x": torch.where(down, x.flip(1), x), "y": self.labels[step.rows]}

    def __call__(self, module, batch):
        each = nn.functional.cross_entropy(
            module(batch["x"]).float(), batch["y"], label_smoothing=0.1, reduction="none"
        )
        return Losses(each.mean(), {}, each.detach())


def by_video(hits, videos):
    """Mean and half of its 95 % interval, over videos."""
    hits, names = np.asarray(hits, float), np.asarray(videos)
    means = np.array([hits[names == v].mean() for v in np.unique(names)])
    return float(hits.mean()), float(1.96 * means.std(ddof=1) / math.sqrt(len(means)))


class Study:
    """The worlds and the judges."""

    def __init__(self, work, materials):
        self.work, self.materials = work, materials
        self.cache = work / "cache"
        self.progress = Line()
        self.train, self.new = (self.world(name) for name in ("train", "many"))
        self.test = self.new.take(self.new.ids[:: max(1, len(self.new) // JUDGED)][:JUDGED])
        self.encoders = EncoderSet.load("palpate/mini")
        self.names = sorted(set(self.train.column("material")))
        pixels = partial(cached_images, size=MINI.size, cache=self.cache)
        self.images, self.real = (pixels(m, "tactile") for m in (self.train, self.test))
        self.gels = gels_of(self.test, MINI.size, self.cache)
        self.answers = np.array([self.names.index(m) for m in self.test.column("material")])
        self.videos = self.test.column("video")
        self.judge = self.trained_judge()
        self.tactile = [
            embed(m, self.encoders, "tactile", cache=self.cache) for m in (self.train, self.test)
        ]
        self.probe = fit_probe(self.tactile[0])

    def world(self, name):
        folder = self.work / f"world {name}"
        shape = {"objects_per_material": JUDGED // self.materials, **WORLDS[name]}
        options = replace(PRESETS["pretrain"], **shape, materials=self.materials)
        if not (folder / "done").is_file():
            write_world(folder / "tree", options, workers=2, progress=self.progress)
            (folder / "done").write_text(options.digest)
        return Manifest.load(folder / "tree")

    def trained_judge(self):
        with seeded(0, "judge"):
            judge = Judge(len(self.names))
        labels = np.array([self.names.index(m) for m in self.train.column("material")])
        loss = JudgeLoss(self.images, labels)
        task = Task("judge", len(labels), loss.load, loss, self.train.digest)
        fit(judge, task, JUDGE, self.work / "judge", compute=BFLOAT, progress=self.progress)
        return judge.eval()

    def judged(self, images, gels):
        """Accuracy of both judges, and TMMD, of images of the test samples in their order, on
        these gels.
        """
        hits = self.judge.names(images) == self.answers
        features = FeatureSet(
            self.test.ids,
            embed_images(np.asarray(images), self.encoders, gels=gels),
            self.test.column("material"),
            self.videos,
            self.encoders.digest("tactile"),
        )
        probed = material_accuracy(self.tactile[0], features, probe=self.probe)
        far = tmmd(features, self.tactile[1], preset="grouped")
        return {
            "cnn": by_video(hits, self.videos),
            "probe": [probed.value, (probed.interval[1] - probed.interval[0]) / 2],
            "tmmd": [far.value, *far.interval],
        }

    def nearest(self, known, cache):
        """The real images of the photos of ``known`` that are most like the test photos, and their
        gels.
        """
        keys, asked = (
            embed(part, self.encoders, "vision", cache=of).features
            for part, of in ((known, cache), (self.test, self.cache))
        )
        images, gels = (
            cached_images(known, column, MINI.size, cache) for column in ("tactile", "background")
        )
        rows = (asked @ keys.T).argmax(1)
        return images[rows], gels[rows]

    def gels_like(self, known, cache):
        """A gel of ``known`` for each judged sample."""
        gels = gels_of(known, MINI.size, cache)
        rows = rng_for(0, "known gels").integers(len(gels), size=len(self.test))
        return np.stack([gels[row] for row in rows])


class Line:
    """A line of progress every half minute."""

    last = 0.0

    def __call__(self, what, done, total, remark=""):
        if time.monotonic() > self.last + 30:
            self.last = time.monotonic()
            print(f"  {what}: {done} of {total} {remark}", flush=True)


def percents(pair):
    """`17.7 ± 4.7` of a share and half of its interval."""
    return f"{100 * pair[0]:.1f} ± {100 * pair[1]:.1f}"


def line(*values):
    return f"| {' | '.join(map(str, values))} |"

"""What several benchmarks share: a judge of generated images, and lines of tables."""

import itertools
import math
import time

import numpy as np
import torch
from torch import nn

from palpate.training.engine import Losses
from palpate.training.options import Compute

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

"""Names of the metrics that go with TMMD."""

from __future__ import annotations

from typing import Literal

Name = Literal[
    "fid",
    "kid",
    "prdc",
    "cmmd",
    "fd-dinov2",
    "mind",
    "vendi",
    "ssim",
    "psnr",
    "ms-ssim",
    "contact",
    "lpips",
]

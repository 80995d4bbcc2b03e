"""How good are generated touches: the TMMD family, SSIM and PSNR. Arrays in, :class:`palpate.core.Score` out; NumPy and SciPy only."""

from palpate.metrics.mmd import mmd2
from palpate.metrics.pairwise import psnr, psnr_per_image, ssim, ssim_per_image
from palpate.metrics.presets import PRESETS, Options
from palpate.metrics.tactile import ci_tmmd, d_tmmd, four_scores, i_tmmd, tmmd

__all__ = [
    "PRESETS", "Options", "ci_tmmd", "d_tmmd", "four_scores", "i_tmmd", "mmd2", "psnr", "psnr_per_image", "ssim", "ssim_per_image", "tmmd",
]  # fmt: skip

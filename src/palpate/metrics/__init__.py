"""How good are generated touches: the TMMD family and its companions. Arrays in, :class:`palpate.core.Score` out; NumPy and SciPy only."""

from palpate.metrics.contact import (
    contact_iou,
    contact_ms_ssim,
    contact_pictures,
    contact_psnr,
    contact_residual,
    contact_scores,
    contact_ssim,
)
from palpate.metrics.frechet import compare_fid, fid
from palpate.metrics.gaussians import frechet_distance
from palpate.metrics.kernels import Gaussian, Linear, Polynomial
from palpate.metrics.masks import contact_mask
from palpate.metrics.mmd import Distance, distance, mmd2
from palpate.metrics.multiscale import ms_ssim, ms_ssim_per_image
from palpate.metrics.neighbors import prdc
from palpate.metrics.paired import Comparison, compare, compare_tmmd
from palpate.metrics.pairwise import (
    mean_score,
    paired_by_id,
    psnr,
    psnr_per_image,
    ssim,
    ssim_per_image,
)
from palpate.metrics.presets import PRESETS, Options
from palpate.metrics.streaming import CITMMD, DTMMD, ITMMD, TMMD
from palpate.metrics.tactile import ci_tmmd, d_tmmd, four_scores, i_tmmd, tmmd

__all__ = [
    "CITMMD",
    "DTMMD",
    "ITMMD",
    "PRESETS",
    "TMMD",
    "Comparison",
    "Distance",
    "Gaussian",
    "Linear",
    "Options",
    "Polynomial",
    "ci_tmmd",
    "compare",
    "compare_fid",
    "compare_tmmd",
    "contact_iou",
    "contact_mask",
    "contact_ms_ssim",
    "contact_pictures",
    "contact_psnr",
    "contact_residual",
    "contact_scores",
    "contact_ssim",
    "d_tmmd",
    "distance",
    "fid",
    "four_scores",
    "frechet_distance",
    "i_tmmd",
    "mean_score",
    "mmd2",
    "ms_ssim",
    "ms_ssim_per_image",
    "paired_by_id",
    "prdc",
    "psnr",
    "psnr_per_image",
    "ssim",
    "ssim_per_image",
    "tmmd",
]

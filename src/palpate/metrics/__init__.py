"""Metrics of generated tactile images: arrays or tensors in, :class:`palpate.core.Score` out.

On features of an encoder: the TMMD family, KID, CMMD, FID, precision, recall, density and coverage.
On pairs of images: SSIM, PSNR and MS-SSIM, of whole images and of the contact alone.
"""

from palpate.metrics.contact import (
    background_digest,
    contact_images,
    contact_iou,
    contact_mask,
    contact_ms_ssim,
    contact_psnr,
    contact_residual,
    contact_scores,
    contact_ssim,
    measure_contacts,
)
from palpate.metrics.distributions import compare_fid, fid, frechet_distance, prdc, precision_recall
from palpate.metrics.images import (
    mean_score,
    ms_ssim,
    ms_ssim_per_image,
    paired_by_id,
    psnr,
    psnr_per_image,
    ssim,
    ssim_per_image,
)
from palpate.metrics.kernels import Gaussian, Linear, Polynomial
from palpate.metrics.mmd import PRESETS, Distance, Options, distance, mmd2
from palpate.metrics.paired import Comparison, compare, compare_tmmd
from palpate.metrics.streaming import CITMMD, DTMMD, ITMMD, TMMD
from palpate.metrics.tactile import ci_tmmd, cmmd, d_tmmd, four_scores, i_tmmd, kid, tmmd

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
    "background_digest",
    "ci_tmmd",
    "cmmd",
    "compare",
    "compare_fid",
    "compare_tmmd",
    "contact_images",
    "contact_iou",
    "contact_mask",
    "contact_ms_ssim",
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
    "kid",
    "mean_score",
    "measure_contacts",
    "mmd2",
    "ms_ssim",
    "ms_ssim_per_image",
    "paired_by_id",
    "prdc",
    "precision_recall",
    "psnr",
    "psnr_per_image",
    "ssim",
    "ssim_per_image",
    "tmmd",
]

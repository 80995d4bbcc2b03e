"""Metrics of generated tactile images: arrays or tensors in, :class:`palpate.core.Score` out.

On features of an encoder: the TMMD family, KID, CMMD, FID, precision, recall, density and coverage,
Vendi, MIND.
On pairs of images: SSIM, PSNR and MS-SSIM; residual, SSIM and IoU of the contact alone; motion of
the markers.
Of a contact itself: ``metrics.conditions`` (place, area, strength, shear), ``metrics.markers``.
"""

from palpate.metrics.contact import background_digest, contact_mask, contact_scores
from palpate.metrics.distributions import compare_fid, fid, prdc
from palpate.metrics.images import PerImage, ms_ssim, per_image, psnr, ssim
from palpate.metrics.inputs import require_same_ids
from palpate.metrics.kernels import Gaussian, Polynomial
from palpate.metrics.mmd import PRESETS, Options
from palpate.metrics.motion import marker_scores
from palpate.metrics.paired import Comparison, compare, compare_tmmd, four_scores
from palpate.metrics.sets import compare_mind, compare_vendi, mind, vendi
from palpate.metrics.streaming import TMMD, distance
from palpate.metrics.tactile import ci_tmmd, cmmd, d_tmmd, i_tmmd, kid, tmmd

__all__ = [
    "PRESETS",
    "TMMD",
    "Comparison",
    "Gaussian",
    "Options",
    "PerImage",
    "Polynomial",
    "background_digest",
    "ci_tmmd",
    "cmmd",
    "compare",
    "compare_fid",
    "compare_mind",
    "compare_tmmd",
    "compare_vendi",
    "contact_mask",
    "contact_scores",
    "d_tmmd",
    "distance",
    "fid",
    "four_scores",
    "i_tmmd",
    "kid",
    "marker_scores",
    "mind",
    "ms_ssim",
    "per_image",
    "prdc",
    "psnr",
    "require_same_ids",
    "ssim",
    "tmmd",
    "vendi",
]

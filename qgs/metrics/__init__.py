"""How good a reconstruction is, and what needs no model to reach."""

from qgs.metrics.baselines import mean_colour, nearest_input
from qgs.metrics.dispersion import OPACITY_USED, Spread, gaussians_used, spread, token_dispersion
from qgs.metrics.images import psnr, ssim

__all__ = [
    "OPACITY_USED",
    "Spread",
    "gaussians_used",
    "mean_colour",
    "nearest_input",
    "psnr",
    "spread",
    "ssim",
    "token_dispersion",
]

"""How good a reconstruction is, and what needs no model to reach."""

from qgs.metrics.baselines import mean_colour, nearest_input
from qgs.metrics.dispersion import OPACITY_USED, Dispersion, gaussians_used, token_dispersion
from qgs.metrics.images import Psnr, Ssim, psnr, ssim
from qgs.metrics.lpips import Lpips

COMPONENTS = (Psnr, Ssim, Lpips, Dispersion)

__all__ = [
    "COMPONENTS",
    "OPACITY_USED",
    "Dispersion",
    "Lpips",
    "Psnr",
    "Ssim",
    "gaussians_used",
    "mean_colour",
    "nearest_input",
    "psnr",
    "ssim",
    "token_dispersion",
]

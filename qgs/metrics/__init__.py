"""How good a reconstruction is, and what needs no model to reach."""

from qgs.metrics.dispersion import Dispersion
from qgs.metrics.images import Psnr, Ssim

COMPONENTS = (Psnr, Ssim, Dispersion)

"""How good a reconstruction is, and what needs no model to reach."""

from qgs.metrics.dispersion import Dispersion
from qgs.metrics.images import Psnr, Ssim
from qgs.metrics.lpips import Lpips

COMPONENTS = (Psnr, Ssim, Lpips, Dispersion)

"""Quality metrics of reconstructions, and baselines that need no model."""

from qgs.metrics.dispersion import Dispersion
from qgs.metrics.images import Psnr, Ssim

COMPONENTS = (Psnr, Ssim, Dispersion)

"""Quality metrics of reconstructions, and baselines that are images made without a model."""

from qgs.metrics.dispersion import Dispersion
from qgs.metrics.images import Psnr, Ssim

COMPONENTS = (Psnr, Ssim, Dispersion)

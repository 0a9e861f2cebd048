"""The metrics PSNR and SSIM, computed as in the evaluation of the LocusGS release."""

from collections.abc import Mapping
from typing import Literal

from torch import Tensor

from qgs.contracts import Column, ComponentConfig, Metric, MetricInput
from qgs.precision import full_precision
from qgs.similarity import WINDOW, similarity_map

SsimCovariance = Literal["population", "sample"]

# Identical images get 100 dB.
_MSE_FLOOR = 1e-10


class Psnr(Metric):
    """PSNR, the peak signal-to-noise ratio of each view; higher is better.

    An increase of 6 dB halves the root mean squared error.
    """

    name = "psnr"
    definition = "dB of images clipped to [0, 1], mean over views, then over scenes"
    column = Column("PSNR", "higher", digits=2, unit="dB")

    def forward(self, given: MetricInput) -> Tensor:
        """Return the PSNR in dB of each of the T views, (1, T)."""
        return psnr(given.images, given.targets.images)


class Ssim(Metric):
    """SSIM, the structural similarity of each rendered view to its photo (Wang et al. 2004).

    Higher is better; 1 means equal images.
    """

    name = "ssim"
    definition = "scikit-image: Gaussian window of 11, sigma 1.5, data range 1, borders left out"

    class Config(ComponentConfig):
        """Options of the metric `qgs/ssim`."""

        covariance: SsimCovariance = "population"
        """Kind of variances and covariance. "population" divides by the number of pixels, as in
        Wang et al. 2004. "sample" divides by this number less 1; it is scikit-image's default,
        which the evaluation of pixelSplat and its successors uses."""

    config: Config

    def columns(self) -> Mapping[str, Column]:
        """Return the column "SSIM", or "SSIM (sample covariance)" for the covariance "sample"."""
        covariance = self.config.covariance
        form = "" if covariance == "population" else f" ({covariance} covariance)"
        return {"": Column(f"SSIM{form}", "higher")}

    def forward(self, given: MetricInput) -> Tensor:
        """Return the SSIM of each of the T views, (1, T).

        Raises ValueError if images are smaller than the window of SSIM.
        """
        return ssim(given.images, given.targets.images, self.config.covariance)


@full_precision
def psnr(images: Tensor, truth: Tensor) -> Tensor:
    """Compute the PSNR in dB of images (..., 3, H, W) after clipping to [0, 1], -> (...)."""
    # Clipped, as a saved picture would be.
    error = (images.clamp(0, 1) - truth.clamp(0, 1)).square().mean((-3, -2, -1))
    return -10 * error.clamp_min(_MSE_FLOOR).log10()


@full_precision
def ssim(images: Tensor, truth: Tensor, covariance: SsimCovariance = "population") -> Tensor:
    """Compute the SSIM of images (..., 3, H, W) after clipping to [0, 1], -> (...).

    The result equals scikit-image's `structural_similarity` with gaussian_weights, sigma 1.5 and
    data_range 1, which leaves out the 5 pixels at the border. Covariance "sample" stands for
    scikit-image's use_sample_covariance: variances of the N = 11 * 11 pixels of a window are
    multiplied by N / (N - 1). The computation is in float64, because variances of flat images are
    small differences of squares.
    Raises ValueError if a side is shorter than the window of 11 pixels.
    """
    x, y = (image.clamp(0, 1).double() for image in (images, truth))
    samples = WINDOW**2
    # Sample variances divide by N - 1, population variances by N.
    correction = samples / (samples - 1) if covariance == "sample" else 1.0
    return similarity_map(x, y, "valid", correction).mean((-3, -2, -1)).to(images.dtype)

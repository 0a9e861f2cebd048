"""What a report is made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from qgs.analysis.pictures.figures import Curves
from qgs.data.sampling import Sample
from qgs.model import QueryGaussianModel


@dataclass(frozen=True)
class Contender:
    """A trained model and its figures.

    psnr (dB) and ssim: means over unseen views. dispersion_mean, dispersion_median: distance of
    Gaussians to their token's centroid, world units. gaussians: per scene. seconds: of training.
    recipe: the resolved recipe as YAML.
    """

    name: str
    model: QueryGaussianModel
    psnr: float
    ssim: float
    dispersion_mean: float
    dispersion_median: float
    gaussians: int
    parameters: int
    seconds: float
    curves: Curves
    recipe: str


@dataclass(frozen=True)
class Baseline:
    """What needs no model: its mean PSNR (dB) and SSIM on the same views."""

    name: str
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Report:
    """A comparison.

    contenders: in the order in which they are shown. samples: the unseen scenes to picture. depths:
    for each of them the true depth (T, 1, H, W) of its targets in the model's units, where known.
    facts: name to value, what was run where.
    """

    title: str
    contenders: Sequence[Contender]
    baselines: Sequence[Baseline]
    samples: Sequence[Sample]
    depths: Sequence[Tensor | None]
    facts: Mapping[str, str]

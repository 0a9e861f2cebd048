"""`lpips/vgg16`, a loss and a metric: LPIPS with VGG-16 (Zhang et al., 2018, arXiv 1801.03924).

It computes version 0.1 of LPIPS. The learned factors of VGG-16's channels are read from a file of
the installed package `lpips`. The package is not imported, because it needs torchvision, whose
wheels work only with CUDA builds of torch.
"""

from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path

import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat
from torch import Tensor, nn

from qgs.contracts import (
    Column,
    ComponentConfig,
    Loss,
    Metric,
    MetricInput,
    MissingExtraError,
    Problem,
    RecipeContext,
)
from qgs.losses.photometric import too_small
from qgs.precision import full_precision
from qgs.types import LayerPrediction, Rendering, Views
from qgs_zoo.parts import weight_file

# The file of torchvision's VGG-16 in torch's cache.
_VGG_FILE = "vgg16-397923af.pth"
_BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""Indices of VGG-16's convolutions in torchvision, grouped into five blocks. There is a 2 x 2 max
pooling between consecutive blocks."""
# mean and standard deviation of ImageNet, for images in [-1, 1]
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPS = 1e-10
SMALLEST_SIDE = 2 ** (len(_BLOCKS) - 1)


class PerceptualDistance(nn.Module):
    """Network that computes LPIPS of rendered and true images. Call `load` before the first use."""

    @full_precision
    def forward(self, images: Tensor, truth: Tensor) -> Tensor:
        """Return the LPIPS (X,) of X pairs of images, (X, 3, H, W) in [0, 1].

        Equal images have LPIPS 0. Only `images` get a gradient. Raises ValueError if a side is
        shorter than 16 pixels.
        """
        if min(images.shape[-2:]) < SMALLEST_SIDE:
            raise ValueError(
                f"LPIPS needs images of at least {SMALLEST_SIDE} pixels a side, got "
                f"{images.shape[-2]}x{images.shape[-1]}; use larger images, or leave out LPIPS"
            )
        # The truth is fixed, so it needs no gradients.
        with torch.no_grad():
            wanted = self._features(truth)
        total = images.new_zeros(len(images))
        for ours, theirs, weight in zip(self._features(images), wanted, self.linear, strict=True):
            total = total + F.conv2d((ours - theirs).square(), weight).mean((1, 2, 3))
        return total

    def _features(self, images: Tensor) -> list[Tensor]:
        """Return the features of VGG-16's blocks, with length 1 at each pixel."""
        x = images * 2 - 1
        shift, scale = (x.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
        x = (x - shift) / scale
        found = []
        for index, block in enumerate(self.blocks):
            x = block(F.max_pool2d(x, 2) if index else x)
            # Unit length for each pixel, so that the size of activations does not count.
            found.append(x / (x.norm(dim=1, keepdim=True) + _EPS))
        return found

    def load(self, weights: str | None) -> None:
        """Read the weights of VGG-16 and LPIPS from files. Nothing is downloaded.

        weights: file of VGG-16's weights, in safetensors or torchvision's format. None uses
        torchvision's file in torch's cache. Raises MissingExtraError if a file is missing or does
        not fit.
        """
        # The package is only located: importing it would import torchvision.
        package = find_spec("lpips")
        if package is None or not package.submodule_search_locations:
            raise MissingExtraError(
                "the package lpips, which holds the weights of LPIPS, is not installed: "
                'pip install "query-gaussians-zoo[weights]"'
            )
        linear = Path(package.submodule_search_locations[0]) / "weights" / "v0.1" / "vgg.pth"
        vgg = weights or str(Path(torch.hub.get_dir()) / "checkpoints" / _VGG_FILE)
        remedy = f"download torchvision's {_VGG_FILE} and name it in the option `weights`"
        with weight_file(vgg, remedy) as weights_of_vgg:
            self.blocks = nn.ModuleList()
            for numbers in _BLOCKS:
                block = nn.Sequential()
                for number in numbers:
                    weight = weights_of_vgg[f"features.{number}.weight"]
                    bias = weights_of_vgg[f"features.{number}.bias"]
                    convolution = nn.Conv2d(weight.shape[1], weight.shape[0], 3, padding=1)
                    convolution.load_state_dict({"weight": weight, "bias": bias})
                    block.extend([convolution, nn.ReLU(inplace=True)])
                self.blocks.append(block)
        with weight_file(str(linear), "install lpips 0.1 again") as factors:
            # number 0 in the files is a dropout, which has no weights
            names = (f"lin{index}.model.1.weight" for index in range(len(_BLOCKS)))
            self.linear = nn.ParameterList([factors[name].float() for name in names])
        self.requires_grad_(False)


class VggOptions(ComponentConfig):
    """Option of components that compute LPIPS."""

    weights: str | None = None
    """File of VGG-16 weights: safetensors, or torchvision's vgg16-397923af.pth. Null uses
    torchvision's file in torch's cache."""


class _WithNetwork(nn.Module):
    """Part of a component that has the network of LPIPS, with its pretrained weights."""

    config: VggOptions

    def __init__(self, config: VggOptions) -> None:
        super().__init__(config)
        self.network = PerceptualDistance()

    def load_pretrained(self) -> None:
        self.network.load(self.config.weights)


class LpipsLoss(_WithNetwork, Loss):
    """Loss: mean LPIPS of rendered views with VGG-16 (TokenGS 2026.6). Nothing is downloaded."""

    name = "vgg16"
    renderings = "each"

    class Config(VggOptions, Loss.Config):
        weight: NonNegativeFloat = 0.5
        """Weight of the loss in the objective."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        yield from too_small(context, SMALLEST_SIDE, "", "LPIPS")

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        """Return the mean LPIPS of the views. Raises ValueError for image sides below 16 pixels."""
        images = rendering.rgb.flatten(0, 1)
        truth = target.images.flatten(0, 1)
        return self.network(images, truth).mean()


class Lpips(_WithNetwork, Metric):
    """LPIPS: distance of each rendered view from the true image in VGG-16 features.

    Nothing is downloaded.
    """

    name = "vgg16"
    definition = "VGG-16, version 0.1, images in [-1, 1]"
    not_in_protocol = frozenset({"weights"})
    column = Column("LPIPS", "lower")

    class Config(VggOptions):
        """Options of the metric LPIPS."""

    config: Config

    def forward(self, given: MetricInput) -> Tensor:
        """Return the LPIPS (1, T) of T views. Raises ValueError for image sides below 16 pixels."""
        return self.distance(given.images, given.targets.images)

    @torch.no_grad()
    def distance(self, images: Tensor, truth: Tensor) -> Tensor:
        """Return the LPIPS (...) of pairs of images (..., 3, H, W), after clipping to [0, 1]."""
        # pair by pair, so that memory does not grow with the number of views
        single = (x.clamp(0, 1).flatten(0, -4).split(1) for x in (images, truth))
        return torch.cat([*map(self.network, *single)]).reshape(images.shape[:-3])

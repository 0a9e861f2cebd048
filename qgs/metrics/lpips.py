"""LPIPS with a VGG-16 (Zhang et al., 2018, arXiv 1801.03924, version 0.1 of the release).

The `lpips` package supplies the learned weights of the layers. Its own network is not imported: it
takes VGG-16 from torchvision, whose wheels work with CUDA builds of torch only.
"""

from collections.abc import Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor, nn

from qgs.contracts import Column, ComponentConfig, Metric, MetricInput
from qgs.geometry.precision import full_precision

_VGG_FILE = "vgg16-397923af.pth"  # torchvision's VGG-16 in torch's cache
_BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""Convolutions of VGG-16 by torchvision's numbers; a 2x2 max pooling stands between blocks."""
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPS = 1e-10
_SMALLEST = 2 ** (len(_BLOCKS) - 1)


class Lpips(Metric):
    """LPIPS, distance of each view to the truth in features of VGG-16; nothing is downloaded."""

    name: ClassVar[str] = "lpips"
    definition: ClassVar[str] = "VGG-16, version 0.1, images in [-1, 1]"
    not_in_protocol: ClassVar[frozenset[str]] = frozenset({"weights"})
    column: ClassVar[Column] = Column("LPIPS", "lower")

    class Config(ComponentConfig):
        """Options of LPIPS."""

        weights: str | None = None
        """File of VGG-16 weights (safetensors, or torchvision's vgg16-397923af.pth); null takes
        the one in torch's cache."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.unavailable = self._load(config.weights)
        self.requires_grad_(False)

    def forward(self, given: MetricInput) -> Tensor:
        """(1, T). Raises ValueError when a side is shorter than 16 pixels."""
        return self.distance(given.images, given.targets.images)

    @full_precision
    @torch.no_grad()
    def distance(self, images: Tensor, truth: Tensor) -> Tensor:
        """LPIPS of images (..., 3, H, W), clipped to [0, 1] -> (...), 0 for equal ones."""
        if min(images.shape[-2:]) < _SMALLEST:
            raise ValueError(
                f"LPIPS needs images of at least {_SMALLEST} pixels a side, got "
                f"{images.shape[-2]}x{images.shape[-1]}"
            )
        pairs = zip(images.flatten(0, -4), truth.flatten(0, -4), strict=True)
        return torch.stack([self._pair(*pair) for pair in pairs]).reshape(images.shape[:-3])

    def _pair(self, image: Tensor, truth: Tensor) -> Tensor:
        x = torch.stack([image, truth]).clamp(0, 1) * 2 - 1
        shift, scale = (x.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
        x = (x - shift) / scale
        total = x.new_zeros(())
        for index, (block, weight) in enumerate(zip(self.blocks, self.linear, strict=True)):
            x = block(F.max_pool2d(x, 2) if index else x)
            unit = x / (x.norm(dim=1, keepdim=True) + _EPS)
            total = total + F.conv2d((unit[:1] - unit[1:]).square(), weight).mean()
        return total

    def _load(self, weights: str | None) -> str:
        """Read the weights; why they cannot be read, "" if they were."""
        package = find_spec("lpips")
        if package is None or not package.submodule_search_locations:
            return (
                "the package lpips, which holds its weights, is not installed: "
                'pip install "query-gaussians[lpips]"'
            )
        linear = Path(package.submodule_search_locations[0]) / "weights" / "v0.1" / "vgg.pth"
        vgg = Path(weights) if weights else Path(torch.hub.get_dir()) / "checkpoints" / _VGG_FILE
        if not vgg.is_file():
            place = f"at {vgg.name}" if weights else "in the cache of torch.hub"
            return (
                f"there are no VGG-16 weights {place}: download torchvision's {_VGG_FILE} and name "
                "it in the option `weights` of qgs/lpips"
            )
        try:
            read = load_file if vgg.suffix == ".safetensors" else _load_pickled
            tensors, factors = read(vgg), _load_pickled(linear)
            self.blocks = nn.ModuleList(
                nn.Sequential(*(layer for number in block for layer in _layers(tensors, number)))
                for block in _BLOCKS
            )
            names = (f"lin{index}.model.1.weight" for index in range(len(_BLOCKS)))
            self.linear = nn.ParameterList([factors[name].float() for name in names])
        except (KeyError, RuntimeError, ValueError, OSError) as error:
            return (
                f"{vgg.name} or {linear.name} does not hold the weights of VGG-16 and LPIPS 0.1 "
                f"({type(error).__name__}: {error})"
            )
        return ""


def _layers(vgg: Mapping[str, Tensor], number: int) -> tuple[nn.Conv2d, nn.ReLU]:
    weight, bias = vgg[f"features.{number}.weight"], vgg[f"features.{number}.bias"]
    convolution = nn.Conv2d(weight.shape[1], weight.shape[0], 3, padding=1)
    convolution.load_state_dict({"weight": weight, "bias": bias})
    return convolution, nn.ReLU(inplace=True)


_load_pickled = partial(torch.load, map_location="cpu", weights_only=True)

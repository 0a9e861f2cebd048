"""LPIPS with a VGG-16 (Zhang et al., 2018, arXiv 1801.03924, version 0.1 of the release).

The `lpips` package supplies the learned weights of the layers. Its own network is not imported: it
takes VGG-16 from torchvision, whose wheels work with CUDA builds of torch only.
"""

from collections.abc import Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor, nn

from qgs.contracts import MissingExtraError
from qgs.geometry.precision import full_precision

# torchvision's VGG-16 in torch's cache.
_VGG_FILE = "vgg16-397923af.pth"
_BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""Convolutions of VGG-16 by torchvision's numbers; a 2x2 max pooling stands between blocks."""
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPS = 1e-10
SMALLEST_SIDE = 2 ** (len(_BLOCKS) - 1)


class PerceptualDistance(nn.Module):
    """LPIPS of images against the truth, with fixed weights; `load` reads them."""

    @full_precision
    def forward(self, images: Tensor, truth: Tensor) -> Tensor:
        """(X,), 0 for equal ones, of images (X, 3, H, W) in [0, 1]; with a gradient in `images`.

        Raises ValueError when a side is shorter than 16 pixels.
        """
        if min(images.shape[-2:]) < SMALLEST_SIDE:
            raise ValueError(
                f"LPIPS needs images of at least {SMALLEST_SIDE} pixels a side, got "
                f"{images.shape[-2]}x{images.shape[-1]}"
            )
        # The photos are given: half of the network's gradients are never needed.
        with torch.no_grad():
            wanted = self._features(truth)
        total = images.new_zeros(len(images))
        for ours, theirs, weight in zip(self._features(images), wanted, self.linear, strict=True):
            total = total + F.conv2d((ours - theirs).square(), weight).mean((1, 2, 3))
        return total

    def _features(self, images: Tensor) -> list[Tensor]:
        """The outputs of the blocks, each pixel's channels of length 1."""
        x = images * 2 - 1
        shift, scale = (x.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
        x = (x - shift) / scale
        found = []
        for index, block in enumerate(self.blocks):
            x = block(F.max_pool2d(x, 2) if index else x)
            # Unit length for each pixel, so that no channel counts for its size.
            found.append(x / (x.norm(dim=1, keepdim=True) + _EPS))
        return found

    def load(self, weights: str | None) -> None:
        """Read the weights; nothing is downloaded.

        weights: file of VGG-16 (safetensors, or torchvision's); None for the one in torch's cache.
        Raises MissingExtraError where they are not there or do not fit.
        """
        # Found, not imported: the package imports torchvision.
        package = find_spec("lpips")
        if package is None or not package.submodule_search_locations:
            raise MissingExtraError(
                "the package lpips, which holds the weights of LPIPS, is not installed: "
                'pip install "query-gaussians-zoo[weights]"'
            )
        linear = Path(package.submodule_search_locations[0]) / "weights" / "v0.1" / "vgg.pth"
        vgg = Path(weights) if weights else Path(torch.hub.get_dir()) / "checkpoints" / _VGG_FILE
        if not vgg.is_file():
            place = f"at {vgg.name}" if weights else "in the cache of torch.hub"
            raise MissingExtraError(
                f"there are no VGG-16 weights {place}: download torchvision's {_VGG_FILE} and name "
                "it in the option `weights` of lpips/vgg16"
            )
        try:
            read = load_file if vgg.suffix == ".safetensors" else _load_pickled
            tensors = read(vgg)
            factors = _load_pickled(linear)
            self.blocks = nn.ModuleList(
                nn.Sequential(*(layer for number in block for layer in _layers(tensors, number)))
                for block in _BLOCKS
            )
            names = (f"lin{index}.model.1.weight" for index in range(len(_BLOCKS)))
            self.linear = nn.ParameterList([factors[name].float() for name in names])
        except (KeyError, RuntimeError, ValueError, OSError) as error:
            raise MissingExtraError(
                f"{vgg.name} or {linear.name} does not hold the weights of VGG-16 and LPIPS 0.1 "
                f"({type(error).__name__}: {error})"
            ) from error
        self.requires_grad_(False)


def _layers(vgg: Mapping[str, Tensor], number: int) -> tuple[nn.Conv2d, nn.ReLU]:
    weight = vgg[f"features.{number}.weight"]
    bias = vgg[f"features.{number}.bias"]
    convolution = nn.Conv2d(weight.shape[1], weight.shape[0], 3, padding=1)
    convolution.load_state_dict({"weight": weight, "bias": bias})
    return convolution, nn.ReLU(inplace=True)


_load_pickled = partial(torch.load, map_location="cpu", weights_only=True)

"""`mvsplat/mvsplat`: MVSplat's networks as an encoder (arXiv 2403.14627).

The networks are a CNN, a window transformer, a plane sweep and two U-Nets.
"""

from typing import Any, Literal

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

from qgs.contracts import ModelDims
from qgs.precision import at_least_float32, full_precision
from qgs.tokengs.encoder import imagenet_normalised
from qgs.types import Views
from qgs_zoo.mvsplat.cnn import CNN, WIDTHS
from qgs_zoo.mvsplat.sweep import (
    DepthRange,
    Sweep,
    SweepEncoder,
    bounds,
    cost_volume,
    cyclic_neighbours,
    evenly_spaced,
)
from qgs_zoo.mvsplat.unet import OverViews, UNet, conv3, group_norm, resized, two_convolutions
from qgs_zoo.mvsplat.windows import WindowTransformer, with_positions

FACTOR = 4
"""Side of an image divided by the side of its feature map."""


class MVSplatEncoder(SweepEncoder):
    """Encoder that predicts depth and raw Gaussian of each pixel with a plane sweep.

    The memory has a token for each pixel, or for each square of pixels if `stride` is more than 1.
    The D numbers of a token are those of `qgs_zoo.mvsplat.pixels.CHANNELS`, then coefficients of
    harmonics. D is the model's width: 86 for harmonics of degree 4 (published). The order of views
    matters. A single view is compared with itself.
    """

    name = "mvsplat"

    class Config(DepthRange):
        cnn_widths: tuple[int, int, int] = WIDTHS
        """Channels of the three stages of the CNN."""
        features: int = Field(default=128, ge=4, multiple_of=4)
        """Channels of the features that the plane sweep compares."""
        stride: Literal[1, 2, 4] = 1
        """Side, in pixels, of the square that gives one Gaussian. 1 gives one Gaussian per pixel
        (published)."""
        candidates: int = Field(default=128, ge=2)
        """Number of depths in the plane sweep, evenly spaced in inverse depth from `far` to
        `near`."""
        cost_width: int = Field(default=128, ge=32, multiple_of=32)
        """Channels of the U-Net over the cost volume."""
        cost_levels: int = Field(default=3, ge=1, le=6)
        """Number of levels of the U-Net over the cost volume. The lowest level has attention over
        all views."""
        depth_width: int = Field(default=32, ge=32, multiple_of=32)
        """Channels of the U-Net that refines depths at full size."""
        depth_levels: int = Field(default=5, ge=1, le=8)
        """Number of levels of the U-Net that refines depths. The lowest level has attention over
        all views."""
        cost_volume: bool = True
        """Compare views in the plane sweep. False replaces the correlations of views by zeros, so
        that depths are predicted from features alone (the paper's ablation)."""

    config: Config

    @classmethod
    def multiple(cls, config: Config) -> int:
        cost, depth = (2 ** (x - 1) for x in (config.cost_levels, config.depth_levels))
        return max(2 * FACTOR, FACTOR * cost, config.stride * depth)

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        # Both compute features at 1/4 of the image size; the names are published.
        cnn = CNN(config.features, (2, 1), config.cnn_widths)
        transformer = WindowTransformer(config.features)
        self.backbone = nn.ModuleDict({"backbone": cnn, "transformer": transformer})
        count = config.candidates
        cost = config.cost_width
        fine = config.depth_width
        width = config.features
        gaussian = dims.width - 2
        matched = count + width
        nets: Any = nn.ModuleDict()
        self.depth_predictor = nets
        nets.corr_refine_net = OverViews(
            conv3(matched, cost),
            group_norm(cost),
            nn.GELU(),
            UNet(cost, config.cost_levels, pre_norm=False),
            conv3(cost, count),
        )
        nets.regressor_residual = nn.Conv2d(matched, count, 1)
        nets.depth_head_lowres = two_convolutions(count, 2 * count, count)
        scale = FACTOR // config.stride
        upscale = nn.Upsample(scale_factor=scale, mode="bilinear", align_corners=True)
        # GELU comes after the resizing, not before it.
        nets.upsampler = nn.Sequential(conv3(2 * width, width), upscale, nn.GELU())
        nets.proj_feature = conv3(width, fine)
        nets.refine_unet = OverViews(
            conv3(3 + fine + 2, fine),
            nn.GroupNorm(4, fine),
            nn.GELU(),
            UNet(fine, config.depth_levels, pre_norm=False),
        )
        nets.to_gaussians = two_convolutions(fine + 3 + width, 2 * gaussian, gaussian)
        nets.to_disparity = two_convolutions(fine, 2 * fine, 2)

    def predict(self, views: Views, near_BV: Tensor, far_BV: Tensor) -> Tensor:
        neighbours = cyclic_neighbours(*near_BV.shape, device=near_BV.device)
        normalized_N3HW = imagenet_normalised(views.images).flatten(0, 1)
        cnn_NDhw = self.backbone["backbone"](normalized_N3HW).features
        cnn_BVDhw = cnn_NDhw.unflatten(0, near_BV.shape)
        # The transformer reads other views in ascending order, the sweep in cyclic order.
        ascending_BVJ = neighbours.sort().values
        features_BVDhw = self.backbone["transformer"](with_positions(cnn_BVDhw), ascending_BVJ)
        sweep = Sweep(views.cameras, neighbours, near_BV, far_BV)
        disparity_N1hw, confidence_N1hw = self.match(features_BVDhw, sweep)
        # These networks see images in [0, 1]; only the CNN sees normalised ones.
        images_N3HW = views.images.flatten(0, 1)
        # With fewer Gaussians than pixels, colours are means over squares.
        if self.config.stride > 1:
            images_N3HW = F.avg_pool2d(images_N3HW, self.config.stride)
        size = images_N3HW.shape[2:]
        disparity_N1HW = resized(disparity_N1hw, size)
        confidence_N1HW = F.interpolate(confidence_N1hw, tuple(size), mode="nearest")
        nets = self.depth_predictor
        full_NDHW = nets.upsampler(torch.cat([features_BVDhw.flatten(0, 1), cnn_NDhw], 1))
        projected = nets.proj_feature(full_NDHW)
        seen = torch.cat([images_N3HW, projected, disparity_N1HW, confidence_N1HW], 1)
        refined = nets.refine_unet(seen, near_BV.shape[1])
        raw = nets.to_gaussians(torch.cat([refined, images_N3HW, full_NDHW], 1))
        change_N1HW, logit_N1HW = nets.to_disparity(refined).split(1, 1)
        fine_N1HW = (disparity_N1HW + at_least_float32(change_N1HW)).clamp(*bounds(sweep))
        return torch.cat([-fine_N1HW.log(), logit_N1HW, raw], 1).unflatten(0, near_BV.shape)

    def match(self, features_BVDhw: Tensor, sweep: Sweep) -> tuple[Tensor, Tensor]:
        """Return inverse depths and confidences, each (B V, 1, h, w), at 1/4 of the image size.

        The confidence of a pixel is the largest probability of a depth of the sweep.
        """
        count = self.config.candidates
        candidates_ND11 = evenly_spaced(*bounds(sweep), count)
        size = features_BVDhw.shape[3:]
        volume_BVDhw = features_BVDhw.new_zeros(*sweep.near.shape, count, *size)
        if self.config.cost_volume:
            volume_BVDhw = cost_volume(features_BVDhw, candidates_ND11, sweep)
        matched = torch.cat([volume_BVDhw, features_BVDhw], 2).flatten(0, 1)
        nets = self.depth_predictor
        refined = nets.corr_refine_net(matched, features_BVDhw.shape[1])
        # The network only corrects the volume, so that matches survive an untrained U-Net.
        refined = refined + nets.regressor_residual(matched)
        return expected_disparity(nets.depth_head_lowres(refined), candidates_ND11)


@full_precision
def expected_disparity(logits_NDhw: Tensor, candidates_NDhw: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean of candidates, weighted by softmax(logits), and the largest weight.

    Candidates are inverse depths of a plane sweep.
    """
    probability = logits_NDhw.softmax(1)
    # A mean, not the best candidate: it has a gradient and can lie between candidates.
    disparity = (probability * candidates_NDhw).sum(1, keepdim=True)
    return disparity, probability.amax(1, keepdim=True)

"""`mvsplat/depthsplat`: DepthSplat (arXiv 2410.13862), a plane sweep and a pretrained ViT.

Names of parameters are those of the released weights. Level 0, 1 or 2 means maps of 1/2, 1/4 or 1/8
of the image size. Scale 0 means the first plane sweep, scale 1 the second.
"""

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import torch
import torch.nn.functional as F
from pydantic import Field, NonNegativeInt, PositiveInt
from torch import Tensor, nn

from qgs.contracts import ComponentConfig, ModelDims, Problem, RecipeContext
from qgs.geometry.harmonics import SH_C0
from qgs.precision import at_least_float32, full_precision
from qgs.tokengs.encoder import imagenet_normalised
from qgs.types import Views
from qgs_zoo.dinov2.vit import PATCH, DinoV2, VitConfig
from qgs_zoo.mvsplat.adapter import coefficients
from qgs_zoo.mvsplat.cnn import CNN, WIDTHS, Stages
from qgs_zoo.mvsplat.dpt import LEVELS, DptHead, Joined
from qgs_zoo.mvsplat.mvsplat import expected_disparity
from qgs_zoo.mvsplat.pixels import WIDTHS as TOKEN_WIDTHS
from qgs_zoo.mvsplat.pixels import degree_of
from qgs_zoo.mvsplat.sweep import (
    DepthRange,
    Sweep,
    SweepEncoder,
    bounds,
    cost_volume,
    evenly_spaced,
    nearest_neighbours,
)
from qgs_zoo.mvsplat.unet import OverViews, UNet, conv3, group_norm, resized, two_convolutions
from qgs_zoo.mvsplat.windows import WindowTransformer, with_positions
from qgs_zoo.parts import Decaying

GAUSSIAN_CHANNELS = 1 + 2 + 3 + 4
"""Number of a raw Gaussian's channels for opacity, position in the pixel, scale and quaternion. The
channels for harmonics come after these."""


class DepthSplatConfig(ComponentConfig):
    """Sizes of DepthSplat's networks, by default of its small model for RealEstate10K."""

    features: int = Field(default=128, ge=32, multiple_of=32)
    """Channels of the multi-view features and of the networks that process the first sweep. The
    networks that process a second sweep have half as many."""
    cnn: tuple[PositiveInt, PositiveInt, PositiveInt] = WIDTHS
    """Channels of the three stages of the CNN."""
    candidates: int = Field(default=128, ge=16, multiple_of=8)
    """Number of depths in the first sweep, evenly spaced in inverse depth from `far` to `near`. The
    second sweep has a quarter as many."""
    scales: Literal[1, 2] = 1
    """Number of sweeps. A second sweep has twice the resolution, and tries depths around the result
    of the first sweep."""
    stride: Literal[4, 8] = 4
    """Side, in pixels of the image, of the square for which the first sweep finds a depth."""
    neighbours: PositiveInt = 2
    """Number of nearest views with which each view is compared if there are more than three views.
    With two or three views, each view is compared with all others."""
    vit: VitConfig
    """Sizes and weights of DINOv2. `{}` is a ViT-S with random initial weights."""
    blocks: tuple[NonNegativeInt, NonNegativeInt, NonNegativeInt, NonNegativeInt] = (2, 5, 8, 11)
    """Indices of the ViT blocks whose tokens are read. The first block has index 0. Published
    values for a ViT-L: 4, 11, 17, 23."""
    dpt: tuple[PositiveInt, PositiveInt, PositiveInt, PositiveInt] = (48, 96, 192, 384)
    """Channels of the two DPT heads, for depths and for Gaussians, at 1/2, 1/4, 1/8 and 1/16 of the
    image size. Published values for a ViT-B: 96, 192, 384, 768; for a ViT-L: 128, 256, 512,
    1024."""
    full_features: int = Field(default=64, ge=4, multiple_of=4)
    """Channels of the full-size features from which Gaussians are predicted. The DPT head that
    corrects depths has half as many. Published values: 96 for a ViT-B, 128 for a ViT-L."""
    regressor: PositiveInt = 64
    """Number of channels between the two consecutive networks that predict Gaussians."""

    @property
    def levels(self) -> list[int]:
        """Levels of the CNN's three stages, of each sweep, and of the last sweep's depth.

        Level 0, 1 or 2 means 1/2, 1/4 or 1/8 of the image size.
        """
        first = self.stride.bit_length() - 2
        sweeps = [first - scale for scale in range(self.scales)]
        return [0, first - 1, first, *sweeps, sweeps[-1]]


class Pyramid(nn.Module):
    """Network that returns its input and, for two scales, a map of twice the size.

    The second map has half the channels.
    """

    def __init__(self, width: int, scales: int) -> None:
        super().__init__()
        self.stages = nn.ModuleList([nn.Identity()])
        if scales > 1:
            upsampling = nn.ConvTranspose2d(width, width // 2, 2, 2)
            last = conv3(width // 2, width // 2)
            self.stages.append(nn.Sequential(upsampling, nn.GELU(), last))

    def forward(self, x_NChw: Tensor) -> list[Tensor]:
        return [stage(x_NChw) for stage in self.stages]


@full_precision
def finer_candidates(coarse_N1hw: Tensor, sweep: Sweep, first: int) -> Tensor:
    """Return inverse depths (B V, D, 2h, 2w) for a second sweep, around those of the first.

    coarse: inverse depths from the first sweep. first: number of depths in the first sweep, four
    times as many as D.
    """
    count = first // 4
    height, width = coarse_N1hw.shape[-2:]
    # No gradient: the first scale learns from its own depth.
    centre_N1hw = resized(coarse_N1hw.detach(), (2 * height, 2 * width))
    least, most = bounds(sweep)
    step = (most - least) / (first - 1) / 2
    low_N1hw = (centre_N1hw - count // 2 * step).clamp(least, most)
    high_N1hw = (centre_N1hw + (count // 2 - 1) * step).clamp(least, most)
    # Linear between clamped ends: near a bound, steps shrink and the centre is not a candidate.
    return evenly_spaced(low_N1hw, high_N1hw, count)


class DepthPredictor(nn.Module):
    """Network that predicts the depths of all pixels from images and cameras."""

    def __init__(self, sizes: DepthSplatConfig) -> None:
        super().__init__()
        self.sizes = sizes
        width = sizes.features
        vit = sizes.vit
        self.backbone = CNN(width, (sizes.stride // 4, 2), sizes.cnn)
        self.transformer = WindowTransformer(width)
        self.pretrained = DinoV2(vit.width, vit.depth, vit.heads)
        self.mv_pyramid = Pyramid(width, sizes.scales)
        self.mono_pyramid = Pyramid(vit.width, sizes.scales)
        self.regressor = nn.ModuleList()
        self.regressor_residual = nn.ModuleList()
        self.depth_head = nn.ModuleList()
        for scale in range(sizes.scales):
            count = self.candidates(scale)
            own = width // 2**scale
            cnn = width if scale == 0 else sizes.cnn[1]
            inputs = count + cnn + own + vit.width // 2**scale
            unet = UNet(own, 3 + scale, pre_norm=True)
            last = conv3(own, own)
            first = (conv3(inputs, own), group_norm(own), nn.GELU())
            self.regressor.append(OverViews(*first, unet, last))
            self.regressor_residual.append(nn.Conv2d(inputs, own, 1))
            self.depth_head.append(two_convolutions(own, 2 * own, count, "replicate"))
        self.upsampler = dpt_head(sizes, depth=True)

    def candidates(self, scale: int) -> int:
        """Return the number of depths that a sweep tries. Scale 0 is the first sweep."""
        return self.sizes.candidates // 4**scale

    def forward(
        self, images_BV3HW: Tensor, sweep: Sweep
    ) -> tuple[list[Tensor], Tensor, list[Tensor], Joined]:
        """Return depths of all pixels, confidences, maps of the ViT, and maps to join with these.

        Depths are camera-frame z (B V, 1, H, W) in world units, one tensor for each sweep; a DPT
        head corrects only the last tensor. The confidence of a pixel is the largest probability of
        a depth in the last sweep, (B V, 1, H, W). The maps of the ViT are (B V, C, H/8, W/8). A DPT
        head reads them together with the maps of other networks.
        """
        size = images_BV3HW.shape[-2:]
        shape = images_BV3HW.shape[:2]
        normalized_N3HW = imagenet_normalised(images_BV3HW).flatten(0, 1)
        cnn = self.backbone(normalized_N3HW)
        x_BVChw = with_positions(cnn.features.unflatten(0, shape))
        x_NChw = self.transformer(x_BVChw, sweep.neighbours).flatten(0, 1)
        # The ViT has patches of 14: the image shrinks to whole patches.
        grid = (size[0] // PATCH, size[1] // PATCH)
        small_N3hw = resized(normalized_N3HW, (grid[0] * PATCH, grid[1] * PATCH))
        tokens = self.pretrained(small_N3hw, self.sizes.blocks)
        eighth = (size[0] // 8, size[1] // 8)
        maps = [resized(x_NPC.mT.unflatten(2, grid), eighth) for x_NPC in tokens]
        # The ViT's maps are at 1/8; features for matching may be at 1/4.
        mono_NChw = resized(maps[-1], x_NChw.shape[-2:])
        multi = self.mv_pyramid(x_NChw)
        mono = self.mono_pyramid(mono_NChw)
        coarse, confidence_N1hw = self.match(cnn, multi, mono, sweep)
        # Inverse depth joins here; depth joins where Gaussians are predicted (released code).
        joined = self.beside(cnn, multi, coarse[-1])
        # Half precision cannot resolve the inverse depths of distant surfaces.
        correction_N1HW = at_least_float32(self.upsampler(maps, joined))
        full = [resized(x, size) for x in coarse]
        full[-1] = (full[-1] + correction_N1HW).clamp(*bounds(sweep))
        depths = [1 / x for x in full]
        confidence_N1HW = F.interpolate(confidence_N1hw, size, mode="nearest")
        return depths, confidence_N1HW, maps, self.beside(cnn, multi)

    def match(
        self, cnn: Stages, multi: Sequence[Tensor], mono: Sequence[Tensor], sweep: Sweep
    ) -> tuple[list[Tensor], Tensor]:
        """Return inverse depths (B V, 1, h, w) from each sweep, and the last sweep's confidence.

        The confidence of a pixel is the largest probability of a depth. cnn: maps of the CNN.
        multi, mono: features of the transformer and features of the ViT, one map for each sweep.
        """
        # `list[Tensor]()` would break the graph of torch.compile.
        found: list[Tensor] = []
        views = sweep.near.shape[1]
        confidence = multi[0]
        candidates = evenly_spaced(*bounds(sweep), self.candidates(0))
        for scale, (own, features) in enumerate(zip(multi, mono, strict=True)):
            if scale:
                candidates = finer_candidates(found[-1], sweep, self.candidates(0))
            cost_BVDhw = cost_volume(own.unflatten(0, sweep.near.shape), candidates, sweep)
            # Published weights expect this order.
            seen = [cost_BVDhw.flatten(0, 1), cnn.second if scale else cnn.features, own, features]
            seen = torch.cat(seen, 1)
            refined = self.regressor[scale](seen, views) + self.regressor_residual[scale](seen)
            inverse, confidence = expected_disparity(self.depth_head[scale](refined), candidates)
            found.append(inverse)
        return found, confidence

    def beside(self, cnn: Stages, multi: Sequence[Tensor], depth: Tensor | None = None) -> Joined:
        """Return maps that a DPT head concatenates with the ViT's maps."""
        # The order of the release: CNN, transformer, depth. If its CNN ends at 1/4, nothing joins
        # at 1/8.
        found: Joined = [[] for _ in range(LEVELS)]
        for x, level in zip([*cnn, *multi, depth], self.sizes.levels, strict=True):
            if x is not None:
                found[level].append(x)
        return found


def dpt_head(sizes: DepthSplatConfig, depth: bool) -> DptHead:
    """Make a DPT head that reads the maps of CNN, transformer and ViT.

    depth: True makes a head that also reads inverse depth, and returns a correction of this depth.
    """
    # Channels that join at each level, for the sizes of the projections.
    others = [0] * LEVELS
    sweeps = [sizes.features // 2**scale for scale in range(sizes.scales)]
    widths = [*sizes.cnn[:2], sizes.features, *sweeps, depth]
    for width, level in zip(widths, sizes.levels, strict=True):
        others[level] += width
    features = sizes.full_features // 2 if depth else sizes.full_features
    return DptHead(sizes.vit.width, sizes.dpt, features, others, depth)


class DepthSplatEncoder(Decaying, SweepEncoder):
    """Encoder that predicts depth and raw Gaussian of each pixel, with a plane sweep and a ViT.

    The ViT is pretrained. The memory has a token for each pixel. The D numbers of a token are those
    of `qgs_zoo.mvsplat.pixels.CHANNELS`, then coefficients of harmonics. The pixel's colour is
    added to the constant coefficient. D is the model's width: 38 for harmonics of degree 2
    (published). In a wider model, tokens have zeros at the end.
    """

    name = "depthsplat"

    class Config(DepthSplatConfig, DepthRange):
        coarse_depth: bool = False
        """Store the logarithm of the first sweep's depth in the last of a token's D numbers, for
        the decoder layer `mvsplat/exchange`. This needs `scales: 2`, and one more channel in
        `model.width` (published: 39)."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        if config.coarse_depth and config.scales == 1:
            reason = "with `scales: 1` there is no coarse depth"
            yield Problem("coarse_depth", reason, "write false, or set scales to 2")
        if config.coarse_depth and context.dims.width in TOKEN_WIDTHS:
            width = context.dims.width
            reason = f"the {width} numbers of a token leave none for a coarse depth"
            yield Problem("coarse_depth", reason, f"set model.width to {width + 1}")
        if config.features % (32 * config.scales):
            reason = f"{config.features} features do not split into heads of 32 in both sweeps"
            yield Problem("features", reason, "write a multiple of 64")
        blocks = config.blocks
        depth = config.vit.depth
        if list(blocks) != sorted(set(blocks)) or blocks[-1] >= depth:
            reason = (
                f"blocks must ascend and stay below the depth of the ViT, {depth}, got {blocks}"
            )
            yield Problem("blocks", reason, "write four block numbers, such as [2, 5, 8, 11]")
        yield from super().problems(config, context)

    @classmethod
    def multiple(cls, config: Config) -> int:
        # The U-Nets halve the features of each sweep.
        return 4 * config.stride

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        # The names of its parts are published.
        self.network: Any = nn.ModuleDict()
        self.network.depth_predictor = DepthPredictor(config)
        self.network.feature_upsampler = dpt_head(config, depth=False)
        features = config.full_features
        hidden = config.regressor
        self.network.gaussian_regressor = two_convolutions(features + 5, hidden, hidden)
        raw = GAUSSIAN_CHANNELS + 3 * coefficients(degree_of(dims.width))
        head = two_convolutions(hidden + features + 4, raw, raw, "replicate")
        self.network.gaussian_head = head
        # Scales and harmonics start at their constant offsets.
        with torch.no_grad():
            for parameter in head[2].parameters():
                parameter[3:6] = 0
                parameter[GAUSSIAN_CHANNELS:] = 0

    def load_pretrained(self) -> None:
        self.network.depth_predictor.pretrained.load(self.config.vit.weights)

    def predict(self, views: Views, near_BV: Tensor, far_BV: Tensor) -> Tensor:
        # Chosen once: both scales and the transformer read the same views.
        neighbours = nearest_neighbours(views.cameras.c2w, self.config.neighbours)
        sweep = Sweep(views.cameras, neighbours, near_BV, far_BV)
        depths, confidence, maps, joined = self.network.depth_predictor(views.images, sweep)
        features_NFHW = self.network.feature_upsampler(maps, joined)
        images_N3HW = views.images.flatten(0, 1)
        # Depth, up to `far`, not its inverse (released code).
        seen = torch.cat([images_N3HW, depths[-1], confidence, features_NFHW], 1)
        hidden = self.network.gaussian_regressor(seen)
        seen = torch.cat([hidden, images_N3HW, features_NFHW, confidence], 1)
        raw_NCHW = at_least_float32(self.network.gaussian_head(seen))
        raw_BVCHW = raw_NCHW.unflatten(0, near_BV.shape)
        # The pixel's colour is added to the constant: an untrained network copies the photo.
        first = GAUSSIAN_CHANNELS
        step = coefficients(degree_of(self.dims.width))
        constant = raw_BVCHW[:, :, first::step] + (views.images - 0.5) / SH_C0
        raw_BVCHW = raw_BVCHW.slice_scatter(constant, 2, first, step=step)
        # Logarithms of depths have about the range of features.
        logs = [depth.log().unflatten(0, near_BV.shape) for depth in depths]
        numbers = torch.cat([logs[-1], raw_BVCHW], 2)
        # It is the last number, where `mvsplat/exchange` expects it.
        coarse = logs[:1] if self.config.coarse_depth else []
        left = self.dims.width - numbers.shape[2] - len(coarse)
        return torch.cat([F.pad(numbers, (0, 0, 0, 0, 0, left)), *coarse], 2)

"""`gslrm/transformer`: encoder with self-attention over the patches of all photos.

`gslrm/pixels` makes a query of each image token, `gslrm/pixel_head` a Gaussian for each pixel of
its patch, and `gslrm/along_rays` puts the Gaussians' means on the rays of the pixels.
"""

from typing import Literal

import torch
import torch.nn.functional as F
from einops import rearrange
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor, nn

from qgs.contracts import (
    Centers,
    ComponentConfig,
    Fields,
    ModelComponent,
    ModelDims,
    PatchEncoder,
    Queries,
    memory_fields,
)
from qgs.contracts.settings import Far
from qgs.geometry.harmonics import SH_C0
from qgs.geometry.rays import patch_rays, plucker_rays
from qgs.geometry.transforms import unit
from qgs.precision import at_least_float32, full_precision
from qgs.tokengs import NORM_EPS, LinearHead
from qgs.types import GaussianAttributes, ImageMemory, QueryState, Views
from qgs_zoo.parts import PIXEL_RAYS, pixel_rays, self_attention

CHANNELS = 9
"""Input channels per pixel: 2 RGB - 1, moment o x d, unit direction d of its ray (paper, 3.1)."""


class Block(nn.Module):
    """Transformer block without biases: pre-norm self-attention, then an MLP with exact GELU."""

    def __init__(self, width: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.heads = heads
        hidden = int(mlp_ratio * width)
        self.norm1 = nn.LayerNorm(width, NORM_EPS, bias=False)
        self.qkv = nn.Linear(width, 3 * width, bias=False)
        self.proj = nn.Linear(width, width, bias=False)
        self.norm2 = nn.LayerNorm(width, NORM_EPS, bias=False)
        self.fc1 = nn.Linear(width, hidden, bias=False)
        self.fc2 = nn.Linear(hidden, width, bias=False)

    def forward(self, x_BMD: Tensor) -> Tensor:
        x_BMD = x_BMD + self.proj(self_attention(self.qkv(self.norm1(x_BMD)), self.heads))
        return x_BMD + self.fc2(F.gelu(self.fc1(self.norm2(x_BMD))))


class Transformer(PatchEncoder):
    """Encoder with self-attention over the patches of all views together (GS-LRM).

    The memory that it returns has features, rays and the grid of patches, but no keys and values,
    because GS-LRM has no decoder.
    """

    name = "transformer"
    writes = memory_fields("features", "patch_rays", "grid")

    class Config(PatchEncoder.Config):
        depth: NonNegativeInt = 24
        """Number of blocks."""
        mlp_ratio: float = Field(default=4.0, ge=1)
        """Hidden width of the MLPs, as a multiple of the model's width (rounded down)."""
        init_std: PositiveFloat = 0.02
        """Standard deviation of the initial weights of linear layers, which are normally
        distributed."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.embedding = nn.Linear(CHANNELS * config.patch_size**2, dims.width, bias=False)
        self.norm = nn.LayerNorm(dims.width, NORM_EPS, bias=False)
        self.blocks = nn.ModuleList(
            Block(dims.width, dims.heads, config.mlp_ratio) for _ in range(config.depth)
        )
        # The paper initialises all linear layers alike, without a factor for the depth.
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.normal_(module.weight, std=config.init_std)

    def forward(self, views: Views) -> ImageMemory:
        """Return features (B, M, D) of the patches, without the last norm, which the head applies.

        Raises ValueError if the patch size does not divide the sides of the images.
        """
        patch = self.config.patch_size
        grid = self.grid(views)
        plucker_BV6HW = plucker_rays(views.cameras)
        pixels_BV9HW = torch.cat([2 * views.images - 1, plucker_BV6HW], 2)
        x_BMC = rearrange(pixels_BV9HW, "b v c (h p) (w q) -> b (v h w) (p q c)", p=patch, q=patch)
        # The rays of each pixel are inputs, so positions need no embedding.
        x_BMD = self.norm(self.embedding(x_BMC))
        for block in self.blocks:
            x_BMD = block(x_BMD)
        return ImageMemory(features=x_BMD, patch_rays=patch_rays(plucker_BV6HW, patch), grid=grid)


PATCH = "gslrm.patch"

PATCH_FIELD: Fields = {PATCH: PIXEL_RAYS}


class PixelQueries(Queries):
    """One query for each image token, with the token's features and the rays of its patch."""

    name = "pixels"
    reads = memory_fields("features", "grid")
    writes = PATCH_FIELD

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        """Return queries: features (B, M, D) of the tokens, and rays `gslrm.patch` (B, M, 4, 3)."""
        assert memory.grid is not None
        _, rows, columns = memory.grid
        fields = {PATCH: pixel_rays(views.cameras, rows, columns)}
        return QueryState(features=memory.features, fields=fields)


@full_precision
def patch_rays_at(patch_BN43: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return origins (B, N, 1, 3) and directions (B, N, K, 3) of K = `count` rays per patch.

    Both are in the world frame; directions have z = 1 in the frame of their camera. The rays of a
    patch go through the centres of a grid of K equal cells, row by row. Cells are as nearly square
    as K allows. If K is the number of pixels of the patch, its cells are the pixels. patch: the
    field `gslrm.patch` of the queries.
    """
    origin_BN13, corner_BN13, across_BN13, down_BN13 = patch_BN43[..., None, :].unbind(-3)
    index_K = torch.arange(count, device=patch_BN43.device)
    # The largest divisor of K up to its root makes the most nearly square cells. It stays a tensor:
    # torch.compile would make a graph for each K that Python divides.
    n_K = index_K + 1
    rows = torch.where((count % n_K == 0) & (n_K * n_K <= count), n_K, 1).amax()
    columns = count // rows
    u_K1 = ((index_K % columns).to(patch_BN43) + 0.5)[:, None] / columns
    v_K1 = ((index_K // columns).to(patch_BN43) + 0.5)[:, None] / rows
    return origin_BN13, corner_BN13 + down_BN13 * v_K1 + across_BN13 * u_K1


class AlongRays(Centers):
    """Gaussian means at o + t d on the rays of pixels, with t = (1 - w) near + w far.

    o is the camera's centre. w is the sigmoid of the mean of the Gaussian's three raw offsets. d is
    a unit vector, or with `measure: depth` a vector with z = 1 in the camera's frame.
    `patch_rays_at` gives the rays of the K Gaussians of a query.
    """

    name = "along_rays"
    reads = PATCH_FIELD

    class Config(ComponentConfig):
        near: NonNegativeFloat = 0.0
        """Least distance of a Gaussian's mean from the camera, in world units. 0 is the camera's
        centre."""
        far: Far = 500.0
        """Largest distance of a Gaussian's mean from the camera, in world units (paper: 500 for
        scenes)."""
        measure: Literal["distance", "depth"] = "distance"
        """Direction in which `near`, `far` and t are measured. `distance`: along the ray (paper).
        `depth`: along the camera's axis (repository gs-lrm-unofficial)."""

    config: Config

    @full_precision
    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """Return world-frame means (B, N, K, 3) for the head's raw offsets (B, N, K, 3)."""
        config = self.config
        origins, directions = patch_rays_at(state[PATCH], offsets.shape[2])
        if config.measure == "distance":
            directions = F.normalize(directions, dim=-1)
        # The sigmoid keeps every Gaussian between near and far, so none is behind its camera.
        w_BNK1 = offsets.mean(-1, keepdim=True).sigmoid()
        return origins + ((1 - w_BNK1) * config.near + w_BNK1 * config.far) * directions


class PixelHead(LinearHead):
    """Head with a LayerNorm and a linear layer to K Gaussians of 12 or 14 channels, without biases.

    The number of channels follows from `position_channels`.
    """

    name = "pixel_head"

    class Config(ComponentConfig):
        gaussians_per_query: PositiveInt = 64
        """K, the number of Gaussians of each token, on an even grid over its patch. The square of
        the encoder's `patch_size` gives one Gaussian per pixel."""
        position_channels: Literal[1, 3] = 3
        """Number of raw offsets that the head predicts for a Gaussian (paper: 1). With 3,
        `gslrm/along_rays` takes their mean. With 1, `model.centers` gets three equal offsets."""
        scale_bias: float = -2.3
        """Number added to the logarithms of scales in world units."""
        scale_limit: float | None = -1.2
        """Largest logarithm of a scale in world units. Null means no limit."""
        opacity_bias: float = -2.0
        """Number added to the logits of opacities."""
        init_std: PositiveFloat = 0.02
        """Standard deviation of the initial weights, which are normally distributed."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.channels = (config.position_channels, 3, 3, 4, 1)
        self.norm = nn.LayerNorm(dims.width, NORM_EPS, bias=False)
        outputs = config.gaussians_per_query * sum(self.channels)
        self.linear = nn.Linear(dims.width, outputs, bias=False)
        nn.init.normal_(self.linear.weight, std=config.init_std)

    # Weight decay only for the linear layer (paper), as components that are no heads have it.
    decays = ModelComponent.decays

    def activate(self, raw_BNKC: Tensor) -> GaussianAttributes:
        raw = at_least_float32(raw_BNKC)
        position, rgb, scale, rotation, opacity = raw.split(self.channels, -1)
        scale = scale + self.config.scale_bias
        if self.config.scale_limit is not None:
            # Without a limit one Gaussian can cover an image and stop the others from learning.
            scale = scale.clamp_max(self.config.scale_limit)
        return GaussianAttributes(
            offsets=position.expand(*position.shape[:-1], 3),
            scales=scale.exp(),
            quats=unit(rotation),
            opacities=torch.sigmoid(opacity[..., 0] + self.config.opacity_bias),
            colors=(0.5 + SH_C0 * rgb).clamp(0, 1),
        )

"""ViT encoders over the patches of all views, such as `qgs/multiview_vit` (TokenGS release)."""

from abc import abstractmethod
from collections.abc import Mapping

from einops import rearrange, repeat
from pydantic import Field, PositiveFloat
from torch import Tensor, nn

from qgs.contracts import ModelDims, PatchEncoder
from qgs.geometry.constants import constant
from qgs.geometry.rays import patch_rays, plucker_rays
from qgs.tokengs.blocks import LayerScale, Mlp, NormConfig, SelfAttentionCore, split_heads
from qgs.types import ImageMemory, Views

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class PatchEmbedding(nn.Module):
    """Patch embedding (X, C, H, W) -> (X, H/P*W/P, D): P x P convolution of stride P, LayerNorm.

    X = B*V counts the views of all scenes. P is the patch size.
    """

    def __init__(self, channels: int, width: int, patch_size: int, norm_eps: float) -> None:
        super().__init__()
        self.proj = nn.Conv2d(channels, width, kernel_size=patch_size, stride=patch_size)
        self.norm = nn.LayerNorm(width, norm_eps)

    def forward(self, images: Tensor) -> Tensor:  # (X, C, H, W)
        return self.norm(rearrange(self.proj(images), "x d h w -> x (h w) d"))


class EncoderBlock(nn.Module):
    """Pre-norm ViT block with QK-LayerNorm and LayerScale."""

    def __init__(
        self, width: int, heads: int, mlp_ratio: float, layer_scale: float, norm_eps: float
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, norm_eps)
        self.attention = SelfAttentionCore(width, heads, norm_eps)
        self.scale1 = LayerScale(width, layer_scale)
        self.norm2 = nn.LayerNorm(width, norm_eps)
        self.mlp = Mlp(width, int(mlp_ratio * width), width)
        self.scale2 = LayerScale(width, layer_scale)

    def forward(self, x_BMD: Tensor) -> Tensor:
        x_BMD = x_BMD + self.scale1(self.attention(self.norm1(x_BMD)))
        return x_BMD + self.scale2(self.mlp(self.norm2(x_BMD)))


class PatchViT(PatchEncoder):
    """Base class of ViTs over the patches of all views.

    A token is the sum of an RGB and a Plücker embedding. Subclasses run the blocks, and make the
    layers that project the resulting features to keys and values.
    """

    kv_proj: nn.Linear
    k_norm: nn.LayerNorm

    class Config(NormConfig, PatchEncoder.Config):
        depth: int = Field(default=3, ge=0, le=256)
        """Number of ViT blocks. With 0, the tokens are the patch embeddings."""
        mlp_ratio: float = Field(default=4.0, ge=1)
        """Hidden width of the MLPs as a multiple of the model's width, rounded down."""
        layer_scale: PositiveFloat = 0.01
        """Initial value of all LayerScale factors in the encoder."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        patch = config.patch_size
        eps = config.norm_eps
        # Each with its own norm: colours and rays have different scales.
        self.rgb_embedding = PatchEmbedding(3, dims.width, patch, eps)
        self.ray_embedding = PatchEmbedding(6, dims.width, patch, eps)
        self.blocks = nn.ModuleList(
            EncoderBlock(dims.width, dims.heads, config.mlp_ratio, config.layer_scale, eps)
            for _ in range(config.depth)
        )

    def adapted(self, learned: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the weights `learned`, enlarged from smaller patches to those of this component.

        If the side of a patch grows by a whole factor f, the enlarged weights give the token that
        `learned` gives for the patch after averaging blocks of f x f pixels. Otherwise the weights
        are returned unchanged.
        """
        # Its shapes give the size of our patches.
        own = self.state_dict()
        return {
            name: _larger(kernel, own[name].shape[-1]) if name.endswith(_KERNEL) else kernel
            for name, kernel in learned.items()
        }

    def embed(self, views: Views, plucker: Tensor) -> Tensor:
        """Embed views (B, V) and their Plücker maps (B, V, 6, H, W) as tokens (B, M, D)."""
        x_XPD = self.rgb_embedding(imagenet_normalised(views.images).flatten(0, 1))
        x_XPD = x_XPD + self.ray_embedding(plucker.flatten(0, 1))
        return rearrange(x_XPD, "(b v) p d -> b (v p) d", b=len(views.images))

    @abstractmethod
    def features(self, views: Views, plucker: Tensor) -> Tensor:
        """Run the blocks on views (B, V) and their Plücker maps; return features (B, M, C)."""

    def forward(self, views: Views) -> ImageMemory:
        grid = self.grid(views)
        plucker_BV6HW = plucker_rays(views.cameras)
        x_BMC = self.features(views, plucker_BV6HW)
        # Here and not in the decoder, whose layers all read the same keys and values.
        keys, values = keys_and_values(x_BMC, self.kv_proj, self.k_norm)
        rays = patch_rays(plucker_BV6HW, self.config.patch_size)
        return ImageMemory(features=x_BMC, keys=keys, values=values, patch_rays=rays, grid=grid)


class MultiViewViT(PatchViT):
    """ViT over the patches of all views, with one projection to keys and values at the end.

    A token is the sum of an RGB and a Plücker embedding.
    """

    name = "multiview_vit"

    def __init__(self, config: PatchViT.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.norm = nn.LayerNorm(dims.width, config.norm_eps)
        self.kv_proj = nn.Linear(dims.width, 2 * dims.width)
        self.k_norm = nn.LayerNorm(dims.width // dims.heads, config.norm_eps)

    def features(self, views: Views, plucker: Tensor) -> Tensor:
        x_BMD = self.embed(views, plucker)
        for block in self.blocks:
            x_BMD = block(x_BMD)
        return self.norm(x_BMD)


def keys_and_values(
    features: Tensor, kv_proj: nn.Linear, k_norm: nn.LayerNorm
) -> tuple[Tensor, Tensor]:
    """Project features of image tokens to keys, normalised per head, and values (B, h, M, d)."""
    heads = kv_proj.out_features // 2 // k_norm.normalized_shape[0]
    k_BMD, v_BMD = kv_proj(features).chunk(2, -1)
    v_BhMd = split_heads(v_BMD, heads)
    return k_norm(split_heads(k_BMD, heads)).to(v_BhMd.dtype), v_BhMd


_KERNEL = "_embedding.proj.weight"
"""End of the parameter name of a patch embedding's kernel."""


def _larger(kernel: Tensor, side: int) -> Tensor:
    """Enlarge the kernel (D, C, p, p) of a convolution to a width and height of `side`.

    If p does not divide `side`, the kernel is returned unchanged.
    """
    if kernel.ndim != 4 or not kernel.numel() or side % kernel.shape[-1]:
        return kernel
    factor = side // kernel.shape[-1]
    # Divided, so that the sum over more pixels equals the mean over small patches.
    return repeat(kernel / factor**2, "d c h w -> d c (h fh) (w fw)", fh=factor, fw=factor)


def imagenet_normalised(images: Tensor) -> Tensor:
    """Normalise images (..., 3, H, W) in [0, 1] by the mean and std of ImageNet."""
    # ImageNet's statistics, as in the release: for other photos they centre well enough.
    mean, std = (constant(x, images)[:, None, None] for x in (IMAGENET_MEAN, IMAGENET_STD))
    return (images - mean) / std

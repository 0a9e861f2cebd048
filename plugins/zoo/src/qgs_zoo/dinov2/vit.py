"""DINOv2's vision transformer (Oquab et al., arXiv 2304.07193), with the published parameter names.

It covers ViT-S, B and L with patches of 14 x 14 pixels and MLPs with GELU, but no register tokens
and no mask token. It is new code that follows facebookresearch/dinov2 (Apache-2.0). The encoder
`dinov2/multiview_vit` adds DINOv2's tokens to embedded rays, and runs transformer blocks over the
tokens of all views.
"""

from collections.abc import Collection

import torch
import torch.nn.functional as F
from einops import rearrange
from pydantic import PositiveInt
from torch import Tensor, nn

from qgs.contracts import ComponentConfig, ModelDims
from qgs.contracts.settings import Heads
from qgs.tokengs import NORM_EPS, LayerScale, Mlp, MultiViewViT
from qgs_zoo.parts import self_attention, weight_file

PATCH = 14
"""Side of a patch, pixels."""
GRID = 37
"""Number of patches along a side of the 518 x 518 images that trained the position embeddings."""
EPS = 1e-6
"""Number that every LayerNorm adds to the variance."""
SHIFT = 0.1
"""Number added to the rows and to the columns of patches when position embeddings are resized, as
in DINOv2."""


class VitConfig(ComponentConfig):
    """Sizes of the transformer, by default those of ViT-S, and its file of weights."""

    width: PositiveInt = 384
    """Width of tokens: 384 for ViT-S, 768 for ViT-B, 1024 for ViT-L."""
    depth: PositiveInt = 12
    """Number of blocks: 12 for ViT-S and ViT-B, 24 for ViT-L."""
    heads: Heads = 6
    """Number of attention heads: 6 for ViT-S, 12 for ViT-B, 16 for ViT-L, of 64 channels each."""
    weights: str | None = None
    """File of pretrained weights: .safetensors, .pth or .pt. Null starts with random weights."""


class Block(nn.Module):
    """Transformer block on (X, T, C): pre-norm attention and MLP, each with LayerScale.

    X: number of images. T: tokens. C: channels. One linear layer computes queries, keys and values.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(width, EPS)
        qkv = nn.Linear(width, 3 * width)
        self.attn = nn.ModuleDict({"qkv": qkv, "proj": nn.Linear(width, width)})
        self.ls1 = LayerScale(width, 1.0)
        self.norm2 = nn.LayerNorm(width, EPS)
        self.mlp = Mlp(width, 4 * width, width)
        self.ls2 = LayerScale(width, 1.0)

    def forward(self, x_XTC: Tensor) -> Tensor:
        read_XTC = self_attention(self.attn["qkv"](self.norm1(x_XTC)), self.heads)
        x_XTC = x_XTC + self.ls1(self.attn["proj"](read_XTC))
        return x_XTC + self.ls2(self.mlp(self.norm2(x_XTC)))


class DinoV2(nn.Module):
    """Transformer from X images (X, 3, 14 h, 14 w) to tokens of their h x w patches, (X, h w, C).

    Images must be normalised by ImageNet's mean and standard deviation. Each image is processed
    alone.
    """

    def __init__(self, width: int, depth: int, heads: int) -> None:
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + GRID**2, width))
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, width, PATCH, PATCH)})
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(width, EPS)
        nn.init.normal_(self.cls_token, std=1e-6)
        nn.init.trunc_normal_(self.pos_embed, std=0.02)
        # The initial weights of the release; a checkpoint or weight file replaces all of them.
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)

    def forward(self, images: Tensor, blocks: Collection[int]) -> list[Tensor]:
        """Return the tokens (X, h w, C) after each of the `blocks`, as a list of tensors.

        blocks: indices of blocks, from 0. The LayerNorm that follows the last block is applied to
        the tokens of every block (DINOv2 release). Blocks after the largest index are not run.
        """
        grid = images.shape[-2] // PATCH, images.shape[-1] // PATCH
        x_XPC = self.patch_embed["proj"](images).flatten(2).mT
        x_XTC = torch.cat([self.cls_token.expand(len(images), -1, -1), x_XPC], 1)
        x_XTC = x_XTC + self.positions(*grid)
        found = []
        for index, block in enumerate(self.blocks[: max(blocks) + 1]):
            x_XTC = block(x_XTC)
            if index in blocks:
                # Without the class token.
                found.append(self.norm(x_XTC)[:, 1:])
        return found

    def positions(self, rows: int, columns: int) -> Tensor:
        """Return position embeddings (1, 1 + rows * columns, C) of class token, then patches."""
        if rows == columns == GRID:
            return self.pos_embed
        # The class token has its own embedding, which is not a place.
        own_1PC = self.pos_embed[:, 1:]
        map_1CGG = rearrange(own_1PC.float(), "x (g k) c -> x c g k", g=GRID)
        # The release passes the factor, not the size: source coordinates step by 37 / (n + 0.1).
        # Pretrained weights expect this small error.
        factor = ((rows + SHIFT) / GRID, (columns + SHIFT) / GRID)
        resized_1Chw = F.interpolate(map_1CGG, scale_factor=factor, mode="bicubic")
        resized_1PC = resized_1Chw.flatten(2).mT.to(own_1PC.dtype)
        return torch.cat([self.pos_embed[:, :1], resized_1PC], 1)

    def load(self, file: str | None) -> None:
        """Read pretrained weights from a file. None keeps the present weights.

        The names of the tensors must be those of DINOv2's files, possibly after a prefix, such as
        `pretrained.` in files of Depth Anything V2. All other tensors in the file are ignored.
        Raises MissingExtraError for a file that does not fit.
        """
        if file is None:
            return
        remedy = (
            "download weights of DINOv2, such as dinov2_vits14_pretrain.pth, and set `weights` to "
            "the file and `width`, `depth` and `heads` to its sizes"
        )
        with weight_file(file, remedy) as weights:
            mark = "patch_embed.proj.weight"
            prefix = next((n.removesuffix(mark) for n in weights if n.endswith(mark)), None)
            if prefix is None:
                raise ValueError(f"no weights of DINOv2: the file has no tensor {mark}")
            # A mask token and registers in the file are ignored.
            own = self.state_dict()
            self.load_state_dict({n: weights[prefix + n] for n in own if prefix + n in weights})


class Tokens(nn.Module):
    """DINOv2, linear layer and LayerNorm, from images (X, 3, H, W) to tokens (X, H/P * W/P, D).

    X: number of images. P: side of a patch in pixels. D: width of tokens.
    """

    def __init__(self, config: VitConfig, width: int, patch_size: int) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.last = config.depth - 1
        self.vit = DinoV2(config.width, config.depth, config.heads)
        self.proj = nn.Linear(config.width, width)
        self.norm = nn.LayerNorm(width, NORM_EPS)

    def forward(self, images_X3HW: Tensor) -> Tensor:
        # Each patch of the model becomes 14 x 14 pixels, so that both have the same grid of tokens.
        size = [side // self.patch_size * PATCH for side in images_X3HW.shape[-2:]]
        if list(images_X3HW.shape[-2:]) != size:
            images_X3HW = F.interpolate(images_X3HW, size, mode="bilinear", antialias=True)
        return self.norm(self.proj(self.vit(images_X3HW, (self.last,))[0]))


class DinoMultiViewViT(MultiViewViT):
    """Encoder `qgs/multiview_vit` with DINOv2 as the embedding of colours.

    DINOv2 processes each photo alone, resized so that each patch has 14 x 14 pixels. For example,
    photos of 256 x 256 with patches of 16 x 16 are resized to 224 x 224.
    """

    name = "multiview_vit"

    class Config(MultiViewViT.Config):
        patch_size: PositiveInt = 16
        """Side of a patch, in pixels of the photos before resizing. It must divide both sides of
        the image."""
        vit: VitConfig
        """Sizes and weights of DINOv2. `{}` is a ViT-S with random initial weights."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.rgb_embedding = Tokens(config.vit, dims.width, config.patch_size)

    def load_pretrained(self) -> None:
        self.rgb_embedding.vit.load(self.config.vit.weights)

"""The multi-view transformer of GMFlow and UniMatch: attention in 2 x 2 windows of all views."""

import math

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

LAYERS = 6
SPLIT = 2
"""Windows along each side of the map, whatever its size."""
EXPANSION = 4
TEMPERATURE = 10_000.0
MASKED = -100.0
"""Added to logits between parts of a shifted window that are no neighbours (Swin)."""


def positions(width: int, rows: int, columns: int, device: torch.device) -> Tensor:
    """Sine embedding (D, rows, columns) of the places in one window (DETR), y before x."""
    half = width // 2
    index_C = torch.arange(half, device=device)
    frequency_C = TEMPERATURE ** (-2 * (index_C // 2) / half)

    def embedded(count: int) -> Tensor:
        # Places count from 1, and the small number keeps them just below 2 pi (DETR).
        places = torch.arange(1, count + 1, device=device) / (count + 1e-6) * 2 * math.pi
        angle_NC = places[:, None] * frequency_C
        return torch.where(index_C % 2 == 0, angle_NC.sin(), angle_NC.cos())

    y = embedded(rows)[:, None].expand(rows, columns, half)
    x = embedded(columns)[None].expand(rows, columns, half)
    return torch.cat([y, x], -1).permute(2, 0, 1)


def with_positions(x_BVCHW: Tensor) -> Tensor:
    """Features plus `positions`, which count inside each of the windows."""
    width, height, columns = x_BVCHW.shape[2:]
    # Positions repeat in each window: attention sees no more than one.
    window = positions(width, height // SPLIT, columns // SPLIT, x_BVCHW.device).to(x_BVCHW)
    return x_BVCHW + window.repeat(1, SPLIT, SPLIT)


def shift_mask(height: int, width: int, device: torch.device) -> Tensor:
    """(4, L, L), added to the logits of windows of a map that was rolled by half a window.

    MASKED between pixels that the roll brought together, 0 between neighbours.
    """

    def pieces(size: int) -> Tensor:
        window = size // SPLIT
        index = torch.arange(size, device=device)
        return (index >= size - window).long() + (index >= size - window // 2).long()

    piece_HW = 3 * pieces(height)[:, None] + pieces(width)
    # Pixels of a window that come from different edges must not see each other.
    piece_WL = rearrange(piece_HW, "(a h) (b w) -> (a b) (h w)", a=SPLIT, b=SPLIT)
    return torch.where(piece_WL[:, :, None] == piece_WL[:, None], 0.0, MASKED)


def in_windows(x_BVHWC: Tensor, shift: tuple[int, int]) -> Tensor:
    """(B, V, H, W, C) rolled by minus `shift`, cut into windows: (B, V, 4, L, C)."""
    if any(shift):
        x_BVHWC = x_BVHWC.roll((-shift[0], -shift[1]), (2, 3))
    return rearrange(x_BVHWC, "n v (a h) (b w) c -> n v (a b) (h w) c", a=SPLIT, b=SPLIT)


def out_of_windows(x_BVWLC: Tensor, size: tuple[int, int], shift: tuple[int, int]) -> Tensor:
    """The inverse of `in_windows`, of a map of `size`."""
    pattern = "n v (a b) (h w) c -> n v (a h) (b w) c"
    x_BVHWC = rearrange(x_BVWLC, pattern, a=SPLIT, b=SPLIT, h=size[0] // SPLIT)
    return x_BVHWC.roll(shift, (2, 3)) if any(shift) else x_BVHWC


class Attention(nn.Module):
    """x + LN(merge(attention)), one head without biases; with `mlp` x + LN(MLP([x, that])).

    No norm in front. `mlp` is x -> W2 gelu(W1 x), widths 2 D, 8 D, D, without biases.
    """

    def __init__(self, width: int, mlp: bool) -> None:
        super().__init__()
        self.q_proj, self.k_proj, self.v_proj, self.merge = (
            nn.Linear(width, width, bias=False) for _ in range(4)
        )
        self.norm1 = nn.LayerNorm(width)
        if mlp:
            hidden = 2 * EXPANSION * width
            linear1 = nn.Linear(2 * width, hidden, bias=False)
            self.mlp = nn.Sequential(linear1, nn.GELU(), nn.Linear(hidden, width, bias=False))
            self.norm2 = nn.LayerNorm(width)
        else:
            self.mlp = None
        for parameter in self.parameters():
            if parameter.ndim > 1:
                nn.init.xavier_uniform_(parameter)

    def forward(
        self,
        x_BVWLC: Tensor,
        source_BVWLC: Tensor,
        neighbours_BVJ: Tensor | None,
        mask: Tensor | None,
    ) -> Tensor:
        """x (B, V, 4, L, C), each view reading `source` of itself or of its neighbours."""
        q = self.q_proj(x_BVWLC)
        k = self.k_proj(source_BVWLC)
        v = self.v_proj(source_BVWLC)
        if neighbours_BVJ is not None:
            k, v = (_of_neighbours(x, neighbours_BVJ) for x in (k, v))
            # Published weights expect this: keys are ordered by pixels, then views, but the mask is
            # repeated view by view, so that with three and more views it falls on other keys.
            mask = None if mask is None else mask.repeat(1, 1, neighbours_BVJ.shape[-1])
        # In four axes, the windows as heads: with five, torch takes a slower way.
        q, k, v = (x.flatten(0, 1) for x in (q, k, v))
        mask = None if mask is None else mask[None].to(q)
        read = F.scaled_dot_product_attention(q, k, v, mask)
        message = self.norm1(self.merge(read.view_as(x_BVWLC)))
        if self.mlp is not None:
            message = self.norm2(self.mlp(torch.cat([x_BVWLC, message], -1)))
        return x_BVWLC + message


def _of_neighbours(x_BVWLC: Tensor, neighbours_BVJ: Tensor) -> Tensor:
    """Windows of the neighbours of each view, the view changing fastest: (B, V, 4, L J, C)."""
    scenes = torch.arange(len(x_BVWLC), device=x_BVWLC.device)[:, None, None]
    return rearrange(x_BVWLC[scenes, neighbours_BVJ], "n v j w l c -> n v w (l j) c")


class Layer(nn.Module):
    """Self-attention without an MLP, then cross-attention to other views with one."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.self_attn = Attention(width, mlp=False)
        self.cross_attn_ffn = Attention(width, mlp=True)

    def forward(self, x_BVWLC: Tensor, neighbours_BVJ: Tensor, mask: Tensor | None) -> Tensor:
        own = self.self_attn(x_BVWLC, x_BVWLC, None, mask)
        # Keys are the other views as they came into the layer; only the query has read itself.
        return self.cross_attn_ffn(own, x_BVWLC, neighbours_BVJ, mask)


class WindowTransformer(nn.Module):
    """Six layers over the maps of all views; in every second one windows are shifted by half."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Layer(width) for _ in range(LAYERS))

    def forward(self, x_BVCHW: Tensor, neighbours_BVJ: Tensor) -> Tensor:
        """Maps (B, V, C, H, W), with positions; `neighbours_BVJ` are the views that each reads."""
        size = (x_BVCHW.shape[-2], x_BVCHW.shape[-1])
        shifted = (size[0] // SPLIT // 2, size[1] // SPLIT // 2)
        mask = shift_mask(*size, x_BVCHW.device)
        x_BVHWC = x_BVCHW.permute(0, 1, 3, 4, 2)
        for index, layer in enumerate(self.layers):
            shift = shifted if index % 2 else (0, 0)
            x_BVWLC = in_windows(x_BVHWC, shift)
            x_BVWLC = layer(x_BVWLC, neighbours_BVJ, mask if index % 2 else None)
            x_BVHWC = out_of_windows(x_BVWLC, size, shift)
        return x_BVHWC.permute(0, 1, 4, 2, 3)

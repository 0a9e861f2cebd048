"""Multi-view transformer with attention in windows (GMFlow, UniMatch).

The feature map of each view is divided into 2 x 2 windows.
"""

import math

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from qgs_zoo.mvsplat.sweep import at_neighbours

LAYERS = 6
SPLIT = 2
"""Number of windows along each side of a map. Windows grow with the map."""
EXPANSION = 4
TEMPERATURE = 10_000.0
MASKED = -100.0
"""Number added to attention logits between pixels from opposite edges of a rolled map (Swin)."""


def positions(width: int, rows: int, columns: int, device: torch.device) -> Tensor:
    """Return DETR's sine embedding (D, rows, columns) of positions in a window.

    The first half of the channels embeds y, the second half x.
    """
    half = width // 2
    index_C = torch.arange(half, device=device)
    frequency_C = TEMPERATURE ** (-2 * (index_C // 2) / half)

    def embedded(count: int) -> Tensor:
        # Places count from 1. The small number keeps angles just below 2 pi (DETR).
        places = torch.arange(1, count + 1, device=device) / (count + 1e-6) * 2 * math.pi
        angle_NC = places[:, None] * frequency_C
        return torch.where(index_C % 2 == 0, angle_NC.sin(), angle_NC.cos())

    both = torch.broadcast_tensors(embedded(rows)[:, None], embedded(columns))
    return torch.cat(both, -1).permute(2, 0, 1)


def with_positions(x_BVCHW: Tensor) -> Tensor:
    """Add to the features of each pixel an embedding of the pixel's position in its window."""
    width, height, columns = x_BVCHW.shape[2:]
    # Positions repeat in each window, because attention sees one window at a time.
    window = positions(width, height // SPLIT, columns // SPLIT, x_BVCHW.device).to(x_BVCHW)
    return x_BVCHW + window.repeat(1, SPLIT, SPLIT)


def shift_mask(height: int, width: int, device: torch.device) -> Tensor:
    """Return the numbers (4, L, L) to add to attention logits for a map rolled by half a window.

    A window of a rolled map may contain pixels from opposite edges of the map. Two pixels from
    opposite edges get the number MASKED, and all other pairs of pixels 0. L is the number of pixels
    in each of the four windows.
    """

    def pieces(size: int) -> Tensor:
        window = size // SPLIT
        index = torch.arange(size, device=device)
        return (index >= size - window).long() + (index >= size - window // 2).long()

    piece_HW = 3 * pieces(height)[:, None] + pieces(width)
    # Pixels of a window that come from different edges must not see each other.
    piece_WL = rearrange(piece_HW, "(a h) (b w) -> (a b) (h w)", a=SPLIT, b=SPLIT)
    return torch.where(piece_WL[:, :, None] == piece_WL[:, None], 0.0, MASKED)


def in_windows(x_BVCHW: Tensor, shift: tuple[int, int]) -> Tensor:
    """Roll maps (B, V, C, H, W) by minus `shift` (rows, columns), and cut them into 2 x 2 windows.

    Returns (B, V, 4, L, C), with L the number of pixels in a window.
    """
    if any(shift):
        x_BVCHW = x_BVCHW.roll((-shift[0], -shift[1]), (3, 4))
    return rearrange(x_BVCHW, "n v c (a h) (b w) -> n v (a b) (h w) c", a=SPLIT, b=SPLIT)


def out_of_windows(x_BVWLC: Tensor, size: tuple[int, int], shift: tuple[int, int]) -> Tensor:
    """Invert `in_windows`: join windows to maps (B, V, C, H, W) of `size` (H, W)."""
    pattern = "n v (a b) (h w) c -> n v c (a h) (b w)"
    x_BVCHW = rearrange(x_BVWLC, pattern, a=SPLIT, b=SPLIT, h=size[0] // SPLIT)
    return x_BVCHW.roll(shift, (3, 4)) if any(shift) else x_BVCHW


class Attention(nn.Module):
    """Attention with one head and no biases: x + message, with message = LN(merge(attention)).

    LN is a LayerNorm and merge a linear layer. With `mlp`, the result is x + LN(MLP([x, message])),
    with an MLP of widths 2 D, 8 D and D, GELU and no biases. There is no norm before attention.
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
        """Return `x` after attention to `source`; both have 4 windows of L pixels, (B, V, 4, L, C).

        neighbours: indices (B, V, J) of the J views whose windows each view reads. None makes each
        view read its own windows. mask: numbers (4, L, L) to add to attention logits; None adds
        nothing.
        """
        q = self.q_proj(x_BVWLC)
        k = self.k_proj(source_BVWLC)
        v = self.v_proj(source_BVWLC)
        if neighbours_BVJ is not None:
            # Pixels are ordered by position in the window, then by neighbour.
            order = "n v j w l c -> n v w (l j) c"
            k, v = (rearrange(at_neighbours(x, neighbours_BVJ), order) for x in (k, v))
            # Published weights expect this order. Keys are ordered by pixels, then views, but the
            # mask is repeated view by view: with three or more views it applies to other keys.
            mask = None if mask is None else mask.repeat(1, 1, neighbours_BVJ.shape[-1])
        # Four axes, with windows as heads: with five, torch uses a slower kernel.
        q, k, v = (x.flatten(0, 1) for x in (q, k, v))
        mask = None if mask is None else mask[None].to(q)
        read = F.scaled_dot_product_attention(q, k, v, mask)
        message = self.norm1(self.merge(read.view_as(x_BVWLC)))
        if self.mlp is not None:
            message = self.norm2(self.mlp(torch.cat([x_BVWLC, message], -1)))
        return x_BVWLC + message


class Layer(nn.Module):
    """Transformer layer: self-attention, then cross-attention to neighbour views, then an MLP."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.self_attn = Attention(width, mlp=False)
        self.cross_attn_ffn = Attention(width, mlp=True)

    def forward(self, x_BVWLC: Tensor, neighbours_BVJ: Tensor, mask: Tensor | None) -> Tensor:
        own = self.self_attn(x_BVWLC, x_BVWLC, None, mask)
        # Keys are the other views before this layer; only the query has read itself.
        return self.cross_attn_ffn(own, x_BVWLC, neighbours_BVJ, mask)


class WindowTransformer(nn.Module):
    """Transformer of six layers over the maps of all views.

    Every second layer shifts its windows by half a window.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Layer(width) for _ in range(LAYERS))

    def forward(self, x_BVCHW: Tensor, neighbours_BVJ: Tensor) -> Tensor:
        """Return updated maps (B, V, C, H, W).

        x: maps to which embeddings of positions were added. neighbours: indices (B, V, J) of the J
        views that each view reads.
        """
        size = (x_BVCHW.shape[-2], x_BVCHW.shape[-1])
        shifted = (size[0] // SPLIT // 2, size[1] // SPLIT // 2)
        mask = shift_mask(*size, x_BVCHW.device)
        for index, layer in enumerate(self.layers):
            shift = shifted if index % 2 else (0, 0)
            x_BVWLC = in_windows(x_BVCHW, shift)
            x_BVWLC = layer(x_BVWLC, neighbours_BVJ, mask if index % 2 else None)
            x_BVCHW = out_of_windows(x_BVWLC, size, shift)
        return x_BVCHW

"""Building blocks that several components share; plugins may import them.

Axes: B scenes, T tokens, N queries, M image tokens, Q chosen queries, D width, h heads, d = D/h.
"""

import torch
import torch.nn.functional as F
from einops import rearrange
from pydantic import PositiveFloat
from torch import Tensor, nn

from qgs.contracts import AttentionWeights, ComponentConfig

NORM_EPS = 1e-5
"""Epsilon of every LayerNorm in the TokenGS and LocusGS releases (PyTorch's default)."""


class NormConfig(ComponentConfig):
    """Options of a component with LayerNorms."""

    norm_eps: PositiveFloat = NORM_EPS
    """Number that every LayerNorm adds to the variance."""


class LayerScale(nn.Module):
    """Learned factor per channel of a residual update, (..., D) -> (..., D); starts at `init`."""

    def __init__(self, width: int, init: float) -> None:
        super().__init__()
        # Deep decoders only train if updates start small and grow.
        self.gamma = nn.Parameter(torch.full((width,), init))

    def forward(self, update: Tensor) -> Tensor:  # (..., D)
        return update * self.gamma


class Mlp(nn.Module):
    """MLP of linear, GELU, linear: (..., inputs) -> (..., outputs)."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(inputs, hidden)
        self.fc2 = nn.Linear(hidden, outputs)

    def forward(self, x: Tensor) -> Tensor:  # (..., inputs)
        return self.fc2(F.gelu(self.fc1(x)))


def split_heads(x_BTD: Tensor, heads: int) -> Tensor:
    """Split channels into attention heads: (B, T, D) -> (B, h, T, d)."""
    return rearrange(x_BTD, "b t (h d) -> b h t d", h=heads)


def merge_heads(x_BhTd: Tensor) -> Tensor:
    """Merge attention heads into channels: (B, h, T, d) -> (B, T, D)."""
    return rearrange(x_BhTd, "b h t d -> b t (h d)")


def attention_weights(q_BhQd: Tensor, k_BhTd: Tensor, bias_BhQT: Tensor | None) -> AttentionWeights:
    """Compute scaled dot-product attention weights in float32.

    bias: added to the logits; (B, 1, Q, T) is the same for all heads, (B, h, Q, T) differs by head.
    """
    # So that logits keep their spread for any width of a head.
    scale = q_BhQd.shape[-1] ** -0.5
    content_BhQT = torch.einsum("bhqd,bhtd->bhqt", q_BhQd.float(), k_BhTd.float()) * scale
    logits_BhQT = content_BhQT if bias_BhQT is None else content_BhQT + bias_BhQT
    weights_BhQT = logits_BhQT.softmax(-1)
    return AttentionWeights(content=content_BhQT, geometry=bias_BhQT, weights=weights_BhQT)


class SelfAttentionCore(nn.Module):
    """Multi-head self-attention with fused qkv and per-head LayerNorm on queries and keys."""

    # It adds the same number to all logits of a query, so it has no effect; TokenGS has it.
    unlearned = ("k_norm.bias",)

    def __init__(self, width: int, heads: int, norm_eps: float = NORM_EPS) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.q_norm = nn.LayerNorm(width // heads, norm_eps)
        self.k_norm = nn.LayerNorm(width // heads, norm_eps)
        self.proj = nn.Linear(width, width)

    def project(self, x_BTD: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return queries, keys and values (B, h, T, d); queries and keys are normalised."""
        q_BhTd, k_BhTd, v_BhTd = (
            split_heads(part_BTD, self.heads) for part_BTD in self.qkv(x_BTD).chunk(3, -1)
        )
        # LayerNorm gives float32 under autocast, and attention wants all three in one type.
        return self.q_norm(q_BhTd).to(v_BhTd.dtype), self.k_norm(k_BhTd).to(v_BhTd.dtype), v_BhTd

    def forward(self, x_BTD: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the attention output (B, T, D).

        mask: bool, where False hides a token. (B, T) hides it from all tokens; in (B, T, T), row i
            says which tokens token i reads.
        """
        q_BhTd, k_BhTd, v_BhTd = self.project(x_BTD)
        if mask is not None:
            mask = _by_head(mask)
        read_BhTd = F.scaled_dot_product_attention(q_BhTd, k_BhTd, v_BhTd, attn_mask=mask)
        return self.proj(merge_heads(read_BhTd))

    def explain(
        self, x_BTD: Tensor, queries: Tensor, mask: Tensor | None = None
    ) -> AttentionWeights:
        """Return the attention weights of the tokens with indices `queries` (Q,).

        mask: bool (B, T) or (B, T, T), where False hides a token, as in `forward`.
        """
        q_BhTd, k_BhTd, _ = self.project(x_BTD)
        bias_B1QT = None
        if mask is not None:
            # As a bias, because pictures show the bias on the logits.
            each = _by_head(mask).expand(-1, -1, x_BTD.shape[1], -1)
            bias_B1QT = torch.where(each[:, :, queries], 0.0, -torch.inf)
        return attention_weights(q_BhTd[:, :, queries], k_BhTd, bias_B1QT)


class CrossAttentionCore(nn.Module):
    """Multi-head attention to given keys and values, with a bias on the logits.

    It applies LayerNorm to the features, projects them to queries, and normalises the queries of
    each head. It uses keys and values as given, and projects the result.
    """

    def __init__(self, width: int, heads: int, norm_eps: float = NORM_EPS) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width, norm_eps)
        self.q_proj = nn.Linear(width, width)
        self.q_norm = nn.LayerNorm(width // heads, norm_eps)
        self.out_proj = nn.Linear(width, width)

    def project(self, x_BND: Tensor) -> Tensor:
        """Project features (B, N, D) to normalised queries (B, h, N, d)."""
        return self.q_norm(split_heads(self.q_proj(self.norm(x_BND)), self.heads))

    def forward(
        self, x_BND: Tensor, k_BhMd: Tensor, v_BhMd: Tensor, bias: Tensor | None = None
    ) -> Tensor:
        """Return the attention output (B, N, D).

        bias: added to the logits; (B, N, M) is the same for all heads, (B, h, N, M) differs by
            head. B and N may be 1. -inf hides a token.
        """
        # Keys are normalised by their encoder, in float32 under autocast, as these queries are.
        q_BhNd = self.project(x_BND).to(v_BhMd.dtype)
        k_BhMd = k_BhMd.to(v_BhMd.dtype)
        bias_BhNM = None if bias is None else _by_head(bias).to(v_BhMd.dtype)
        read_BhNd = F.scaled_dot_product_attention(q_BhNd, k_BhMd, v_BhMd, attn_mask=bias_BhNM)
        return self.out_proj(merge_heads(read_BhNd))

    def explain(
        self, x_BND: Tensor, k_BhMd: Tensor, queries: Tensor, bias: Tensor | None = None
    ) -> AttentionWeights:
        """Return the attention weights of the queries with indices `queries` (Q,).

        bias: (B, N, M) or (B, h, N, M), added to the logits, as in `forward`.
        """
        q_BhQd = self.project(x_BND)[:, :, queries]
        full = (len(x_BND), -1, x_BND.shape[1], k_BhMd.shape[2])
        bias_BhQM = None if bias is None else _by_head(bias).expand(full)[:, :, queries]
        return attention_weights(q_BhQd, k_BhMd, bias_BhQM)


def _by_head(bias: Tensor) -> Tensor:
    """Add missing axes after B to a bias (B, h, N, M), as in (B, N, M) -> (B, 1, N, M)."""
    while bias.ndim < 4:
        bias = bias[:, None]
    return bias

"""Building blocks that several components share; plugins may use them too.

B batch, T tokens, D width, h heads, d = D/h.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from qgs.contracts import AttentionWeights

NORM_EPS = 1e-5
"""Added to the variance by every LayerNorm of both releases (PyTorch's default)."""


class LayerScale(nn.Module):
    """Per-channel factor on a residual update, initialised at `init`."""

    def __init__(self, width: int, init: float) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.full((width,), init))

    def forward(self, update: Tensor) -> Tensor:
        """(..., D) -> (..., D)."""
        return update * self.gamma


class Mlp(nn.Module):
    """Linear, GELU, linear: (..., in) -> (..., out)."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(inputs, hidden)
        self.fc2 = nn.Linear(hidden, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """(..., in) -> (..., out)."""
        return self.fc2(F.gelu(self.fc1(x)))


def split_heads(x_BTD: Tensor, heads: int) -> Tensor:
    """(B, T, D) -> (B, h, T, d)."""
    return rearrange(x_BTD, "b t (h d) -> b h t d", h=heads)


def merge_heads(x_BhTd: Tensor) -> Tensor:
    """(B, h, T, d) -> (B, T, D)."""
    return rearrange(x_BhTd, "b h t d -> b t (h d)")


def attention_weights(q_BhQd: Tensor, k_BhTd: Tensor, bias: Tensor | None) -> AttentionWeights:
    """What scaled dot-product attention computes on the way, spelled out in float32."""
    scale = q_BhQd.shape[-1] ** -0.5
    content = torch.einsum("bhqd,bhtd->bhqt", q_BhQd.float(), k_BhTd.float()) * scale
    logits = content if bias is None else content + bias
    return AttentionWeights(content, bias, logits.softmax(-1))


class SelfAttentionCore(nn.Module):
    """Multi-head self-attention with fused qkv and per-head LayerNorm on queries and keys."""

    def __init__(self, width: int, heads: int, norm_eps: float = NORM_EPS) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.q_norm = nn.LayerNorm(width // heads, norm_eps)
        self.k_norm = nn.LayerNorm(width // heads, norm_eps)
        self.proj = nn.Linear(width, width)

    def project(self, x_BTD: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values (B, h, T, d), norms applied."""
        q, k, v = (split_heads(part, self.heads) for part in self.qkv(x_BTD).chunk(3, -1))
        return self.q_norm(q).to(v.dtype), self.k_norm(k).to(v.dtype), v

    def forward(self, x_BTD: Tensor) -> Tensor:
        """(B, T, D) -> (B, T, D)."""
        q, k, v = self.project(x_BTD)
        return self.proj(merge_heads(F.scaled_dot_product_attention(q, k, v)))

    def explain(self, x_BTD: Tensor, queries: Tensor) -> AttentionWeights:
        """Attention of the tokens with indices `queries` (Q,)."""
        q, k, _ = self.project(x_BTD)
        return attention_weights(q[:, :, queries], k, None)


class CrossAttentionCore(nn.Module):
    """Pre-norm multi-head reading of given keys and values, with an additive bias on the logits."""

    def __init__(self, width: int, heads: int, norm_eps: float = NORM_EPS) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width, norm_eps)
        self.q_proj = nn.Linear(width, width)
        self.q_norm = nn.LayerNorm(width // heads, norm_eps)
        self.out_proj = nn.Linear(width, width)

    def project(self, x_BND: Tensor) -> Tensor:
        """Queries (B, h, N, d), norm applied."""
        return self.q_norm(split_heads(self.q_proj(self.norm(x_BND)), self.heads))

    def forward(
        self, x_BND: Tensor, keys: Tensor, values: Tensor, bias_BNM: Tensor | None = None
    ) -> Tensor:
        """(B, N, D) read from keys, values (B, h, M, d); `bias_BNM` is shared by all heads."""
        q = self.project(x_BND).to(values.dtype)
        bias = None if bias_BNM is None else bias_BNM[:, None].to(values.dtype)
        read = F.scaled_dot_product_attention(q, keys.to(values.dtype), values, attn_mask=bias)
        return self.out_proj(merge_heads(read))

    def explain(
        self, x_BND: Tensor, keys: Tensor, queries: Tensor, bias_BNM: Tensor | None = None
    ) -> AttentionWeights:
        """Attention of the queries with indices `queries` (Q,)."""
        q = self.project(x_BND)[:, :, queries]
        bias = None if bias_BNM is None else bias_BNM[:, None, queries]
        return attention_weights(q, keys, bias)

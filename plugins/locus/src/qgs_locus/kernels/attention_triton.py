"""Attention with the bias `RayBias` in Triton: logits and bias of a pair stay in registers.

There are three kernels, as in FlashAttention-2 (arXiv 2307.08691). Two loop over all tokens for a
block of queries: one for the result, one for the gradients of the queries. The third loops over all
queries for a block of tokens, for the gradients of keys and values. The bias and all sums are in
float32. Each sum is added in a fixed order, so a repeated run gives the same bits.

A query has five numbers: its anchor's centre mu = (x, y, z), factor = gamma / (2 sigma^2) and
lower = gamma * bias_min. A token has six: moment and direction of its ray. `RayBias` in
`qgs_locus.ray_bias` explains them. The kernels take these numbers as queries (B, N, 5) and tokens
(B, 6, M). Every 4-d tensor (B, h, count, width) comes with its strides, count and width.

Axes: as in `qgs_locus.kernels.attention_bias`. W is the head width d, rounded up to a power of two.
"""

from typing import Any

import torch
import triton  # pyright: ignore[reportMissingImports]
import triton.language as tl  # pyright: ignore[reportMissingImports]
from torch import Tensor
from torch.autograd.function import once_differentiable

jit: Any = triton.jit
F = tl.constexpr(5)
G = tl.constexpr(6)


@jit
def _read(queries, tokens, n, m, N, M):
    """Load what the bias of queries n and tokens m of the program's scene is computed from.

    Returns e = mu x d - m, whose length is the distance of anchor and ray, as three tensors (n, m)
    of coordinates; the ray's direction d, as three tensors (1, m); factor and lower, each (n, 1).
    mu is the anchor's centre, m the ray's moment.
    """
    scene = tl.program_id(2).to(tl.int64)
    of_n = queries + (scene * N + tl.minimum(n, N - 1))[:, None] * F
    of_m = tokens + scene * G * M + tl.minimum(m, M - 1)[None, :]
    x = tl.load(of_n)
    y = tl.load(of_n + 1)
    z = tl.load(of_n + 2)
    m0 = tl.load(of_m)
    m1 = tl.load(of_m + M)
    m2 = tl.load(of_m + 2 * M)
    d0 = tl.load(of_m + 3 * M)
    d1 = tl.load(of_m + 4 * M)
    d2 = tl.load(of_m + 5 * M)
    e0 = y * d2 - z * d1 - m0
    e1 = z * d0 - x * d2 - m1
    e2 = x * d1 - y * d0 - m2
    return e0, e1, e2, d0, d1, d2, tl.load(of_n + 3), tl.load(of_n + 4)


@jit
def _bias_gradients(queries, tokens, n, m, N, M, gradient, sums):
    """Add the gradients of n queries' five numbers to `sums`, five tensors (n,); return the sums.

    gradient: gradient of the loss with respect to the bias (n, m). With e = mu x d - m, the
    gradient of |e|^2 with respect to mu is 2 d x e.
    """
    e0, e1, e2, d0, d1, d2, factor, lower = _read(queries, tokens, n, m, N, M)
    distance_sq = e0 * e0 + e1 * e1 + e2 * e2
    at_bound = -factor * distance_sq <= lower
    inside = tl.where(at_bound, 0.0, gradient)
    # Not gradient - inside: the compiler would fuse it, and leave a rounding error.
    to_bound = tl.where(at_bound, gradient, 0.0)
    to_center = -2 * factor * inside
    return (
        sums[0] + tl.sum(to_center * (d1 * e2 - d2 * e1), 1),
        sums[1] + tl.sum(to_center * (d2 * e0 - d0 * e2), 1),
        sums[2] + tl.sum(to_center * (d0 * e1 - d1 * e0), 1),
        sums[3] - tl.sum(inside * distance_sq, 1),
        sums[4] + tl.sum(to_bound, 1),
    )


@jit
def _load(x, rows, WIDTH: tl.constexpr):
    """Load `rows` of the program's scene and head of `x`, (rows, WIDTH); outside of `x` it is 0.

    WIDTH: power of 2, at least the width of `x`.
    """
    at, inside = _at(x, rows, WIDTH)
    return tl.load(at, mask=inside, other=0.0)


@jit
def _store(x, rows, values):
    """Write `values` to `rows` of the program's scene and head of x; do nothing if x is None."""
    if x is not None:
        at, inside = _at(x, rows, values.shape[1])
        tl.store(at, values.to(x[0].dtype.element_ty), mask=inside)


@jit
def _at(x, rows, WIDTH: tl.constexpr):
    tensor, of_scene, of_head, of_row, of_column, count, width = x
    columns = tl.arange(0, WIDTH)[None, :]
    # Offsets exceed 2^31 for large batches.
    at = tl.program_id(2).to(tl.int64) * of_scene + columns * of_column
    at += tl.program_id(1).to(tl.int64) * of_head
    at += rows.to(tl.int64)[:, None] * of_row
    return tensor + at, (rows[:, None] < count) & (columns < width)


@jit
def _logits(q, k, queries, tokens, n, m, N, M, scale):
    """Return logits q k / sqrt(d) + b (n, m), with -inf for tokens of index M or more."""
    e0, e1, e2, _, _, _, factor, lower = _read(queries, tokens, n, m, N, M)
    bias = -factor * (e0 * e0 + e1 * e1 + e2 * e2)
    products = tl.dot(q, tl.trans(k), input_precision="ieee") * scale
    logits = products + tl.where(bias <= lower, lower, bias)
    return tl.where((m < M)[None, :], logits, float("-inf"))


@jit
def _forward(
    q, k, v, queries, tokens, out, lse, N, M, scale,
    BLOCK_N: tl.constexpr, BLOCK_M: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Write attention to `out`, and the log-sum-exp of queries' logits to `lse` (B, h, N, 1)."""
    n = tl.program_id(0) * BLOCK_N + tl.arange(0, BLOCK_N)
    of_q = _load(q, n, WIDTH)
    greatest = tl.full((BLOCK_N,), float("-inf"), tl.float32)
    total = tl.zeros((BLOCK_N,), tl.float32)
    sums = tl.zeros((BLOCK_N, WIDTH), tl.float32)
    for first in range(0, M, BLOCK_M):
        m = first + tl.arange(0, BLOCK_M)
        of_k = _load(k, m, WIDTH)
        of_v = _load(v, m, WIDTH)
        logits = _logits(of_q, of_k, queries, tokens, n, m, N, M, scale)
        # The running maximum keeps exp in range. When it rises, earlier sums are scaled down.
        above = tl.maximum(greatest, tl.max(logits, 1))
        p = tl.exp(logits - above[:, None])
        shrunk = tl.exp(greatest - above)
        total = total * shrunk + tl.sum(p, 1)
        sums = sums * shrunk[:, None] + tl.dot(p.to(of_v.dtype), of_v, input_precision="ieee")
        greatest = above
    _store(out, n, sums / total[:, None])
    _store(lse, n, (greatest + tl.log(total))[:, None])


@jit
def _backward_queries(
    q, k, v, queries, tokens, g, lse, rowsum, dq, of_bias, N, M, scale,
    BLOCK_N: tl.constexpr, BLOCK_M: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Write the gradient of q to `dq`, and the gradient of the bias to `of_bias` (B, h, N, F).

    `of_bias` holds the gradient with respect to the F numbers of each query, for each head. If
    `dq` or `of_bias` is None, its gradient is not computed. g: gradient of the attention result.
    rowsum: sum of g times the result over the head's channels, (B, h, N, 1).
    """
    n = tl.program_id(0) * BLOCK_N + tl.arange(0, BLOCK_N)
    of_q = _load(q, n, WIDTH)
    of_g = _load(g, n, WIDTH)
    of_lse = _load(lse, n, 1)
    of_rowsum = _load(rowsum, n, 1)
    sums = tl.zeros((BLOCK_N, WIDTH), tl.float32)
    bias_sums = (tl.zeros((BLOCK_N,), tl.float32),) * F
    for first in range(0, M, BLOCK_M):
        m = first + tl.arange(0, BLOCK_M)
        of_k = _load(k, m, WIDTH)
        of_v = _load(v, m, WIDTH)
        logits = _logits(of_q, of_k, queries, tokens, n, m, N, M, scale)
        of_p = tl.dot(of_g, tl.trans(of_v), input_precision="ieee")
        ds = tl.exp(logits - of_lse) * (of_p - of_rowsum)
        if dq is not None:
            sums += tl.dot(ds.to(of_k.dtype), of_k, input_precision="ieee")
        if of_bias is not None:
            bias_sums = _bias_gradients(queries, tokens, n, m, N, M, ds, bias_sums)
    _store(dq, n, sums * scale)
    if of_bias is not None:
        at, inside = _at(of_bias, n, 1)
        for f in tl.static_range(F):
            tl.store(at + f, bias_sums[f][:, None], mask=inside)


@jit
def _backward_tokens(
    q, k, v, queries, tokens, g, lse, rowsum, dk, dv, N, M, scale,
    BLOCK_N: tl.constexpr, BLOCK_M: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Write the gradients of k and v to `dk` and `dv`; leave one out if its tensor is None.

    Rows beyond the last query have g = 0 and rowsum = 0, so they add nothing. g: gradient of the
    attention result. rowsum: sum of g times the result over the head's channels, (B, h, N, 1).
    """
    m = tl.program_id(0) * BLOCK_M + tl.arange(0, BLOCK_M)
    of_k = _load(k, m, WIDTH)
    of_v = _load(v, m, WIDTH)
    k_sums = tl.zeros((BLOCK_M, WIDTH), tl.float32)
    v_sums = tl.zeros((BLOCK_M, WIDTH), tl.float32)
    for first in range(0, N, BLOCK_N):
        n = first + tl.arange(0, BLOCK_N)
        of_q = _load(q, n, WIDTH)
        of_g = _load(g, n, WIDTH)
        of_lse = _load(lse, n, 1)
        of_rowsum = _load(rowsum, n, 1)
        logits = _logits(of_q, of_k, queries, tokens, n, m, N, M, scale)
        p = tl.exp(logits - of_lse)
        if dv is not None:
            v_sums += tl.dot(tl.trans(p.to(of_g.dtype)), of_g, input_precision="ieee")
        if dk is not None:
            ds = p * (tl.dot(of_g, tl.trans(of_v), input_precision="ieee") - of_rowsum)
            k_sums += tl.dot(tl.trans(ds.to(of_q.dtype)), of_q, input_precision="ieee")
    _store(dk, m, k_sums * scale)
    _store(dv, m, v_sums)


class TritonAttention(torch.autograd.Function):
    """Autograd function of `biased_attention` in Triton.

    queries (B, N, F), tokens (B, G, M): the F numbers of each query and the G numbers of each token
    that `RayBias` lists, float32. Tokens get no gradient.
    """

    @staticmethod
    def forward(
        ctx: Any, q: Tensor, k: Tensor, v: Tensor, queries: Tensor, tokens: Tensor
    ) -> Tensor:
        out = torch.empty_like(q)
        lse = q.new_empty(*q.shape[:3], 1, dtype=torch.float32)
        # Kernels assume that rows of these are contiguous.
        saved = q, k, v, queries.contiguous(), tokens.contiguous()
        _launch(_forward, *saved, out, lse)
        ctx.save_for_backward(*saved, out, lse)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *saved, out, lse = ctx.saved_tensors
        q, k, v, queries, _ = saved
        needs = ctx.needs_input_grad
        dq, dk, dv = (torch.empty_like(x) if needs[n] else None for n, x in enumerate((q, k, v)))
        by_head = queries.new_empty(*q.shape[:2], *queries.shape[1:]) if needs[3] else None
        rowsum = (gradients[0].float() * out.float()).sum(-1, keepdim=True)
        given = *saved, gradients[0], lse, rowsum
        if dq is not None or by_head is not None:
            _launch(_backward_queries, *given, dq, by_head)
        if dk is not None or dv is not None:
            _launch(_backward_tokens, *given, dk, dv)
        # Summed over heads here: atomics in the kernel would add in a changing order.
        summed = None if by_head is None else by_head.sum(1)
        return dq, dk, dv, summed, None


def _launch(kernel: Any, *tensors: Any) -> None:
    """Run a kernel for each head and block; 4-d tensors are passed with strides and last sizes."""
    q, k = tensors[:2]
    (scenes, heads, N, width), M = q.shape, k.shape[2]
    sizes = _blocks(q)
    count, block = (M, "BLOCK_M") if kernel is _backward_tokens else (N, "BLOCK_N")
    # One program per block (of queries, or of tokens in the third kernel), head and scene.
    grid = triton.cdiv(count, sizes[block]), heads, scenes
    arguments = [
        (x, *x.stride(), *x.shape[2:]) if x is not None and x.ndim == 4 else x for x in tensors
    ]
    with torch.cuda.device_of(q):
        kernel[grid](*arguments, N, M, width**-0.5, **sizes)


def _blocks(q: Tensor) -> dict[str, int]:
    """Return block sizes and numbers of warps for which 255 registers per thread nearly suffice.

    Products in float32 do not use the GPU's matrix units, so loading blocks in advance (num_stages
    above 1) would only cost registers.
    """
    # `tl.dot` needs at least 16.
    width = max(triton.next_power_of_2(q.shape[-1]), 16)
    exact = q.dtype == torch.float32
    wide = width > 128
    rows = 16 if exact and wide else 32 if exact or width > 64 else 64
    return {
        "BLOCK_N": rows,
        "BLOCK_M": min(rows, 32),
        "WIDTH": width,
        "num_warps": 8 if exact or wide else 4,
        "num_stages": 1 if exact or wide else 2,
    }

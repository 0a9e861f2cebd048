"""Attention with the bias `RayBias` in Triton: logits and bias of a pair stay in registers.

There are three kernels, as in FlashAttention-2 (arXiv 2307.08691). Two loop over all tokens for a
block of queries: one for the result, one for the gradients of the queries. The third loops over all
queries for a block of tokens, for the gradients of keys and values. The bias and all sums are in
float32. Each sum is added in a fixed order, so a repeated run gives the same bits.

A query has five numbers: its anchor's centre mu = (x, y, z), factor = gamma / (2 sigma^2) and
lower = gamma * bias_min. A token has six: moment and direction of its ray. `RayBias` in
`qgs_locus.ray_bias` explains them. The functions of the bias get pointers (n, 1) and (1, m) to the
first numbers of n queries and m tokens. `step` is the stride between two numbers of a token.
The kernels take these numbers as read_q (B, N, 5) and read_k (B, 6, M).

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
def _moment(queries, tokens, step):
    """Return mu x d - m, whose length is the distance of anchor and ray, as three tensors (n, m).

    mu is the anchor's centre, m and d are moment and direction of the ray. The three tensors hold
    the coordinates.
    """
    x = tl.load(queries)
    y = tl.load(queries + 1)
    z = tl.load(queries + 2)
    m0 = tl.load(tokens)
    m1 = tl.load(tokens + step)
    m2 = tl.load(tokens + 2 * step)
    d0 = tl.load(tokens + 3 * step)
    d1 = tl.load(tokens + 4 * step)
    d2 = tl.load(tokens + 5 * step)
    return y * d2 - z * d1 - m0, z * d0 - x * d2 - m1, x * d1 - y * d0 - m2


@jit
def _bias(queries, tokens, step):
    """Return the bias (n, m) of `RayBias`, from the numbers of n queries and of m tokens."""
    e0, e1, e2 = _moment(queries, tokens, step)
    bias = -tl.load(queries + 3) * (e0 * e0 + e1 * e1 + e2 * e2)
    lower = tl.load(queries + 4)
    return tl.where(bias <= lower, lower, bias)


@jit
def _bias_gradients(queries, tokens, step, gradient, sums):
    """Add the gradients of n queries' five numbers to `sums`, five tensors (n,); return the sums.

    gradient: gradient of the loss with respect to the bias (n, m). With e = mu x d - m, the result
    of `_moment`, the gradient of |e|^2 with respect to mu is 2 d x e.
    """
    e0, e1, e2 = _moment(queries, tokens, step)
    d0 = tl.load(tokens + 3 * step)
    d1 = tl.load(tokens + 4 * step)
    d2 = tl.load(tokens + 5 * step)
    factor = tl.load(queries + 3)
    lower = tl.load(queries + 4)
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
def _load(x, rows, count, width, WIDTH: tl.constexpr):
    """Load `rows` of the program's scene and head of `x`, (rows, WIDTH); outside of `x` it is 0.

    x: pair of a tensor (B, h, count, width) and its strides. WIDTH: power of 2, at least `width`.
    """
    at, inside = _at(x, rows, count, width, WIDTH)
    return tl.load(at, mask=inside, other=0.0)


@jit
def _store(x, rows, count, width, values, WIDTH: tl.constexpr):
    """Write `values` to `rows` of the program's scene and head of x; do nothing if x is None."""
    if x is not None:
        at, inside = _at(x, rows, count, width, WIDTH)
        tl.store(at, values.to(x[0].dtype.element_ty), mask=inside)


@jit
def _at(x, rows, count, width, WIDTH: tl.constexpr):
    tensor, strides = x
    columns = tl.arange(0, WIDTH)[None, :]
    # Offsets exceed 2^31 for large batches.
    at = tl.program_id(2).to(tl.int64) * strides[0] + columns * strides[3]
    at += tl.program_id(1).to(tl.int64) * strides[1]
    at += rows.to(tl.int64)[:, None] * strides[2]
    return tensor + at, (rows[:, None] < count) & (columns < width)


@jit
def _logits(q, k, queries, tokens, m, M, scale):
    """Return logits q k / sqrt(d) + b (n, m), with -inf for tokens of index M or more."""
    products = tl.dot(q, tl.trans(k), input_precision="ieee") * scale
    return tl.where((m < M)[None, :], products + _bias(queries, tokens, M), float("-inf"))


@jit
def _forward(
    q, k, v, read_q, read_k, out, lse, heads, N, M, width, scale,
    BLOCK_N: tl.constexpr, BLOCK_M: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Write attention to `out`, and the log-sum-exp of each query's logits (B, h, N) to `lse`."""
    scene = tl.program_id(2).to(tl.int64)
    each = scene * heads + tl.program_id(1)
    n = tl.program_id(0) * BLOCK_N + tl.arange(0, BLOCK_N)
    of_q = _load(q, n, N, width, WIDTH)
    queries = read_q + (scene * N + tl.minimum(n, N - 1))[:, None] * F
    greatest = tl.full((BLOCK_N,), float("-inf"), tl.float32)
    total = tl.zeros((BLOCK_N,), tl.float32)
    sums = tl.zeros((BLOCK_N, WIDTH), tl.float32)
    for first in range(0, M, BLOCK_M):
        m = first + tl.arange(0, BLOCK_M)
        of_k = _load(k, m, M, width, WIDTH)
        of_v = _load(v, m, M, width, WIDTH)
        tokens = read_k + scene * G * M + tl.minimum(m, M - 1)[None, :]
        logits = _logits(of_q, of_k, queries, tokens, m, M, scale)
        # The running maximum keeps exp in range. When it rises, earlier sums are scaled down.
        above = tl.maximum(greatest, tl.max(logits, 1))
        p = tl.exp(logits - above[:, None])
        shrunk = tl.exp(greatest - above)
        total = total * shrunk + tl.sum(p, 1)
        sums = sums * shrunk[:, None] + tl.dot(p.to(of_v.dtype), of_v, input_precision="ieee")
        greatest = above
    _store(out, n, N, width, sums / total[:, None], WIDTH)
    tl.store(lse + each * N + n, greatest + tl.log(total), mask=n < N)


@jit
def _backward_queries(
    q, k, v, read_q, read_k, g, lse, rowsum, dq, of_bias, heads, N, M, width, scale,
    BLOCK_N: tl.constexpr, BLOCK_M: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Write the gradient of q to `dq`, and the gradient of the bias to `of_bias` (B, h, N, F).

    `of_bias` holds the gradient with respect to the F numbers of each query, for each head. If
    `dq` or `of_bias` is None, its gradient is not computed. g: gradient of the attention result.
    rowsum: sum of g times the result over the head's channels, (B, h, N).
    """
    scene = tl.program_id(2).to(tl.int64)
    each = scene * heads + tl.program_id(1)
    n = tl.program_id(0) * BLOCK_N + tl.arange(0, BLOCK_N)
    of_q = _load(q, n, N, width, WIDTH)
    of_g = _load(g, n, N, width, WIDTH)
    # Rows outside get weights exp(-inf) = 0.
    of_lse = tl.load(lse + each * N + n, mask=n < N, other=float("inf"))
    of_rowsum = tl.load(rowsum + each * N + n, mask=n < N, other=0.0)
    queries = read_q + (scene * N + tl.minimum(n, N - 1))[:, None] * F
    sums = tl.zeros((BLOCK_N, WIDTH), tl.float32)
    bias_sums = (tl.zeros((BLOCK_N,), tl.float32),) * F
    for first in range(0, M, BLOCK_M):
        m = first + tl.arange(0, BLOCK_M)
        of_k = _load(k, m, M, width, WIDTH)
        of_v = _load(v, m, M, width, WIDTH)
        tokens = read_k + scene * G * M + tl.minimum(m, M - 1)[None, :]
        logits = _logits(of_q, of_k, queries, tokens, m, M, scale)
        of_p = tl.dot(of_g, tl.trans(of_v), input_precision="ieee")
        ds = tl.exp(logits - of_lse[:, None]) * (of_p - of_rowsum[:, None])
        if dq is not None:
            sums += tl.dot(ds.to(of_k.dtype), of_k, input_precision="ieee")
        if of_bias is not None:
            bias_sums = _bias_gradients(queries, tokens, M, ds, bias_sums)
    _store(dq, n, N, width, sums * scale, WIDTH)
    if of_bias is not None:
        for f in tl.static_range(F):
            tl.store(of_bias + (each * N + n) * F + f, bias_sums[f], mask=n < N)


@jit
def _backward_tokens(
    q, k, v, read_q, read_k, g, lse, rowsum, dk, dv, heads, N, M, width, scale,
    BLOCK_N: tl.constexpr, BLOCK_M: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Write the gradients of k and v to `dk` and `dv`; leave one out if its tensor is None.

    Rows beyond the last query get log-sum-exp inf, so their attention weights are 0. g: gradient
    of the attention result. rowsum: sum of g times the result over the head's channels, (B, h, N).
    """
    scene = tl.program_id(2).to(tl.int64)
    each = scene * heads + tl.program_id(1)
    m = tl.program_id(0) * BLOCK_M + tl.arange(0, BLOCK_M)
    of_k = _load(k, m, M, width, WIDTH)
    of_v = _load(v, m, M, width, WIDTH)
    tokens = read_k + scene * G * M + tl.minimum(m, M - 1)[None, :]
    k_sums = tl.zeros((BLOCK_M, WIDTH), tl.float32)
    v_sums = tl.zeros((BLOCK_M, WIDTH), tl.float32)
    for first in range(0, N, BLOCK_N):
        n = first + tl.arange(0, BLOCK_N)
        of_q = _load(q, n, N, width, WIDTH)
        of_g = _load(g, n, N, width, WIDTH)
        of_lse = tl.load(lse + each * N + n, mask=n < N, other=float("inf"))
        of_rowsum = tl.load(rowsum + each * N + n, mask=n < N, other=0.0)
        queries = read_q + (scene * N + tl.minimum(n, N - 1))[:, None] * F
        logits = _logits(of_q, of_k, queries, tokens, m, M, scale)
        p = tl.exp(logits - of_lse[:, None])
        if dv is not None:
            v_sums += tl.dot(tl.trans(p.to(of_g.dtype)), of_g, input_precision="ieee")
        if dk is not None:
            ds = p * (tl.dot(of_g, tl.trans(of_v), input_precision="ieee") - of_rowsum[:, None])
            k_sums += tl.dot(tl.trans(ds.to(of_q.dtype)), of_q, input_precision="ieee")
    _store(dk, m, M, width, k_sums * scale, WIDTH)
    _store(dv, m, M, width, v_sums, WIDTH)


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
        lse = q.new_empty(q.shape[:3], dtype=torch.float32)
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
        shape = (q.shape[0] * q.shape[1], *queries.shape[1:])
        dq, dk, dv = (torch.empty_like(x) if needs[n] else None for n, x in enumerate((q, k, v)))
        by_head = queries.new_empty(shape) if needs[3] else None
        given = *saved, gradients[0], lse, (gradients[0].float() * out.float()).sum(-1)
        if dq is not None or by_head is not None:
            _launch(_backward_queries, *given, dq, by_head)
        if dk is not None or dv is not None:
            _launch(_backward_tokens, *given, dk, dv)
        # Summed over heads here: atomics in the kernel would add in a changing order.
        summed = None if by_head is None else by_head.unflatten(0, q.shape[:2]).sum(1)
        return dq, dk, dv, summed, None


def _launch(kernel: Any, *tensors: Any) -> None:
    """Run a kernel for each head and block; a 4-d tensor is passed as (tensor, strides)."""
    q, k = tensors[:2]
    (scenes, heads, N, width), M = q.shape, k.shape[2]
    sizes = _blocks(q)
    count, block = (M, "BLOCK_M") if kernel is _backward_tokens else (N, "BLOCK_N")
    # One program per block (of queries, or of tokens in the third kernel), head and scene.
    grid = triton.cdiv(count, sizes[block]), heads, scenes
    arguments = [(x, x.stride()) if x is not None and x.ndim == 4 else x for x in tensors]
    with torch.cuda.device_of(q):
        kernel[grid](*arguments, heads, N, M, width, width**-0.5, **sizes)


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

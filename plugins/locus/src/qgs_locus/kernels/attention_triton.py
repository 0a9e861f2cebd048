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

import math
from typing import Any

import torch
import triton  # pyright: ignore[reportMissingImports]
import triton.language as tl  # pyright: ignore[reportMissingImports]
from torch import Tensor

jit: Any = triton.jit
F = tl.constexpr(5)
G = tl.constexpr(6)
LOG2_E = tl.constexpr(math.log2(math.e))
LN_2 = tl.constexpr(math.log(2))


@jit
def _read_queries(queries, n, N):
    """Load x, y, z, factor and lower of queries n of the program's scene, each (n, 1).

    factor and lower are for logits to base 2, because exp2 is faster than exp.
    """
    scene = tl.program_id(2).to(tl.int64)
    at = queries + (scene * N + tl.minimum(n, N - 1))[:, None] * F
    factor = tl.load(at + 3) * LOG2_E
    lower = tl.load(at + 4) * LOG2_E
    return tl.load(at), tl.load(at + 1), tl.load(at + 2), factor, lower


@jit
def _read_tokens(tokens, m, M):
    """Load moment and direction of tokens m of the program's scene, six tensors (1, m)."""
    at = tokens + tl.program_id(2).to(tl.int64) * G * M + tl.minimum(m, M - 1)[None, :]
    m0 = tl.load(at)
    m1 = tl.load(at + M)
    m2 = tl.load(at + 2 * M)
    return m0, m1, m2, tl.load(at + 3 * M), tl.load(at + 4 * M), tl.load(at + 5 * M)


@jit
def _difference(query, token):
    """Return e = mu x d - m, three tensors (n, m); |e| is the distance of anchor and ray."""
    x, y, z, _, _ = query
    m0, m1, m2, d0, d1, d2 = token
    # Brackets make two fused operations of each.
    return y * d2 - (z * d1 + m0), z * d0 - (x * d2 + m1), x * d1 - (y * d0 + m2)


@jit
def _bias_gradients(query, token, gradient, sums):
    """Return `sums`, five (n,), plus the gradients of n queries' five numbers from these tokens.

    The gradient of the centre lacks the factor -2 factor, which is the same for all tokens.
    gradient: gradient of the loss with respect to the bias (n, m). With e = mu x d - m, the
    gradient of |e|^2 with respect to mu is 2 d x e.
    """
    e0, e1, e2 = _difference(query, token)
    _, _, _, d0, d1, d2 = token
    distance_sq = e0 * e0 + e1 * e1 + e2 * e2
    at_bound = -query[3] * distance_sq <= query[4]
    inside = tl.where(at_bound, 0.0, gradient)
    # Not gradient - inside: the compiler would fuse it, and leave a rounding error.
    to_bound = tl.where(at_bound, gradient, 0.0)
    return (
        sums[0] + tl.sum(inside * (d1 * e2 - d2 * e1), 1),
        sums[1] + tl.sum(inside * (d2 * e0 - d0 * e2), 1),
        sums[2] + tl.sum(inside * (d0 * e1 - d1 * e0), 1),
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
    # Offsets exceed 2^31 for large batches, but not within a head.
    tensor += tl.program_id(2).to(tl.int64) * of_scene + tl.program_id(1).to(tl.int64) * of_head
    columns = tl.arange(0, WIDTH)[None, :]
    inside = (rows[:, None] < count) & (columns < width)
    return tensor + rows[:, None] * of_row + columns * of_column, inside


@jit
def _logits(q, k, query, token, m, M, scale):
    """Return logits q k / sqrt(d) + b (n, m) to base 2, with -inf for tokens of index M or more."""
    e0, e1, e2 = _difference(query, token)
    bias = -query[3] * (e0 * e0 + e1 * e1 + e2 * e2)
    products = tl.dot(q, tl.trans(k), input_precision="ieee") * (scale * LOG2_E)
    # Where the bias is NaN, the logit is too.
    logits = products + tl.maximum(bias, query[4], propagate_nan=tl.PropagateNan.ALL)
    return tl.where((m < M)[None, :], logits, float("-inf"))


@jit
def _forward(
    q, k, v, queries, tokens, out, lse, N, M, scale,
    BLOCK_N: tl.constexpr, BLOCK_M: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Write attention to `out`, and log2 of the sum of 2^logits to `lse` (B, h, N, 1)."""
    n = tl.program_id(0) * BLOCK_N + tl.arange(0, BLOCK_N)
    of_q = _load(q, n, WIDTH)
    query = _read_queries(queries, n, N)
    greatest = tl.full((BLOCK_N,), float("-inf"), tl.float32)
    total = tl.zeros((BLOCK_N,), tl.float32)
    sums = tl.zeros((BLOCK_N, WIDTH), tl.float32)
    for first in range(0, M, BLOCK_M):
        m = first + tl.arange(0, BLOCK_M)
        of_k = _load(k, m, WIDTH)
        of_v = _load(v, m, WIDTH)
        logits = _logits(of_q, of_k, query, _read_tokens(tokens, m, M), m, M, scale)
        # The running maximum keeps exp2 in range. When it rises, earlier sums are scaled down.
        above = tl.maximum(greatest, tl.max(logits, 1))
        p = tl.exp2(logits - above[:, None])
        shrunk = tl.exp2(greatest - above)
        total = total * shrunk + tl.sum(p, 1)
        sums = sums * shrunk[:, None] + tl.dot(p.to(of_v.dtype), of_v, input_precision="ieee")
        greatest = above
    _store(out, n, sums / total[:, None])
    _store(lse, n, (greatest + tl.log2(total))[:, None])


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
    query = _read_queries(queries, n, N)
    sums = tl.zeros((BLOCK_N, WIDTH), tl.float32)
    bias_sums = (tl.zeros((BLOCK_N,), tl.float32),) * F
    for first in range(0, M, BLOCK_M):
        m = first + tl.arange(0, BLOCK_M)
        of_k = _load(k, m, WIDTH)
        of_v = _load(v, m, WIDTH)
        token = _read_tokens(tokens, m, M)
        logits = _logits(of_q, of_k, query, token, m, M, scale)
        of_p = tl.dot(of_g, tl.trans(of_v), input_precision="ieee")
        ds = tl.exp2(logits - of_lse) * (of_p - of_rowsum)
        if dq is not None:
            sums += tl.dot(ds.to(of_k.dtype), of_k, input_precision="ieee")
        if of_bias is not None:
            bias_sums = _bias_gradients(query, token, ds, bias_sums)
    _store(dq, n, sums * scale)
    if of_bias is not None:
        at, inside = _at(of_bias, n, 1)
        for f in tl.static_range(F):
            # Of the centre's gradients, this factor is the same for all tokens.
            times = -2 * LN_2 * query[3] if f < 3 else 1.0
            tl.store(at + f, bias_sums[f][:, None] * times, mask=inside)


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
    token = _read_tokens(tokens, m, M)
    k_sums = tl.zeros((BLOCK_M, WIDTH), tl.float32)
    v_sums = tl.zeros((BLOCK_M, WIDTH), tl.float32)
    for first in range(0, N, BLOCK_N):
        n = first + tl.arange(0, BLOCK_N)
        of_q = _load(q, n, WIDTH)
        of_g = _load(g, n, WIDTH)
        of_lse = _load(lse, n, 1)
        of_rowsum = _load(rowsum, n, 1)
        logits = _logits(of_q, of_k, _read_queries(queries, n, N), token, m, M, scale)
        p = tl.exp2(logits - of_lse)
        if dv is not None:
            v_sums += tl.dot(tl.trans(p.to(of_g.dtype)), of_g, input_precision="ieee")
        if dk is not None:
            ds = p * (tl.dot(of_g, tl.trans(of_v), input_precision="ieee") - of_rowsum)
            k_sums += tl.dot(tl.trans(ds.to(of_q.dtype)), of_q, input_precision="ieee")
    _store(dk, m, k_sums * scale)
    _store(dv, m, v_sums)


def _empty_results(q: Tensor, *_: Tensor) -> tuple[Tensor, Tensor]:
    """Return uninitialised memory for the results of `attention`."""
    return torch.empty_like(q), q.new_empty(*q.shape[:3], 1, dtype=torch.float32)


# Operators of torch, which torch.compile does not look into.
@torch.library.custom_op("qgs_locus::attention", mutates_args=())
def attention(
    q: Tensor, k: Tensor, v: Tensor, queries: Tensor, tokens: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the result of `biased_attention`, and log2 of the sum of 2^logits (B, h, N, 1).

    queries (B, N, F), tokens (B, G, M): the F numbers of each query and the G numbers of each token
    that `RayBias` lists, float32, contiguous. Tokens and the second result get no gradient.
    """
    results = _empty_results(q)
    _launch(_forward, q, k, v, queries, tokens, *results)
    return results


@torch.library.custom_op("qgs_locus::attention_gradients", mutates_args=())
def attention_gradients(
    gradient: Tensor,
    q: Tensor,
    k: Tensor,
    v: Tensor,
    queries: Tensor,
    tokens: Tensor,
    out: Tensor,
    lse: Tensor,
    needed: list[bool],
) -> list[Tensor]:
    """Return those gradients of q, k, v and queries that are needed, given that of `attention`.

    out, lse: results of `attention`. needed: whether each of the four gradients is needed.
    """
    learnt = (q, k, v)
    dq, dk, dv = (torch.empty_like(x) if needed[n] else None for n, x in enumerate(learnt))
    by_head = queries.new_empty(*q.shape[:2], *queries.shape[1:]) if needed[3] else None
    rowsum = (gradient.float() * out.float()).sum(-1, keepdim=True)
    given = *learnt, queries, tokens, gradient, lse, rowsum
    if dq is not None or by_head is not None:
        _launch(_backward_queries, *given, dq, by_head)
    if dk is not None or dv is not None:
        _launch(_backward_tokens, *given, dk, dv)
    # Summed over heads here: atomics in the kernel would add in a changing order.
    summed = None if by_head is None else by_head.sum(1)
    return [x for x in (dq, dk, dv, summed) if x is not None]


def _save(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*inputs, *output)
    ctx.mark_non_differentiable(output[1])


def _backward(ctx: Any, gradient: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
    *needed, of_tokens = ctx.needs_input_grad
    assert not of_tokens
    found = iter(attention_gradients(gradient, *ctx.saved_tensors, needed))
    return *(next(found) if each else None for each in needed), None


attention.register_fake(_empty_results)
attention.register_autograd(_backward, setup_context=_save)


@attention_gradients.register_fake
def _empty_gradients(gradient: Tensor, *given: Any) -> list[Tensor]:
    *tensors, needed = given
    return [torch.empty_like(x) for x, each in zip(tensors[:4], needed, strict=False) if each]


def _launch(kernel: Any, *tensors: Any) -> None:
    """Run a kernel for each head and block; 4-d tensors are passed with strides and last sizes."""
    q, k = tensors[:2]
    (scenes, heads, N, width), M = q.shape, k.shape[2]
    sizes = _blocks(q, kernel)
    count, block = (M, "BLOCK_M") if kernel is _backward_tokens else (N, "BLOCK_N")
    # One program per block (of queries, or of tokens in the third kernel), head and scene.
    grid = triton.cdiv(count, sizes[block]), heads, scenes
    arguments = [
        (x, *x.stride(), *x.shape[2:]) if x is not None and x.ndim == 4 else x for x in tensors
    ]
    with torch.cuda.device_of(q):
        kernel[grid](*arguments, N, M, width**-0.5, **sizes)


def _blocks(q: Tensor, kernel: Any) -> dict[str, int]:
    """Return block sizes and numbers of warps for which 255 registers per thread suffice.

    In half precision with heads of at most 64 channels, a warp on an H100 then takes 24, 53 and 28
    instructions for 32 pairs of query and token (forward, gradients of queries, of tokens; counted
    in compiled code). Blocks of 64 x 32 would take 39, 53 and 34, and 128 x 64 with 8 warps 35, 61
    and 30. Products in float32 do not use the GPU's matrix units, so loading blocks in advance
    (num_stages above 1) would only cost registers.
    """
    # `tl.dot` needs at least 16.
    width = max(triton.next_power_of_2(q.shape[-1]), 16)
    exact = q.dtype == torch.float32
    wide = width > 128
    rows = 16 if exact and wide else 32 if exact or width > 64 else 64
    tokens = {_forward: 128, _backward_tokens: 64} if rows == 64 else {}
    return {
        "BLOCK_N": rows,
        "BLOCK_M": tokens.get(kernel, min(rows, 32)),
        "WIDTH": width,
        "num_warps": 8 if exact or wide else 4,
        "num_stages": 1 if exact or wide else 2,
    }

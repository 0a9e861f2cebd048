"""`RayBias` in Triton, for the kernels of `qgs_locus.kernels.attention_triton`.

Queries are rows (x, y, z, gamma / (2 sigma^2), gamma * bias_min); tokens have six numbers, m and d.
"""

import triton.language as tl  # pyright: ignore[reportMissingImports]

from qgs_locus.kernels.attention_triton import jit


@jit
def value(queries, tokens, step):
    """max(-factor |mu x d - m|^2, lower)."""
    e0, e1, e2 = _moment(queries, tokens, step)
    bias = -tl.load(queries + 3) * (e0 * e0 + e1 * e1 + e2 * e2)
    lower = tl.load(queries + 4)
    return tl.where(bias <= lower, lower, bias)


@jit
def gradients(queries, tokens, step, gradient, sums):
    """With e = mu x d - m, the gradient of |e|^2 to mu is 2 d x e."""
    e0, e1, e2 = _moment(queries, tokens, step)
    d0 = tl.load(tokens + 3 * step)
    d1 = tl.load(tokens + 4 * step)
    d2 = tl.load(tokens + 5 * step)
    factor = tl.load(queries + 3)
    lower = tl.load(queries + 4)
    distance_sq = e0 * e0 + e1 * e1 + e2 * e2
    at_bound = -factor * distance_sq <= lower
    inside = tl.where(at_bound, 0.0, gradient)
    # gradient - inside would be fused with the product in `gradient`, and leave its rounding error.
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
def _moment(queries, tokens, step):
    """mu x d - m, (n, m) each."""
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

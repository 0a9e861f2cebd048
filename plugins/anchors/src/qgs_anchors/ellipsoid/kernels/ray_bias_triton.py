"""`EllipsoidBias` in Triton, for the kernels of `qgs_locus.kernels.attention_triton`.

Queries are rows: mu, cof(W) and W by rows, gamma / 2, gamma * bias_min. Tokens have nine numbers:
m, d, d / |d|.
"""

import triton.language as tl  # pyright: ignore[reportMissingImports]
from qgs_locus.kernels.attention_triton import jit


@jit
def value(queries, tokens, step):
    """max(-factor |cof(W) (m - mu x d)|^2 / |W d|^2, lower), with d of unit length below."""
    a, b, _, _ = _parts(queries, tokens, step)
    bias = -tl.load(queries + 21) * _squared(a) / _squared(b)
    lower = tl.load(queries + 22)
    return tl.where(bias <= lower, lower, bias)


@jit
def gradients(queries, tokens, step, gradient, sums):
    """A gradient g of e = m - mu x d is g x d of mu, and that of e is cof(W)' times that of a."""
    a, b, e, u = _parts(queries, tokens, step)
    below = _squared(b)
    factor = tl.load(queries + 21)
    lower = tl.load(queries + 22)
    ratio = _squared(a) / below
    at_bound = -factor * ratio <= lower
    inside = tl.where(at_bound, 0.0, gradient)
    # gradient - inside would be fused with the product in `gradient`, and leave its rounding error.
    to_bound = tl.where(at_bound, gradient, 0.0)
    up = -2 * factor * inside / below
    down = -up * ratio
    a0 = up * a[0]
    a1 = up * a[1]
    a2 = up * a[2]
    b0 = down * b[0]
    b1 = down * b[1]
    b2 = down * b[2]
    d0, d1, d2 = _three(tokens + 3 * step, step)
    c0, c1, c2 = _three(queries + 3, 1)
    c3, c4, c5 = _three(queries + 6, 1)
    c6, c7, c8 = _three(queries + 9, 1)
    e0 = a0 * c0 + a1 * c3 + a2 * c6
    e1 = a0 * c1 + a1 * c4 + a2 * c7
    e2 = a0 * c2 + a1 * c5 + a2 * c8
    return (
        sums[0] + tl.sum(e1 * d2 - e2 * d1, 1),
        sums[1] + tl.sum(e2 * d0 - e0 * d2, 1),
        sums[2] + tl.sum(e0 * d1 - e1 * d0, 1),
        sums[3] + tl.sum(a0 * e[0], 1),
        sums[4] + tl.sum(a0 * e[1], 1),
        sums[5] + tl.sum(a0 * e[2], 1),
        sums[6] + tl.sum(a1 * e[0], 1),
        sums[7] + tl.sum(a1 * e[1], 1),
        sums[8] + tl.sum(a1 * e[2], 1),
        sums[9] + tl.sum(a2 * e[0], 1),
        sums[10] + tl.sum(a2 * e[1], 1),
        sums[11] + tl.sum(a2 * e[2], 1),
        sums[12] + tl.sum(b0 * u[0], 1),
        sums[13] + tl.sum(b0 * u[1], 1),
        sums[14] + tl.sum(b0 * u[2], 1),
        sums[15] + tl.sum(b1 * u[0], 1),
        sums[16] + tl.sum(b1 * u[1], 1),
        sums[17] + tl.sum(b1 * u[2], 1),
        sums[18] + tl.sum(b2 * u[0], 1),
        sums[19] + tl.sum(b2 * u[1], 1),
        sums[20] + tl.sum(b2 * u[2], 1),
        sums[21] - tl.sum(inside * ratio, 1),
        sums[22] + tl.sum(to_bound, 1),
    )


@jit
def _parts(queries, tokens, step):
    """a = cof(W) e and b = W u, with e = m - mu x d and u = d / |d|; and e and u."""
    x, y, z = _three(queries, 1)
    m0, m1, m2 = _three(tokens, step)
    d0, d1, d2 = _three(tokens + 3 * step, step)
    e = m0 - y * d2 + z * d1, m1 - z * d0 + x * d2, m2 - x * d1 + y * d0
    u = _three(tokens + 6 * step, step)
    return _times(queries + 3, e), _times(queries + 12, u), e, u


@jit
def _three(first, step):
    return tl.load(first), tl.load(first + step), tl.load(first + 2 * step)


@jit
def _times(matrix, x):
    """The matrix (3, 3) of each query, by rows, times x."""
    return _dot(matrix, x), _dot(matrix + 3, x), _dot(matrix + 6, x)


@jit
def _dot(row, x):
    return tl.load(row) * x[0] + tl.load(row + 1) * x[1] + tl.load(row + 2) * x[2]


@jit
def _squared(x):
    return x[0] * x[0] + x[1] * x[1] + x[2] * x[2]

"""Numba kernels of `EllipsoidBias`, which pass once over all rays for each query.

A query is a row of numbers: the anchor's centre mu, the rows of cof(W), the rows of W,
factor = gamma / 2 and lower = gamma * bias_min. `qgs_anchors.ellipsoid.ray_bias` defines W, gamma
and bias_min. A token is a column of nine numbers: moment m, direction d and unit direction d / |d|
of its ray. In the code, a matrix is a tuple of its nine entries.
"""

from qgs.kernels import TWO, ZERO, kernel


@kernel
def _times(a, v):
    """Return the product of the 3 x 3 matrix `a` and the vector `v`, and its squared length."""
    x, y, z = v
    p = a[0] * x + a[1] * y + a[2] * z
    q = a[3] * x + a[4] * y + a[5] * z
    r = a[6] * x + a[7] * y + a[8] * z
    return (p, q, r), p * p + q * q + r * r


@kernel
def _nine(row, first):
    return (
        row[first], row[first + 1], row[first + 2], row[first + 3], row[first + 4],
        row[first + 5], row[first + 6], row[first + 7], row[first + 8],
    )  # fmt: skip


@kernel
def _query(row):
    """Return mu, cof(W), W, factor and lower of a query."""
    mu = (row[0], row[1], row[2])
    return mu, _nine(row, 3), _nine(row, 12), row[21], row[22]


@kernel
def _moment(mu, t, j):
    """Return m - mu x d, the moment of ray j around the point mu.

    t: columns of all tokens, which start with the moment m and the direction d of a ray.
    """
    return (
        t[0, j] - mu[1] * t[5, j] + mu[2] * t[4, j],
        t[1, j] - mu[2] * t[3, j] + mu[0] * t[5, j],
        t[2, j] - mu[0] * t[4, j] + mu[1] * t[3, j],
    )


@kernel
def write(queries, tokens, out):
    """Write the bias max(-factor s, lower) to `out`, with factor and lower of each query.

    s = |cof(W) (m - mu x d)|^2 / |W u|^2 is the squared distance of the anchor's centre mu from the
    ray (moment m, direction d, u = d / |d|). W maps an ellipsoid around mu to a unit ball.
    """
    for n in range(queries.shape[0]):
        row = out[n]
        mu, c, w, factor, lower = _query(queries[n])
        for j in range(row.shape[0]):
            _, above = _times(c, _moment(mu, tokens, j))
            _, below = _times(w, (tokens[6, j], tokens[7, j], tokens[8, j]))
            bias = -factor * above / below
            # Not max(): NaN must stay NaN.
            row[j] = lower if bias <= lower else bias


@kernel
def _store(out, values):
    for i in range(len(values)):
        out[i] = values[i]


@kernel
def gradients(queries, tokens, gradient, out):
    """Compute gradients (N, 23) of the queries in `out` from gradients (N, M) of the bias."""
    for n in range(queries.shape[0]):
        row = gradient[n]
        of = out[n]
        mu, c, w, factor, lower = _query(queries[n])
        of_x = of_y = of_z = of_factor = of_lower = ZERO
        # Eighteen scalars, which the compiler keeps in registers, unlike an array.
        c0 = c1 = c2 = c3 = c4 = c5 = c6 = c7 = c8 = ZERO
        w0 = w1 = w2 = w3 = w4 = w5 = w6 = w7 = w8 = ZERO
        for j in range(row.shape[0]):
            e = _moment(mu, tokens, j)
            u, v, t = tokens[6, j], tokens[7, j], tokens[8, j]
            a, above = _times(c, e)
            b, below = _times(w, (u, v, t))
            ratio = above / below
            # At the clamp the gradient goes to the bound.
            inside = ZERO if -factor * ratio <= lower else row[j]
            of_lower += row[j] - inside
            of_factor -= inside * ratio
            up = -TWO * factor * inside / below
            a0, a1, a2 = up * a[0], up * a[1], up * a[2]
            c0 += a0 * e[0]
            c1 += a0 * e[1]
            c2 += a0 * e[2]
            c3 += a1 * e[0]
            c4 += a1 * e[1]
            c5 += a1 * e[2]
            c6 += a2 * e[0]
            c7 += a2 * e[1]
            c8 += a2 * e[2]
            # cof(W)' maps a gradient of a to one of e.
            e0 = a0 * c[0] + a1 * c[3] + a2 * c[6]
            e1 = a0 * c[1] + a1 * c[4] + a2 * c[7]
            e2 = a0 * c[2] + a1 * c[5] + a2 * c[8]
            # If g is the gradient of e = m - mu x d, then that of mu is g x d.
            of_x += e1 * tokens[5, j] - e2 * tokens[4, j]
            of_y += e2 * tokens[3, j] - e0 * tokens[5, j]
            of_z += e0 * tokens[4, j] - e1 * tokens[3, j]
            # d ratio = d above / below - ratio d below / below.
            down = -up * ratio
            b0, b1, b2 = down * b[0], down * b[1], down * b[2]
            w0 += b0 * u
            w1 += b0 * v
            w2 += b0 * t
            w3 += b1 * u
            w4 += b1 * v
            w5 += b1 * t
            w6 += b2 * u
            w7 += b2 * v
            w8 += b2 * t
        _store(of, (of_x, of_y, of_z, c0, c1, c2, c3, c4, c5, c6, c7, c8))
        _store(of[12:], (w0, w1, w2, w3, w4, w5, w6, w7, w8))
        _store(of[21:], (of_factor, of_lower))

"""Numba kernels of `EllipsoidBias`, which pass once over all rays for each query.

A query is a row of numbers: the anchor's centre mu, the rows of cof(W), the rows of W,
factor = gamma / 2 and lower = gamma * bias_min. `qgs_anchors.ellipsoid.ray_bias` defines W, gamma
and bias_min. A token is a column of nine numbers: moment m, direction d and unit direction d / |d|
of its ray. In the code, a vector is a tuple, and a matrix is a tuple of its rows.
"""

from qgs_locus.kernels.ray_bias_numba import of_ray

from qgs.kernels import ONE, TWO, ZERO, kernel
from qgs.kernels.projection import combine, cross, dot, dots, plus, vector


@kernel
def _times(matrix, a):
    """Return the product of the 3 x 3 matrix and the vector `a`, and its squared length."""
    product = dots(a, matrix)
    return product, dot(product, product)


@kernel
def _matrix(row):
    return vector(row), vector(row[3:]), vector(row[6:])


@kernel
def _query(row):
    """Return mu, cof(W), W, factor and lower of a query."""
    return vector(row), _matrix(row[3:]), _matrix(row[12:]), row[21], row[22]


@kernel
def _ray(tokens, j):
    """Return moment m, direction d and unit direction d / |d| of ray j."""
    return of_ray(tokens, 0, j), of_ray(tokens, 3, j), of_ray(tokens, 6, j)


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
            m, d, u = _ray(tokens, j)
            _, above = _times(c, plus(m, -ONE, cross(mu, d)))
            _, below = _times(w, u)
            bias = -factor * above / below
            # Not max(): NaN must stay NaN.
            row[j] = lower if bias <= lower else bias


@kernel
def gradients(queries, tokens, gradient, out):
    """Compute gradients (N, 23) of the queries in `out` from gradients (N, M) of the bias."""
    for n in range(queries.shape[0]):
        row = gradient[n]
        mu, c, w, factor, lower = _query(queries[n])
        # Tuples, which the compiler keeps in registers, unlike an array.
        of_mu = c0 = c1 = c2 = w0 = w1 = w2 = (ZERO, ZERO, ZERO)
        of_factor = of_lower = ZERO
        for j in range(row.shape[0]):
            m, d, u = _ray(tokens, j)
            e = plus(m, -ONE, cross(mu, d))
            a, above = _times(c, e)
            b, below = _times(w, u)
            ratio = above / below
            # At the clamp the gradient goes to the bound.
            inside = ZERO if -factor * ratio <= lower else row[j]
            of_lower += row[j] - inside
            of_factor -= inside * ratio
            up = -TWO * factor * inside / below
            c0 = plus(c0, up * a[0], e)
            c1 = plus(c1, up * a[1], e)
            c2 = plus(c2, up * a[2], e)
            # cof(W)' maps the gradient of a to g, that of e = m - mu x d. That of mu is g x d.
            of_mu = plus(of_mu, up, cross(combine(a, c), d))
            # d ratio = d above / below - ratio d below / below.
            down = -up * ratio
            w0 = plus(w0, down * b[0], u)
            w1 = plus(w1, down * b[1], u)
            w2 = plus(w2, down * b[2], u)
        values = of_mu + c0 + c1 + c2 + w0 + w1 + w2 + (of_factor, of_lower)
        for i in range(len(values)):
            out[n, i] = values[i]

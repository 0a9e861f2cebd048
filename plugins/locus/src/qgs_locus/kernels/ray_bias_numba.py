"""Numba kernels of `RayBias`, which pass once over all rays for each query.

A query is a row of five numbers (x, y, z, factor, lower): the anchor's centre mu = (x, y, z),
factor = gamma / (2 sigma^2) and lower = gamma * bias_min, with the weight gamma and bandwidth sigma
of the bias. A token is a column of six numbers: moment m and direction d of its ray.
"""

from qgs.kernels import ONE, TWO, ZERO, kernel
from qgs.kernels.projection import cross, dot, plus, vector


@kernel
def _query(row):
    """Return mu, factor and lower of a query."""
    return vector(row), row[3], row[4]


@kernel
def of_ray(tokens, first, j):
    """Return three numbers of ray j, from the number `first` on, as a vector."""
    # Not by `vector` of a slice, whose strides would keep the compiler from vectors of rays.
    return (tokens[first, j], tokens[first + 1, j], tokens[first + 2, j])


@kernel
def _ray(tokens, j):
    """Return moment m and direction d of ray j."""
    return of_ray(tokens, 0, j), of_ray(tokens, 3, j)


@kernel
def write(queries, tokens, out):
    """Write the bias max(-factor D^2, lower) of each query and token to `out`, (n, M).

    D = |mu x d - m| is the distance of the anchor's centre mu from the ray (moment m, direction d).
    """
    for n in range(queries.shape[0]):
        mu, factor, lower = _query(queries[n])
        row = out[n]
        for j in range(row.shape[0]):
            m, d = _ray(tokens, j)
            e = plus(cross(mu, d), -ONE, m)
            bias = -factor * dot(e, e)
            # Not max(): a NaN must stay, so that training sees it.
            row[j] = lower if bias <= lower else bias


@kernel
def gradients(queries, tokens, gradient, out):
    """Write the gradient of the loss with respect to each query's five numbers to `out`, (n, 5).

    gradient: gradient of the loss with respect to the bias (n, M). The bias depends on |e|^2 with
    e = mu x d - m. The gradient of |e|^2 with respect to the anchor's centre mu is 2 d x e.
    """
    for n in range(queries.shape[0]):
        mu, factor, lower = _query(queries[n])
        row = gradient[n]
        of_mu = (ZERO, ZERO, ZERO)
        of_factor = of_lower = ZERO
        for j in range(row.shape[0]):
            m, d = _ray(tokens, j)
            e = plus(cross(mu, d), -ONE, m)
            distance_sq = dot(e, e)
            # At the clamp the gradient goes to the bound, which contains gamma.
            inside = ZERO if -factor * distance_sq <= lower else row[j]
            of_mu = plus(of_mu, inside, cross(d, e))
            of_factor += inside * distance_sq
            of_lower += row[j] - inside
        for axis in range(3):
            out[n, axis] = -TWO * factor * of_mu[axis]
        out[n, 3] = -of_factor
        out[n, 4] = of_lower

"""Numba kernels of `RayBias`, which pass once over all rays for each query.

A query is a row of five numbers (x, y, z, factor, lower): the anchor's centre mu = (x, y, z),
factor = gamma / (2 sigma^2) and lower = gamma * bias_min, with the weight gamma and bandwidth sigma
of the bias. A token is a column of six numbers: moment m and direction d of its ray.
"""

from qgs.kernels import TWO, ZERO, kernel


@kernel
def _query(row):
    """Return x, y, z, factor and lower of a query."""
    return row[0], row[1], row[2], row[3], row[4]


@kernel
def _moment(x, y, z, t, j):
    """Return e = mu x d - m, the moment of ray j around the point mu = (x, y, z).

    t: columns of all tokens: moment m and direction d of a ray.
    """
    return (
        y * t[5, j] - z * t[4, j] - t[0, j],
        z * t[3, j] - x * t[5, j] - t[1, j],
        x * t[4, j] - y * t[3, j] - t[2, j],
    )


@kernel
def write(queries, tokens, out):
    """Write the bias max(-factor D^2, lower) of each query and token to `out`, (n, M).

    D = |mu x d - m| is the distance of the anchor's centre mu from the ray (moment m, direction d).
    """
    for n in range(queries.shape[0]):
        x, y, z, factor, lower = _query(queries[n])
        row = out[n]
        for j in range(row.shape[0]):
            e0, e1, e2 = _moment(x, y, z, tokens, j)
            bias = -factor * (e0 * e0 + e1 * e1 + e2 * e2)
            # Not max(): a NaN must stay, so that training sees it.
            row[j] = lower if bias <= lower else bias


@kernel
def gradients(queries, tokens, gradient, out):
    """Write the gradient of the loss with respect to each query's five numbers to `out`, (n, 5).

    gradient: gradient of the loss with respect to the bias (n, M). The bias depends on |e|^2 with
    e = mu x d - m. The gradient of |e|^2 with respect to the anchor's centre mu is 2 d x e.
    """
    for n in range(queries.shape[0]):
        x, y, z, factor, lower = _query(queries[n])
        row = gradient[n]
        of_x = of_y = of_z = of_factor = of_lower = ZERO
        for j in range(row.shape[0]):
            e0, e1, e2 = _moment(x, y, z, tokens, j)
            distance_sq = e0 * e0 + e1 * e1 + e2 * e2
            # At the clamp the gradient goes to the bound, which contains gamma.
            inside = ZERO if -factor * distance_sq <= lower else row[j]
            of_x += inside * (tokens[4, j] * e2 - tokens[5, j] * e1)
            of_y += inside * (tokens[5, j] * e0 - tokens[3, j] * e2)
            of_z += inside * (tokens[3, j] * e1 - tokens[4, j] * e0)
            of_factor += inside * distance_sq
            of_lower += row[j] - inside
        out[n, 0] = -TWO * factor * of_x
        out[n, 1] = -TWO * factor * of_y
        out[n, 2] = -TWO * factor * of_z
        out[n, 3] = -of_factor
        out[n, 4] = of_lower

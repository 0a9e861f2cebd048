"""Numba kernels of `qgs/cpu` that blend splats into sums of features, and their gradients.

A unit of work is a stripe of one image: several rows of tiles. The splats, sorted by depth, are
picked for the stripe, for each row of tiles, and for each tile of 16 x 16 pixels, where they are
blended, front to back. A row of a tile is 16 lanes (pixels) without branches, in a flat float32
buffer at constant offsets, so that LLVM can vectorise the lanes.

A splat has 9 float32 fields: pixel u, v; conic (inverse 2D covariance) xx, xy, yy; depth; half
extents in x and y (pixels; not positive for invisible splats); and the least exponent p at which
alpha = opacity * 2^p reaches alpha_min. An image has 5 sums over splats, w r, w g, w b, w z and w,
where w is the weight of a splat at a pixel, r, g, b its colour and z its depth.

For each row of a tile the buffer has 8 blocks of 16 lanes. Block 0 is the transmittance, or 0 where
the pixel takes no more splats. The other blocks are the sums (forward pass) or the values from
`_load_gradients` (backward pass).

The backward pass repeats the forward pass with the same skips. Let L be the loss, w_i the weight of
splat i, v_i = dL/dw_i, T_i the transmittance before splat i, and S_i the sum of w_j v_j over the
splats j behind it. Then dL/dalpha_i = T_i v_i - S_i / (1 - alpha_i).
"""

import numpy as np

from qgs.kernels import HALF, LOG2_E, ONE, TWO, ZERO, kernel

TILE = 16
SPLAT_FIELDS = 9
SUMS = 5
# Number of gradients: u, v, xx, xy, yy, depth, opacity, r, g, b.
GRADIENTS = 10

_LANES = np.uint64(TILE)
# Offsets of the blocks of lanes.
_BLOCKS = tuple(np.uint64(TILE * block) for block in range(8))
# Floats per row of a tile.
_ROW = 8 * TILE
_LAST_LANE = np.float32(TILE - 1)
# Splats from one check for open rows to the next.
_CHECK_EVERY = 16

_LOWEST = np.float32(-126)
# 2^f on [0, 1]: least-squares fit of degree 5, relative error 8e-8.
_C0, _C1, _C2, _C3, _C4, _C5 = (
    np.float32(c) for c in (0.99999993, 0.69315297, 0.24015453, 0.05582360, 0.00899258, 0.00187623)
)


@kernel
def _exp2(x):
    """Compute 2^x for float32 x in [-126, 0]."""
    whole = np.floor(x)
    f = x - whole
    mantissa = _C0 + f * (_C1 + f * (_C2 + f * (_C3 + f * (_C4 + f * _C5))))
    exponent = np.int32((np.int32(whole) + np.int32(127)) << np.int32(23))
    return mantissa * exponent.view(np.float32)


@kernel
def _edges(order, splats, axis):
    """Return both ends of the splats in `order` on an axis, in pixels. axis: 0 for u, 1 for v."""
    centers = splats[order, axis]
    halves = splats[order, 6 + axis]
    return centers - halves, centers + halves


@kernel
def _touching(order, edges, start, end):
    """Return the visible splats in `order` that touch pixels [start, end) of an axis.

    edges: the result of `_edges` for this order and axis.
    """
    first, last = edges
    touching = np.empty(len(order) + 1, np.int32)
    n = 0
    for i in range(len(order)):
        touching[n] = order[i]
        # Without `and`: a processor could not predict branches on what splats touch.
        visible = first[i] < last[i]
        n += visible & (last[i] > start) & (first[i] < end)
    return touching[:n]


@kernel
def _open(state, rows, columns):
    """Initialise `state`, the buffer of a tile: block 0 becomes 1 inside the image, all else 0.

    rows, columns: how many of the tile's rows and columns lie inside the image.
    """
    state[:] = ZERO
    state.reshape(TILE, _ROW)[:rows, :columns] = ONE


@kernel
def _is_open(state, live):
    """Set live[row] to whether a pixel of the row takes more splats; return `live.any()`."""
    for row in range(TILE):
        live[row] = state[row * _ROW :][:TILE].any()
    return live.any()


@kernel
def _take(state, i, dx, power_of, opacity, options):
    """Blend a splat into the pixel at offset `i` of the buffer `state`.

    Alpha is opacity * 2^power with power = (quadratic dx + linear) dx + constant, where dx is the
    distance of the pixel from the splat in x. power_of: (linear, quadratic, constant). Returns
    alpha before its limits, alpha, the transmittance before the splat, and the splat's weight.
    options: alpha_min, alpha_cap, transmittance_min.
    """
    linear, quadratic, constant = power_of
    alpha_min, alpha_cap, transmittance_min = options
    power = max(min((quadratic * dx + linear) * dx + constant, ZERO), _LOWEST)
    full = opacity * _exp2(power)
    before = state[i]
    alpha = min(full, alpha_cap) if full >= alpha_min else ZERO
    after = before - before * alpha
    taken = after > transmittance_min
    alpha = alpha if taken else ZERO
    state[i] = after if taken else ZERO
    return full, alpha, before, before * alpha


@kernel
def _blend_row(state, base, dx0, power_of, look, options):
    """Blend a splat into one row of a tile, at offset `base` of the buffer `state`.

    dx0: distance of the row's first pixel from the splat in x. look: opacity, r, g, b, depth.
    """
    opacity, r, g, b, z = look
    for lane in range(_LANES):
        i = base + lane
        _, _, _, weight = _take(state, i, dx0 + np.float32(lane), power_of, opacity, options)
        state[i + _BLOCKS[1]] += weight * r
        state[i + _BLOCKS[2]] += weight * g
        state[i + _BLOCKS[3]] += weight * b
        state[i + _BLOCKS[4]] += weight * z
        state[i + _BLOCKS[5]] += weight


@kernel
def _backward_row(state, base, totals, dx0, dy, power_of, look, options):
    """Repeat `_blend_row` and add the splat's gradients to `totals`, 7 blocks of 16 pixels.

    The blocks are h, h dy, h dy dy, then the gradients of depth, r, g, b. h is dL/ds with alpha =
    opacity * e^s. dy: distance of the pixel from the splat in y.
    """
    opacity, r, g, b, z = look
    for lane in range(_LANES):
        i = base + lane
        dx = dx0 + np.float32(lane)
        full, alpha, before, weight = _take(state, i, dx, power_of, opacity, options)
        g_r = state[i + _BLOCKS[2]]
        g_g = state[i + _BLOCKS[3]]
        g_b = state[i + _BLOCKS[4]]
        g_z = state[i + _BLOCKS[5]]
        z_here = z - state[i + _BLOCKS[7]]
        value = g_r * r + g_g * g + g_b * b + g_z * z_here + state[i + _BLOCKS[6]]
        rest = state[i + _BLOCKS[1]] - weight * value
        state[i + _BLOCKS[1]] = rest
        slope = before * value - rest / (ONE - alpha)
        h = slope * alpha if full <= options[1] else ZERO
        hy = h * dy
        totals[lane] += h
        totals[lane + _BLOCKS[1]] += hy
        totals[lane + _BLOCKS[2]] += hy * dy
        totals[lane + _BLOCKS[3]] += weight * g_z
        totals[lane + _BLOCKS[4]] += weight * g_r
        totals[lane + _BLOCKS[5]] += weight * g_g
        totals[lane + _BLOCKS[6]] += weight * g_b


@kernel
def _add_gradients(totals, dx0, xx, xy, yy, opacity, out):
    """Sum `totals` of `_backward_row` over its pixels and add the splat's gradients to `out` (10,).

    dx0: see `_blend_row`. Order of `out`: u, v, conic xx, xy, yy, depth, opacity, r, g, b.
    """
    h = ZERO
    hx = ZERO
    hy = ZERO
    hxx = ZERO
    hxy = ZERO
    hyy = ZERO
    for lane in range(TILE):
        # A lane has the same dx in all rows.
        dx = dx0 + np.float32(lane)
        h += totals[lane]
        hx += totals[lane] * dx
        hxx += totals[lane] * dx * dx
        hy += totals[TILE + lane]
        hxy += totals[TILE + lane] * dx
        hyy += totals[2 * TILE + lane]
    out[0] += xx * hx + xy * hy
    out[1] += xy * hx + yy * hy
    out[2] -= HALF * hxx
    out[3] -= hxy
    out[4] -= HALF * hyy
    out[6] += h / opacity
    for block, field in enumerate((5, 7, 8, 9), 3):
        total = ZERO
        for lane in range(TILE):
            total += totals[block * TILE + lane]
        out[field] += total


@kernel
def _load_gradients(state, sums, slopes, y0, x0, rows, columns):
    """Write what `_backward_row` needs of a tile to blocks 1 to 7 of the buffer `state`.

    The module explains the symbols. Block 1 gets the sum of w_j v_j over all splats j, blocks 2 to
    5 the gradients `slopes` of the first four sums, block 6 the gradient of the sum of w, block 7
    the pixel's depth. In v, z is replaced by z minus the pixel's depth. Otherwise large
    terms would cancel at nearly transparent pixels, and float32 gradients would be inaccurate.
    """
    for row in range(rows):
        for lane in range(columns):
            y = y0 + row
            x = x0 + lane
            base = row * _ROW + lane
            weight = sums[4, y, x]
            depth = sums[3, y, x] / weight if weight > ZERO else ZERO
            for channel in range(4):
                state[base + (2 + channel) * TILE] = slopes[channel, y, x]
            of_weight = slopes[4, y, x] + depth * slopes[3, y, x]
            rest = of_weight * weight
            for channel in range(3):
                rest += slopes[channel, y, x] * sums[channel, y, x]
            state[base + TILE] = rest
            state[base + 6 * TILE] = of_weight
            state[base + 7 * TILE] = depth


@kernel
def _rows_touched(splat, y0, dx0):
    """Return the first and the last row of a tile in which a splat's alpha reaches alpha_min.

    These pixels form an ellipse, xx dx^2 + 2 xy dx dy + yy dy^2 <= t. The rows are those of its
    part between the tile's first and last column; if there is none, the first row is after the
    last. splat: see the module. y0: the tile's first row. dx0: see `_blend_row`.
    """
    v, xx, xy, yy, ey, lowest = splat[1], splat[2], splat[3], splat[4], splat[7], splat[8]
    above = v - np.float32(y0) - HALF
    t = -TWO / LOG2_E * lowest
    # dx at the ellipse's least dy; minus this at its largest.
    side = xy / xx * (ey - HALF)
    bottom = _edge(min(max(-side, dx0), dx0 + _LAST_LANE), xx, xy, yy, t)
    # The ellipse is symmetric about its centre.
    top = -_edge(-min(max(side, dx0), dx0 + _LAST_LANE), xx, xy, yy, t)
    return max(0, int(np.ceil(above + top))), min(TILE - 1, int(np.floor(above + bottom)))


@kernel
def _edge(dx, xx, xy, yy, t):
    """Return the largest dy of the ellipse of `_rows_touched` at `dx`."""
    # The last term is above the rounding error of the determinant.
    square = yy * t - (xx * yy - xy * xy) * dx * dx + np.float32(5e-7) * xx * yy * dx * dx
    return (np.sqrt(max(square, ZERO)) - xy * dx) / yy


@kernel
def blend_unit(splats, order, opacities, colors, tile_rows, options, sums, slopes, out, backward):
    """Blend all G splats (G, 9) of one image in the tile rows [tile_rows[0], tile_rows[1]).

    If `backward` is false, fill sums (5, H, W). If it is true, read the sums and add the gradients
    of the splats to out (G, 10). order: indices (G,) of splats by ascending depth. slopes:
    gradients of `sums`. options: see `_take`.
    """
    height, width = sums.shape[1:]
    top, bottom = tile_rows[0] * TILE, min(tile_rows[1] * TILE, height)
    of_unit = _touching(order, _edges(order, splats, 1), top, bottom)
    row_edges = _edges(of_unit, splats, 1)
    state = np.empty(TILE * _ROW, np.float32)
    totals = np.empty(7 * TILE, np.float32)
    live = np.empty(TILE, np.bool_)
    for y0 in range(top, bottom, TILE):
        rows = min(TILE, height - y0)
        of_row = _touching(of_unit, row_edges, y0, y0 + rows)
        column_edges = _edges(of_row, splats, 0)
        for x0 in range(0, width, TILE):
            columns = min(TILE, width - x0)
            _open(state, rows, columns)
            if backward:
                _load_gradients(state, sums, slopes, y0, x0, rows, columns)
            of_tile = _touching(of_row, column_edges, x0, x0 + columns)
            for i in range(len(of_tile)):
                if i % _CHECK_EVERY == 0 and not _is_open(state, live):
                    break
                g = of_tile[i]
                splat = splats[g]
                dx0 = np.float32(x0) + HALF - splat[0]
                first, last = _rows_touched(splat, y0, dx0)
                if first > last:
                    continue
                xx, xy, yy = splat[2], splat[3], splat[4]
                look = opacities[g], colors[g, 0], colors[g, 1], colors[g, 2], splat[5]
                quadratic = -HALF * LOG2_E * xx
                if backward:
                    totals[:] = ZERO
                for row in range(first, last + 1):
                    if not live[row]:
                        continue
                    dy = np.float32(y0 + row) + HALF - splat[1]
                    linear = -LOG2_E * xy * dy
                    constant = -HALF * LOG2_E * yy * dy * dy
                    base = np.uint64(row * _ROW)
                    power = (linear, quadratic, constant)
                    if backward:
                        _backward_row(state, base, totals, dx0, dy, power, look, options)
                    else:
                        _blend_row(state, base, dx0, power, look, options)
                if backward:
                    _add_gradients(totals, dx0, xx, xy, yy, opacities[g], out[g])
            if not backward:
                blocks = state.reshape(TILE, 8, TILE)[:rows, 1 : 1 + SUMS, :columns]
                sums[:, y0 : y0 + rows, x0 : x0 + columns] = blocks.transpose(1, 0, 2)

"""Numba kernels of `qgs/cpu` that blend splats into sums of features, and their gradients.

A unit of work is a stripe of one image: several rows of tiles. First the splats that touch the
stripe are sorted by depth. Then the splats of each tile of 16 x 16 pixels are blended, front to
back. A row of a tile is 16 lanes (pixels) without branches, in a flat float32 buffer at constant
offsets, so that LLVM can vectorise the lanes.

A splat has 9 float32 fields: pixel u, v; conic (inverse 2D covariance) xx, xy, yy; depth; half
extents in x and y (pixels; not positive for invisible splats); and the least exponent p at which
alpha = opacity * 2^p reaches alpha_min. An image has 5 sums over splats, w r, w g, w b, w z and w,
where w is the weight of a splat at a pixel, r, g, b its colour and z its depth.

For each row of a tile the buffer has 9 blocks of 16 lanes. Block 0 is the transmittance. Block 1 is
1 while the pixel still takes splats, then 0. The other blocks are the sums (forward pass) or the
values from `_load_gradients` (backward pass).

The backward pass repeats the forward pass with the same skips. Let L be the loss, w_i the weight of
splat i, v_i = dL/dw_i, T_i the transmittance before splat i, and S_i the sum of w_j v_j over the
splats j behind it. Then dL/dalpha_i = T_i v_i - S_i / (1 - alpha_i).
"""

import numpy as np

from qgs.kernels import HALF, LOG2_E, ONE, ZERO, kernel

TILE = 16
SPLAT_FIELDS = 9
SUMS = 5
# Number of gradients: u, v, xx, xy, yy, depth, opacity, r, g, b.
GRADIENTS = 10

_LANES = np.uint64(TILE)
# Offsets of the blocks of lanes.
_BLOCKS = tuple(np.uint64(TILE * block) for block in range(10))
# Floats per row of a tile.
_ROW = 9 * TILE
_STATE = np.uint64(_ROW)
_LAST_LANE = np.float32(TILE - 1)
# Splats between two checks for open rows.
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
def _by_depth(splats, top, bottom, width):
    """Return the indices of splats that touch image rows [top, bottom), by ascending depth.

    Splats of equal depth keep their order. width: image width in pixels.
    """
    count = splats.shape[0]
    order = np.empty(count, np.int32)
    n = 0
    for g in range(count):
        u = splats[g, 0]
        v = splats[g, 1]
        ex = splats[g, 6]
        ey = splats[g, 7]
        if ex > 0 and v + ey > top and v - ey < bottom and u + ex > 0 and u - ex < width:
            order[n] = g
            n += 1
    order = order[:n]
    return order[np.argsort(splats[order, 5], kind="mergesort")]


@kernel
def _touching_rows(order, splats, top, bottom, out):
    """Write the splats in `order` that touch rows [top, bottom) to `out`; return their number."""
    n = 0
    for i in range(order.shape[0]):
        g = order[i]
        v = splats[g, 1]
        ey = splats[g, 7]
        out[n] = g
        # No branch: a processor could not predict which splats touch the rows.
        n += 1 if v + ey > top and v - ey < bottom else 0
    return n


@kernel
def _open(state, live, rows, columns):
    """Initialise `state`, the buffer of a tile (see the module), and `live`, a flag for each row.

    Block 0 becomes 1, block 1 becomes 1 inside the image, all else 0. live: becomes True for each
    tile row inside the image. rows, columns: how many of the tile's rows and columns lie inside the
    image.
    """
    state[:] = ZERO
    state.reshape(TILE, _ROW)[:rows, : TILE + columns] = ONE
    live[:] = False
    live[:rows] = True


@kernel
def _close_rows(state, live):
    """Set live[row] to False if no pixel of the row takes more splats; return `live.any()`."""
    for row in range(TILE):
        live[row] = state[row * _ROW + TILE :][:TILE].any()
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
    live = state[i + _BLOCKS[1]]
    alpha = min(full, alpha_cap) if full >= alpha_min else ZERO
    live = live if before - before * alpha > transmittance_min else ZERO
    alpha = alpha * live
    weight = before * alpha
    state[i] = before - weight
    state[i + _BLOCKS[1]] = live
    return full, alpha, before, weight


@kernel
def _blend_row(state, base, dx0, power_of, look, options):
    """Blend a splat into one row of a tile, at offset `base` of the buffer `state`.

    dx0: distance of the row's first pixel from the splat in x. look: opacity, r, g, b, depth.
    """
    opacity, r, g, b, z = look
    for lane in range(_LANES):
        i = base + lane
        _, _, _, weight = _take(state, i, dx0 + np.float32(lane), power_of, opacity, options)
        state[i + _BLOCKS[2]] += weight * r
        state[i + _BLOCKS[3]] += weight * g
        state[i + _BLOCKS[4]] += weight * b
        state[i + _BLOCKS[5]] += weight * z
        state[i + _BLOCKS[6]] += weight


@kernel
def _backward_row(state, base, totals, dx0, dy, power_of, look, options):
    """Repeat `_blend_row` and add the splat's gradients to `totals`, 10 blocks of 16 pixels.

    The blocks are h, h dx, h dy, h dx dx, h dx dy, h dy dy, then the gradients of depth, r, g, b.
    h is dL/ds with alpha = opacity * e^s. dx, dy: distance of the pixel from the splat.
    """
    opacity, r, g, b, z = look
    for lane in range(_LANES):
        i = base + lane
        dx = dx0 + np.float32(lane)
        full, alpha, before, weight = _take(state, i, dx, power_of, opacity, options)
        g_r = state[i + _BLOCKS[3]]
        g_g = state[i + _BLOCKS[4]]
        g_b = state[i + _BLOCKS[5]]
        g_z = state[i + _BLOCKS[6]]
        z_here = z - state[i + _BLOCKS[8]]
        value = g_r * r + g_g * g + g_b * b + g_z * z_here + state[i + _BLOCKS[7]]
        rest = state[i + _BLOCKS[2]] - weight * value
        state[i + _BLOCKS[2]] = rest
        slope = before * value - rest / (ONE - alpha)
        h = slope * alpha if full <= options[1] else ZERO
        hx = h * dx
        hy = h * dy
        totals[lane] += h
        totals[lane + _BLOCKS[1]] += hx
        totals[lane + _BLOCKS[2]] += hy
        totals[lane + _BLOCKS[3]] += hx * dx
        totals[lane + _BLOCKS[4]] += hx * dy
        totals[lane + _BLOCKS[5]] += hy * dy
        totals[lane + _BLOCKS[6]] += weight * g_z
        totals[lane + _BLOCKS[7]] += weight * g_r
        totals[lane + _BLOCKS[8]] += weight * g_g
        totals[lane + _BLOCKS[9]] += weight * g_b


@kernel
def _add_gradients(totals, xx, xy, yy, opacity, out):
    """Sum `totals` of `_backward_row` over its pixels and add the splat's gradients to `out` (10,).

    Order of `out`: u, v, conic xx, xy, yy, depth, opacity, r, g, b.
    """
    t = np.empty(GRADIENTS, np.float32)
    for block in range(GRADIENTS):
        total = ZERO
        for lane in range(TILE):
            total += totals[block * TILE + lane]
        t[block] = total
    out[0] += xx * t[1] + xy * t[2]
    out[1] += xy * t[1] + yy * t[2]
    out[2] -= HALF * t[3]
    out[3] -= t[4]
    out[4] -= HALF * t[5]
    out[5] += t[6]
    out[6] += t[0] / opacity
    for channel in range(3):
        out[7 + channel] += t[7 + channel]


@kernel
def _load_gradients(state, sums, slopes, y0, x0, rows, columns):
    """Write what `_backward_row` needs of a tile to blocks 2 to 8 of the buffer `state`.

    The module explains the symbols. Block 2 gets the sum of w_j v_j over all splats j, blocks 3 to
    6 the gradients `slopes` of the first four sums, block 7 the gradient of the sum of w, block 8
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
                state[base + (3 + channel) * TILE] = slopes[channel, y, x]
            of_weight = slopes[4, y, x] + depth * slopes[3, y, x]
            rest = of_weight * weight
            for channel in range(3):
                rest += slopes[channel, y, x] * sums[channel, y, x]
            state[base + 2 * TILE] = rest
            state[base + 7 * TILE] = of_weight
            state[base + 8 * TILE] = depth


@kernel
def _rows_within(above, reach):
    """Return the first and the last of those rows of a tile that lie within `reach` of a splat.

    reach: largest distance in pixels from a row's pixel centres to the splat's centre, in y. above:
    distance in pixels from the pixel centres of the tile's first row down to the splat's centre.
    """
    first = max(0, int(np.ceil(above - reach)))
    last = min(TILE - 1, int(np.floor(above + reach)))
    return first, last


@kernel
def _store_sums(state, sums, y0, x0, rows, columns):
    blocks = state.reshape(TILE, 9, TILE)[:rows, 2 : 2 + SUMS, :columns]
    sums[:, y0 : y0 + rows, x0 : x0 + columns] = blocks.transpose(1, 0, 2)


@kernel
def blend_unit(splats, opacities, colors, tile_rows, options, sums, slopes, out, backward):
    """Blend all G splats (G, 9) of one image in the tile rows [tile_rows[0], tile_rows[1]).

    If `backward` is false, fill sums (5, H, W). If it is true, read the sums and add the gradients
    of the splats to out (G, 10). slopes: gradients of `sums`. options: see `_take`.
    """
    height, width = sums.shape[1:]
    top, bottom = tile_rows[0] * TILE, min(tile_rows[1] * TILE, height)
    order = _by_depth(splats, top, bottom, width)
    row_order = np.empty(order.shape[0] + 1, np.int32)
    state = np.empty(TILE * _ROW, np.float32)
    totals = np.empty(GRADIENTS * TILE, np.float32)
    live = np.empty(TILE, np.bool_)
    for y0 in range(top, bottom, TILE):
        rows = min(TILE, height - y0)
        n = _touching_rows(order, splats, y0, y0 + rows, row_order)
        for x0 in range(0, width, TILE):
            columns = min(TILE, width - x0)
            _open(state, live, rows, columns)
            if backward:
                _load_gradients(state, sums, slopes, y0, x0, rows, columns)
            since_check = 0
            for i in range(n):
                g = row_order[i]
                u, v, ex, ey = splats[g, 0], splats[g, 1], splats[g, 6], splats[g, 7]
                if u + ex <= x0 or u - ex >= x0 + columns:
                    continue
                xx, xy, yy = splats[g, 2], splats[g, 3], splats[g, 4]
                look = opacities[g], colors[g, 0], colors[g, 1], colors[g, 2], splats[g, 5]
                first, last = _rows_within(v - np.float32(y0) - HALF, ey)
                dx0 = np.float32(x0) + HALF - u
                quadratic = -HALF * LOG2_E * xx
                lean = -xy / xx  # the peak of a row moves by lean dy
                touched = False
                for row in range(first, last + 1):
                    if not live[row]:
                        continue
                    dy = np.float32(y0 + row) + HALF - v
                    linear = -LOG2_E * xy * dy
                    constant = -HALF * LOG2_E * yy * dy * dy
                    # If the largest power over all lanes is too low, skip the row.
                    peak = min(max(lean * dy, dx0), dx0 + _LAST_LANE)
                    if (quadratic * peak + linear) * peak + constant < splats[g, 8]:
                        continue
                    base = np.uint64(row) * _STATE
                    power = (linear, quadratic, constant)
                    if not backward:
                        _blend_row(state, base, dx0, power, look, options)
                        continue
                    if not touched:
                        totals[:] = ZERO
                        touched = True
                    _backward_row(state, base, totals, dx0, dy, power, look, options)
                if touched:
                    _add_gradients(totals, xx, xy, yy, opacities[g], out[g])
                since_check += 1
                if since_check % _CHECK_EVERY == 0 and not _close_rows(state, live):
                    break
            if not backward:
                _store_sums(state, sums, y0, x0, rows, columns)

"""Numba kernels of `qgs/cpu` that project Gaussians to splats, and their gradients.

The formulas are those of `qgs.renderers.reference.project`; tests compare values and gradients with
that function. A unit of work is a range of one scene's Gaussians in all views of the scene, so that
gradients are summed over views in a fixed order. Vectors are tuples; a matrix is a tuple of rows.

Symbols: m, R and S are the mean, rotation and diagonal scales of a Gaussian; F = R S is the factor
of its covariance F F^T. C and p are the rotation and position of the camera's c2w, and W = C^T. In
the camera's frame, the mean is W (m - p) and the factor is W F. J is the Jacobian of the projection
to pixels, L the loss.
"""

import numpy as np

from qgs.kernels import HALF, LOG2_E, ONE, TWO, ZERO, kernel

# Number of gradients: C by rows, p, fx, fy, cx, cy.
CAMERA_GRADIENTS = 16

# A quaternion's norm is at least this, as in F.normalize.
_SHORTEST = np.float32(1e-12)
# Added to a power of 2 against rounding.
_SLACK = np.float32(0.05)
# Half extent in pixels that still converts to an integer.
_LARGEST = np.float32(1e9)


@kernel
def dot(a, b):
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a, b):
    """Return the cross product of two vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@kernel
def plus(a, s, b):
    """Return a + s b for vectors a, b and a number s."""
    return (a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2])


@kernel
def _times(s, a):
    return (s * a[0], s * a[1], s * a[2])


@kernel
def combine(a, rows):
    """Return the sum of `rows`, weighted by the entries of the vector `a`."""
    return plus(plus(_times(a[0], rows[0]), a[1], rows[1]), a[2], rows[2])


@kernel
def _columns(m):
    return (
        (m[0][0], m[1][0], m[2][0]), (m[0][1], m[1][1], m[2][1]), (m[0][2], m[1][2], m[2][2]),
    )  # fmt: skip


@kernel
def vector(array):
    """Return the first three numbers of an array as a vector."""
    return (array[0], array[1], array[2])


@kernel
def _four(row):
    return row[0], row[1], row[2], row[3]


@kernel
def _rotation(quat):
    """Return the rotation matrix, the normalised quaternion, and the norm of `quat`."""
    w, x, y, z = _four(quat)
    norm = max(np.sqrt(w * w + x * x + y * y + z * z), _SHORTEST)
    w = w / norm
    x = x / norm
    y = y / norm
    z = z / norm
    rows = (
        (ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y)),
        (TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x)),
        (TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y)),
    )
    return rows, (w, x, y, z), norm


@kernel
def _scaled_columns(rows, scale):
    """Return the columns of R S from the rows of the rotation R and the three scales S."""
    columns = _columns(rows)
    return (
        _times(scale[0], columns[0]), _times(scale[1], columns[1]), _times(scale[2], columns[2]),
    )  # fmt: skip


@kernel
def dots(a, rows):
    """Return the product of the matrix `rows` and the vector `a`."""
    return (dot(rows[0], a), dot(rows[1], a), dot(rows[2], a))


@kernel
def _axis(axis, seen, turned, focal, principal, size, margin):
    """Return x/z of the mean, x/z clamped, and the row of J W R S of an image axis (0: x, 1: y).

    For the image axis y, x/z means y/z. seen: mean (x, y, z) in the camera's frame. turned: rows of
    W R S; the module explains the symbols. margin: fraction of the image size by which x/z may lie
    outside of the image before it is clamped.
    """
    slope = seen[axis] / seen[2]
    low = (-margin * size - principal) / focal
    high = (size + margin * size - principal) / focal
    held = min(max(slope, low), high)
    return slope, held, _times(focal / seen[2], plus(turned[axis], -held, turned[2]))


@kernel
def _view(c2w, lens, mean, factor, margin, height, width):
    """Return a Gaussian in a camera's frame: (C, m - p, W (m - p), W R S, x axis, y axis).

    The module explains the symbols. lens: fx, fy, cx, cy. mean: m. factor: columns of R S. The two
    axes are results of `_axis`.
    """
    pose = (vector(c2w[0]), vector(c2w[1]), vector(c2w[2]))
    offset = plus(vector(mean), -ONE, (c2w[0, 3], c2w[1, 3], c2w[2, 3]))
    seen = combine(offset, pose)
    axes = _columns(pose)
    # Rows of C^T F.
    turned = (dots(axes[0], factor), dots(axes[1], factor), dots(axes[2], factor))
    fx, fy, cx, cy = _four(lens)
    x_axis = _axis(0, seen, turned, fx, cx, width, margin)
    y_axis = _axis(1, seen, turned, fy, cy, height, margin)
    return pose, offset, seen, turned, x_axis, y_axis


@kernel
def project_unit(means, scales, quats, c2w, lenses, opacities, bounds, limits, splats):
    """Fill `splats` (V, G, 9), views by Gaussians, for a range of Gaussians of one scene.

    means (G, 3), scales (G, 3), quats (G, 4), c2w (V, 4, 4), lenses (V, 4): fx, fy, cx, cy,
    opacities (G,). bounds: (first, last) index of the range, `last` excluded. limits: near, far,
    dilation, alpha_min, margin of `_axis`, height, width. `qgs.kernels.rasterisation` lists the 9
    fields of a splat. A splat ends at the Mahalanobis distance sqrt(2 ln(opacity / alpha_min)),
    where its alpha falls to alpha_min. Half a pixel is added to its extents, against rounding.
    """
    near, far, dilation, alpha_min, margin, height, width = limits
    for g in range(bounds[0], bounds[1]):
        rows, _, _ = _rotation(quats[g])
        factor = _scaled_columns(rows, vector(scales[g]))
        opacity = opacities[g]
        fall = max(np.log(opacity / alpha_min), ZERO)
        reach = np.sqrt(TWO * fall)
        lowest = -LOG2_E * fall - _SLACK
        for v in range(len(c2w)):
            _, _, seen, _, (x, _, row_x), (y, _, row_y) = _view(
                c2w[v], lenses[v], means[g], factor, margin, height, width
            )
            fx, fy, cx, cy = _four(lenses[v])
            z = seen[2]
            out = splats[v, g]
            out[6] = ZERO
            out[7] = ZERO
            # Written so that NaN is dropped too.
            if not (opacity >= alpha_min and z >= near and z <= far):
                out[5] = ONE
                continue
            xx = dot(row_x, row_x)
            xy = dot(row_x, row_y)
            yy = dot(row_y, row_y)
            minors = cross(row_x, row_y)
            # Cauchy-Binet: unlike xx * yy - xy^2 this does not cancel for needles.
            determinant = dot(minors, minors) + dilation * (xx + yy) + dilation * dilation
            out[0] = cx + fx * x
            out[1] = cy + fy * y
            out[5] = z
            if not (determinant > ZERO and determinant < np.float32(np.inf)):
                continue
            out[2] = (yy + dilation) / determinant
            out[3] = -xy / determinant
            out[4] = (xx + dilation) / determinant
            out[8] = lowest
            out[6] = min(reach * np.sqrt(xx + dilation) + HALF, _LARGEST)
            out[7] = min(reach * np.sqrt(yy + dilation) + HALF, _LARGEST)


@kernel
def _covariance_slopes(row_x, row_y, splat, given, dilation):
    """Return the gradients of `row_x` and `row_y`, given the gradients of a splat's fields.

    row_x, row_y: rows of J W R S for the image axes x and y; the module explains the symbols.
    splat: the splat's fields; fields 2 to 4 are the conic (inverse 2D covariance). given: gradients
        of the fields.
    """
    xx = dot(row_x, row_x)
    yy = dot(row_y, row_y)
    minors = cross(row_x, row_y)
    inverse = ONE / (dot(minors, minors) + dilation * (xx + yy) + dilation * dilation)
    of_determinant = -inverse * (given[2] * splat[2] + given[3] * splat[3] + given[4] * splat[4])
    of_xx = TWO * (given[4] * inverse + dilation * of_determinant)
    of_xy = -given[3] * inverse
    of_yy = TWO * (given[2] * inverse + dilation * of_determinant)
    of_minors = _times(TWO * of_determinant, minors)
    of_row_x = plus(plus(cross(row_y, of_minors), of_xx, row_x), of_xy, row_y)
    of_row_y = plus(plus(cross(of_minors, row_x), of_yy, row_y), of_xy, row_x)
    return of_row_x, of_row_y


@kernel
def _axis_slopes(axis, focal, z, of_row, turned_z, of_pixel):
    """Return the gradients of the loss with respect to six inputs of `_axis`, for one image axis.

    The inputs are x (or y) of the camera-frame mean, its z, focal length, principal point, row x
    (or y) of W R S, and row z of W R S. axis: the result of `_axis`. of_row: gradient of the row of
    J W R S. of_pixel: gradient of the pixel coordinate. turned_z: row z of W R S.
    """
    slope, held, row = axis
    gain = focal / z
    of_turned = _times(gain, of_row)
    of_turned_z = _times(-held, of_turned)
    of_held = -dot(of_turned, turned_z)
    of_gain = dot(of_row, row)
    of_focal = of_gain / focal + of_pixel * slope
    of_principal = of_pixel
    of_slope = focal * of_pixel
    # At (border - principal) / focal.
    if held != slope:
        of_focal -= of_held * held / focal
        of_principal -= of_held / focal
    else:
        of_slope += of_held
    of_position = of_slope / z
    of_z = -of_gain / z - of_position * slope
    return of_position, of_z, of_focal, of_principal, of_turned, of_turned_z


@kernel
def _quat_slopes(quat, norm, m, out):
    """Write the gradient of a quaternion before its normalisation to `out` (4,).

    quat: normalised quaternion. norm: norm before the normalisation. m: gradient of the rotation
        matrix.
    """
    w, x, y, z = quat
    yz = m[2][1] - m[1][2]
    zx = m[0][2] - m[2][0]
    xy = m[1][0] - m[0][1]
    s_yz = m[2][1] + m[1][2]
    s_zx = m[0][2] + m[2][0]
    s_xy = m[1][0] + m[0][1]
    of_w = TWO * (x * yz + y * zx + z * xy)
    of_x = TWO * (w * yz + y * s_xy + z * s_zx - TWO * x * (m[1][1] + m[2][2]))
    of_y = TWO * (w * zx + x * s_xy + z * s_yz - TWO * y * (m[0][0] + m[2][2]))
    of_z = TWO * (w * xy + x * s_zx + y * s_yz - TWO * z * (m[0][0] + m[1][1]))
    along = w * of_w + x * of_x + y * of_y + z * of_z if norm > _SHORTEST else ZERO
    out[0] = (of_w - along * w) / norm
    out[1] = (of_x - along * x) / norm
    out[2] = (of_y - along * y) / norm
    out[3] = (of_z - along * z) / norm


@kernel
def _add_camera(out, offset, factor_rows, of_seen, of_turned, of_mean, of_lens):
    """Add one splat's gradients of camera parameters to `out` (16,).

    Order of `out`: rotation C by rows, position p, fx, fy, cx, cy. Arguments `of_...` are gradients
    of the splat's values.
    """
    for i in range(3):
        for j in range(3):
            out[3 * i + j] += offset[i] * of_seen[j] + dot(factor_rows[i], of_turned[j])
        out[9 + i] -= of_mean[i]
    for i in range(4):
        out[12 + i] += of_lens[i]


@kernel
def project_backward_unit(
    means, scales, quats, c2w, lenses, bounds, limits, splats, given, wants_cameras,
    of_means, of_scales, of_quats, of_opacities, of_cameras,
):  # fmt: skip
    """Compute gradients of the inputs of `project_unit` from the gradients of its splats.

    given: gradients (V, G, 10) of the rasteriser: views, Gaussians. Writes the gradients of_means
        (G, 3), of_scales (G, 3), of_quats (G, 4) and of_opacities (G,). If `wants_cameras` is true,
        it adds the gradients of cameras to of_cameras (V, 16), in the order of `_add_camera`.
    """
    _, _, dilation, _, margin, height, width = limits
    zeros = (ZERO, ZERO, ZERO)
    for g in range(bounds[0], bounds[1]):
        rows, quat, norm = _rotation(quats[g])
        scale = vector(scales[g])
        factor = _scaled_columns(rows, scale)
        of_mean = zeros
        of_opacity = ZERO
        of_factor = (zeros, zeros, zeros)
        for v in range(len(c2w)):
            splat = splats[v, g]
            if not splat[6] > ZERO:
                continue
            slopes = given[v, g]
            of_opacity += slopes[6]
            pose, offset, seen, turned, x_axis, y_axis = _view(
                c2w[v], lenses[v], means[g], factor, margin, height, width
            )
            fx, fy, _, _ = _four(lenses[v])
            of_row_x, of_row_y = _covariance_slopes(x_axis[2], y_axis[2], splat, slopes, dilation)
            of_x, z_x, of_fx, of_cx, of_turned_x, turned_z_x = _axis_slopes(
                x_axis, fx, seen[2], of_row_x, turned[2], slopes[0]
            )
            of_y, z_y, of_fy, of_cy, of_turned_y, turned_z_y = _axis_slopes(
                y_axis, fy, seen[2], of_row_y, turned[2], slopes[1]
            )
            of_seen = (of_x, of_y, z_x + z_y + slopes[5])
            of_turned = (of_turned_x, of_turned_y, plus(turned_z_x, ONE, turned_z_y))
            of_offset = dots(of_seen, pose)
            of_mean = plus(of_mean, ONE, of_offset)
            of_factor = (
                plus(of_factor[0], ONE, combine(pose[0], of_turned)),
                plus(of_factor[1], ONE, combine(pose[1], of_turned)),
                plus(of_factor[2], ONE, combine(pose[2], of_turned)),
            )
            if wants_cameras:
                _add_camera(
                    of_cameras[v], offset, _columns(factor), of_seen, of_turned, of_offset,
                    (of_fx, of_fy, of_cx, of_cy),
                )  # fmt: skip
        of_opacities[g] = of_opacity
        of_columns, axes = _columns(of_factor), _columns(rows)
        for i in range(3):
            of_means[g, i] = of_mean[i]
            of_scales[g, i] = dot(of_columns[i], axes[i])
        _quat_slopes(quat, norm, _columns(_scaled_columns(of_factor, scale)), of_quats[g])

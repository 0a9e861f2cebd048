"""Numba kernel of `qgs.similarity` for the sum of SSIM over an image plane, and its gradient.

The formula is that of `qgs.similarity.similarity_map`; tests compare values and gradients.
"""

import numpy as np

from qgs.kernels import ONE, TWO, ZERO, kernel

_REACH = 5


@kernel
def _windowed(planes, row, weights, framed, out):
    """Write weighted means over windows around each pixel of one image row to `out` (N, W).

    planes: N planes (N, H, W), taken as zero outside. row: number of the image row. weights:
        weights of pixels at distances 0 to _REACH from the window's centre. framed: working memory
        (N, W + 2 _REACH).
    """
    parts, height, width = planes.shape
    framed[:] = ZERO
    for part in range(parts):
        for other in range(max(row - _REACH, 0), min(row + _REACH + 1, height)):
            weight = weights[abs(other - row)]
            for column in range(width):
                framed[part, column + _REACH] += weight * planes[part, other, column]
        for column in range(width):
            at = column + _REACH
            mean = weights[0] * framed[part, at]
            for k in range(1, _REACH + 1):
                mean += weights[k] * (framed[part, at - k] + framed[part, at + k])
            out[part, column] = mean


@kernel
def similarity_sum(moments, weights, stabilisers, slope):
    """Return the sum of SSIM of planes x and y over all pixels; write its gradient in x to `slope`.

    moments: (4, H, W) with x, y, x^2 + y^2 and x y. weights: window weights as in `_windowed`.
        stabilisers: the constants C1 and C2 of SSIM. slope: (H, W).
    """
    (_, height, width), (c1, c2), total = moments.shape, stabilisers, 0.0
    framed = np.empty((4, width + 2 * _REACH), np.float32)
    means = np.empty((4, width), np.float32)
    # Slopes with respect to the means of x, of squares, of x y.
    slopes = np.empty((3, height, width), np.float32)
    for row in range(height):
        _windowed(moments, row, weights, framed, means)
        of_row = ZERO
        for column in range(width):
            a = means[0, column]
            b = means[1, column]
            energy = a * a + b * b
            luminance = TWO * a * b + c1
            structure = TWO * (means[3, column] - a * b) + c2
            bright = energy + c1
            spread = means[2, column] - energy + c2
            inverse = ONE / (bright * spread)
            value = luminance * structure * inverse
            of_mean = b * (structure - luminance) * inverse
            of_row += value
            slopes[0, row, column] = TWO * (of_mean + a * value * (ONE / spread - ONE / bright))
            slopes[1, row, column] = -value / spread
            slopes[2, row, column] = TWO * luminance * inverse
        total += of_row
    for row in range(height):
        _windowed(slopes, row, weights, framed, means)
        for column in range(width):
            of_squares = means[0, column] + TWO * moments[0, row, column] * means[1, column]
            slope[row, column] = of_squares + moments[1, row, column] * means[2, column]
    return total

"""Rows of numbers that describe shapes, textures, lights and air to the ray caster.

World frame: metres, z up. A shape is a primitive in a frame of its own, in which it fits the cube
[-1, 1]^3 (a capsule is longer), less a second convex primitive, if it has one.
"""

from dataclasses import dataclass

import numpy as np

ELLIPSOID, BOX, FRUSTUM, CAPSULE, TORUS, HEIGHT = range(6)
NOTHING = -1  # kind of the second primitive of a shape that has none

# Fields of a primitive: kind, one more number, the matrix from world to local, centre, half sizes.
# The number is a frustum's upper radius, half a capsule's length, both by the radius, the thickness
# of a torus by its outer radius, or the index of a height map.
KIND, EXTRA, MATRIX, CENTER, HALF, PRIMITIVE_FIELDS = 0, 1, 2, 11, 14, 17
# Fields of a shape: two primitives, bounding sphere x y z r, half extents of the first primitive in
# its frame, first texture, number of textures, texture of the cut, metres per unit of a texture.
SPHERE, EXTENT, TEXTURE, FACES, CUT_TEXTURE, SCALE, SHAPE_FIELDS = 34, 38, 41, 42, 43, 44, 45

VALUE, GRADIENT, CELLS = range(3)  # kinds of noise
NO_PATTERN, STRIPES, CHECKER, TILES, DOTS, GLYPHS, RINGS = range(7)
# Fields of a texture. Periods are in units of the texture.
(SEED, BASIS, PERIOD, OCTAVES, GAIN, CONTRAST, WARP, STRETCH, PATTERN, PATTERN_PERIOD, ASPECT,
 WIDTH, STRENGTH, TONE, SPECULAR, SHINE, COLORS) = range(17)  # fmt: skip
TEXTURE_FIELDS = COLORS + 12  # RGB of four colours: three of the ramp, one of the pattern

# Fields of a light: whether it is a lamp, its position or the direction to the sun, RGB, whether it
# throws shadows: 0, or the number of its first map plus 1.
LAMP, PLACE, COLOR, SHADOWS, LIGHT_FIELDS = 0, 1, 4, 7, 8
# Fields of the air: ambient RGB from above and from below, RGB of the sky overhead and at the
# horizon, fog per metre, clouds, seed, strength and reach of the ambient occlusion.
ABOVE, BELOW, ZENITH, HORIZON, FOG, CLOUDS, AIR_SEED, OCCLUSION, REACH, AIR_FIELDS = (
    0, 3, 6, 9, 12, 13, 14, 15, 16, 17,
)  # fmt: skip
# Fields of the camera: gains of R, G and B, exponent of the tone curve, darkening towards the
# corners, deviation of noise, seed of the noise.
GAINS, GAMMA, VIGNETTE, NOISE, NOISE_SEED, EFFECT_FIELDS = 0, 3, 4, 5, 6, 7


@dataclass(frozen=True)
class World:
    """A scene, ready to be cast.

    shapes: (S, SHAPE_FIELDS) float32. heights: (K, G, G) float32 in [-1, 1]. textures:
    (T, TEXTURE_FIELDS), lights: (L, LIGHT_FIELDS), air: (AIR_FIELDS,), all float64. maps, depths,
    codes: the shadow maps (`shadow_maps`), to which lights point.
    """

    shapes: np.ndarray
    heights: np.ndarray
    textures: np.ndarray
    lights: np.ndarray
    air: np.ndarray
    maps: np.ndarray
    depths: np.ndarray
    codes: np.ndarray

    def packed(self) -> tuple[object, ...]:
        """The arrays as kernels take them."""
        shades = (self.maps, self.depths, self.codes)
        return self.shapes, self.heights, self.textures, self.lights, self.air, shades

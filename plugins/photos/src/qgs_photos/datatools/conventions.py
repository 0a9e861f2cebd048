"""How a format writes poses, and what other ways of writing them look like when it is read."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_HALF_TURN = np.diag([-1.0, 1.0, -1.0, 1.0])  # about the camera's y axis
_RIGHT_UP_BACK = np.eye(4)[:, [1, 0, 2, 3]] * [1, -1, 1, 1]  # columns read as LLFF's
_RIGHT_DOWN_FORWARD = np.eye(4)[:, [1, 0, 2, 3]] * [1, 1, -1, 1]


@dataclass(frozen=True)
class Misreading:
    """What poses may have been meant as. axes: (4, 4), the OpenCV axes meant, by those read."""

    reason: str
    fix: str
    axes: np.ndarray = field(default_factory=lambda: np.eye(4))
    inverted: bool = False

    def meant(self, pose: np.ndarray) -> np.ndarray:
        """The OpenCV camera-to-world (4, 4) that was meant by one that was read."""
        return (np.linalg.inv(pose) if self.inverted else pose) @ self.axes


Convention = Mapping[str, Misreading]
"""A pose convention: by name, the mistakes that files of this convention often have."""

OPENGL: Convention = {
    "flipped": Misreading(
        "these look like OpenCV poses read as OpenGL",
        "negate columns 1 and 2 (the camera's y and z axes) of every transform_matrix",
        _FLIP,
    ),
    "inverted": Misreading(
        "these look like OpenCV world-to-camera matrices read as OpenGL camera-to-world",
        "invert every transform_matrix, then negate its columns 1 and 2",
        inverted=True,
    ),
    "inverted and flipped": Misreading(
        "these look like world-to-camera matrices read as camera-to-world",
        "invert every transform_matrix",
        _FLIP,
        inverted=True,
    ),
}
"""OpenGL camera-to-world: transforms.json of nerfstudio, Blender and DL3DV."""

OPENCV: Convention = {
    "flipped": Misreading(
        "these look like OpenGL poses read as OpenCV",
        "negate rows 1 and 2 (the camera's y and z axes) of every world-to-camera matrix",
        _FLIP,
    ),
    "inverted": Misreading(
        "these look like camera-to-world matrices read as world-to-camera",
        "invert every matrix",
        inverted=True,
    ),
    "inverted and flipped": Misreading(
        "these look like OpenGL camera-to-world matrices read as OpenCV world-to-camera",
        "negate columns 1 and 2 of every matrix, then invert it",
        _FLIP,
        inverted=True,
    ),
}
"""OpenCV world-to-camera: chunks and COLMAP models."""

OPENCV_C2W: Convention = {
    "flipped": Misreading(
        "these look like OpenGL poses read as OpenCV",
        "negate columns 1 and 2 (the camera's y and z axes) of every camera-to-world matrix",
        _FLIP,
    ),
    "inverted": Misreading(
        "these look like world-to-camera matrices read as camera-to-world",
        "invert every matrix",
        inverted=True,
    ),
    "inverted and flipped": Misreading(
        "these look like OpenGL world-to-camera matrices read as OpenCV camera-to-world",
        "invert every matrix, then negate its columns 1 and 2",
        _FLIP,
        inverted=True,
    ),
}
"""OpenCV camera-to-world: cameras.json."""

LLFF: Convention = {
    "OpenGL axes": Misreading(
        "these look like OpenGL poses (axes right, up, back), not LLFF's (down, right, back)",
        "write the columns as (-up, right, back)",
        _RIGHT_UP_BACK,
    ),
    "OpenCV axes": Misreading(
        "these look like OpenCV poses (axes right, down, forward), not OpenGL's nor LLFF's "
        "(down, right, back)",
        "write the columns as (down, right, -forward)",
        _RIGHT_DOWN_FORWARD,
    ),
    "flipped": Misreading(
        "the axes look like (up, right, forward), OpenGL and OpenCV mixed, and LLFF's are "
        "(down, right, back)",
        "negate columns 0 and 2 of every pose",
        _FLIP,
    ),
    "turned": Misreading(
        "the axes look like (down, left, forward), OpenGL and OpenCV mixed, and LLFF's are "
        "(down, right, back)",
        "negate columns 1 and 2 of every pose",
        _HALF_TURN,
    ),
    "inverted": Misreading(
        "these look like world-to-camera matrices read as camera-to-world",
        "invert every pose, and write its columns as (down, right, back)",
        inverted=True,
    ),
}
"""LLFF camera-to-world with axes (down, right, back): poses_bounds.npy."""

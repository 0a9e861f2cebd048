"""How a format writes poses, and what other ways of writing them look like when it is read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

Reading = Callable[[np.ndarray], np.ndarray]

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
AS_READ = "as read"


def _flipped(pose: np.ndarray) -> np.ndarray:
    return pose @ _FLIP


def _inverted(pose: np.ndarray) -> np.ndarray:
    return np.linalg.inv(pose)


def _inverted_and_flipped(pose: np.ndarray) -> np.ndarray:
    return np.linalg.inv(pose) @ _FLIP


def _from_right_up_back(pose: np.ndarray) -> np.ndarray:
    """OpenGL columns that were read as LLFF's (down, right, back)."""
    return np.stack([pose[:, 1], -pose[:, 0], pose[:, 2], pose[:, 3]], 1)


def _from_right_down_forward(pose: np.ndarray) -> np.ndarray:
    """OpenCV columns that were read as LLFF's."""
    return np.stack([pose[:, 1], pose[:, 0], -pose[:, 2], pose[:, 3]], 1)


def _turned(pose: np.ndarray) -> np.ndarray:
    """Half a turn about the camera's y axis."""
    return pose @ np.diag([-1.0, 1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Misreading:
    """What poses may have been meant as. meant: the OpenCV camera-to-world (4, 4) of a read one."""

    meant: Reading
    reason: str
    fix: str


@dataclass(frozen=True)
class Convention:
    """How a format writes poses. misreadings: what else its files may hold by mistake, by name."""

    name: str
    misreadings: Mapping[str, Misreading]


OPENGL = Convention(
    "OpenGL camera-to-world",
    {
        "flipped": Misreading(
            _flipped,
            "these look like OpenCV poses read as OpenGL",
            "negate columns 1 and 2 (the camera's y and z axes) of every transform_matrix",
        ),
        "inverted": Misreading(
            _inverted,
            "these look like OpenCV world-to-camera matrices read as OpenGL camera-to-world",
            "invert every transform_matrix, then negate its columns 1 and 2",
        ),
        "inverted and flipped": Misreading(
            _inverted_and_flipped,
            "these look like world-to-camera matrices read as camera-to-world",
            "invert every transform_matrix",
        ),
    },
)
"""transforms.json of nerfstudio, Blender and DL3DV."""

OPENCV = Convention(
    "OpenCV world-to-camera",
    {
        "flipped": Misreading(
            _flipped,
            "these look like OpenGL poses read as OpenCV",
            "negate rows 1 and 2 (the camera's y and z axes) of every world-to-camera matrix",
        ),
        "inverted": Misreading(
            _inverted,
            "these look like camera-to-world matrices read as world-to-camera",
            "invert every matrix",
        ),
        "inverted and flipped": Misreading(
            _inverted_and_flipped,
            "these look like OpenGL camera-to-world matrices read as OpenCV world-to-camera",
            "negate columns 1 and 2 of every matrix, then invert it",
        ),
    },
)
"""Chunks and COLMAP models."""

LLFF = Convention(
    "LLFF camera-to-world with axes (down, right, back)",
    {
        "OpenGL axes": Misreading(
            _from_right_up_back,
            "these look like OpenGL poses (axes right, up, back), not LLFF's (down, right, back)",
            "write the columns as (-up, right, back)",
        ),
        "OpenCV axes": Misreading(
            _from_right_down_forward,
            "these look like OpenCV poses (axes right, down, forward), not OpenGL's nor LLFF's "
            "(down, right, back)",
            "write the columns as (down, right, -forward)",
        ),
        "flipped": Misreading(
            _flipped,
            "the axes look like (up, right, forward), OpenGL and OpenCV mixed, and LLFF's are "
            "(down, right, back)",
            "negate columns 0 and 2 of every pose",
        ),
        "turned": Misreading(
            _turned,
            "the axes look like (down, left, forward), OpenGL and OpenCV mixed, and LLFF's are "
            "(down, right, back)",
            "negate columns 1 and 2 of every pose",
        ),
        "inverted": Misreading(
            _inverted,
            "these look like world-to-camera matrices read as camera-to-world",
            "invert every pose, and write its columns as (down, right, back)",
        ),
    },
)
"""poses_bounds.npy."""


def readings(convention: Convention) -> Mapping[str, Reading]:
    """Every way in which poses of this convention may have been meant, as they are read first."""
    return {AS_READ: lambda pose: pose} | {
        name: misreading.meant for name, misreading in convention.misreadings.items()
    }

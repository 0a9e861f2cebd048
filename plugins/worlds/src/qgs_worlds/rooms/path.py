"""Cameras that move through a room: a smooth sway while looking across it."""

import math

import numpy as np

from qgs_worlds.caster.lens import look_along

# metres above the floor
EYE = (1.25, 1.65)
# least distance from a camera to a wall
WALL = 0.45
# metres from the first to the last camera
TRAVEL = (0.65, 1.2)


def camera_path(
    rng: np.random.Generator, size: tuple[float, float, float], count: int
) -> np.ndarray:
    """Return OpenCV c2w (count, 4, 4) of cameras that look across the room."""
    # drawn along one wall, then turned, so that all four are alike
    side = int(rng.integers(4))
    across = size[0] if side % 2 == 0 else size[1]
    along = size[1] if side % 2 == 0 else size[0]
    travel = float(rng.uniform(*TRAVEL))
    back = float(rng.uniform(WALL + 0.1, 0.25 * across)) - across / 2
    middle = float(rng.uniform(-1, 1)) * max(along / 2 - WALL - travel / 2 - 0.1, 0.0)
    s = np.linspace(-0.5, 0.5, count) if count > 1 else np.zeros(1)
    sway, lift = rng.uniform(-0.12, 0.12, 2)
    phase = rng.uniform(0, math.pi)
    eyes = np.stack(
        [
            back + sway * np.cos(3 * s + phase) + abs(sway),
            middle + travel * s,
            rng.uniform(*EYE) + lift * np.sin(3 * s + phase),
        ],
        -1,
    )
    drift = float(rng.uniform(-0.3, 0.5)) * travel
    target = np.stack(
        [
            np.full(count, 0.25 * across),
            float(rng.uniform(-0.25, 0.25)) * along - 0.35 * middle + drift * s,
            rng.uniform(0.7, 1.15) + 0.1 * np.sin(2 * s + phase),
        ],
        -1,
    )
    # walks go both ways
    if rng.random() < 0.5:
        eyes = eyes[::-1]
        target = target[::-1]
    cos = math.cos(side * math.pi / 2)
    sin = math.sin(side * math.pi / 2)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return look_along(eyes @ turn.T, (target - eyes) @ turn.T)

"""Which photos of a scene become inputs: photos that overlap, as far apart as in training."""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import torch

from qgs.analysis.depth import scene_depth
from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.domain import Domain
from qgs.data.samples import training_frames
from qgs.geometry.rays import pixel_directions
from qgs.types import Cameras

Window: TypeAlias = tuple[Frames, Frames]
"""Input frames, and novel frames that are compared with."""
NOVEL = 6
"""Views that are compared with by default, at most."""
BASELINE, TURN = (0.06, 0.25), 20.0
"""Distance of inputs per depth, and degrees between their axes, where no training is known."""
_MOST = 300  # frames that are considered: time grows with the square of their number
_NEAR = 48  # frames around a target that its inputs are chosen from
_POINTS = 6  # of a frustum, per side of the image
_SEEN = 0.7  # least share of a compared photo that the inputs see
_POOR = 1.0  # cost above the best window's up to which a window is shown


def choose_windows(
    scene: Scene, views: ViewsConfig, trained_on: Domain | None, count: int = 1
) -> list[Window]:
    """At most `count` windows of `scene`, the best first, the others spread over the scene.

    Each has `views.inputs` inputs, none of them held out. A window is made for each photo to
    compare with, a held-out one where there are: of the photos near it those that together see most
    of it, overlap, and stand as far apart as in training. Deterministic; the order of the frames
    does not matter. Raises ValueError for fewer photos than inputs.
    """
    usable, inputs = training_frames(scene), views.inputs
    if inputs > len(usable):
        raise ValueError(f"there are {len(usable)} photos, too few for {inputs} input views")
    frusta = _Frusta(scene.cameras, scene_depth(scene), trained_on or Domain())
    targets = sorted(scene.held_out) or (usable if len(usable) > inputs else [])
    if not targets:
        return [(tuple(usable), ())]
    usable, targets = _thinned(usable, _MOST), _thinned(targets, _MOST)
    made = [frusta.window(target, usable, inputs) for target in targets]
    ranked = sorted((cost, window, target) for cost, window, target in made)
    good = [(t, w) for cost, w, t in ranked if cost <= ranked[0][0] + _POOR]
    chosen = dict([good[0]])
    while len(chosen) < min(count, len(good)):
        # the farthest from all chosen ones; of equal ones the best
        far = max(good, key=lambda item: min(frusta.far[item[0], t] for t in chosen))
        if far[0] in chosen:
            break
        chosen[far[0]] = far[1]
    among = sorted(scene.held_out) or usable
    return [(w, frusta.compared(w, t, among)) for t, w in chosen.items()]


def trained_ratios(trained_on: Domain) -> tuple[tuple[float, float], float]:
    """Range of baseline per depth, and largest turn in degrees, of the training's inputs."""
    ranges = trained_on.ranges
    if "baseline" not in ranges:
        return BASELINE, TURN
    near, far = ranges.get("depth", (1.0, 1.0))
    # parallel axes meet at infinity; what they show has a depth of the order of the nearest
    depth = math.sqrt(near * min(far, 3 * near)) if math.isfinite(near) else 1.0
    low, high = (end / depth for end in ranges["baseline"])
    return (low, high), ranges.get("turn", (0.0, TURN))[1]


class _Frusta:
    """Cameras in units of the depth that they look at, and what each sees of the others' views."""

    def __init__(self, cameras: Cameras, depth: float, trained_on: Domain) -> None:
        c2w = cameras.c2w.double().numpy()
        self.centres, self.axes = c2w[:, :3, 3] / depth, c2w[:, :3, 2]
        self.rotations, self.cameras = c2w[:, :3, :3], cameras
        (self.low, self.high), self.most_turn = trained_ratios(trained_on)
        self.apart = np.linalg.norm(self.centres[:, None] - self.centres, axis=-1)
        self.turns = np.degrees(np.arccos((self.axes @ self.axes.T).clip(-1, 1)))
        # a turn by the trained largest one counts as the largest distance does
        self.far = self.apart / self.high + self.turns / self.most_turn

    def seen(self, frame: int, others: Sequence[int]) -> np.ndarray:
        """Which points of a frame's view at depth 1 are in others' views, (points, others)."""
        intrinsics, (height, width) = self.cameras.intrinsics.double(), self.cameras.size
        scale = torch.tensor([_POINTS / width, _POINTS / height] * 2).double()
        rays = pixel_directions(intrinsics[frame] * scale, (_POINTS, _POINTS)).reshape(-1, 3)
        points = rays.numpy() @ self.rotations[frame].T + self.centres[frame]
        others = list(others)
        ways = points[:, None] - self.centres[others]
        x, y, z = np.moveaxis(np.einsum("pni,nij->pnj", ways, self.rotations[others]), -1, 0)
        fx, fy, cx, cy = intrinsics[others].numpy().T
        z = np.where(z > 1e-6, z, np.nan)  # NaN compares as not seen
        u, v = fx * x / z + cx, fy * y / z + cy
        return (u >= 0) & (u <= width) & (v >= 0) & (v <= height)

    def window(self, target: int, usable: Sequence[int], inputs: int) -> tuple[float, Frames, int]:
        """The best `inputs` of `usable` frames for a target: cost, frames, and the target."""
        others = sorted((f for f in usable if f != target), key=lambda f: self.far[target, f])
        # beyond the nearest, every second, third, ...: a slow video has hundreds of near frames
        near = others if len(others) <= _NEAR else self._reach(target, others)
        seen = self.seen(target, near)
        first, second = np.triu_indices(len(near), k=min(inputs - 1, 1))
        union = (seen[:, first] | seen[:, second]).mean(0)
        a, b = np.array(near)[first], np.array(near)[second]
        apart, turn = self.apart[a, b], self.turns[a, b]
        # a photo that is almost one of the inputs compares little
        close = np.minimum(self.apart[target, a], self.apart[target, b])
        cost = 4 * (1 - union) + self._beside(target, a, b) / self.high
        cost += _excess(self.high / 2, close)
        if inputs > 1:
            shared = (seen[:, first] & seen[:, second]).mean(0)
            cost += 1 - shared + 0.5 * _excess(turn, self.most_turn)
            cost += 0.5 * _excess(self.low, apart) + _excess(apart, self.high)
        best = int(cost.argmin())
        ends = {int(a[best]), int(b[best])}
        return float(cost[best]), self._filled(ends, near, inputs), target

    def _reach(self, target: int, others: Sequence[int]) -> list[int]:
        """_NEAR of `others`, evenly spaced up to twice the trained distance, else the nearest."""
        inside = [f for f in others if self.apart[target, f] <= 2 * self.high]
        return _thinned(inside, _NEAR) if len(inside) > _NEAR else list(others[:_NEAR])

    def _beside(self, frame: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Distance of a camera from the lines between cameras a and b, (n,) in depths."""
        start, way = self.centres[a], self.centres[b] - self.centres[a]
        along = ((self.centres[frame] - start) * way).sum(-1) / np.maximum((way**2).sum(-1), 1e-12)
        nearest = start + along.clip(0, 1)[:, None] * way
        return np.linalg.norm(self.centres[frame] - nearest, axis=-1)

    def _filled(self, ends: set[int], near: Sequence[int], inputs: int) -> Frames:
        """The ends and frames at even steps between them, in the order of the way."""
        first, last = min(ends), max(ends)
        order = [first]
        for step in range(1, inputs - 1):
            place = step / (inputs - 1)
            centre = self.centres[first] * (1 - place) + self.centres[last] * place
            left = [f for f in near if f not in (*order, last)]
            order.append(min(left, key=lambda f: np.linalg.norm(self.centres[f] - centre)))
        return tuple(order) if inputs == 1 else (*order, last)

    def compared(self, window: Frames, target: int, among: Sequence[int]) -> Frames:
        """The target and the nearest of `among` that the window's inputs see, at most NOVEL."""
        first, last = np.array(window[:1]), np.array(window[-1:])
        reach = max(self.high, self.apart[first[0], last[0]]) / 2

        def fits(frame: int) -> bool:
            beside = self._beside(frame, first, last)[0]
            return beside <= reach and self.seen(frame, window).any(1).mean() >= _SEEN

        others = [f for f in among if f not in window and f != target and fits(f)]
        others.sort(key=lambda f: self.far[target, f])
        return tuple(sorted([target, *others[: NOVEL - 1]]))


def _excess(value: np.ndarray | float, limit: np.ndarray | float) -> np.ndarray:
    """Logarithm of the factor by which a value exceeds its limit; 0 below."""
    return np.log(np.maximum(value / np.maximum(limit, 1e-9), 1))


def _thinned(frames: Sequence[int], most: int) -> list[int]:
    """At most `most` of `frames`, evenly spaced."""
    places = np.linspace(0, len(frames) - 1, min(most, len(frames))).round()
    return [frames[int(place)] for place in places]

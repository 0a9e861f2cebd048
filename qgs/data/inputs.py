"""Which photos of a scene become inputs: photos that overlap, as far apart as in training."""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import torch

from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.depth import scene_depth
from qgs.data.frames import evenly
from qgs.domain import Domain
from qgs.geometry.rays import pixel_directions

Window: TypeAlias = tuple[Frames, Frames]
"""Input frames, and novel frames that are compared with."""
NOVEL = 6
"""Views that are compared with by default, at most."""
BASELINE, TURN, VARIED = (0.06, 0.25), 20.0, 20.0
"""Baseline per depth, turn in degrees: of unknown trainings, and baselines VARIED-fold apart."""
_MOST = 300  # frames that are considered: time grows with the square of their number
_NEAR = 48  # frames around a target that its inputs are chosen from
_POINTS = 6  # of a frustum, per side of the image
_SEEN = 0.7  # least share of a compared photo that the inputs see
_POOR = 1.0  # cost above the best window's up to which a window is shown


def choose_windows(
    scene: Scene,
    views: ViewsConfig,
    trained_on: Domain,
    count: int = 1,
    held_out: Sequence[int] | None = None,
) -> list[Window]:
    """At most `count` windows of `scene`, the best first, the others spread over the scene.

    Each has `views.inputs` inputs, none of them held out. A window is made for each photo to
    compare with, a held-out one where there are: of the photos near it those that together see most
    of it, overlap, and stand as far apart as in training. Deterministic; the order of the frames
    does not matter. held_out: by default the scene's. ValueError for fewer photos than inputs.
    """
    held, inputs = sorted(scene.held_out if held_out is None else held_out), views.inputs
    usable = [frame for frame in range(len(scene)) if frame not in held]
    if inputs > len(usable):
        besides = f" beside {len(held)} held-out ones" if held else ""
        raise ValueError(
            f"there are {len(usable)} photos{besides}, too few for {inputs} input views: add "
            "photos, take fewer inputs, or hold no photos out"
        )
    targets = held or (usable if len(usable) > inputs else [])
    if not targets:
        return [(tuple(usable), ())]
    frusta, usable = Frusta(scene, trained_on), evenly(usable, _MOST)
    ranked = sorted((*frusta.window(t, usable, inputs), t) for t in evenly(targets, _MOST))
    good = {target: window for cost, window, target in ranked if cost <= ranked[0][0] + _POOR}
    chosen = [next(iter(good))]
    while len(chosen) < min(count, len(good)):
        # the farthest from all chosen ones; of equal ones the best
        chosen.append(max(good.keys() - {*chosen}, key=lambda t: frusta.far[t, chosen].min()))
    return [(good[target], frusta.compared(good[target], target)) for target in chosen]


def trained_ratios(trained_on: Domain) -> tuple[tuple[float, float], float]:
    """Range of baseline per depth, and largest turn in degrees, of the training's inputs."""
    ranges = trained_on.ranges
    least, most = ranges.get("baseline", (0.0, math.inf))
    if most > VARIED * least:
        return BASELINE, TURN
    near, far = ranges.get("depth", (1.0, 1.0))
    # parallel axes meet at infinity; what they show has a depth of the order of the nearest
    depth = math.sqrt(near * min(far, 3 * near)) if math.isfinite(near) else 1.0
    return (least / depth, most / depth), ranges.get("turn", (0.0, TURN))[1]


class Frusta:
    """Cameras in units of a depth, by default `scene_depth`; what each sees of others' views."""

    def __init__(self, scene: Scene, trained_on: Domain, depth: float | None = None) -> None:
        self.scene, self.cameras = scene, scene.cameras
        c2w = self.cameras.c2w.double().numpy()
        self.centres, self.rotations = c2w[:, :3, 3] / (depth or scene_depth(scene)), c2w[:, :3, :3]
        (self.low, self.high), self.most_turn = trained_ratios(trained_on)
        self.apart = np.linalg.norm(self.centres[:, None] - self.centres, axis=-1)
        self.turns = np.degrees(np.arccos((c2w[:, :3, 2] @ c2w[:, :3, 2].T).clip(-1, 1)))
        # a turn by the trained largest one counts as the largest distance does
        self.far = self.apart / self.high + self.turns / max(self.most_turn, 1.0)

    def seen(self, frame: int, others: Sequence[int]) -> np.ndarray:
        """Which points of a frame's view at depth 1 are in others' views, (points, others)."""
        intrinsics, (height, width) = self.cameras.intrinsics.double(), self.cameras.size
        scale, others = torch.tensor([_POINTS / width, _POINTS / height] * 2), list(others)
        rays = pixel_directions(intrinsics[frame] * scale, (_POINTS, _POINTS)).reshape(-1, 3)
        points = rays.numpy() @ self.rotations[frame].T + self.centres[frame]
        ways = points[:, None] - self.centres[others]
        x, y, z = np.moveaxis(np.einsum("pni,nij->pnj", ways, self.rotations[others]), -1, 0)
        fx, fy, cx, cy = intrinsics[others].numpy().T
        z = np.where(z > 1e-6, z, np.nan)  # NaN compares as not seen
        u, v = fx * x / z + cx, fy * y / z + cy
        return (u >= 0) & (u <= width) & (v >= 0) & (v <= height)

    def window(self, target: int, usable: Sequence[int], inputs: int) -> tuple[float, Frames]:
        """Cost and frames of the best `inputs` of `usable` for a target.

        Weights are those of a regression of novel-view PSNR on 580 windows of three scenes, in
        units of 2 dB.
        """
        near = self._near(target, usable)
        seen, frames = self.seen(target, near), np.array(near)
        first, second = np.triu_indices(len(near), 1) if inputs > 1 else (np.arange(len(near)),) * 2
        a, b = frames[first], frames[second]
        # a photo that is almost one of the inputs compares little
        close = np.minimum(self.apart[target, a], self.apart[target, b])
        cost = 4 * (1 - (seen[:, first] | seen[:, second]).mean(0)) + _excess(self.high / 2, close)
        cost += self._beside(target, a, b) / self.high
        if inputs > 1:
            apart, turn = self.apart[a, b], self.turns[a, b]
            cost += 1 - (seen[:, first] & seen[:, second]).mean(0)
            cost += _excess(apart, self.high) + 0.5 * _excess(self.low, apart)
            cost += 0.5 * _excess(turn, self.most_turn)
        best = int(cost.argmin())
        ends = sorted((int(a[best]), int(b[best])))
        return float(cost[best]), self._filled(ends[0], ends[1], near, inputs)

    def _near(self, target: int, usable: Sequence[int]) -> list[int]:
        """_NEAR frames around a target: evenly spaced ones of a slow video, else the nearest."""
        others = sorted((f for f in usable if f != target), key=lambda f: self.far[target, f])
        inside = [f for f in others if self.apart[target, f] <= 2 * self.high]
        return evenly(inside, _NEAR) if len(inside) > _NEAR else others[:_NEAR]

    def _beside(self, frame: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Distance of a camera from the lines between cameras a and b, (n,) in depths."""
        start, way = self.centres[frame] - self.centres[a], self.centres[b] - self.centres[a]
        along = (start * way).sum(-1) / np.maximum((way**2).sum(-1), 1e-12)
        return np.linalg.norm(start - along.clip(0, 1)[:, None] * way, axis=-1)

    def _filled(self, first: int, last: int, near: Sequence[int], inputs: int) -> Frames:
        """The ends, and the nearest frames to even steps between them, in this order."""
        chosen = [first]
        for place in np.linspace(0, 1, inputs)[1:-1]:
            centre = self.centres[first] * (1 - place) + self.centres[last] * place
            distances = np.linalg.norm(self.centres - centre, axis=-1)
            chosen.append(min({*near} - {*chosen, last}, key=lambda f: (distances[f], f)))
        return tuple(chosen) if inputs == 1 else (*chosen, last)

    def compared(self, window: Frames, target: int | None = None) -> Frames:
        """The target and the frames nearest to it, or to the inputs, that the inputs see.

        At most NOVEL; held-out ones where there are.
        """
        held_out, inputs = sorted(self.scene.held_out), list(window)
        reach = max(1.0, self.far[np.ix_(inputs, inputs)].max() / 2)
        others = [f for f in held_out or range(len(self.scene)) if f not in (*inputs, target)]
        others = [f for f in others if self.far[f, inputs].min() <= reach]
        others = [f for f in others if self.seen(f, inputs).any(1).mean() >= _SEEN]
        others.sort(key=lambda f: self.far[f, inputs if target is None else [target]].min())
        return tuple(sorted([*([] if target is None else [target]), *others][:NOVEL]))


def _excess(value: np.ndarray | float, limit: np.ndarray | float) -> np.ndarray:
    """Logarithm of the factor by which a value exceeds its limit; 0 below."""
    return np.log(np.maximum(value / np.maximum(limit, 1e-9), 1))

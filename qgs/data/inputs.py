"""Choice of input photos that overlap and are about as far apart as the inputs of training.

Distances between cameras are divided by the depth of the scene, which comes from the cameras alone
or from matching photos. Source of the matching: A Space-Sweep Approach to True Multi-Image Matching
(Collins 1996), with planes parallel to each photo.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.contracts import Frames, Scene
from qgs.data.view_samplers import evenly
from qgs.domain import Domain
from qgs.geometry.poses import largest_distance, look_at_depth
from qgs.geometry.rays import pixel_directions
from qgs.geometry.transforms import depths_in_view, to_camera, to_pixels

NOVEL = 6
"""Default limit on the number of photos that renderings are compared with."""
BASELINE = (0.06, 0.25)
"""Range of baseline / scene depth of inputs, if the range of training is unknown."""
TURN = 20.0
"""Largest angle in degrees between input cameras, if that of training is unknown."""
VARIED = 20.0
"""Largest ratio of the largest to the smallest baseline in training. If the ratio is larger,
BASELINE and TURN are used in place of the limits of training."""

# Most frames to consider, because time grows with the square of their number.
_MOST = 300
# Number of frames around a target from which its inputs are chosen.
_NEAR = 48
# Points of a frustum along each side of the image.
_POINTS = 6
# Least part of a compared photo that the inputs must see.
_SEEN = 0.7
# Number of photos to sweep, and the ranks by distance of the photos matched with each.
_PHOTOS = 4
_OTHERS = (0, 1, 4)
# Least length in pixels to which the shorter side of photos is reduced for the sweep.
_SWEPT = 64
# Planes at depths from 1/64 to 4 times the extent of the cameras.
_PLANES = 28
# Largest angle between the axes of matched photos, in degrees.
_MATCHED_TURN = 20.0
# A motion whose cosine to the axis is larger counts as forward, which shows no depth.
_ALONG = 0.8
# Largest difference of colours that counts, against occlusions.
_MOST_COST = 0.3
# A depth counts if its cost is this far below the median, which excludes walls of one colour.
_MARGIN = 0.03


def ranked_windows(
    frusta: "Frusta", inputs: int, held_out: Sequence[int] | None = None
) -> list[tuple[float, Frames, int]]:
    """Return windows of a scene as (cost, input frames, target frame), the lowest cost first.

    Each target has one window. Targets are the held-out photos, or all photos if none is held out.
    The `inputs` input photos of a window are near the target, together see most of its view,
    overlap, and are as far apart as in training. The list is empty if the scene has just `inputs`
    photos, so that none is left as a target. The result is deterministic and does not depend on the
    order of the frames. held_out: held-out frames, by default the scene's. Raises ValueError if
    there are fewer photos than inputs.
    """
    scene = frusta.scene
    held = sorted(scene.held_out if held_out is None else held_out)
    usable = [frame for frame in range(len(scene)) if frame not in held]
    if inputs > len(usable):
        besides = f" besides {len(held)} held-out photos" if held else ""
        raise ValueError(
            f"there are {len(usable)} photos{besides}, too few for {inputs} input views: add "
            "photos, use fewer inputs, or hold out no photos"
        )
    targets = held or (usable if len(usable) > inputs else [])
    usable = evenly(usable, _MOST)
    return sorted((*frusta.window(t, usable, inputs), t) for t in evenly(targets, _MOST))


def trained_ratios(trained_on: Domain) -> tuple[float, float, float]:
    """Return limits for input cameras: least and largest baseline / depth, and largest angle.

    The limits are those of training, or defaults if they are unknown. The angle is between viewing
    directions, in degrees.
    """
    ranges = trained_on.ranges
    least, most = ranges.get("baseline", (0.0, math.inf))
    if most > VARIED * least:
        return *BASELINE, TURN
    near, far = ranges.get("depth", (1.0, 1.0))
    # Parallel axes meet at infinity, but the scene's depth is of the order of the nearest one.
    depth = math.sqrt(near * min(far, 3 * near)) if math.isfinite(near) else 1.0
    return least / depth, most / depth, ranges.get("turn", (0.0, TURN))[1]


class Frusta:
    """Cameras of a scene, in units of the scene's depth, and the overlap of their views.

    trained_on: ranges that the model's training covered. depth: depth of the scene in the scene's
        unit; None computes it by `scene_depth`.
    """

    def __init__(self, scene: Scene, trained_on: Domain, depth: float | None = None) -> None:
        self.scene = scene
        given = scene.cameras.to(torch.float64)
        c2w = given.c2w.clone()
        c2w[:, :3, 3] /= depth or scene_depth(scene)
        self.cameras = given.replace(c2w=c2w)
        self.centres = c2w[:, :3, 3].numpy()
        axes = c2w[:, :3, 2].numpy()
        self.low, self.high, self.most_turn = trained_ratios(trained_on)
        self.apart = np.linalg.norm(self.centres[:, None] - self.centres, axis=-1)
        self.turns = np.degrees(np.arccos((axes @ axes.T).clip(-1, 1)))
        # The largest turn of training counts as much as its largest distance.
        self.far = self.apart / self.high + self.turns / max(self.most_turn, 1.0)

    def seen(self, frame: int, others: Sequence[int]) -> np.ndarray:
        """Return which points in the view of `frame`, at depth 1, are in the views of `others`.

        The result is a bool array (points, others).
        """
        height, width = self.cameras.size
        own = self.cameras[frame]
        scale = own.intrinsics.new_tensor([_POINTS / width, _POINTS / height] * 2)
        rays = pixel_directions(own.intrinsics * scale, (_POINTS, _POINTS)).reshape(-1, 3)
        points = rays @ own.c2w[:3, :3].T + own.c2w[:3, 3]
        depths = depths_in_view(points, self.cameras[None, list(others)])
        return ~depths.isnan().T.numpy()

    def window(self, target: int, usable: Sequence[int], inputs: int) -> tuple[float, Frames]:
        """Choose `inputs` input frames among `usable` for a target; return (cost, frames).

        The weights of the cost's terms come from a regression of novel-view PSNR on 580 windows of
        three scenes. A cost of 1 predicts a PSNR about 2 dB lower than a cost of 0.
        """
        near = self._near(target, usable)
        seen = self.seen(target, near)
        frames = np.array(near)
        # Pairs of inputs are the ends of a window; a single input is both ends.
        first, second = np.triu_indices(len(near), 1) if inputs > 1 else np.diag_indices(len(near))
        a = frames[first]
        b = frames[second]
        # Comparing with a photo that is almost an input says little.
        close = np.minimum(self.apart[target, a], self.apart[target, b])
        cost = 4 * (1 - (seen[:, first] | seen[:, second]).mean(0)) + _excess(self.high / 2, close)
        cost += self._beside(target, a, b) / self.high
        if inputs > 1:
            apart = self.apart[a, b]
            cost += 1 - (seen[:, first] & seen[:, second]).mean(0)
            cost += _excess(apart, self.high) + 0.5 * _excess(self.low, apart)
            cost += 0.5 * _excess(self.turns[a, b], self.most_turn)
        best = int(cost.argmin())
        start, end = sorted((int(a[best]), int(b[best])))
        return float(cost[best]), self._filled(start, end, near, inputs)

    def _near(self, target: int, usable: Sequence[int]) -> list[int]:
        """Return up to _NEAR frames around a target.

        They are the nearest frames or, in a dense video, frames at even steps.
        """
        others = sorted((f for f in usable if f != target), key=lambda f: self.far[target, f])
        inside = [f for f in others if self.apart[target, f] <= 2 * self.high]
        return evenly(inside, _NEAR) if len(inside) > _NEAR else others[:_NEAR]

    def _beside(self, frame: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the distances (n,) of the camera of `frame` from n segments between cameras.

        a, b: frames (n,) whose cameras are the ends of the segments.
        """
        start = self.centres[frame] - self.centres[a]
        way = self.centres[b] - self.centres[a]
        along = (start * way).sum(-1) / np.maximum((way**2).sum(-1), 1e-12)
        return np.linalg.norm(start - along.clip(0, 1)[:, None] * way, axis=-1)

    def _filled(self, first: int, last: int, near: Sequence[int], inputs: int) -> Frames:
        """Return `inputs` frames in all: `first`, evenly spaced frames of `near`, and `last`."""
        if inputs == 1:
            return (first,)
        chosen = [first]
        for place in np.linspace(0, 1, inputs)[1:-1]:
            centre = self.centres[first] * (1 - place) + self.centres[last] * place
            distances = np.linalg.norm(self.centres - centre, axis=-1)
            chosen.append(min({*near} - {*chosen, last}, key=lambda f: (distances[f], f)))
        return (*chosen, last)

    def with_middle(self, window: Frames, left_out: Sequence[int]) -> Frames:
        """Return `window`, and a window of two frames with a third in the middle, if there is one.

        It is nearer to both frames than they are to each other, and not in `left_out`.
        """
        reach = self.far[list(window)].max(0)
        reach[list(left_out)] = math.inf
        middle = int(reach.argmin())
        if len(window) != 2 or reach[middle] >= self.far[window]:
            return window
        return window[0], middle, window[1]

    def compared(self, window: Frames, target: int | None = None) -> Frames:
        """Return up to NOVEL frames to score: the target, and frames that overlap with the inputs.

        Frames nearest to the target or, without a target, to the inputs come first. If the scene
        has held-out frames, only these are chosen besides the target.
        """
        inputs = list(window)
        first = [] if target is None else [target]
        reach = max(1.0, self.far[np.ix_(inputs, inputs)].max() / 2)
        others = [
            frame
            for frame in sorted(self.scene.held_out) or range(len(self.scene))
            if frame not in (*inputs, *first)
            and self.far[frame, inputs].min() <= reach
            and self.seen(frame, inputs).any(1).mean() >= _SEEN
        ]
        others.sort(key=lambda frame: self.far[frame, first or inputs].min())
        return tuple(sorted([*first, *others][:NOVEL]))


def _excess(value: np.ndarray | float, limit: np.ndarray | float) -> np.ndarray:
    """Return the natural logarithm of value / limit, or 0 where the value is below the limit."""
    return np.log(np.maximum(value / np.maximum(limit, 1e-9), 1))


def scene_depth(scene: Scene) -> float:
    """Return the depth of the scene in front of its cameras, positive, in the scene's unit.

    The depth is the first of these that exists: depth of the point that all cameras look at
    (`look_at_depth`), `seen_depth` of some photos, largest distance between cameras, 1. The result
    is deterministic.
    """
    c2w = scene.cameras.c2w.double()
    extent = float(largest_distance(c2w))
    depth = float(look_at_depth(c2w))
    if not depth:
        chosen = {int((k + 0.5) * len(scene) / _PHOTOS) for k in range(_PHOTOS)}
        depth = seen_depth(scene, sorted(chosen))
    return depth or extent or 1.0


def seen_depth(scene: Scene, frames: Sequence[int]) -> float:
    """Return the median depth of what `frames` show, in the scene's unit; 0 if it is unknown.

    It comes from depth maps, else from a plane sweep, else it is the depth of the point that the
    cameras look at.
    """
    c2w = scene.cameras.c2w.double()
    depths = scene.depths(frames)
    if depths is None:
        extent = float(largest_distance(c2w))
        planes = extent * torch.logspace(-6, 2, _PLANES, base=2).double()
        depths = torch.cat([_depths(scene, frame, planes, extent) for frame in frames])
    known = depths[depths > 0]
    return float(known.median() if len(known) else look_at_depth(c2w[list(frames)]))


def _depths(scene: Scene, frame: int, planes: Tensor, extent: float) -> Tensor:
    """Return the depths (n,) of those pixels of a photo that match other photos at one plane.

    planes: depths to try. extent: largest distance between cameras. Both are in scene units. Pixels
        that match about equally well at many planes are left out.
    """
    others = _matched(scene, frame, extent)
    if not others:
        return planes[:0]
    cameras = scene.cameras.to(torch.float64)
    # More pixels would take time and change little.
    step = max(min(cameras.size) // _SWEPT, 1)
    photo, *images = F.avg_pool2d(scene.images([frame, *others]), step)
    height, width = photo.shape[-2:]
    cameras = cameras.replace(intrinsics=cameras.intrinsics / step)
    pose = cameras.c2w[frame]
    rays_HW3 = pixel_directions(cameras.intrinsics[frame], (height, width)) @ pose[:3, :3].T
    points_DHW3 = pose[:3, 3] + rays_HW3 * planes[:, None, None, None]
    costs = []
    for other, image in zip(others, images, strict=True):
        seen = to_camera(points_DHW3.reshape(1, -1, 3), cameras[None, [other]])[0, 0]
        seen[seen[:, 2] <= 1e-6 * extent] = torch.nan
        grid = to_pixels(seen, cameras.intrinsics[other]) / seen.new_tensor([width, height]) * 2 - 1
        grid = grid.nan_to_num(9.0).float().reshape(*points_DHW3.shape[:3], 2)
        shown = F.grid_sample(image.expand(len(planes), -1, -1, -1), grid, align_corners=False)
        cost = (shown - photo).abs().mean(1, keepdim=True).clamp(max=_MOST_COST)
        # Points outside another photo count neither for a depth nor against it.
        cost = cost.where((grid.abs() <= 1).all(-1)[:, None], torch.nan)
        costs.append(F.avg_pool2d(cost, 5, 1, 2, count_include_pad=False)[:, 0])
    total = torch.stack(costs).nanmean(0)
    least, place = total.nan_to_num(_MOST_COST).min(0)
    return planes[place[total.nanmedian(0).values - least > _MARGIN]]


def _matched(scene: Scene, frame: int, extent: float) -> list[int]:
    """Return frames to match with `frame`.

    They are near it, look in a similar direction, and are neither ahead of it nor behind it.
    """
    c2w = scene.cameras.c2w.double()
    axes = c2w[:, :3, 2]
    ways = c2w[:, :3, 3] - c2w[frame, :3, 3]
    distances = ways.norm(dim=-1)
    along = (ways @ axes[frame]).abs() / distances.clamp_min(1e-12)
    fits = (axes @ axes[frame] > math.cos(math.radians(_MATCHED_TURN))) & (along < _ALONG)
    fits &= distances > 1e-3 * extent
    order = [int(i) for i in distances.argsort() if fits[i]]
    return sorted({order[rank] for rank in _OTHERS if rank < len(order)})

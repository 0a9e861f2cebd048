"""From a scene to what a model sees: which frames, in which frame and scale, mirrored or not.

Sources: TokenGS release (gap, targets from the span of the inputs, pose normalisation, mirroring).
Everything here is a pure function of its arguments and of the random generator it is given.
Images are moved by NumPy, on one thread: torch's would wait for cores that training holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from qgs.contracts import Scene, ViewsConfig
from qgs.data.scenes import warn_once
from qgs.geometry.poses import (
    first_camera,
    largest_distance,
    mean_camera,
    mirrored,
    relative_to,
    scaled,
)
from qgs.types import Cameras, Views

Frames: TypeAlias = tuple[int, ...]


@dataclass(frozen=True)
class Sample:
    """Input and target views of one scene, both Views (1, V), in the frame of the inputs."""

    scene: str
    inputs: Views
    targets: Views
    input_frames: Frames
    target_frames: Frames


@dataclass(frozen=True)
class Batch:
    """B samples: inputs (B, V_in) and targets (B, V_out), float32 and contiguous.

    scenes, input_frames, target_frames: what they show, sample by sample.
    """

    inputs: Views
    targets: Views
    scenes: tuple[str, ...]
    input_frames: tuple[Frames, ...]
    target_frames: tuple[Frames, ...]


def training_frames(scene: Scene) -> list[int]:
    """The frames that training may see: all but the held-out ones."""
    held_out = set(scene.held_out)
    return [frame for frame in range(len(scene)) if frame not in held_out]


def gap_range(count: int, views: ViewsConfig, scene: str) -> tuple[int, int]:
    """Smallest and largest gap that `count` frames of `scene` allow.

    Where both lie below views.gap, that is logged once for each scene.
    Raises ValueError when the inputs do not fit into the gap, or the scene has too few frames.
    """
    low, high = views.gap
    if views.inputs - 1 > high:
        raise ValueError(
            f"views.inputs is {views.inputs}, but views.gap [{low}, {high}] spans only {high + 1} "
            f"frames: raise the upper gap to {views.inputs - 1} or more, or ask for fewer inputs"
        )
    needed = max(views.inputs, 2)
    if count < needed:
        raise ValueError(
            f"scene {scene!r} has {count} frames for inputs, but views.inputs is {views.inputs} "
            f"and at least {needed} are needed: use fewer inputs, hold out fewer frames, or drop "
            "the scene"
        )
    if count - 1 < low:
        warn_once(
            f"scene {scene!r} has {count} frames for inputs, fewer than views.gap [{low}, {high}] "
            f"asks for: its gap is {count - 1}"
        )
    high = min(high, count - 1)
    return max(min(low, high), views.inputs - 1), high


def draw_frames(
    scene: Scene, views: ViewsConfig, rng: np.random.Generator
) -> tuple[Frames, Frames]:
    """Input frames, ascending, and target frames of a training sample.

    The gap counts steps between frames that training may see. Targets are frames of the span that
    are no inputs; where those are too few, input frames join them, and where even these are too
    few, frames come again.
    """
    usable = training_frames(scene)
    low, high = gap_range(len(usable), views, scene.name)
    gap = int(rng.integers(low, high + 1))
    first = int(rng.integers(0, len(usable) - gap))
    span = usable[first : first + gap + 1]
    inputs = _inputs_of(span, views.inputs, rng)
    return inputs, _targets_of(span, inputs, views.targets, rng)


def _inputs_of(span: Sequence[int], count: int, rng: np.random.Generator) -> Frames:
    """The two ends of `span` and `count - 2` frames between; one alone is drawn from the span."""
    if count == 1:
        return (int(rng.choice(span)),)
    between = rng.choice(span[1:-1], count - 2, replace=False) if count > 2 else ()
    return (span[0], *sorted(map(int, between)), span[-1])


def _targets_of(
    span: Sequence[int], inputs: Frames, count: int, rng: np.random.Generator
) -> Frames:
    novel = rng.permutation([frame for frame in span if frame not in inputs]).astype(int)
    chosen = [*novel, *rng.permutation(inputs)][:count]
    chosen += list(rng.choice(span, count - len(chosen)))
    return tuple(map(int, chosen))


def make_sample(
    scene: Scene, input_frames: Frames, target_frames: Frames, views: ViewsConfig, mirror: bool
) -> Sample:
    """Decode the frames, normalise their poses by the inputs, and mirror them if asked to.

    Poses are normalised in the precision that the scene has; what is delivered is float32.
    """
    frames = (*input_frames, *target_frames)
    wanted = sorted(set(frames))
    place = {frame: i for i, frame in enumerate(wanted)}
    order = [place[frame] for frame in frames]
    images, masks = scene.images(wanted), scene.masks(wanted)
    cameras = scene.cameras[list(frames)]
    c2w = normalised(cameras.c2w, len(input_frames), views, scene.name).float()
    both = Views(
        torch.from_numpy(images.numpy()[order])[None],
        Cameras(c2w[None], cameras.intrinsics.float()[None], cameras.size),
        None if masks is None else torch.from_numpy(masks.numpy()[order])[None],
    )
    if mirror:
        both = mirrored_views(both)
    inputs = both.select(slice(0, len(input_frames)))
    targets = both.select(slice(len(input_frames), None))
    return Sample(scene.name, inputs, targets, input_frames, target_frames)


def normalised(c2w: Tensor, inputs: int, views: ViewsConfig, scene: str = "") -> Tensor:
    """Poses (V, 4, 4) in the frame and scale of the first `inputs` ones. Raises as `own_world`."""
    reference, factor = own_world(c2w[:inputs], views, scene)
    return scaled(relative_to(reference, c2w), factor)


def own_world(c2w: Tensor, views: ViewsConfig, scene: str = "") -> tuple[Tensor, Tensor]:
    """The world in which a model sees inputs with poses c2w (V, 4, 4): reference pose and scale.

    A point p of it is, in the scene's world, the reference (4, 4) applied to p / scale (0-d).
    Raises ValueError for `scale: distance` when the input cameras stand on one point.
    """
    reference = (first_camera if views.frame == "first_cam" else mean_camera)(c2w)
    factor = torch.tensor(views.scale_factor, dtype=c2w.dtype)
    if views.scale == "distance":
        distance = largest_distance(relative_to(reference, c2w))
        if not distance > 0:
            raise ValueError(
                f"views.scale is 'distance', but the input cameras of scene {scene!r} stand on one "
                "point: use at least two inputs that moved, or `scale: constant`"
            )
        factor = factor / distance
    return reference, factor


def mirrored_views(views: Views) -> Views:
    """The same scene seen in a mirror that flips x: images, poses and principal point."""
    cameras = views.cameras
    fx, fy, cx, cy = cameras.intrinsics.unbind(-1)
    intrinsics = torch.stack([fx, fy, cameras.size[1] - cx, cy], -1)
    flipped = Cameras(mirrored(cameras.c2w), intrinsics, cameras.size)
    masks = None if views.masks is None else _flipped(views.masks)
    return Views(_flipped(views.images), flipped, masks)


def _flipped(images: Tensor) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(images.numpy()[..., ::-1]))


def collate(samples: Sequence[Sample]) -> Batch:
    """Stack samples of equal view counts and image size."""
    return Batch(
        stack_views([sample.inputs for sample in samples]),
        stack_views([sample.targets for sample in samples]),
        tuple(sample.scene for sample in samples),
        tuple(sample.input_frames for sample in samples),
        tuple(sample.target_frames for sample in samples),
    )


def stack_views(views: Sequence[Views]) -> Views:
    """Views (B, V) of several (b, V) with equal view counts and image size, on the CPU.

    Where only some have masks, the others get masks that are 1 everywhere.
    """
    cameras = Cameras(
        torch.cat([v.cameras.c2w for v in views]),
        torch.cat([v.cameras.intrinsics for v in views]),
        views[0].cameras.size,
    )
    images = np.concatenate([v.images.numpy() for v in views])
    masks = None
    if any(v.masks is not None for v in views):
        masks = torch.from_numpy(np.concatenate([_mask(v) for v in views]))
    return Views(torch.from_numpy(images), cameras, masks)


def _mask(views: Views) -> np.ndarray:
    if views.masks is not None:
        return views.masks.numpy()
    batch, count, _, height, width = views.images.shape
    return np.ones((batch, count, 1, height, width), np.float32)

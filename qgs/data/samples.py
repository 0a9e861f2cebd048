"""Samples of scenes as a model sees them: views, coordinates, mirroring.

Source: TokenGS release (pose normalisation, mirroring).
Everything here is a pure function of its arguments and of the random generator it is given.
Images are moved by NumPy, on one thread: torch's would wait for cores that training holds.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qgs.containers import concatenated, map_tensors
from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.view_samplers import refuse_too_many
from qgs.geometry.poses import (
    largest_distance,
    look_at_depth,
    mirrored,
    reference_pose,
    relative_to,
    scaled,
)
from qgs.types import Cameras, Views
from qgs.wording import listed, numbered, warn_once


@dataclass(frozen=True)
class Sample:
    """Input and target Views (1, V) of one scene, in the frame of the inputs.

    world: of the frame, reference pose (4, 4) and scale, as of `own_world`. names: of frames that
    are known by more than their number, such as by a file.
    """

    scene: str
    inputs: Views
    targets: Views
    input_frames: Frames
    target_frames: Frames
    world: tuple[Tensor, Tensor]
    names: Mapping[int, str] = field(default_factory=dict)

    def label(self, frame: int) -> str:
        """See `Scene`."""
        return numbered(frame, self.names.get(frame, ""))


@dataclass(frozen=True)
class Batch:
    """B samples: inputs (B, V_in) and targets (B, V_out), float32, contiguous; what they show."""

    inputs: Views
    targets: Views
    scenes: tuple[str, ...]
    input_frames: tuple[Frames, ...]
    target_frames: tuple[Frames, ...]
    left_out: tuple[str, ...] = ()
    """Samples that could not be made: scene, frame and reason."""


def make_sample(
    scene: Scene,
    input_frames: Frames,
    target_frames: Frames,
    views: ViewsConfig,
    mirror: bool,
    noise: np.random.Generator | None = None,
    depths: bool = False,
) -> Sample:
    """Decode frames, normalise poses in the scene's precision, mirror if asked; float32.

    noise: draws `views.pose_noise`, if given. depths: whether views have depth maps where the scene
    has them; 0 in views whose pose is noisy, which the surface was not seen from.
    """
    world = own_world(scene, input_frames, views)
    both = views_in(world, scene, (*input_frames, *target_frames), depths)
    count = len(input_frames)
    if both.times is not None:
        both = replace(both, target_time=_asked(both.times, count))
    if noise is not None and views.pose_noise:
        both = replace(both, cameras=with_noise(both.cameras, count, views, noise))
        # The first camera is exact, and with it its depth map.
        if both.depths is not None:
            both.depths[:, 1:count] = 0
    both = mirrored_views(both) if mirror else both
    names = {frame: scene.frame_name(frame) for frame in (*input_frames, *target_frames)}
    return Sample(
        scene=scene.name,
        inputs=both.select(slice(0, count)),
        targets=both.select(slice(count, None)),
        input_frames=input_frames,
        target_frames=target_frames,
        world=world,
        names={frame: name for frame, name in names.items() if name != str(frame)},
    )


def _asked(times: Tensor, inputs: int) -> Tensor | None:
    """Return the time (1, 1) of targets, or the inputs' median, of all (1, V); None for several."""
    asked = times[:, inputs:].unique() if times.shape[1] > inputs else times.median()
    return asked.reshape(1, 1) if asked.numel() == 1 else None


def with_noise(
    cameras: Cameras, inputs: int, views: ViewsConfig, rng: np.random.Generator
) -> Cameras:
    """Return cameras (1, F) with `ViewsConfig.pose_noise` on the inputs.

    The inputs are the first `inputs` cameras. The first of them stays exact.
    """
    if not views.pose_noise:
        return cameras
    c2w = cameras.c2w[0, :inputs]
    angle = math.radians(views.pose_noise)
    turns, moves = torch.from_numpy(rng.normal(0, angle, (2, inputs, 3))).to(c2w)
    # The matrix of the cross product with a turn; its exponential is the rotation.
    cross = torch.linalg.cross(turns[:, None], torch.eye(3).to(c2w)[None]).mT
    distances = (c2w[:, :3, 3] - c2w[0, :3, 3]).norm(dim=-1, keepdim=True)
    # The first pose sets the world and stays exact; farther cameras are off by more.
    off = cameras.c2w.clone()
    off[0, 1:inputs, :3, :3] = (c2w[:, :3, :3] @ torch.linalg.matrix_exp(cross))[1:]
    off[0, 1:inputs, :3, 3] += (moves * distances)[1:]
    return replace(cameras, c2w=off)


def views_in(
    world: tuple[Tensor, Tensor], scene: Scene, frames: Frames, depths: bool = False
) -> Views:
    """Read views (1, F) of these frames in a world as of `own_world`, float32; times are 0 to 1."""
    refuse_too_many(len(frames), scene)
    wanted = list(frames)
    masks = scene.masks(wanted)
    surface = scene.depths(wanted) if depths else None
    times = None if scene.times is None else from_0_to_1(scene.times[wanted])
    return Views(
        images=scene.images(wanted)[None],
        cameras=cameras_in(world, scene, frames),
        masks=None if masks is None else masks[None],
        times=None if times is None else times[None].float(),
        # The z of cameras scales with their translations.
        depths=None if surface is None else (surface * world[1].float())[None],
    )


def cameras_in(world: tuple[Tensor, Tensor], scene: Scene, frames: Frames) -> Cameras:
    """Return cameras (1, F) of these frames in a world as of `own_world`; decodes no image."""
    reference, scale = world
    cameras = scene.cameras[list(frames)]
    # float32 only now: coordinates of maps have seven digits before the point.
    c2w = scaled(relative_to(reference, cameras.c2w), scale).float()
    return Cameras(c2w[None], cameras.intrinsics.float()[None], cameras.size)


def from_0_to_1(times: Tensor) -> Tensor:
    """Return times (F,) as parts of the way from first to last (TokenGS 2026.6); 0 for equal."""
    first, last = times.aminmax()
    return (times - first) / (last - first) if last > first else torch.zeros_like(times)


def own_world(scene: Scene, input_frames: Frames, views: ViewsConfig) -> tuple[Tensor, Tensor]:
    """Return the world in which a model sees these inputs of `scene`: reference pose and scale.

    A point p of it is, in the scene's world, the reference (4, 4) applied to p / scale (0-d).
    `scale: auto` brings what all cameras of the scene look at to depth 1; where that is nothing in
    common (see `look_at_depth`), it warns, and the largest distance from the first one becomes 1.
    Raises ValueError where a scale is asked of cameras that stand on one point, and for `search`,
    which needs a model.
    """
    if views.scale == "search":
        raise ValueError(
            "views.scale: search finds the scale at which a trained model renders photos best, so "
            "it is for photos of a user alone; write auto, distance or constant"
        )
    # Of all cameras: the scale of a scene does not depend on which inputs are drawn.
    every = scene.cameras.c2w
    c2w = every[list(input_frames)]
    reference = reference_pose(views.frame, c2w)
    factor = c2w.new_tensor(views.scale_factor)
    if views.scale == "constant":
        return reference, factor
    auto = views.scale == "auto"
    if auto and (depth := look_at_depth(every)) > 0:
        return reference, 1 / depth
    distance = largest_distance(every if auto else relative_to(reference, c2w))
    if not distance > 0:
        which = "all" if auto else "the input"
        raise ValueError(
            f"views.scale is {views.scale!r}, but {which} cameras of scene {scene.name!r} stand on "
            "one point: use `scale: constant`, or photos that were taken from several places"
        )
    if not auto:
        return reference, factor / distance
    warn_once(
        f"the cameras of scene {scene.name!r} look at no common point, so views.scale: auto makes "
        f"the largest distance from the first one 1, a factor of {1 / float(distance):.4g}; if "
        "what they see comes out too near or too far, give `scale: constant` and a scale_factor"
    )
    return reference, 1 / distance


def mirrored_views(views: Views) -> Views:
    """Return the same scene in a mirror that flips x: images, poses and principal point."""
    cameras = views.cameras
    fx, fy, cx, cy = cameras.intrinsics.unbind(-1)
    intrinsics = torch.stack([fx, fy, cameras.size[1] - cx, cy], -1)
    flipped = Cameras(mirrored(cameras.c2w), intrinsics, cameras.size)
    images, masks, depths = map_tensors(_flipped, (views.images, views.masks, views.depths))
    return replace(views, images=images, cameras=flipped, masks=masks, depths=depths)


def _flipped(images: Tensor) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(images.numpy()[..., ::-1]))


def collate(samples: Sequence[Sample]) -> Batch:
    """Stack samples of equal view counts and image size; ValueError where only some have times."""
    # Models that read times need them in every sample of a batch.
    still = [sample.scene for sample in samples if sample.inputs.times is None]
    if 0 < len(still) < len(samples):
        raise ValueError(
            f"scenes without times, {listed(still)}, are in a batch with others that have some: "
            "write 'time' for the frames of all scenes, or of none"
        )
    return Batch(
        inputs=stack_views([sample.inputs for sample in samples]),
        targets=stack_views([sample.targets for sample in samples]),
        scenes=tuple(sample.scene for sample in samples),
        input_frames=tuple(sample.input_frames for sample in samples),
        target_frames=tuple(sample.target_frames for sample in samples),
    )


def stack_views(views: Sequence[Views]) -> Views:
    """Join views (b, V) to (B, V), on the CPU. Raises ValueError where only some have times.

    Masks of 1 and depths of 0 (unknown) where only others have some.
    """
    others: list[dict[str, Any]] = [
        {"cameras": v.cameras, "times": v.times, "target_time": v.target_time} for v in views
    ]
    images = np.concatenate([v.images.numpy() for v in views])
    masks = _stacked([v.masks for v in views], views, torch.ones_like)
    depths = _stacked([v.depths for v in views], views, torch.zeros_like)
    return Views(torch.from_numpy(images), masks=masks, depths=depths, **concatenated(others, 0))


def _stacked(
    maps: Sequence[Tensor | None], views: Sequence[Views], missing: Callable[[Tensor], Tensor]
) -> Tensor | None:
    """Join maps (b, V, 1, H, W), with `missing` ones in place of None; None for none at all."""
    if all(part is None for part in maps):
        return None
    whole = [
        (missing(view.images[:, :, :1]) if part is None else part).numpy()
        for part, view in zip(maps, views, strict=True)
    ]
    return torch.from_numpy(np.concatenate(whole))

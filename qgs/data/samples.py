"""Samples of scenes: views in a model's coordinate frame, mirrored on request.

Source: TokenGS release (pose normalisation, mirroring).
Everything here is a pure function of its arguments, which include the random generator. NumPy
copies images on one thread, because threads of torch would wait for cores that training uses.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.containers import concatenated, map_tensors
from qgs.contracts import Frames, Scene, ViewsConfig, Window
from qgs.data.view_samplers import refuse_too_many
from qgs.geometry.poses import (
    largest_distance,
    look_at_depth,
    mirrored,
    reference_pose,
    relative_to,
    scaled,
)
from qgs.types import Cameras, Views, World
from qgs.wording import listed, numbered, warn_once


@dataclass(frozen=True)
class Sample:
    """Input and target Views (1, V) of one scene, in the model's coordinate frame.

    world: reference pose (4, 4) and scale of this coordinate frame, see `own_world`. names: names
        of photos, such as file names, by frame number; photos without a name are absent.
    """

    scene: str
    inputs: Views
    targets: Views
    input_frames: Frames
    target_frames: Frames
    world: World
    names: Mapping[int, str] = field(default_factory=dict)

    def short_label(self, frame: int) -> str:
        """Return the number of a frame, with its name without folders if it has one."""
        return numbered(frame, Path(self.names.get(frame, "")).name)


@dataclass(frozen=True)
class Batch:
    """Batch of B samples: views (B, V_in) and (B, V_out), with names of scenes and frame numbers.

    V_in and V_out are the numbers of input views and target views. Tensors are float32 and
    contiguous. windows: frames of inputs and of targets, for each sample.
    """

    inputs: Views
    targets: Views
    scenes: tuple[str, ...]
    windows: tuple[Window, ...]
    left_out: tuple[str, ...] = ()
    """Messages about samples that failed and were replaced: scene, frame and reason."""


def make_sample(
    scene: Scene,
    input_frames: Frames,
    target_frames: Frames,
    views: ViewsConfig,
    mirror: bool = False,
    noise: np.random.Generator | None = None,
    depths: bool = False,
) -> Sample:
    """Decode the frames of a sample, normalise their poses, and mirror them if `mirror` is true.

    Poses are normalised in the scene's precision and returned in float32. noise: random generator
    for `views.pose_noise`; None adds no noise. depths: read depth maps if the scene has them.
    Depths are 0 (unknown) in views with noisy poses, because they do not fit the moved camera.
    """
    world = own_world(scene, input_frames, views)
    frames = (*input_frames, *target_frames)
    both = views_in(world, scene, frames, depths)
    count = len(input_frames)
    if both.times is not None:
        both = both.replace(target_time=_asked(both.times, count))
    if noise is not None and views.pose_noise:
        both = both.replace(cameras=with_noise(both.cameras, count, views, noise))
        # The first camera is exact, so its depth map is valid.
        if both.depths is not None:
            both.depths[:, 1:count] = 0
    both = mirrored_views(both) if mirror else both
    names = {frame: name for frame in frames if (name := scene.frame_name(frame)) != str(frame)}
    return Sample(
        scene=scene.name,
        inputs=both.select(slice(0, count)),
        targets=both.select(slice(count, None)),
        input_frames=input_frames,
        target_frames=target_frames,
        world=world,
        names=names,
    )


def _asked(times: Tensor, inputs: int) -> Tensor | None:
    """Return the time (1, 1) at which to reconstruct a scene: the time of all its targets.

    If target times differ, return None. Without targets, return the median time of the inputs.
    times: times (1, V) of inputs, then targets. inputs: number of inputs.
    """
    asked = times[:, inputs:].unique() if times.shape[1] > inputs else times.median()
    return asked.reshape(1, 1) if asked.numel() == 1 else None


def with_noise(
    cameras: Cameras, inputs: int, views: ViewsConfig, rng: np.random.Generator
) -> Cameras:
    """Return `cameras` with noise on the poses of all input cameras but the first.

    cameras: (1, F), of which the first `inputs` are the input cameras. The noise is that of the
        option `views.pose_noise`. If this is 0, `rng` is not used.
    """
    if not views.pose_noise:
        return cameras
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    c2w = cameras.c2w[0, :inputs]
    angle = math.radians(views.pose_noise)
    turns, moves = torch.from_numpy(rng.normal(0, angle, (2, inputs, 3))).to(c2w)
    distances = (c2w[:, :3, 3] - c2w[0, :3, 3]).norm(dim=-1, keepdim=True)
    # The first pose sets the world and stays exact; noise grows with the distance from it.
    off = cameras.c2w.clone()
    off[0, 1:inputs, :3, :3] = (c2w[:, :3, :3] @ axis_angle_to_rotation_matrix(turns))[1:]
    off[0, 1:inputs, :3, 3] += (moves * distances)[1:]
    return cameras.replace(c2w=off)


def views_in(world: World, scene: Scene, frames: Frames, depths: bool = False) -> Views:
    """Read F frames as float32 views (1, F) in the coordinate frame `world`, from `own_world`.

    Times are scaled to [0, 1]. depths: read depth maps if the scene has them.
    """
    refuse_too_many(len(frames), scene)
    wanted = list(frames)
    masks = scene.masks(wanted)
    surface = scene.depths(wanted) if depths else None
    times = None if scene.times is None else from_0_to_1(scene.times[wanted])[None].float()
    return Views(
        images=scene.images(wanted)[None],
        cameras=cameras_in(world, scene, frames),
        masks=None if masks is None else masks[None],
        times=times,
        # Depths scale with the translations of cameras.
        depths=None if surface is None else (surface * world[1].float())[None],
    )


def cameras_in(world: World, scene: Scene, frames: Frames) -> Cameras:
    """Return cameras (1, F) of F frames in the coordinate frame `world`, from `own_world`.

    No image is decoded.
    """
    return in_world(world, scene.cameras[list(frames)])[None]


def in_world(world: World, cameras: Cameras) -> Cameras:
    """Return a scene's cameras, (V,) or (B, V), as float32 in the coordinate frame `world`.

    world: the result of `own_world`.
    """
    reference, scale = world
    # float32 only now, because map coordinates have seven digits before the point.
    c2w = scaled(relative_to(reference, cameras.c2w), scale)
    return cameras.replace(c2w=c2w).to(torch.float32)


def in_photos_world(world: World, cameras: Cameras, names: Iterable[str]) -> dict[str, Cameras]:
    """Return cameras (1, 1), float64, in the frame of the photos by their names.

    cameras: (1, V) in the frame `world`; `in_world` is the inverse.
    """
    reference, scale = world
    c2w = reference.double() @ scaled(cameras.c2w.to(reference.device, torch.float64), 1 / scale)
    placed = cameras.replace(c2w=c2w)
    return {name: placed[:, [view]] for view, name in enumerate(names)}


def from_0_to_1(times: Tensor) -> Tensor:
    """Return times (F,) scaled to [0, 1] (TokenGS 2026.6), or zeros if all times are equal."""
    first, last = times.aminmax()
    return (times - first) / (last - first or 1)


def own_world(scene: Scene, input_frames: Frames, views: ViewsConfig) -> World:
    """Return the model's coordinate frame for given inputs: reference pose (4, 4) and 0-d scale.

    A point p in this frame is the point reference @ (p / scale) of the scene. With `scale: auto`,
    the point at which all cameras of the scene look gets depth 1. Without such a point (see
    `look_at_depth`), a warning is logged, and the distance from the scene's first camera to the
    farthest camera becomes 1. Raises ValueError if a scale is needed but the cameras are at one
    point, and for `scale: search`, which needs a model.
    """
    if views.scale == "search":
        raise ValueError(
            "views.scale: search needs a trained model, so it works only for the reconstruction of "
            "a user's photos; write auto, distance or constant"
        )
    # From all cameras, so that a scene's scale does not depend on the drawn inputs.
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
            f"views.scale is {views.scale!r}, but {which} cameras of scene {scene.name!r} are at "
            "one point: use `scale: constant`, or photos from several places"
        )
    if not auto:
        return reference, factor / distance
    warn_once(
        f"the cameras of scene {scene.name!r} look at no common point, so views.scale: auto makes "
        f"the largest distance from the first camera 1 (factor {1 / float(distance):.4g}); if "
        "the scene is too near or too far, set `scale: constant` and a scale_factor"
    )
    return reference, 1 / distance


def mirrored_views(views: Views) -> Views:
    """Mirror views left to right: images, masks, depth maps, poses and principal points."""
    cameras = views.cameras
    intrinsics = cameras.intrinsics.clone()
    intrinsics[..., 2] = cameras.size[1] - intrinsics[..., 2]
    flipped = cameras.replace(c2w=mirrored(cameras.c2w), intrinsics=intrinsics)
    images, masks, depths = map_tensors(
        lambda x: torch.from_numpy(np.ascontiguousarray(x.numpy()[..., ::-1])),
        (views.images, views.masks, views.depths),
    )
    return views.replace(images=images, cameras=flipped, masks=masks, depths=depths)


def shrunk(views: Views, part: int) -> Views:
    """Return views (1, V) without depth maps, with height and width divided by `part`.

    Pixels are averaged over areas.
    """
    if part == 1:
        return views
    height, width = views.cameras.size
    size = (height // part, width // part)
    images, masks = map_tensors(
        lambda x: F.interpolate(x[0], size=size, mode="area")[None], (views.images, views.masks)
    )
    factors = [size[1] / width, size[0] / height]
    intrinsics = views.cameras.intrinsics * views.cameras.intrinsics.new_tensor(factors * 2)
    cameras = views.cameras.replace(intrinsics=intrinsics, size=size)
    return views.replace(images=images, cameras=cameras, masks=masks)


def collate(samples: Sequence[Sample]) -> Batch:
    """Stack samples with equal numbers of views and equal image sizes.

    Raises ValueError if some samples have times and others do not.
    """
    # Models that read times need them in every sample of a batch.
    still = [sample.scene for sample in samples if sample.inputs.times is None]
    if 0 < len(still) < len(samples):
        raise ValueError(
            f"a batch mixes scenes with times and scenes without times ({listed(still)}): write "
            "'time' for the frames of all scenes, or of no scene"
        )
    return Batch(
        inputs=stack_views([sample.inputs for sample in samples]),
        targets=stack_views([sample.targets for sample in samples]),
        scenes=tuple(sample.scene for sample in samples),
        windows=tuple((sample.input_frames, sample.target_frames) for sample in samples),
    )


def stack_views(views: Sequence[Views]) -> Views:
    """Join views (b, V) on the CPU along the first axis, to (B, V) with B the sum of all b.

    If only some views have masks or depths, the others get masks of 1 and depths of 0 (unknown).
    Raises ValueError if only some views have times.
    """
    for name, missing in (("masks", torch.ones_like), ("depths", torch.zeros_like)):
        lacking = [getattr(view, name) is None for view in views]
        if not all(lacking):
            views = [
                view.replace(**{name: missing(view.images[:, :, :1])}) if lacks else view
                for view, lacks in zip(views, lacking, strict=True)
            ]
    return concatenated(views, 0, lambda parts, dim: torch.from_numpy(np.concatenate(parts, dim)))

"""From a scene to what a model sees: which views, in which coordinates, mirrored or not.

Sources: TokenGS release (gap, targets from the span of the inputs, pose normalisation, mirroring).
Everything here is a pure function of its arguments and of the random generator it is given.
Images are moved by NumPy, on one thread: torch's would wait for cores that training holds.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from qgs.containers import concatenated, map_tensors
from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.geometry.poses import (
    largest_distance,
    look_at_depth,
    mirrored,
    reference_pose,
    relative_to,
    scaled,
)
from qgs.machine import refuse_more_than_memory
from qgs.types import Cameras, Views
from qgs.wording import listed, numbered, warn_once

_T = TypeVar("_T")


@dataclass(frozen=True)
class Sample:
    """Input and target Views (1, V) of one scene, in the frame of the inputs.

    names: of frames that are known by more than their number, such as by a file.
    """

    scene: str
    inputs: Views
    targets: Views
    input_frames: Frames
    target_frames: Frames
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
    """What was to be in it and could not be made: scene, frame and reason."""


def held_out_frames(total: int, every: int) -> Frames:
    """Every n-th of `total` frames, from n // 2 on, or the middle one of fewer; none of 2, by 0."""
    every = min(every, total)
    return tuple(range(every // 2, total, every)) if every and total > 2 else ()


def training_frames(scene: Scene) -> list[int]:
    """The frames that training may see: all but the held-out ones."""
    return sorted({*range(len(scene))} - {*scene.held_out})


def moments(scene: Scene, frames: Iterable[int] | None = None) -> list[Frames]:
    """Group frames, by default those of training, by time; a static scene gives groups of one."""
    frames = training_frames(scene) if frames is None else frames
    times = None if scene.times is None else scene.times.tolist()
    together = defaultdict[float, list[int]](list)
    for number, frame in enumerate(frames):
        together[times[frame] if times else number].append(frame)
    return [tuple(together[time]) for time in sorted(together)]


def gap_range(count: int, views: ViewsConfig, scene: Scene) -> tuple[int, int]:
    """Least and largest gap that `count` `moments` allow. Raises ValueError for too few."""
    low, high = views.gap
    what = "frames" if scene.times is None else "times"
    if views.inputs - 1 > high:
        raise ValueError(
            f"views.inputs is {views.inputs}, but views.gap [{low}, {high}] spans only {high + 1} "
            f"{what}: raise the upper gap to {views.inputs - 1} or more, or ask for fewer inputs"
        )
    if count < max(views.inputs, 2):
        raise ValueError(
            f"scene {scene.name!r} has {count} {what} for inputs, but views.inputs is "
            f"{views.inputs} and at least {max(views.inputs, 2)} are needed: use fewer inputs, "
            "hold out fewer frames, or drop the scene"
        )
    if count - 1 < low:
        warn_once(
            f"scene {scene.name!r} has {count} {what} for inputs, fewer than views.gap "
            f"[{low}, {high}] asks for: its gap is {count - 1}"
        )
    high = min(high, count - 1)
    # each input takes a frame of its own
    return max(min(low, high), views.inputs - 1), high


def refuse_too_many(frames: int, scene: Scene) -> None:
    """Raise TooLargeError when that many images of `scene` do not fit into memory."""
    height, width = scene.cameras.size
    refuse_more_than_memory(
        f"a sample of {frames} images of {height} x {width}",
        {"images": frames * 3 * height * width * torch.float32.itemsize},
        "Ask for fewer views (views.inputs, views.targets) or smaller images (data.image_size).",
    )


def draw_frames(
    scene: Scene, views: ViewsConfig, rng: np.random.Generator
) -> tuple[Frames, Frames]:
    """Input frames, ascending, and target frames of a training sample, of a span of usable ones.

    Targets are no inputs, where there are enough frames; then inputs join, then frames repeat.
    Where times are known, the span is of times, each input is of another one and of another camera,
    as far as there are, and all targets are of one (TokenGS 2026.6).
    """
    refuse_too_many(views.inputs + views.targets, scene)
    usable = moments(scene)
    low, high = gap_range(len(usable), views, scene)
    gap = int(rng.integers(low, high + 1))
    first = int(rng.integers(0, len(usable) - gap))
    span = usable[first : first + gap + 1]
    if views.inputs == 1:  # with no span to be the end of
        places = [int(rng.choice(gap + 1))]
    else:  # the two ends and moments between
        more = views.inputs - 2
        between = rng.choice(range(1, gap), more, replace=False) if more else ()
        places = [0, *sorted(map(int, between)), gap]
    chosen = [span[place] for place in places]
    # permuting one camera draws nothing: static scenes have the same numbers after it
    inputs = one_of_each(chosen, rng.permutation(max(map(len, span))).tolist())
    pool = [frame for moment in span for frame in moment]
    if scene.times is not None:
        novel = [moment for moment in span if {*moment} - {*inputs}] or span
        pool = novel[rng.integers(len(novel))]
    # new views first, then inputs, then repetitions, so that short scenes can be used too
    targets = [*rng.permutation([frame for frame in pool if frame not in inputs])]
    targets += [*rng.permutation([frame for frame in inputs if frame in pool])]
    targets += list(rng.choice(pool, max(views.targets - len(targets), 0)))
    return inputs, tuple(map(int, targets[: views.targets]))


def one_of_each(chosen: Sequence[Frames], cameras: Sequence[int]) -> Frames:
    """One frame per moment, cycling through the cameras."""
    return tuple(m[cameras[i % len(cameras)] % len(m)] for i, m in enumerate(chosen))


def evenly(items: Sequence[_T], count: int) -> list[_T]:
    """At most `count` of `items`, evenly spaced, the first and last among them; one: the middle."""
    last, count = len(items) - 1, min(count, len(items))
    places = np.linspace(0, last, count) if count > 1 else np.full(count, last // 2)
    return [items[place] for place in places.round().astype(int)]


def spread(span: Sequence[Frames], count: int) -> Frames:
    """Frames of `count` moments, as of `evenly`."""
    return one_of_each(evenly(span, count), range(count))


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
        # the first camera is exact, and with it its depth map
        if both.depths is not None:
            both.depths[:, 1:count] = 0
    both = mirrored_views(both) if mirror else both
    inputs, targets = both.select(slice(0, count)), both.select(slice(count, None))
    names = {frame: scene.frame_name(frame) for frame in (*input_frames, *target_frames)}
    names = {frame: name for frame, name in names.items() if name != str(frame)}
    return Sample(scene.name, inputs, targets, input_frames, target_frames, names)


def _asked(times: Tensor, inputs: int) -> Tensor | None:
    """The time (1, 1) of targets, or the inputs' median, of all (1, V); None for several times."""
    asked = times[:, inputs:].unique() if times.shape[1] > inputs else times.median()
    return asked.reshape(1, 1) if asked.numel() == 1 else None


def with_noise(
    cameras: Cameras, inputs: int, views: ViewsConfig, rng: np.random.Generator
) -> Cameras:
    """Cameras (1, F), the first `inputs` of them with `views.pose_noise`."""
    c2w = cameras.c2w[0].clone()
    c2w[:inputs] = shaken(c2w[:inputs], math.radians(views.pose_noise), rng)
    return replace(cameras, c2w=c2w[None])


def shaken(c2w: Tensor, angle: float, rng: np.random.Generator) -> Tensor:
    """Poses (F, 4, 4), all but the first off by `angle`, see `ViewsConfig.pose_noise`; radians."""
    turns, moves = torch.from_numpy(rng.normal(0, angle, (2, len(c2w), 3))).to(c2w)
    cross = torch.linalg.cross(turns[:, None], torch.eye(3).to(c2w)[None]).mT  # of turn x
    off, distances = c2w.clone(), (c2w[:, :3, 3] - c2w[0, :3, 3]).norm(dim=-1, keepdim=True)
    off[1:, :3, :3] = (c2w[:, :3, :3] @ torch.linalg.matrix_exp(cross))[1:]
    off[1:, :3, 3] += (moves * distances)[1:]
    return off


def views_in(
    world: tuple[Tensor, Tensor], scene: Scene, frames: Frames, depths: bool = False
) -> Views:
    """Views (1, F) of these frames in a world as of `own_world`, float32; times are 0 to 1.

    Raises ValueError where all masks of `scene` are black.
    """
    refuse_too_many(len(frames), scene)
    wanted = sorted(set(frames))
    # a frame that is input and target, or target twice, is decoded once
    order = [wanted.index(frame) for frame in frames]
    images, masks = scene.images(wanted), scene.masks(wanted)
    black = masks is not None and not masks.numpy().any()
    # these views alone may not show what is modelled
    if black and not any(m.any() for i in range(len(scene)) if (m := scene.masks([i])) is not None):
        fix = "make them white on what is modelled, or list none"
        raise ValueError(f"all masks of scene {scene.name!r} are black: {fix}")
    surface = scene.depths(wanted) if depths else None
    if surface is not None:  # z of cameras scales with their translations
        surface = torch.from_numpy(surface.numpy()[order] * np.float32(world[1].item()))[None]
    return Views(
        torch.from_numpy(images.numpy()[order])[None],
        cameras_in(world, scene, frames),
        None if masks is None else torch.from_numpy(masks.numpy()[order])[None],
        None if scene.times is None else from_0_to_1(scene.times[list(frames)])[None].float(),
        depths=surface,
    )


def cameras_in(world: tuple[Tensor, Tensor], scene: Scene, frames: Frames) -> Cameras:
    """Cameras (1, F) of these frames in a world as of `own_world`, float32; decodes no image."""
    cameras, (reference, scale) = scene.cameras[list(frames)], world
    # float32 only now: coordinates of maps have seven digits before the point
    c2w = scaled(relative_to(reference, cameras.c2w), scale).float()
    return Cameras(c2w[None], cameras.intrinsics.float()[None], cameras.size)


def from_0_to_1(times: Tensor) -> Tensor:
    """Times (F,) as parts of the way from the first to the last (TokenGS 2026.6); 0 for equal."""
    first, last = times.aminmax()
    return (times - first) / (last - first) if last > first else torch.zeros_like(times)


def own_world(scene: Scene, input_frames: Frames, views: ViewsConfig) -> tuple[Tensor, Tensor]:
    """The world in which a model sees these inputs of `scene`: reference pose and scale.

    A point p of it is, in the scene's world, the reference (4, 4) applied to p / scale (0-d).
    Raises ValueError for `scale: distance` when the input cameras stand on one point, for `search`,
    which needs a model, and as `auto_scale`.
    """
    if views.scale == "search":
        raise ValueError(
            "views.scale: search finds the scale at which a trained model renders photos best, so "
            "it is for photos of a user alone; write auto, distance "
            "or constant"
        )
    c2w = scene.cameras.c2w[list(input_frames)]
    reference = reference_pose(views.frame, c2w)
    # of all cameras: the scale of a scene does not depend on which inputs are drawn
    if views.scale == "auto":
        return reference, auto_scale(scene.cameras.c2w, scene.name)
    factor = torch.tensor(views.scale_factor, dtype=c2w.dtype)
    if views.scale == "distance":
        distance = largest_distance(relative_to(reference, c2w))
        if not distance > 0:
            raise ValueError(
                f"views.scale is 'distance', but the input cameras of scene {scene.name!r} stand "
                "on one point: use at least two inputs that moved, or `scale: constant`"
            )
        factor = factor / distance
    return reference, factor


def auto_scale(c2w: Tensor, scene: str) -> Tensor:
    """The factor that brings what all cameras c2w (F, 4, 4) of `scene` look at to a depth of 1.

    Where they look at nothing in common (see `look_at_depth`), it warns, and the largest distance
    from the first camera becomes 1. 0-d. Raises ValueError when all stand on one point.
    """
    depth = look_at_depth(c2w)
    if depth > 0:
        return 1 / depth
    distance = largest_distance(c2w)
    if not distance > 0:
        raise ValueError(
            f"views.scale is 'auto', but all cameras of scene {scene!r} stand on one point: "
            "use `scale: constant`"
        )
    warn_once(
        f"the cameras of scene {scene!r} look at no common point, so views.scale: auto makes the "
        f"largest distance from the first one 1, a factor of {1 / float(distance):.4g}; if what "
        "they see comes out too near or too far, give `scale: constant` and a scale_factor"
    )
    return 1 / distance


def mirrored_views(views: Views) -> Views:
    """The same scene seen in a mirror that flips x: images, poses and principal point."""
    cameras = views.cameras
    fx, fy, cx, cy = cameras.intrinsics.unbind(-1)
    intrinsics = torch.stack([fx, fy, cameras.size[1] - cx, cy], -1)
    flipped = Cameras(mirrored(cameras.c2w), intrinsics, cameras.size)
    images, masks, depths = map_tensors(_flipped, (views.images, views.masks, views.depths))
    return replace(views, images=images, cameras=flipped, masks=masks, depths=depths)


def _flipped(images: Tensor) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(images.numpy()[..., ::-1]))


def collate(samples: Sequence[Sample]) -> Batch:
    """Stack samples of equal view counts and image size. ValueError where only some have times."""
    still = [sample.scene for sample in samples if sample.inputs.times is None]
    if 0 < len(still) < len(samples):
        raise ValueError(
            f"scenes without times, {listed(still)}, are in a batch with others that have some: "
            "write 'time' for the frames of all scenes, or of none"
        )
    return Batch(
        stack_views([sample.inputs for sample in samples]),
        stack_views([sample.targets for sample in samples]),
        *zip(*((s.scene, s.input_frames, s.target_frames) for s in samples), strict=True),
    )


def stack_views(views: Sequence[Views]) -> Views:
    """Views (B, V) of several (b, V), on the CPU. Raises ValueError where only some have times.

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
    """Maps (b, V, 1, H, W) one after the other, with `missing` ones; None for none at all."""
    if all(part is None for part in maps):
        return None
    pairs = zip(maps, views, strict=True)
    whole = [missing(v.images[:, :, :1]) if part is None else part for part, v in pairs]
    return torch.from_numpy(np.concatenate([part.numpy() for part in whole]))

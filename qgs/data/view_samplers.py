"""Held-out frames of a scene, and the view sampler `qgs/span` for training.

Source: TokenGS release (gap between inputs, targets from the span of the inputs).
"""

from collections.abc import Iterable, Sequence
from itertools import cycle, groupby
from typing import Any, TypeVar

import numpy as np
import torch
from pydantic import NonNegativeInt, PositiveInt

from qgs.contracts import (
    ComponentConfig,
    Frames,
    Problem,
    RecipeContext,
    Scene,
    ViewSampler,
    ViewsConfig,
    Window,
)
from qgs.contracts.schedule import END
from qgs.machine import refuse_more_than_memory
from qgs.wording import warn_once

_T = TypeVar("_T")


def held_out_frames(total: int, every: int) -> Frames:
    """Return every nth of `total` frames, starting at n // 2, where n is `every`.

    If there are fewer than n frames, return the middle frame. If `every` is 0 or `total` is at most
    2, return no frame.
    """
    every = min(every, total)
    return tuple(range(every // 2, total, every)) if every and total > 2 else ()


def training_frames(scene: Scene) -> list[int]:
    """Return all frames of `scene` except the held-out frames."""
    return sorted({*range(len(scene))} - {*scene.held_out})


def moments(scene: Scene, frames: Iterable[int] | None = None) -> list[Frames]:
    """Group frames by time, in ascending order; in scenes without times, each frame is a group.

    frames: frames to group, by default those of `training_frames`.
    """
    frames = training_frames(scene) if frames is None else frames
    times: Any = range(len(scene)) if scene.times is None else scene.times.tolist()
    ordered = sorted(frames, key=times.__getitem__)
    return [tuple(moment) for _, moment in groupby(ordered, times.__getitem__)]


def gap_range(count: int, views: ViewsConfig, scene: Scene) -> tuple[int, int]:
    """Return the least and the largest gap between first and last input in a scene, in moments.

    A moment is a time or, in scenes without times, a frame. count: number of moments in the scene.
    Raises ValueError if there are too few moments for the inputs.
    """
    low, high = views.gap
    what = "frames" if scene.times is None else "times"
    if views.inputs - 1 > high:
        raise ValueError(
            f"views.inputs is {views.inputs}, but views.gap [{low}, {high}] spans only {high + 1} "
            f"{what}: raise the upper gap to {views.inputs - 1} or more, or use fewer inputs"
        )
    needed = max(views.inputs, 2)
    if count < needed:
        raise ValueError(
            f"scene {scene.name!r} has {count} {what} for inputs, but views.inputs is "
            f"{views.inputs} and at least {needed} are needed: use fewer inputs, hold out fewer "
            "frames, or remove the scene"
        )
    if count - 1 < low:
        warn_once(
            f"scene {scene.name!r} has {count} {what} for inputs, fewer than views.gap "
            f"[{low}, {high}] needs: the gap is {count - 1} in this scene"
        )
    high = min(high, count - 1)
    # Each input needs its own frame.
    return max(min(low, high), views.inputs - 1), high


def refuse_too_many(frames: int, scene: Scene) -> None:
    """Raise TooLargeError if `frames` images of `scene` do not fit into memory."""
    height, width = scene.cameras.size
    refuse_more_than_memory(
        f"a sample of {frames} images of {height} x {width}",
        frames * 3 * height * width * torch.float32.itemsize,
        "Use fewer views (views.inputs, views.targets) or smaller images (data.image_size).",
    )


def one_of_each(chosen: Sequence[Frames], cameras: Sequence[int]) -> Frames:
    """Return one frame of each group of frames in `chosen`.

    cameras: for each group, the index of its frame to return, taken modulo the group's size.
    """
    turns = zip(chosen, cycle(cameras), strict=False)
    return tuple(moment[camera % len(moment)] for moment, camera in turns)


def evenly(items: Sequence[_T], count: int) -> list[_T]:
    """Return `count` items, evenly spaced from first to last; for a count of 1, the middle item.

    If there are fewer than `count` items, return all of them.
    """
    last = len(items) - 1
    count = min(count, len(items))
    places = np.linspace(0, last, count) if count > 1 else np.full(count, last // 2)
    return [items[place] for place in places.round().astype(int)]


def spread(span: Sequence[Frames], count: int) -> Frames:
    """Return one frame from each of `count` groups of `span`, evenly spaced from first to last.

    span: a group of frames for each time; in a scene without times, each group is one frame.
    """
    return one_of_each(evenly(span, count), range(count))


class Span(ViewSampler):
    """View sampler that takes views from a random span of frames (TokenGS release).

    The last frame of the span is min_gap to max_gap frames after the first. Inputs are the first
    and the last frame, and random frames between them. Targets are random frames of the span that
    are not inputs. If there are too few such frames, inputs are used as targets, and then frames
    repeat.

    In scenes with times, the span and the gap count distinct times. Each input has a different
    time, and a different camera if there are enough cameras. All targets have the same time
    (TokenGS 2026.6).
    """

    name = "span"
    scheduled = frozenset({"min_gap", "max_gap"})

    class Config(ComponentConfig):
        min_gap: PositiveInt | None = None
        """Least distance in frames from the first to the last input view. null uses `views.gap`."""
        max_gap: PositiveInt | None = None
        """Largest distance in frames from the first to the last input view. null uses `views.gap`.
        With a schedule, it can grow during training."""
        extra_inputs: NonNegativeInt = 0
        """Largest number of inputs in training beyond `views.inputs`. The first step uses
        `views.inputs`, each further step one more, up to this largest number, and then it starts
        again. Evaluation always uses `views.inputs`."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Yield a problem if `min_gap` is larger than `max_gap`."""
        if config.min_gap and config.max_gap and config.min_gap > config.max_gap:
            yield Problem("min_gap", "`min_gap` is larger than `max_gap`", "raise `max_gap`")

    def draw(self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int) -> Window:
        """Choose input and target frames from a random span of `scene`."""
        options = self.options(step)
        high = options.max_gap or views.gap[1]
        # A schedule may lower the largest gap below the least one of the recipe.
        low = min(options.min_gap or views.gap[0], high)
        count = views.inputs
        if step != END:
            count += step % (options.extra_inputs + 1)
        views = views.model_copy(update={"gap": (low, high), "inputs": count})
        refuse_too_many(count + views.targets, scene)
        usable = moments(scene)
        low, high = gap_range(len(usable), views, scene)
        gap = int(rng.integers(low, high + 1))
        # The draws follow the order of the release; another order would change all trainings.
        first = int(rng.integers(0, len(usable) - gap))
        span = usable[first : first + gap + 1]
        if count == 1:
            places = [int(rng.choice(gap + 1))]
        else:
            more = count - 2
            between = rng.choice(range(1, gap), more, replace=False) if more else ()
            places = [0, *sorted(map(int, between)), gap]
        # Permuting one camera draws no random number, so static scenes are unaffected.
        cameras = rng.permutation(max(map(len, span))).tolist()
        inputs = one_of_each([span[place] for place in places], cameras)
        pool = [frame for moment in span for frame in moment]
        if scene.times is not None:
            novel = [moment for moment in span if {*moment} - {*inputs}] or span
            pool = novel[rng.integers(len(novel))]
        # New views come first, then inputs, then repetitions, so that short scenes work too.
        targets = [*rng.permutation([frame for frame in pool if frame not in inputs])]
        targets += [*rng.permutation([frame for frame in inputs if frame in pool])]
        targets += list(rng.choice(pool, max(views.targets - len(targets), 0)))
        return inputs, tuple(map(int, targets[: views.targets]))

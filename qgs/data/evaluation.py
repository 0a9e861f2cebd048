"""Which views an evaluation compares: the same ones on every run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from qgs.contracts import EvaluationConfig, Scene, SceneSource, ViewsConfig
from qgs.data.sampling import (
    Frames,
    Sample,
    draw_frames,
    gap_range,
    make_sample,
    training_frames,
)


def evaluation_samples(
    source: SceneSource, views: ViewsConfig, evaluation: EvaluationConfig
) -> Sequence[Sample]:
    """The samples of the test split, never mirrored; deterministic.

    A scene with held-out frames gives `held_out_windows`, evenly thinned to `evaluation.scenes`
    samples. Of the others, the first `evaluation.scenes` give `evaluation.samples` samples each:
    inputs drawn as in training, with `evaluation.seed`; targets are the other frames of the span.

    Raises ValueError when the test split is empty or a scene has too few frames.
    """
    scenes = source.scenes("test")
    if not len(scenes):
        raise ValueError(f"the data source {type(source).name!r} has no test scenes")
    samples: list[Sample] = []
    for index in range(min(evaluation.scenes, len(scenes))):
        scene = scenes[index]
        if scene.held_out:
            chosen = _thinned(held_out_windows(scene, views), evaluation.scenes)
        else:
            chosen = list(_drawn(scene, index, views, evaluation))
        samples += [make_sample(scene, *frames, views, mirror=False) for frames in chosen]
    return samples


def held_out_windows(scene: Scene, views: ViewsConfig) -> list[tuple[Frames, Frames]]:
    """Input and target frames such that every held-out frame is a target once.

    For the first held-out frame not yet covered, a window of the largest gap (counted in training
    frames) is centred on it and shifted to lie within the scene; the inputs are evenly spaced in
    it. Its targets are the held-out frames of the window's span that are not yet covered, and the
    frame itself.
    """
    usable = np.array(training_frames(scene))
    gap = gap_range(len(usable), views, scene.name)[1]
    windows: list[tuple[Frames, Frames]] = []
    covered: set[int] = set()
    for frame in sorted(scene.held_out):
        if frame in covered:
            continue
        centre = int(np.searchsorted(usable, frame))
        first = min(max(centre - (gap + 1) // 2, 0), len(usable) - 1 - gap)
        span = usable[first : first + gap + 1]
        inputs = span[np.linspace(0, gap, views.inputs).round().astype(int)]
        if views.inputs == 1:
            inputs = span[[gap // 2]]
        inside = {f for f in scene.held_out if span[0] < f < span[-1]} | {frame}
        targets = sorted(inside - covered)
        covered.update(targets)
        windows.append((tuple(map(int, inputs)), tuple(targets)))
    return windows


def _thinned(windows: list[tuple[Frames, Frames]], limit: int) -> list[tuple[Frames, Frames]]:
    if len(windows) <= limit:
        return windows
    return [windows[i] for i in np.linspace(0, len(windows) - 1, limit).round().astype(int)]


def _drawn(
    scene: Scene, index: int, views: ViewsConfig, evaluation: EvaluationConfig
) -> Iterator[tuple[Frames, Frames]]:
    for k in range(evaluation.samples):
        rng = np.random.default_rng([evaluation.seed, index, k])
        inputs, drawn = draw_frames(scene, views, rng)
        between = tuple(f for f in range(inputs[0], inputs[-1] + 1) if f not in inputs)
        yield inputs, between or tuple(sorted(set(drawn)))

"""Endless training batches, which may start at any number."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np

from qgs.contracts import Scene, SceneSource, ViewsConfig
from qgs.data.evaluation import evaluation_samples
from qgs.data.sampling import Batch, Sample, collate, draw_frames, make_sample

__all__ = ["evaluation_samples", "training_batches"]


def training_batches(
    source: SceneSource, views: ViewsConfig, batch_size: int, seed: int, start: int = 0
) -> Generator[Batch, None, None]:
    """Batches start, start + 1, ... of an endless sequence.

    Each epoch visits every training scene once, in an order of its own. Sample k, the k-th of the
    whole sequence, depends on (seed, k) alone, so `start` resumes exactly. The next batch is made
    in a thread while the caller uses this one; closing the generator ends that thread.

    Raises ValueError when the source has no training scenes or a scene has too few frames.
    """
    scenes = source.scenes("train")
    if not len(scenes):
        raise ValueError(f"the data source {type(source).name!r} has no training scenes")
    draw = _drawer(scenes, views, seed)

    def batch(number: int) -> Batch:
        first = number * batch_size
        return collate([draw(k) for k in range(first, first + batch_size)])

    return _prefetched(batch, start)


def _drawer(scenes: Sequence[Scene], views: ViewsConfig, seed: int) -> Callable[[int], Sample]:
    @lru_cache(maxsize=2)
    def order(epoch: int) -> np.ndarray:
        return np.random.default_rng([seed, 0, epoch]).permutation(len(scenes))

    def draw(k: int) -> Sample:
        epoch, position = divmod(k, len(scenes))
        rng = np.random.default_rng([seed, 1, k])
        scene = scenes[int(order(epoch)[position])]
        mirror = bool(rng.random() < views.mirror)
        return make_sample(scene, *draw_frames(scene, views, rng), views, mirror)

    return draw


def _prefetched(batch: Callable[[int], Batch], start: int) -> Generator[Batch, None, None]:
    """Yield batch(start), batch(start + 1), ..., each made while the one before is in use."""
    with ThreadPoolExecutor(1, thread_name_prefix="qgs-loader") as pool:
        number, pending = start, pool.submit(batch, start)
        while True:
            ready = pending.result()
            number += 1
            pending = pool.submit(batch, number)
            yield ready

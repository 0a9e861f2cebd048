"""Endless training batches, which may start at any number."""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from qgs.contracts import SceneSource, SceneSourceConfig, ViewsConfig
from qgs.data.evaluation import evaluation_samples
from qgs.data.order import SceneOrder
from qgs.data.sampling import Batch
from qgs.data.stream import SampleError, SampleStream
from qgs.data.workers import decoded_by_workers

__all__ = [
    "SampleError",
    "Share",
    "evaluation_samples",
    "scenes_fingerprint",
    "training_batches",
]


@dataclass(frozen=True)
class Share:
    """Which part of every global batch is one process's own: slice `rank` of `processes`."""

    rank: int = 0
    processes: int = 1


def training_batches(
    source: SceneSource,
    views: ViewsConfig,
    batch_size: int,
    seed: int,
    start: int = 0,
    *,
    share: Share = Share(),
    workers: int = 0,
) -> Generator[Batch, None, None]:
    """Batches start, start + 1, ... of an endless sequence, of `batch_size` samples each.

    Each epoch visits every training scene once, in an order of its own that respects
    `SceneSource.groups`. Sample k of the whole sequence depends on (seed, k) alone. Global batch n
    is the samples from n * batch_size * processes on, and every process gets its slice: so W
    processes see together what one with W times the batch size sees, `start` resumes exactly, and
    the number of workers changes nothing.

    workers: processes that decode; with 0 the next batch is made in a thread while the caller uses
    this one. Closing the generator ends them.
    Raises ValueError when the source has no training scenes or a scene has too few frames, and
    SampleError, which is one too, for a sample that cannot be made.
    """
    stream = SampleStream(source, views, seed)
    part = _Part(batch_size, share)
    if not workers:
        return _prefetched(lambda number: stream.batch(part.samples(number)), start)
    opener = _Opener(type(source), source.config, views, seed, part)
    return decoded_by_workers(opener, start, workers)


def scenes_fingerprint(source: SceneSource) -> str:
    """Equal where `training_batches` visits equally many training scenes, stored alike."""
    return SceneOrder(source.groups("train"), len(source.scenes("train")), seed=0).fingerprint


@dataclass(frozen=True)
class _Part:
    batch_size: int
    share: Share

    def samples(self, number: int) -> range:
        """The samples of this process's slice of global batch `number`."""
        first = (number * self.share.processes + self.share.rank) * self.batch_size
        return range(first, first + self.batch_size)


@dataclass(frozen=True)
class _Opener:
    """Opens a source of the class and options that the training process has opened."""

    kind: type[SceneSource]
    config: SceneSourceConfig
    views: ViewsConfig
    seed: int
    part: _Part

    def __call__(self) -> Callable[[int], Batch]:
        stream = SampleStream(self.kind(self.config), self.views, self.seed)
        return lambda number: stream.batch(self.part.samples(number))


def _prefetched(batch: Callable[[int], Batch], start: int) -> Generator[Batch, None, None]:
    """Yield batch(start), batch(start + 1), ..., each made while the one before is in use."""
    with ThreadPoolExecutor(1, thread_name_prefix="qgs-loader") as pool:
        number, pending = start, pool.submit(batch, start)
        while True:
            ready = pending.result()
            number += 1
            pending = pool.submit(batch, number)
            yield ready

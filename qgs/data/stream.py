"""Endless training batches by number: order of scenes, samples, worker processes."""

from __future__ import annotations

import atexit
import hashlib
import logging
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from qgs.contracts import Scene, SceneSource, SceneSourceConfig, ViewsConfig
from qgs.data.sampling import Batch, Frames, Sample, collate, draw_frames, make_sample


class SceneOrder:
    """The scenes of an endless sequence of samples: a function of (groups, seed) alone.

    groups: scene indices by where they are stored, see `SceneSource.groups`. Each epoch visits
    every scene once: the groups in a random order, the scenes of a group one after another in a
    random order. Raises ValueError unless the groups hold each of `count` scenes once.
    """

    def __init__(self, groups: Sequence[Sequence[int]], count: int, seed: int) -> None:
        self._groups = [np.asarray(group, np.int64) for group in groups if len(group)]
        listed = np.concatenate([np.empty(0, np.int64), *self._groups])
        if not np.array_equal(np.sort(listed), np.arange(count)):
            raise ValueError(
                f"the data source has {count} training scenes, but its groups list "
                f"{len(listed)} indices, not each scene once; this is a mistake of the data source"
            )
        self._count = count
        self._seed = seed
        self._epoch = lru_cache(maxsize=2)(self._draw_epoch)

    def scene(self, sample: int) -> int:
        """The scene of a sample, counted from 0 over all epochs."""
        epoch, position = divmod(sample, self._count)
        return int(self._epoch(epoch)[position])

    @property
    def fingerprint(self) -> str:
        """Equal for equal groups: sequences of equal fingerprint and seed visit alike."""
        digest = hashlib.sha256()
        for group in self._groups:
            digest.update(len(group).to_bytes(8, "little") + group.astype("<i8").tobytes())
        return digest.hexdigest()[:16]

    def _draw_epoch(self, epoch: int) -> np.ndarray:
        rng = np.random.default_rng([self._seed, 0, epoch])
        shuffled = rng.permutation(len(self._groups))
        return np.concatenate([rng.permutation(self._groups[index]) for index in shuffled])


class SampleError(ValueError):
    """A training sample that cannot be made; the message names the scene and the frame."""


class SampleStream:
    """Training samples of `source` by number; sample k depends on (seed, k) alone.

    Raises ValueError when the source has no training scenes.
    """

    def __init__(self, source: SceneSource, views: ViewsConfig, seed: int) -> None:
        self._scenes = source.scenes("train")
        if not len(self._scenes):
            raise ValueError(f"the data source {type(source).name!r} has no training scenes")
        self.order = SceneOrder(source.groups("train"), len(self._scenes), seed)
        self._views, self._seed = views, seed

    def batch(self, numbers: Sequence[int]) -> Batch:
        """The samples of these numbers, counted from 0 over all epochs.

        Raises ValueError for a scene with too few frames, SampleError for frames that cannot be
        decoded or normalised.
        """
        return collate([self._sample(number) for number in numbers])

    def _sample(self, number: int) -> Sample:
        rng = np.random.default_rng([self._seed, 1, number])
        scene = self._scenes[self.order.scene(number)]
        mirror = bool(rng.random() < self._views.mirror)
        inputs, targets = draw_frames(scene, self._views, rng)
        try:
            return make_sample(scene, inputs, targets, self._views, mirror)
        except Exception as error:
            raise SampleError(_told(scene, (*inputs, *targets), error)) from error


def _told(scene: Scene, frames: Frames, error: Exception) -> str:
    """What went wrong with which frames of `scene`: the first that fails alone, else all."""
    for frame in frames:
        try:
            scene.images([frame])
            scene.masks([frame])
        except Exception as own:
            return f"scene {scene.name!r}, frame {frame} ({scene.frame_name(frame)}): {own}"
    return f"scene {scene.name!r}, frames {sorted(set(frames))}: {error}"


class WorkerError(ChildProcessError):
    """A process that decodes data was killed."""


@dataclass(frozen=True)
class _Failure:
    """An error of a worker, as text: exceptions need not survive the way between processes."""

    message: str
    trace: str

    def error(self) -> SampleError:
        error = SampleError(self.message)
        error.add_note(f"In a process that decodes data:\n{self.trace}")
        return error


class _Batches(Dataset[Batch | _Failure]):
    """Batches by number. A worker opens the data itself, so that nothing decoded ever travels."""

    def __init__(self, opener: Callable[[], Callable[[int], Batch]]) -> None:
        self._opener = opener
        self._make: Callable[[int], Batch] | None = None

    def __getitem__(self, number: int) -> Batch | _Failure:
        try:
            self._make = self._make or self._opener()
            return self._make(number)
        except Exception as error:
            return _Failure(str(error), traceback.format_exc())


class _From(Sampler[int]):
    """start, start + 1, ..."""

    def __init__(self, start: int) -> None:
        self._start = start

    def __iter__(self) -> Iterator[int]:
        number = self._start
        while True:
            yield number
            number += 1


def decoded_by_workers(
    opener: Callable[[], Callable[[int], Batch]], start: int, workers: int
) -> Generator[Batch, None, None]:
    """Batches start, start + 1, ..., made by `workers` processes; closing ends them.

    opener: opens the data and returns what makes the batch of a number; it runs in the workers and
        so must be picklable. They are spawned: threads of numba and torch do not survive a fork.
    Raises SampleError with what a worker raised, WorkerError when one was killed.
    """
    loader = DataLoader(
        _Batches(opener),
        batch_size=None,
        sampler=_From(start),
        num_workers=workers,
        multiprocessing_context="spawn",
        worker_init_fn=_prepare_worker,
        generator=torch.Generator(),  # so that no random number of the training is used up
    )
    with _signals_of_children_left_alone():
        batches = iter(loader)
    try:
        while True:
            batch = _next(batches)
            if isinstance(batch, _Failure):
                raise batch.error()
            yield batch
    finally:
        del batches


@contextmanager
def _signals_of_children_left_alone() -> Iterator[None]:
    """Keep torch from raising where the training happens to be when a worker dies.

    Asking for a batch raises too, within seconds, between two steps.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGCHLD)
    yield
    signal.signal(signal.SIGCHLD, before)


def _next(batches: Iterator[Batch | _Failure]) -> Batch | _Failure:
    try:
        return next(batches)
    # What torch tells of a worker's sudden end, and what a connection to it says when it breaks.
    except (RuntimeError, OSError, EOFError) as error:
        raise WorkerError(
            f"a process that decodes data ended suddenly ({error}): often the system was out of "
            "memory; lower training.workers, or views and image sizes"
        ) from error


def _prepare_worker(number: int) -> None:
    """Leave stopping to the training process, which closes its workers in an orderly way.

    Terminals and schedulers send their signals to all processes of a job.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    logging.getLogger("qgs").setLevel(logging.ERROR)  # opening the data has been reported before
    # Python's own end aborts where the thread that sends batches is inside torch at that moment.
    atexit.register(os._exit, 0)


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


class Feed:
    """Holds the batches of the step that comes next.

    They are fetched while the step before is not over, so that processes can agree on a failure
    where they exchange numbers anyway: one that ended alone would leave the others waiting.

    error: what fetching raised; after that there are no batches any more.
    """

    def __init__(self, stream: Iterator[Batch], count: int) -> None:
        self.batches: Sequence[Batch] = ()
        self.error: Exception | None = None
        self._stream = stream
        self._count = count

    def fetch(self) -> None:
        """Get the `count` batches of the next step, or the error."""
        try:
            self.batches = list(islice(self._stream, self._count))
        except Exception as error:  # raised by whoever reads `error`
            self.batches, self.error = (), error

"""Endless training batches by number: order of scenes, samples, processes that decode."""

import atexit
import hashlib
import os
import signal
import threading
import traceback
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import InitVar, dataclass, replace
from functools import cached_property, partial
from itertools import count, islice
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from qgs.contracts import Frames, Scene, SceneSource, ViewSampler, ViewsConfig
from qgs.data.samples import Batch, Sample, cameras_in, collate, make_sample, own_world, with_noise
from qgs.data.scenes import BoundedCache
from qgs.data.view_samplers import Span
from qgs.domain import Domain
from qgs.machine import is_out_of_memory
from qgs.terminal import show_safely
from qgs.types import Cameras
from qgs.wording import one_line

MEASURED = 512
"""Samples whose cameras `trained_domain` measures."""
MAX_REPLACED = 10
"""Most scenes that are tried instead of a failing one; after them training stops."""


class SampleError(ValueError):
    """Error: a training sample cannot be made; the message names the scene."""


class WorkerError(ChildProcessError):
    """Error: a process that decodes data was killed."""


def training_batches(
    source: SceneSource,
    views: ViewsConfig,
    batch_size: int,
    seed: int,
    start: int = 0,
    *,
    rank: int = 0,
    processes: int = 1,
    workers: int = 0,
    skips: bool = False,
    sampler: ViewSampler | None = None,
    accumulate: int = 1,
    depths: bool = False,
) -> Generator[Batch, None, None]:
    """Batches start, start + 1, ... of an endless sequence, of `batch_size` samples each.

    Sample k depends on (seed, k) alone. Global batch n is the samples from n * batch_size *
    processes on; every process gets the slice of its `rank`. `start` resumes exactly, and
    processes and workers change nothing. workers: processes that decode; 0 decodes in a thread.
    Closing ends them. skips, sampler, depths: see `SampleStream`. accumulate: batches of an
    optimiser step.
    Raises ValueError without training scenes or with too few frames, SampleError and WorkerError.
    """
    every = batch_size * processes
    stream = SampleStream(source, views, seed, skips, sampler, every * accumulate, depths)
    firsts = count(start * every + rank * batch_size, every)
    numbers = (range(first, first + batch_size) for first in firsts)
    return _from_workers(stream, numbers, workers) if workers else _from_thread(stream, numbers)


def trained_domain(
    source: SceneSource,
    views: ViewsConfig,
    seed: int,
    sampler: ViewSampler,
    steps: int,
) -> Domain:
    """Measure the cameras of MEASURED training samples; no image is decoded.

    The scenes are the first ones of the training, and the samples those of steps spread evenly
    from 0 to `steps`, since the options of `sampler` may follow them. A scene that fails is left
    out: training itself reports it.
    """
    stream = SampleStream(source, views, seed, sampler=sampler)
    domain = Domain()
    for number in range(MEASURED):
        # A reader may raise anything.
        with suppress(Exception):
            domain.see(*stream.cameras(number, round(number / (MEASURED - 1) * steps)))
    return domain


def scenes_fingerprint(source: SceneSource) -> str:
    """Return a hash of the number of training scenes and of their groups."""
    digest = hashlib.sha256()
    for group in filter(len, source.groups("train")):
        digest.update(len(group).to_bytes(8, "little") + np.asarray(group, "<i8").tobytes())
    return digest.hexdigest()[:16]


@dataclass(eq=False)
class SampleStream(Dataset[Batch | Exception]):
    """Samples by number, each a function of (seed, number) alone. Raises ValueError without scenes.

    A copy in a worker opens the data itself on first use.

    Each epoch visits the groups (see `SceneSource.groups`) in a random order, and the scenes of
    each at random.

    skips: replace a failing sample by one of the next scene, at most MAX_REPLACED times. sampler:
    `Span` by default. per_step: samples of an optimiser step, by which the sampler knows the step
    of a sample. depths: whether views have them, see `make_sample`.
    """

    source: InitVar[SceneSource]
    views: ViewsConfig
    seed: int
    skips: bool = False
    sampler: ViewSampler | None = None
    per_step: int = 1
    depths: bool = False

    def __post_init__(self, source: SceneSource) -> None:
        self._open = partial(type(source), source.config)
        self._sampler = self.sampler or Span(Span.Config())
        self._scenes = source.scenes("train")
        if not len(self._scenes):
            raise ValueError(f"the data source {type(source).name!r} has no training scenes")
        self._groups = [np.asarray(group, np.int64) for group in source.groups("train")]
        self._orders: BoundedCache[np.ndarray] = BoundedCache(2)

    # Open scenes hold files and caches, which cannot be sent to a worker.
    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_scenes"}

    @cached_property
    def _scenes(self) -> Sequence[Scene]:
        return self._open().scenes("train")

    def _scene(self, number: int) -> Scene:
        epoch, place = divmod(number, len(self._scenes))
        order = self._orders.get(epoch, lambda: self._draw_epoch(epoch))
        return self._scenes[int(order[place])]

    def _draw_epoch(self, epoch: int) -> np.ndarray:
        rng = np.random.default_rng([self.seed, 0, epoch])
        groups = [group for group in self._groups if len(group)]
        # Groups in turn, such as files of scenes: each is opened once an epoch.
        shuffled = rng.permutation(len(groups))
        return np.concatenate([rng.permutation(groups[index]) for index in shuffled])

    def batch(self, numbers: Sequence[int]) -> Batch:
        """Make samples by number. Raises ValueError for too few frames, else SampleError."""
        left_out: list[str] = []
        batch = collate([self._sample(number, left_out) for number in numbers])
        return replace(batch, left_out=tuple(left_out))

    def __getitem__(self, numbers: Sequence[int]) -> Batch | Exception:
        """Return `batch(numbers)` in a worker, or the failure as an exception."""
        try:
            return self.batch(numbers)
        except Exception as error:
            # Exceptions with arguments of their own cannot be pickled.
            kind = MemoryError if is_out_of_memory(error) else SampleError
            failure = kind(str(error) or one_line(error))
            failure.add_note(f"In a process that decodes data:\n{traceback.format_exc()}")
            return failure

    def _sample(self, number: int, left_out: list[str]) -> Sample:
        for attempt in range(MAX_REPLACED + 1):
            try:
                return self._sample_after(number, attempt)
            except Exception as error:
                # Another scene would need the same memory.
                if not self.skips or is_out_of_memory(error):
                    raise
                left_out.append(one_line(error))
        raise SampleError(
            f"{MAX_REPLACED + 1} samples in a row cannot be made, the last: {left_out[-1]}"
        )

    def cameras(self, number: int, step: int) -> tuple[Cameras, Cameras]:
        """Draw the cameras (1, V) of inputs and targets as after `step` optimiser steps."""
        rng = np.random.default_rng([self.seed, 1, number])
        scene = self._scene(number)
        _, inputs, targets = self._drawn(scene, rng, step)
        count = len(inputs)
        both = cameras_in(own_world(scene, inputs, self.views), scene, (*inputs, *targets))
        both = with_noise(both, count, self.views, rng)
        return both[:, :count], both[:, count:]

    def _drawn(
        self, scene: Scene, rng: np.random.Generator, step: int
    ) -> tuple[bool, Frames, Frames]:
        """Draw whether a sample is mirrored, and its input and target frames."""
        mirror = bool(rng.random() < self.views.mirror)
        return mirror, *self._sampler.draw(scene, self.views, rng, step)

    def _sample_after(self, number: int, attempt: int) -> Sample:
        """Make sample `number`, or its replacement after `attempt` failures."""
        # The first attempt draws from (seed, 1, number), whether others were replaced or not.
        key = [self.seed, 1, number]
        rng = np.random.default_rng([*key, attempt] if attempt else key)
        scene = self._scene(number + attempt)
        mirror, inputs, targets = self._drawn(scene, rng, number // self.per_step)
        try:
            return make_sample(scene, inputs, targets, self.views, mirror, rng, self.depths)
        except Exception as error:
            if is_out_of_memory(error):
                raise
            raise SampleError(f"scene {scene.name!r}: {one_line(error)}") from error


def _from_thread(
    stream: SampleStream, numbers: Iterator[Sequence[int]]
) -> Generator[Batch, None, None]:
    """Yield batches of these samples; make each one while the previous one is in use."""
    with ThreadPoolExecutor(1, thread_name_prefix="qgs-loader") as pool:
        pending = pool.submit(stream.batch, next(numbers))
        for following in numbers:
            # Taken before the next is begun: one thread reads, as files and caches expect.
            ready = pending.result()
            pending = pool.submit(stream.batch, following)
            yield ready


def _from_workers(
    stream: SampleStream, numbers: Iterator[Sequence[int]], workers: int
) -> Generator[Batch, None, None]:
    """Yield batches of these samples, of spawned processes: numba and torch survive no fork."""
    loader = DataLoader(
        stream,
        batch_size=None,
        sampler=numbers,
        num_workers=workers,
        multiprocessing_context="spawn",
        worker_init_fn=_prepare_worker,
        # Its own, so that no random number of the training is used up.
        generator=torch.Generator(),
    )
    handler = signal.getsignal(signal.SIGCHLD)
    made = iter(loader)
    if threading.current_thread() is threading.main_thread():
        # torch's handler raises wherever training is when a worker dies. Asking for a batch raises
        # too, within seconds, between two steps.
        signal.signal(signal.SIGCHLD, handler)
    try:
        while True:
            try:
                batch = next(made)
            # Torch raises the first for a worker's sudden end, a broken connection the others.
            except (RuntimeError, OSError, EOFError) as error:
                raise WorkerError(
                    f"a process that decodes data ended suddenly ({error}): often the system was "
                    "out of memory; lower training.workers, or views and image sizes"
                ) from error
            if isinstance(batch, Exception):
                raise batch
            yield batch
    finally:
        # The iterator of torch ends its workers when it goes.
        del made


def _prepare_worker(number: int) -> None:
    """Ignore signals, which go to all processes of a job; the training process ends workers."""
    show_safely()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    # Python's own end aborts where the thread that sends batches is inside torch at that moment.
    atexit.register(os._exit, 0)


@dataclass
class Feed:
    """The batches of the next optimiser step, or the error that fetching them raised.

    Fetched during a step, `count` at a time, so that processes can agree on failures at its end.
    """

    stream: Iterator[Batch]
    count: int
    batches: Sequence[Batch] = ()
    error: Exception | None = None

    def fetch(self) -> None:
        """Get the `count` batches of the next step; if that fails, set `error` instead."""
        try:
            self.batches = list(islice(self.stream, self.count))
        # Whoever reads `error` raises it, once all processes know.
        except Exception as error:
            self.batches = ()
            self.error = error

"""Endless training batches: order of scenes, random samples, and decoding in other processes."""

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
from itertools import count
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from qgs.contracts import Frames, Scene, SceneSource, ViewSampler, ViewsConfig
from qgs.data.samples import Batch, Sample, cameras_in, collate, make_sample, own_world, with_noise
from qgs.data.scenes import BoundedCache, resized
from qgs.data.view_samplers import Span
from qgs.domain import Domain
from qgs.machine import is_out_of_memory
from qgs.terminal import show_safely
from qgs.types import Cameras, Size
from qgs.wording import one_line

MEASURED = 512
"""Number of training samples whose cameras `trained_domain` measures."""
MAX_REPLACED = 10
"""Number of replacements to try for a failing sample before training stops."""
Batches = Generator[Batch, None, None]
"""Batches without end, whose threads or processes end when it is closed."""
_SPAN = Span(Span.Config())


class SampleError(ValueError):
    """Error for a training sample that cannot be made; the message names the scene."""


class WorkerError(ChildProcessError):
    """Error for a process that decodes data and ended suddenly."""


def training_batches(
    stream: "SampleStream",
    batch_size: int,
    start: int = 0,
    *,
    rank: int = 0,
    processes: int = 1,
    workers: int = 0,
) -> Batches:
    """Return an endless generator of training batches, each with `batch_size` samples.

    Batch n consists of the samples of `stream` from n * batch_size * processes on, split among the
    training processes by `rank`. The samples therefore do not depend on the number of processes or
    workers. start: number n of the first batch, to resume a run exactly.

    workers: number of processes that decode; they end when the generator is closed. 0 decodes in a
        thread.
    Raises ValueError if there are too few frames, SampleError for a sample that fails, and
    WorkerError for a process that ends suddenly.
    """
    every = batch_size * processes
    firsts = count(start * every + rank * batch_size, every)
    numbers = (range(first, first + batch_size) for first in firsts)
    return _from_workers(stream, numbers, workers) if workers else _from_thread(stream, numbers)


def trained_domain(stream: "SampleStream", steps: int) -> Domain:
    """Measure the cameras of the first MEASURED training samples, without decoding images.

    Options of the view sampler may follow a schedule. So the samples are chosen as at optimiser
    steps spread evenly from 0 to `steps`, the length of training. Scenes that fail are left out
    here; training itself reports them.
    """
    domain = Domain()
    for number in range(MEASURED):
        # A reader may raise any kind of error.
        with suppress(Exception):
            domain.see(*stream.cameras(number, round(number / (MEASURED - 1) * steps)))
    return domain


def scenes_fingerprint(source: SceneSource) -> str:
    """Return a hash of the training scenes: their indices, grouped as by `SceneSource.groups`."""
    digest = hashlib.sha256()
    for group in filter(len, source.groups("train")):
        digest.update(len(group).to_bytes(8, "little") + np.asarray(group, "<i8").tobytes())
    return digest.hexdigest()[:16]


@dataclass(eq=False)
class SampleStream(Dataset[Batch | Exception]):
    """Endless stream of training samples. Each sample depends only on the seed and its number.

    Each epoch visits the groups of scenes (see `SceneSource.groups`) in random order, and the
    scenes of a group in random order. A copy in a worker process opens the data at first use.
    Raises ValueError if there are no training scenes.

    skips: replace a failing sample by a sample of the next scene, up to MAX_REPLACED times.
    sampler: view sampler, by default `Span`.
    per_step: number of samples per optimiser step. The stream computes from it the step that uses a
        sample, because options of the sampler may depend on the step.
    depths: read depth maps if a scene has them.
    sizes: sizes (H, W) of images; each optimiser step takes one at random. Empty: that of `source`.
    """

    source: InitVar[SceneSource]
    views: ViewsConfig
    seed: int
    skips: bool = False
    sampler: ViewSampler = _SPAN
    per_step: int = 1
    depths: bool = False
    sizes: Sequence[Size] = ()

    def __post_init__(self, source: SceneSource) -> None:
        sources = [resized(source, source.config, size) for size in self.sizes] or [source]
        self._openers = [partial(type(source), each.config) for each in sources]
        self._scenes = [each.scenes("train") for each in sources]
        if not len(self._scenes[0]):
            raise ValueError(f"the data source {type(source).name!r} has no training scenes")
        groups = filter(len, source.groups("train"))
        self._groups = [np.asarray(group, np.int64) for group in groups]
        self._orders: BoundedCache[np.ndarray] = BoundedCache(2)

    # Open scenes hold files and caches that cannot be sent to a worker.
    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_scenes"}

    @cached_property
    def _scenes(self) -> Sequence[Sequence[Scene]]:
        """The training scenes, once for each image size."""
        return [opened().scenes("train") for opened in self._openers]

    def _draw_epoch(self, epoch: int) -> np.ndarray:
        rng = np.random.default_rng([self.seed, 0, epoch])
        # One group after another: each, such as a file of scenes, is opened once per epoch.
        shuffled = rng.permutation(len(self._groups))
        return np.concatenate([rng.permutation(self._groups[index]) for index in shuffled])

    def batch(self, numbers: Sequence[int]) -> Batch:
        """Make a batch of the samples that have these numbers in the stream.

        Raises ValueError if a scene has too few frames, and SampleError for other failures.
        """
        left_out: list[str] = []
        batch = collate([self._sample(number, left_out) for number in numbers])
        return replace(batch, left_out=tuple(left_out))

    def __getitem__(self, numbers: Sequence[int]) -> Batch | Exception:
        """Return `batch(numbers)` in a worker process; if it fails, return the exception."""
        try:
            return self.batch(numbers)
        except Exception as error:
            # Exceptions with extra arguments cannot be pickled.
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
            f"{MAX_REPLACED + 1} samples in a row failed to load; the last: {left_out[-1]}"
        )

    def cameras(self, number: int, step: int) -> tuple[Cameras, Cameras]:
        """Return cameras (1, V) of inputs and of targets of sample `number`, without images.

        step: optimiser step, on which options of the view sampler may depend.
        """
        scene, rng, _, inputs, targets = self._drawn(number, step)
        count = len(inputs)
        both = cameras_in(own_world(scene, inputs, self.views), scene, (*inputs, *targets))
        both = with_noise(both, count, self.views, rng)
        return both[:, :count], both[:, count:]

    def _drawn(
        self, number: int, step: int, attempt: int = 0
    ) -> tuple[Scene, np.random.Generator, bool, Frames, Frames]:
        """Return the scene of a sample, its random generator, and what the generator chose.

        These choices are whether to mirror the sample, its input frames and its target frames.
        attempt: number of earlier attempts that failed; each takes the next scene.
        """
        epoch, place = divmod(number + attempt, len(self._scenes[0]))
        order = self._orders.get(epoch, lambda: self._draw_epoch(epoch))
        size = np.random.default_rng([self.seed, 2, step]).integers(len(self._openers))
        scene = self._scenes[int(size)][int(order[place])]
        # The first attempt always draws from (seed, 1, number), also if other samples failed.
        key = [self.seed, 1, number]
        rng = np.random.default_rng([*key, attempt] if attempt else key)
        mirror = bool(rng.random() < self.views.mirror)
        return scene, rng, mirror, *self.sampler.draw(scene, self.views, rng, step)

    def _sample_after(self, number: int, attempt: int) -> Sample:
        """Make sample `number`; or its replacement, if `attempt` earlier attempts failed."""
        scene, rng, mirror, inputs, targets = self._drawn(number, number // self.per_step, attempt)
        try:
            return make_sample(scene, inputs, targets, self.views, mirror, rng, self.depths)
        except Exception as error:
            if is_out_of_memory(error):
                raise
            raise SampleError(f"scene {scene.name!r}: {one_line(error)}") from error


def _from_thread(stream: SampleStream, numbers: Iterator[Sequence[int]]) -> Batches:
    """Yield a batch for each list of sample numbers.

    A thread makes the next batch while the caller uses the last one.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="qgs-loader") as pool:
        pending = pool.submit(stream.batch, next(numbers))
        for following in numbers:
            # Taken before the next one starts: files and caches expect one reading thread.
            ready = pending.result()
            pending = pool.submit(stream.batch, following)
            yield ready


def _from_workers(stream: SampleStream, numbers: Iterator[Sequence[int]], workers: int) -> Batches:
    """Yield a batch for each list of sample numbers, made in `workers` other processes.

    Processes are spawned, because numba and torch do not survive a fork.
    """
    loader = DataLoader(
        stream,
        batch_size=None,
        sampler=numbers,
        num_workers=workers,
        multiprocessing_context="spawn",
        worker_init_fn=_prepare_worker,
        # A generator of its own, so that no random number of training is used up.
        generator=torch.Generator(),
    )
    handler = signal.getsignal(signal.SIGCHLD)
    made = iter(loader)
    if threading.current_thread() is threading.main_thread():
        # When a worker dies, torch's handler raises at any point of training. Asking for a batch
        # also raises within seconds, but between two steps.
        signal.signal(signal.SIGCHLD, handler)
    try:
        while True:
            try:
                batch = next(made)
            # Torch raises RuntimeError when a worker dies; a broken connection raises the others.
            except (RuntimeError, OSError, EOFError) as error:
                raise WorkerError(
                    f"a process that decodes data ended suddenly ({error}), often because memory "
                    "ran out: lower training.workers, or use fewer views or smaller images"
                ) from error
            if isinstance(batch, Exception):
                raise batch
            yield batch
    finally:
        # Torch's iterator ends its workers when it is deleted.
        del made


def _prepare_worker(number: int) -> None:
    """Ignore SIGINT and SIGTERM in a worker process; the training process ends its workers.

    number: number of the worker, not used.
    """
    show_safely()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    # Python's normal exit aborts if the thread that sends batches is inside torch.
    atexit.register(os._exit, 0)

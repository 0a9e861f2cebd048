"""Processes that decode training batches."""

from __future__ import annotations

import atexit
import logging
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from qgs.data.sampling import Batch
from qgs.data.stream import SampleError


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

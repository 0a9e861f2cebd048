"""Devices and processes of a run; requests to stop."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from importlib.util import find_spec
from types import FrameType
from typing import TypeAlias

import torch
from accelerate import Accelerator
from accelerate.utils import (
    DistributedDataParallelKwargs,
    DistributedType,
    InitProcessGroupKwargs,
)

TIMEOUT = timedelta(hours=24)
"""Time that processes wait while one evaluates or saves.

NCCL's default of 10 minutes would end such runs. The launcher notices a process that died, and ends
the others."""

_PARALLEL = (DistributedType.NO, DistributedType.MULTI_CPU, DistributedType.MULTI_GPU)


def make_accelerator(device: str, unread: bool) -> Accelerator:
    """Return the processes that a launcher started (DDP), or this one alone.

    unread: some parameters never get a gradient, which DDP must then search for.
    Raises ValueError for a launcher's request of anything but DDP.
    """
    group = InitProcessGroupKwargs(timeout=TIMEOUT)
    parallel = DistributedDataParallelKwargs(find_unused_parameters=unread)
    # Its own mixed precision would run geometry and losses in half precision too.
    accelerator = Accelerator(
        cpu=device == "cpu", mixed_precision="no", kwargs_handlers=[group, parallel]
    )
    if accelerator.distributed_type not in _PARALLEL:
        kind = accelerator.distributed_type.value
        raise ValueError(f"training runs in one process or under DDP: launch it without {kind}")
    return accelerator


DEVICES = ("auto", "cpu", "cuda")


def choose_device(wanted: str, say: Callable[[str], None] = print) -> str:
    """Return "cpu" or "cuda" for one of DEVICES.

    "auto" takes CUDA if there is one and gsplat is installed; `say` gets a note if it is missing.
    Raises ValueError for another name, and for "cuda" where there is none.
    """
    if wanted not in DEVICES:
        raise ValueError(f"the device must be one of {', '.join(DEVICES)}, got {wanted!r}")
    available = torch.cuda.is_available()
    if wanted == "cuda" and not available:
        raise ValueError(
            "the device 'cuda' was asked for, but torch finds none: install a torch with CUDA and "
            "its driver, or choose 'cpu'"
        )
    if wanted != "auto":
        return wanted
    # The renderer `qgs/auto` has only gsplat for tensors on a GPU.
    if available and find_spec("gsplat") is None:
        say(
            "Computing on the CPU although a CUDA device is there: its renderer, gsplat, is not "
            'installed (`pip install "query-gaussians[gsplat]"`, or --device cuda for recipes with '
            "another one)"
        )
        return "cpu"
    return "cuda" if available else "cpu"


StopRequest: TypeAlias = list[signal.Signals]
"""The signals that asked to stop; empty, thus false, until one does."""


@contextmanager
def stop_requests(quiet: bool) -> Iterator[StopRequest]:
    """Turn SIGINT and SIGTERM inside the block into a request; print so once unless `quiet`.

    Does nothing outside the main thread, where Python cannot handle signals.
    """
    request: StopRequest = []
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def ask(number: int, frame: FrameType | None) -> None:
        asked = signal.Signals(number)
        message = f"\n{asked.name}: finishing the step, then saving (Ctrl-\\ ends at once)\n"
        # Launchers and terminals each send the signal: repeats mean nothing new.
        if not (quiet or request):
            # Not print, which is not reentrant: a handler may interrupt it.
            os.write(2, message.encode())
        request.append(asked)

    # Restored afterwards: a notebook goes on with handlers of its own.
    before = {s: signal.signal(s, ask) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

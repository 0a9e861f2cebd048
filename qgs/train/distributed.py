"""Devices, processes and random states of a run; requests to stop."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from importlib.util import find_spec
from types import FrameType
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import (
    DistributedDataParallelKwargs,
    DistributedType,
    InitProcessGroupKwargs,
    gather_object,
)
from torch import Tensor

TIMEOUT = timedelta(hours=24)
"""How long processes wait while one evaluates or saves. NCCL's default of 10 minutes would end such
runs; a process that died is noticed by the launcher, which ends the others."""

_PARALLEL = (DistributedType.NO, DistributedType.MULTI_CPU, DistributedType.MULTI_GPU)


def make_accelerator(device: str, unread: bool = False) -> Accelerator:
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


def mean(accelerator: Accelerator, value: Tensor) -> Tensor:
    """Return the mean of `value` over processes, which must all call this."""
    reduced: Any = accelerator.reduce(value, "mean")
    return reduced


def true_anywhere(accelerator: Accelerator, flag: object) -> bool:
    """Return whether `flag` is true in any process; all must call this, and all get one answer."""
    own = torch.tensor(float(bool(flag)), device=accelerator.device)
    return bool(mean(accelerator, own))


@dataclass
class RandomStates:
    """Torch's generators, of every process by its rank; components draw from no others."""

    accelerator: Accelerator

    def state(self) -> dict[str, Any]:
        """Return the states; all processes must call this."""
        own = {"torch": torch.get_rng_state()}
        if self.accelerator.device.type == "cuda":
            own["cuda"] = torch.cuda.get_rng_state(self.accelerator.device)
        ranks = enumerate(gather_object([own]))
        return {f"{rank}/{key}": value for rank, found in ranks for key, value in found.items()}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore this process's generators; a rank that `state` lacks keeps its own."""
        rank = self.accelerator.process_index
        # A run may go on in more processes than it was saved by.
        if rank and f"{rank}/torch" not in state:
            return
        torch.set_rng_state(state[f"{rank}/torch"])
        on_device = state.get(f"{rank}/cuda")
        if self.accelerator.device.type == "cuda" and on_device is not None:
            torch.cuda.set_rng_state(on_device, self.accelerator.device)


DEVICES = ("auto", "cpu", "cuda")


def choose_device(wanted: str = "auto", say: Callable[[str], None] = print) -> str:
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


@dataclass
class StopRequest:
    """A request to stop training, true once there is one. signal: the first that asked."""

    signal: signal.Signals | None = None

    def __bool__(self) -> bool:
        return self.signal is not None


@contextmanager
def stop_requests(quiet: bool = False) -> Iterator[StopRequest]:
    """Turn SIGINT and SIGTERM inside the block into a request; print so once unless `quiet`.

    Does nothing outside the main thread, where Python cannot handle signals.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def ask(number: int, frame: FrameType | None) -> None:
        # Launchers and terminals each send the signal: repeats mean nothing new.
        if request:
            return
        request.signal = signal.Signals(number)
        message = f"{request.signal.name}: finishing the step, then saving (Ctrl-\\ ends at once)"
        # Not print, which is not reentrant: a handler may interrupt it.
        if not quiet:
            os.write(2, f"\n{message}\n".encode())

    # Restored afterwards: a notebook goes on with handlers of its own.
    before = {s: signal.signal(s, ask) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

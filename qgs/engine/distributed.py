"""Devices and processes of a run, and asking it to stop."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from importlib.util import find_spec
from types import FrameType

import torch
from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs, InitProcessGroupKwargs
from torch import Tensor, nn
from torch.distributed.fsdp import FSDPModule, fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor

from qgs.model import QueryGaussianModel

TIMEOUT = timedelta(hours=24)
"""How long processes wait for each other while one evaluates or saves; torch's own 10 minutes with
NCCL would end such runs. A process that died is noticed by the launcher, which ends the others."""


def make_accelerator(device: str, unread: bool = False) -> Accelerator:
    """The processes that a launcher started, or this one alone; autocast is the trainer's own.

    unread: whether some parameters never get a gradient, which processes must then look for.
    """
    group = InitProcessGroupKwargs(timeout=TIMEOUT)
    parallel = DistributedDataParallelKwargs(find_unused_parameters=unread)
    options = {"cpu": device == "cpu", "mixed_precision": "no"}
    return Accelerator(**options, kwargs_handlers=[group, parallel])


def wants_shards(accelerator: Accelerator) -> bool:
    """Whether `accelerate launch --use_fsdp` started several processes."""
    asked = os.environ.get("ACCELERATE_USE_FSDP", "false").lower() in ("1", "true")
    return asked and accelerator.num_processes > 1


def shard(model: QueryGaussianModel) -> None:
    """Lay the parameters of `model` in shards over all processes (FSDP2), in place.

    Each decoder layer gathers its own when it runs. Scalars stay whole, see `average_gradients`.
    """
    scalars = {parameter for parameter in model.parameters() if parameter.ndim == 0}
    for layer in model.decoder:
        fully_shard(layer, ignored_params=scalars)
    fully_shard(model, ignored_params=scalars)


def sharded(module: nn.Module) -> list[FSDPModule]:
    """The modules inside `module` whose parameters `shard` laid in shards."""
    return [inner for inner in module.modules() if isinstance(inner, FSDPModule)]


@contextmanager
def unsynchronised(accelerator: Accelerator, module: nn.Module) -> Iterator[None]:
    """Leave gradients unshared between processes for the `with` block; a later pass shares them."""
    shards = sharded(module)
    for inner in shards:
        inner.set_requires_gradient_sync(False, recurse=False)
    try:
        with accelerator.no_sync(module):
            yield
    finally:
        for inner in shards:
            inner.set_requires_gradient_sync(True, recurse=False)


def average_gradients(accelerator: Accelerator, module: nn.Module) -> None:
    """Average the gradients of parameters that are whole beside others in shards."""
    if not sharded(module):
        return
    for parameter in module.parameters():
        if parameter.grad is not None and not isinstance(parameter, DTensor):
            parameter.grad.copy_(mean(accelerator, parameter.grad))


def mean(accelerator: Accelerator, value: Tensor) -> Tensor:
    """Mean of `value` over processes."""
    reduced = accelerator.reduce(value, "mean")
    assert isinstance(reduced, Tensor)
    return reduced


def whole(tensor: Tensor) -> Tensor:
    """`tensor` without gradient; where processes hold shards of it, gathered, in host memory.

    All processes must call this.
    """
    tensor = tensor.detach()
    return tensor.full_tensor().cpu() if isinstance(tensor, DTensor) else tensor


def placed_like(tensor: Tensor, other: Tensor) -> Tensor:
    """The whole `tensor` on the device of `other`, as shards where `other` lies in shards."""
    tensor = tensor.to(other.device)
    if not isinstance(other, DTensor) or tensor.shape != other.shape:
        return tensor
    return distribute_tensor(tensor, other.device_mesh, other.placements, src_data_rank=None)


DEVICES = ("auto", "cpu", "cuda")


def choose_device(wanted: str = "auto", say: Callable[[str], None] = print) -> str:
    """ "cpu" or "cuda" for one of DEVICES; raises ValueError for others, or for "cuda" without one.

    "auto" takes CUDA where there is one and gsplat is installed; `say` is called if it is missing.
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
    if available and find_spec("gsplat") is None:
        say(
            "Computing on the CPU although a CUDA device is there: its renderer, gsplat, is not "
            'installed (`pip install "query-gaussians[gsplat]"`, or --device cuda for recipes with '
            "another one)"
        )
        return "cpu"
    return "cuda" if available else "cpu"


PAUSE = 1.0
"""Seconds after which a second Ctrl-C is a person's: launchers and terminals repeat theirs."""


@dataclass
class StopRequest:
    """Whether someone asked training to stop, and by which signal."""

    signal: signal.Signals | None = None

    def __bool__(self) -> bool:
        return self.signal is not None


@contextmanager
def stop_requests(quiet: bool = False) -> Iterator[StopRequest]:
    """Turn the first SIGINT or SIGTERM inside the block into a request, and say so unless `quiet`.

    Launchers repeat their signals, so later ones are ignored; only a second SIGINT, PAUSE seconds
    or more after the first, raises KeyboardInterrupt. Outside the main thread none ever comes.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    gives_up_at = float("inf")

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal gives_up_at
        if number == signal.SIGINT:
            if time.monotonic() >= gives_up_at:
                raise KeyboardInterrupt
            gives_up_at = min(gives_up_at, time.monotonic() + PAUSE)
        if not request:
            request.signal = signal.Signals(number)
            message = f"{request.signal.name}: finishing the step, saving; Ctrl-C again to give up"
            if not quiet:  # not by print, which must not be entered twice
                os.write(2, f"\n{message}\n".encode())

    before = {s: signal.signal(s, ask) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

"""Device and processes of a training run, and signals that ask it to stop."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from importlib.util import find_spec
from types import FrameType

import torch
from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs, DistributedType, InitProcessGroupKwargs

TIMEOUT = timedelta(hours=24)
"""Longest time that processes wait for each other, such as while one evaluates or saves.

NCCL's default of 10 minutes would end a run with a long evaluation. If a process dies, the launcher
ends all others.
"""


def make_accelerator(device: str, unread: bool) -> Accelerator:
    """Return an Accelerator for all processes that a launcher started (DDP), or for one process.

    device: "cpu" or "cuda". unread: whether some parameters never get a gradient, so that DDP must
        search for them.
    Raises ValueError if the launcher asks for anything but DDP.
    """
    group = InitProcessGroupKwargs(timeout=TIMEOUT)
    parallel = DistributedDataParallelKwargs(find_unused_parameters=unread)
    # Its own mixed precision would run geometry and losses in half precision too.
    accelerator = Accelerator(
        cpu=device == "cpu", mixed_precision="no", kwargs_handlers=[group, parallel]
    )
    if accelerator.distributed_type not in (
        DistributedType.NO,
        DistributedType.MULTI_CPU,
        DistributedType.MULTI_GPU,
    ):
        kind = accelerator.distributed_type.value
        raise ValueError(f"training supports one process or DDP only: launch it without {kind}")
    return accelerator


DEVICES = ("auto", "cpu", "cuda")


def choose_device(wanted: str, say: Callable[[str], None] = print) -> str:
    """Return the device "cpu" or "cuda" for `wanted`, which is "auto", "cpu" or "cuda".

    "auto" chooses CUDA if a CUDA device exists and gsplat is installed. If only gsplat is missing,
    `say` gets a message on how to use CUDA. Raises ValueError for an unknown name, and for "cuda"
    without a CUDA device.
    """
    if wanted not in DEVICES:
        raise ValueError(f"the device must be one of {', '.join(DEVICES)}, got {wanted!r}")
    available = torch.cuda.is_available()
    if wanted == "cuda" and not available:
        raise ValueError(
            "torch finds no CUDA device: install a torch with CUDA and the driver, or choose the "
            "device 'cpu'"
        )
    if wanted != "auto":
        return wanted
    # On a GPU, the renderer `qgs/auto` can only use gsplat.
    if available and find_spec("gsplat") is None:
        say(
            "Computing on the CPU although there is a CUDA device, because gsplat is not "
            'installed. Run `pip install "query-gaussians[gsplat]"`, or pass --device cuda if the '
            "recipe has another renderer"
        )
        return "cpu"
    return "cuda" if available else "cpu"


StopRequest = list[signal.Signals]
"""Signals that asked the run to stop. The list is empty until a signal arrives."""


@contextmanager
def stop_requests(quiet: bool) -> Iterator[StopRequest]:
    """Collect the signals SIGINT and SIGTERM inside the block, and announce the first on stderr.

    quiet: whether to announce nothing. Outside the main thread no signal is collected, because
        Python handles signals only there.
    """
    request: StopRequest = []
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def ask(number: int, frame: FrameType | None) -> None:
        asked = signal.Signals(number)
        message = f"\n{asked.name}: finishing the step, then saving (Ctrl-\\ ends at once)\n"
        # Launchers and terminals both send the signal, so only the first one is news.
        if not (quiet or request):
            # `print` is not reentrant, and a handler may interrupt it.
            os.write(2, message.encode())
        request.append(asked)

    # Restored afterwards, because a notebook has handlers of its own.
    with ExitStack() as before:
        for number in (signal.SIGINT, signal.SIGTERM):
            before.callback(signal.signal, number, signal.signal(number, ask))
        yield request

"""Ctrl-C and SIGTERM end training between two steps, not inside one."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

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

    Launchers (torchrun, Slurm) send their signals more than once, so that later ones are ignored;
    only a second SIGINT, PAUSE seconds or more after the first, raises KeyboardInterrupt.
    Outside the main thread, where Python delivers no signals, requests never come.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    patience_ends = float("inf")

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal patience_ends
        if number == signal.SIGINT:
            if time.monotonic() >= patience_ends:
                raise KeyboardInterrupt
            patience_ends = min(patience_ends, time.monotonic() + PAUSE)
        if request:
            return
        request.signal = signal.Signals(number)
        if not quiet:  # not by print, which must not be entered twice
            told = f"\n{request.signal.name}: finishing the step, saving; Ctrl-C again to give up\n"
            os.write(2, told.encode())

    before = {s: signal.signal(s, ask) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

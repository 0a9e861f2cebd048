"""How long a run has trained, the same on all processes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from accelerate import Accelerator

from qgs.engine.processes import mean


class Clock:
    """Seconds of training, over all sessions of a run.

    A session's clock starts after its first step, in which kernels compile.
    """

    def __init__(self, accelerator: Accelerator) -> None:
        self.seconds = 0.0
        self._accelerator = accelerator
        self._before = 0.0
        self._started: float | None = None

    def tick(self) -> None:
        """Bring `seconds` up to date: the mean over processes, so that all decide alike."""
        now = time.perf_counter()
        if self._started is None:
            self._started = now
        elapsed = torch.tensor(now - self._started, device=self._accelerator.device)
        self.seconds = self._before + float(mean(self._accelerator, elapsed))

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Leave the time of the `with` block out."""
        since = time.perf_counter()
        yield
        if self._started is not None:
            self._started += time.perf_counter() - since

    def state(self) -> dict[str, Any]:
        """See `qgs.engine.state.Stateful`."""
        return {"seconds": self.seconds}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """See `qgs.engine.state.Stateful`."""
        self.seconds = self._before = state["seconds"]

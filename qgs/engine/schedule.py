"""One-cycle cosine learning rate that also follows a time budget."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from qgs.contracts import TrainingConfig

WARMUP_TIME = 0.1
"""Largest part of a time budget that warm-up may take."""


class OneCycle:
    """Cosine from peak / initial_divisor to the peak, then down by final_divisor from the start.

    Warm-up ends after `warmup` optimiser steps, or after WARMUP_TIME of a time budget if that comes
    first. The descent follows the fraction of the budget that is used, the larger of steps and
    seconds; with steps alone this is torch's `OneCycleLR` with pct_start = warmup / steps.
    Raises ValueError when the warm-up fills all steps and no time budget shortens it.
    """

    def __init__(self, config: TrainingConfig) -> None:
        self.config = config
        self.peak = config.learning_rate
        self.first = config.learning_rate / config.initial_divisor
        self.last = self.first / config.final_divisor
        self._descent_starts: float | None = None
        if config.seconds is None and config.warmup >= config.steps:
            raise ValueError(
                f"training.warmup is {config.warmup}, but training.steps is {config.steps}: the "
                "learning rate would never come down; lower warmup or train for longer"
            )

    def rate(self, step: int, seconds: float) -> float:
        """Learning rate of the `step`-th optimiser step (0 is the first), `seconds` into training.

        To be called with ascending steps.
        """
        used = self._used(step, seconds)
        if self._descent_starts is None:
            warmed = self._warmed(step, seconds)
            if warmed < 1:
                return _cosine(self.first, self.peak, warmed)
            self._descent_starts = used
        left = 1 - self._descent_starts
        part = (used - self._descent_starts) / left if left > 0 else 1.0
        return _cosine(self.peak, self.last, min(part, 1.0))

    def state(self) -> dict[str, float | None]:
        """See `qgs.engine.state.Stateful`."""
        return {"descent_starts": self._descent_starts}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """See `qgs.engine.state.Stateful`."""
        self._descent_starts = state["descent_starts"]

    def _warmed(self, step: int, seconds: float) -> float:
        """Fraction of the warm-up that is over; may exceed 1."""
        top = self.config.warmup - 1
        of_steps = step / top if top > 0 else 1.0
        of_seconds = seconds / (WARMUP_TIME * self.config.seconds) if self.config.seconds else 0.0
        return max(of_steps, of_seconds)

    def _used(self, step: int, seconds: float) -> float:
        of_steps = step / max(self.config.steps - 1, 1)
        of_seconds = seconds / self.config.seconds if self.config.seconds else 0.0
        return min(max(of_steps, of_seconds), 1.0)


def _cosine(start: float, end: float, part: float) -> float:
    return end + (start - end) / 2 * (1 + math.cos(math.pi * part))

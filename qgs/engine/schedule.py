"""One-cycle cosine learning rate that also follows a time budget."""

from __future__ import annotations

import math

from qgs.contracts import TrainingConfig


class OneCycle:
    """Cosine from peak / initial_divisor to the peak, then down by final_divisor from the start.

    Warm-up counts optimiser steps. The descent follows the fraction of the budget that is used,
    the larger of steps and seconds; with steps alone this is torch's `OneCycleLR` with
    pct_start = warmup / steps.
    """

    def __init__(self, config: TrainingConfig) -> None:
        self.config = config
        self.peak = config.learning_rate
        self.first = config.learning_rate / config.initial_divisor
        self.last = self.first / config.final_divisor
        self._descent_starts = 0.0

    def rate(self, step: int, seconds: float) -> float:
        """Learning rate of the `step`-th optimiser step (0 is the first), `seconds` into training.

        To be called with ascending steps.
        """
        top = self.config.warmup - 1
        used = self._used(step, seconds)
        if step <= top:
            self._descent_starts = used
            return _cosine(self.first, self.peak, step / top if top > 0 else 1.0)
        left = 1 - self._descent_starts
        part = (used - self._descent_starts) / left if left > 0 else 1.0
        return _cosine(self.peak, self.last, min(part, 1.0))

    def _used(self, step: int, seconds: float) -> float:
        of_steps = step / max(self.config.steps - 1, 1)
        of_seconds = seconds / self.config.seconds if self.config.seconds else 0.0
        return min(max(of_steps, of_seconds), 1.0)


def _cosine(start: float, end: float, part: float) -> float:
    return end + (start - end) / 2 * (1 + math.cos(math.pi * part))

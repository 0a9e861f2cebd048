"""Seconds of several tasks, in turn, so that whatever else the machine does slows all alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from torch.utils.benchmark import timer

from qgs.engine.bench.tasks import Task


@dataclass(frozen=True)
class Spread:
    """Samples, their median and their lower and upper quartile (linear interpolation)."""

    samples: tuple[float, ...]

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """Lower quartile, median, upper quartile."""
        lower, median, upper = np.quantile(self.samples, (0.25, 0.5, 0.75)).tolist()
        return lower, median, upper

    @property
    def median(self) -> float:
        """The middle of the samples."""
        return self.quartiles[1]

    def over(self, base: Spread) -> Spread:
        """Ratios to the samples that `base` has of the same rounds."""
        pairs = zip(self.samples, base.samples, strict=True)
        return Spread(tuple(ours / theirs for ours, theirs in pairs))


def in_turn(
    tasks: Sequence[Task], rounds: int, warmup: int, say: Callable[[str], None] = lambda _: None
) -> list[Spread]:
    """Seconds of each task: `warmup` calls of each unmeasured, then all of them in every round.

    The clock is that of torch.utils.benchmark, which waits for a GPU. `say` hears of each round.
    """
    for number in range(warmup):
        say(f"warm-up {number + 1} of {warmup}")
        for task in tasks:
            task()
    columns: list[list[float]] = [[] for _ in tasks]
    for number in range(rounds):
        say(f"round {number + 1} of {rounds}")
        for task, column in zip(tasks, columns, strict=True):
            start = timer()
            task()
            column.append(timer() - start)
    return [Spread(tuple(column)) for column in columns]

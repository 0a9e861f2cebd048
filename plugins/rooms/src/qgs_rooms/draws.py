"""Single random numbers, drawn quickly."""

from __future__ import annotations

import random


class Draws(random.Random):
    """Python's generator under the names of NumPy's, whose single draws are far slower."""

    def integers(self, low: int, high: int | None = None) -> int:
        """A whole number in [low, high), or in [0, low)."""
        return self.randrange(low) if high is None else self.randrange(low, high)

    def several(self, low: float, high: float, count: int) -> list[float]:
        """`count` numbers in [low, high]."""
        return [self.uniform(low, high) for _ in range(count)]

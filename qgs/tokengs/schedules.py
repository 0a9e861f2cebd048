"""Kinds of schedules, which a recipe can use for numbers that change during training."""

import math
from bisect import bisect_right
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from qgs.contracts.component import OptionError
from qgs.contracts.schedule import Schedule

Step: TypeAlias = Annotated[int, Field(ge=0)]


class Constant(Schedule):
    """A constant number, the same as a plain number."""

    schedule: Literal["constant"]
    """A constant number, the same as a plain number."""
    value: float
    """The constant number."""

    def number(self, step: int) -> float:
        """See `Schedule`."""
        return self.value


class _Listed(Schedule):
    """Schedule with ascending steps `at`, one of `values` for each step, and `more` values."""

    more: ClassVar[int] = 0
    values: tuple[float, ...]
    at: tuple[int, ...]

    @model_validator(mode="after")
    def _values_fit(self) -> Self:
        steps = list(self.at)
        if steps != sorted(set(steps)):
            raise OptionError(f"`at` must ascend, got {steps}", f"write {sorted(set(steps))}")
        wanted = len(steps) + self.more
        if len(self.values) != wanted:
            raise OptionError(
                f"{len(steps)} steps in `at` need {wanted} values, got {len(self.values)}",
                "`linear` and `cosine` need one value per step in `at`, `steps` one more",
            )
        return self

    @property
    def corners(self) -> tuple[int, ...]:
        """See `Schedule`."""
        return self.at


class Steps(_Listed):
    """Steps: `values[0]` first, then each further value from its step on."""

    more: ClassVar[int] = 1
    schedule: Literal["steps"]
    """One number for each range of steps."""
    values: tuple[float, ...]
    """The numbers, one more than the steps in `at`."""
    at: tuple[Annotated[int, Field(ge=1)], ...] = Field(min_length=1)
    """Ascending steps; each starts the next value."""

    def number(self, step: int) -> float:
        """See `Schedule`."""
        return self.values[bisect_right(self.at, step)]

    @property
    def corners(self) -> tuple[int, ...]:
        """See `Schedule`. The last step before each jump is a corner too."""
        before = [max(at - 1, 0) for at in self.at]
        return (*before, *self.at)


class Linear(_Listed):
    """Interpolation between numbers over ranges of steps; constant before and after."""

    schedule: Literal["linear", "cosine"]
    """Interpolation on lines, or on half cosines, which are slow at both ends."""
    values: tuple[float, ...] = Field(min_length=2)
    """The numbers at the steps in `at`. The first also holds before, the last after them."""
    at: tuple[Step, ...]
    """Ascending steps, one for each of `values`."""

    def number(self, step: int) -> float:
        """See `Schedule`."""
        after = bisect_right(self.at, step)
        if after in (0, len(self.at)):
            return self.values[min(after, len(self.at) - 1)]
        first, last = self.at[after - 1 : after + 1]
        start, end = self.values[after - 1 : after + 1]
        share = (step - first) / (last - first)
        if self.schedule == "cosine":
            share = (1 - math.cos(math.pi * share)) / 2
        return (1 - share) * start + share * end


SCHEDULES: Mapping[str, type[Schedule]] = {
    "constant": Constant, "steps": Steps, "linear": Linear, "cosine": Linear
}  # fmt: skip
"""Kinds of schedules, by their name in a recipe."""

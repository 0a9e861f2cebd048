"""Kinds of schedules: what a recipe writes for a number that follows the steps of training."""

import math
from bisect import bisect_right
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from qgs.contracts.component import OptionError
from qgs.contracts.schedule import Schedule

Step: TypeAlias = Annotated[int, Field(ge=0)]


class Constant(Schedule):
    """One number, as if it were written alone."""

    schedule: Literal["constant"]
    """One number, as if it were written alone."""
    value: float
    """The number."""

    def number(self, step: int) -> float:
        """See `Schedule`."""
        return self.value


class _Listed(Schedule):
    """A number by ascending steps `at`, and one of `values` for each of them, or `more`."""

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
                "give `linear` and `cosine` as many values as steps, `steps` the first one besides",
            )
        return self

    @property
    def corners(self) -> tuple[int, ...]:
        """See `Schedule`."""
        return self.at


class Steps(_Listed):
    """`values[0]` first, and each further value from its step on."""

    more: ClassVar[int] = 1
    schedule: Literal["steps"]
    """A number for each of several ranges of steps."""
    values: tuple[float, ...]
    """The numbers, one more than there are steps in `at`."""
    at: tuple[Annotated[int, Field(ge=1)], ...] = Field(min_length=1)
    """Steps after which the next value holds, ascending."""

    def number(self, step: int) -> float:
        """See `Schedule`."""
        return self.values[bisect_right(self.at, step)]

    @property
    def corners(self) -> tuple[int, ...]:
        """See `Schedule`; others go on until the last step before a jump."""
        before = [max(at - 1, 0) for at in self.at]
        return (*before, *self.at)


class Linear(_Listed):
    """From each number to the next one over a range of steps; constant before and after."""

    schedule: Literal["linear", "cosine"]
    """From number to number on lines, or on halves of a cosine, which are slow at both ends."""
    values: tuple[float, ...] = Field(min_length=2)
    """The numbers at the steps in `at`: the first also before, the last also after them."""
    at: tuple[Step, ...]
    """Steps, ascending, one for each of `values`."""

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
"""By the word under `schedule` in a recipe."""

"""Kinds of schedules: what a recipe writes for a number that follows the steps of training."""

import math
from bisect import bisect_right
from collections.abc import Mapping
from typing import Annotated, Literal, Self, TypeAlias

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


class Steps(Schedule):
    """`values[0]` first, and each further value from its step on."""

    schedule: Literal["steps"]
    """A number for each of several ranges of steps."""
    values: tuple[float, ...]
    """The numbers, one more than there are steps in `at`."""
    at: tuple[Annotated[int, Field(ge=1)], ...] = Field(min_length=1)
    """Steps after which the next value holds, ascending."""

    @model_validator(mode="after")
    def _one_value_more(self) -> Self:
        steps = _ascending(self.at)
        count = len(self.values)
        if count != len(steps) + 1:
            reason = f"{len(steps)} steps in `at` part {len(steps) + 1} values, got {count}"
            raise OptionError(reason, "give one value more than steps; the first holds from 0")
        return self

    def number(self, step: int) -> float:
        """See `Schedule`."""
        return self.values[bisect_right(self.at, step)]

    @property
    def corners(self) -> tuple[int, ...]:
        """See `Schedule`; others go on until the last step before a jump."""
        return tuple(step for at in self.at for step in (max(at - 1, 0), at))


class Linear(Schedule):
    """From each number to the next one over a range of steps; constant before and after."""

    schedule: Literal["linear", "cosine"]
    """From number to number on lines, or on halves of a cosine, which are slow at both ends."""
    values: tuple[float, ...] = Field(min_length=2)
    """The numbers at the steps in `at`: the first also before, the last also after them."""
    at: tuple[Step, ...]
    """Steps, ascending, one for each of `values`."""

    @model_validator(mode="after")
    def _one_step_each(self) -> Self:
        steps = _ascending(self.at)
        count = len(self.values)
        if count != len(steps):
            reason = f"{count} values need {count} steps in `at`, got {len(steps)}"
            raise OptionError(reason, "give a step for each value; for jumps, `schedule: steps`")
        return self

    def number(self, step: int) -> float:
        """See `Schedule`."""
        after = bisect_right(self.at, step)
        if after in (0, len(self.at)):
            return self.values[min(after, len(self.at) - 1)]
        (first, last), (start, end) = self.at[after - 1 : after + 1], self.values[after - 1 :][:2]
        share = (step - first) / (last - first)
        if self.schedule == "cosine":
            share = (1 - math.cos(math.pi * share)) / 2
        return (1 - share) * start + share * end

    @property
    def corners(self) -> tuple[int, ...]:
        """See `Schedule`."""
        return self.at


def _ascending(at: tuple[int, ...]) -> list[int]:
    """The steps; raises OptionError where they do not ascend."""
    if (steps := list(at)) != sorted(set(steps)):
        raise OptionError(f"`at` must ascend, got {steps}", f"write {sorted(set(steps))}")
    return steps


SCHEDULES: Mapping[str, type[Schedule]] = {
    "constant": Constant, "steps": Steps, "linear": Linear, "cosine": Linear
}  # fmt: skip
"""By the word under `schedule` in a recipe."""

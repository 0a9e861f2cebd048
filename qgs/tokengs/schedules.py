"""Kinds of schedules, by which a recipe makes numeric options change during training."""

import math
from bisect import bisect_right
from collections.abc import Mapping
from typing import ClassVar, Literal, Self

from pydantic import Field, NonNegativeInt, PositiveInt, model_validator

from qgs.contracts.component import OptionError
from qgs.contracts.schedule import Schedule


class Constant(Schedule):
    """A constant number; it has the same effect as a plain number."""

    schedule: Literal["constant"]
    """A constant number; it has the same effect as a plain number."""
    value: float
    """The constant number."""

    def number(self, step: int) -> float:
        return self.value


class _Listed(Schedule):
    """Schedule with a list `at` of ascending steps and a list `values` of numbers.

    more: by how much `values` must be longer than `at`.
    """

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
                "give `linear` and `cosine` one value per step in `at`, and `steps` one value more",
            )
        return self

    @property
    def corners(self) -> tuple[int, ...]:
        return self.at


class Steps(_Listed):
    """Step function: `values[0]` at first, and `values[i + 1]` from step `at[i]` on."""

    more = 1
    schedule: Literal["steps"]
    """Step function: one constant number for each range of training steps."""
    values: tuple[float, ...]
    """The numbers in order, one more than there are steps in `at`."""
    at: tuple[PositiveInt, ...] = Field(min_length=1)
    """Ascending training steps. At each of these steps the next value starts."""

    def number(self, step: int) -> float:
        return self.values[bisect_right(self.at, step)]

    @property
    def corners(self) -> tuple[int, ...]:
        """Steps in `at`, and the last step before each of them."""
        return (*(at - 1 for at in self.at), *self.at)


class Linear(_Listed):
    """Interpolation between `values` at the steps `at`; outside of these steps, constant."""

    schedule: Literal["linear", "cosine"]
    """Interpolate linearly, or along half cosines, whose slope is 0 at each step of `at`."""
    values: tuple[float, ...] = Field(min_length=2)
    """The numbers at the steps in `at`. The first one also holds before the first step, the last
    one after the last step."""
    at: tuple[NonNegativeInt, ...]
    """Ascending training steps, one for each of `values`."""

    def number(self, step: int) -> float:
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
"""Classes of schedules, by their name in a recipe."""

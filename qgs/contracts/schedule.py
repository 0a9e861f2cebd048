"""Options that follow the progress of training: what a recipe writes in place of a number."""

import math
from abc import abstractmethod
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from types import UnionType
from typing import Annotated, Any, Literal, Self, TypeAlias, TypeVar, Union, get_args, get_origin

from pydantic import Field, model_validator

from qgs.contracts.component import Component, ComponentConfig, OptionError

ConfigT = TypeVar("ConfigT", bound=ComponentConfig)
Step: TypeAlias = Annotated[int, Field(ge=0)]
END = 2**53
"""A step after the end of every schedule."""


class Schedule(ComponentConfig):
    """A number as a function of the optimiser steps that were made: 0 in the first step."""

    schedule: str
    """What kind of schedule it is."""

    @abstractmethod
    def number(self, step: int) -> float:
        """The number after `step` steps."""

    @property
    def corners(self) -> tuple[int, ...]:
        """Steps besides 0 between which the number goes one way: its extremes are at these."""
        return ()


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
        steps, count = _ascending(self.at), len(self.values)
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
        steps, count = _ascending(self.at), len(self.values)
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


def number_kinds(annotation: Any) -> set[type]:
    """Which of int and float an option of this type can hold; none where it is no number."""
    if annotation in (int, float):
        return {annotation}
    parts = get_args(annotation) if get_origin(annotation) in (Union, UnionType, Annotated) else ()
    return {kind for part in parts for kind in number_kinds(part)}


def at_step(config: ConfigT, schedules: Mapping[str, Schedule], step: int) -> ConfigT:
    """`config` with the numbers after `step` steps, rounded for options that are whole numbers."""
    fields, numbers = type(config).model_fields, {n: s.number(step) for n, s in schedules.items()}
    whole = [name for name in numbers if float not in number_kinds(fields[name].annotation)]
    return config.model_copy(update=numbers | {name: round(numbers[name]) for name in whole})


def follow(parts: Iterable[object], step: int) -> None:
    """Give those of `parts` that are components the options that they have after `step` steps."""
    for part in parts:
        if isinstance(part, Component) and part.schedules:
            part.config, part.followed = at_step(part.config, part.schedules, step), step


def steps_followed(parts: Iterable[object]) -> int | None:
    """The step that `follow` has given `parts`; None where no option follows one."""
    found = [x.followed for x in parts if isinstance(x, Component) and x.schedules]
    return found[0] if found else None

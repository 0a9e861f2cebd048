"""Numbers that follow the steps of training; the kinds are in `qgs.tokengs.schedules`."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from typing import TypeVar

from qgs.contracts.component import Component, ComponentConfig

ConfigT = TypeVar("ConfigT", bound=ComponentConfig)
# A float counts every step up to here.
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
        """Steps, without 0, between which the number is monotonic: its extremes are at these."""
        return ()


def at_step(config: ConfigT, schedules: Mapping[str, Schedule], step: int) -> ConfigT:
    """`config` with the numbers after `step` steps, rounded for options that are whole numbers."""
    numbers = {name: schedule.number(step) for name, schedule in schedules.items()}
    for name in numbers:
        if isinstance(getattr(config, name), int):
            numbers[name] = round(numbers[name])
    # Every value was within its limits at the corners, so that it is not checked again.
    return config.model_copy(update=numbers)


def follow(parts: Iterable[object], step: int) -> None:
    """Give those of `parts` that are components the options that they have after `step` steps."""
    for part in parts:
        # Modules of torch are among the parts as well.
        if isinstance(part, Component) and part.schedules:
            part.config = at_step(part.config, part.schedules, step)
            part.followed = step


def steps_followed(parts: Iterable[object]) -> int | None:
    """The step that `follow` has given `parts`; None where no option follows one."""
    found = [x.followed for x in parts if isinstance(x, Component) and x.schedules]
    return found[0] if found else None

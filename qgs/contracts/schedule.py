"""Contract of schedules, for options that change during training.

The kinds of schedules are in `qgs.tokengs.schedules`.
"""

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from typing import TypeVar

from qgs.contracts.component import Component, ComponentConfig

ConfigT = TypeVar("ConfigT", bound=ComponentConfig)
# A float counts every step up to here.
END = 2**53
"""Step number after the end of every schedule."""


class Schedule(ComponentConfig):
    """A number that depends on how many optimiser steps are finished (0 during the first step)."""

    schedule: str
    """Name of the kind of schedule, such as linear."""

    @abstractmethod
    def number(self, step: int) -> float:
        """Return the value of the schedule after `step` optimiser steps."""

    @property
    def corners(self) -> tuple[int, ...]:
        """Steps after 0 at which the value may turn from rising to falling or back.

        Between these steps the value is monotonic, so its extremes lie at these steps or step 0.
        """
        return ()


def at_step(config: ConfigT, schedules: Mapping[str, Schedule], step: int) -> ConfigT:
    """Return `config` with the values of `schedules` after `step` steps.

    Values of integer options are rounded.
    """
    numbers = {name: schedule.number(step) for name, schedule in schedules.items()}
    for name in numbers:
        if isinstance(getattr(config, name), int):
            numbers[name] = round(numbers[name])
    # Every value was within its limits at the corners, so that it is not checked again.
    return config.model_copy(update=numbers)


def follow(parts: Iterable[object], step: int) -> None:
    """Set scheduled options of the components in `parts` to their values after `step` steps."""
    for part in parts:
        # Modules of torch are among the parts as well.
        if isinstance(part, Component) and part.schedules:
            part.config = at_step(part.config, part.schedules, step)
            part.followed = step

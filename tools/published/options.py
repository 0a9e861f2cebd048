"""The options of a published training run; one that is missing or unknown is an error."""

from collections.abc import Mapping
from math import isfinite
from typing import Any, TypeVar

T = TypeVar("T")


class ReleasedOptionError(ValueError):
    """An option of a published run is missing, or no recipe can express its value."""


class ReleasedOptions:
    """The options that a published codebase ran with, by its own names."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        self._options = options

    def __getitem__(self, name: str) -> Any:
        """The value of `name`; raises ReleasedOptionError without it."""
        if name not in self._options:
            raise ReleasedOptionError(f"the option {name} is missing; give it as the run had it")
        return self._options[name]

    def __contains__(self, name: str) -> bool:
        return name in self._options

    def meaning(self, name: str, meanings: Mapping[str, T]) -> T:
        """`meanings` of the value of `name`; raises ReleasedOptionError for an unknown value."""
        value = self[name]
        if not isinstance(value, str) or value not in meanings:
            known = ", ".join(sorted(meanings))
            raise ReleasedOptionError(f"the option {name} is {value!r}; known are {known}")
        return meanings[value]

    def number(self, name: str) -> int | float:
        """A number; raises ReleasedOptionError for anything else."""
        value = self[name]
        if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
            raise ReleasedOptionError(f"the option {name} is {value!r}; it must be a number")
        return value

    def count(self, name: str) -> int:
        """A whole number, 4 or 4.0; raises ReleasedOptionError for anything else."""
        value = self.number(name)
        if value != int(value):
            raise ReleasedOptionError(f"the option {name} is {value!r}; it must be whole")
        return int(value)

    def counts(self, name: str) -> list[int]:
        """A list of whole numbers; raises ReleasedOptionError for anything else."""
        values = self[name]
        if not isinstance(values, list | tuple):
            raise ReleasedOptionError(f"the option {name} is {values!r}; it must be a list")
        return [ReleasedOptions({name: value}).count(name) for value in values]

    def flag(self, name: str) -> bool:
        """A value that is true or false; raises ReleasedOptionError for any other."""
        value = self[name]
        if not isinstance(value, bool):
            raise ReleasedOptionError(f"the option {name} is {value!r}; it must be true or false")
        return value

    def only(self, expected: Mapping[str, Any]) -> None:
        """Raise ReleasedOptionError for an option that is there with another value."""
        for name, value in expected.items():
            given = self._options.get(name, value)
            if given != value:
                raise ReleasedOptionError(
                    f"the option {name} is {given!r}; only {value!r} is supported"
                )

"""The options of a published training run; one that is missing or unknown is an error."""

from collections.abc import Mapping
from typing import Any, TypeVar

T = TypeVar("T")


class ReleasedOptionError(ValueError):
    """An option of a published run is missing, or no recipe can express its value."""


class ReleasedOptions:
    """The options that a published codebase ran with, by its own names."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        self._options = options

    def __getitem__(self, name: str) -> Any:
        """Return the value of `name`; raise ReleasedOptionError without it."""
        if name not in self._options:
            raise ReleasedOptionError(f"the option {name} is missing; give it as the run had it")
        return self._options[name]

    def __contains__(self, name: str) -> bool:
        return name in self._options

    def get(self, name: str, default: T) -> T:
        """Return the value of `name`, or `default` without it."""
        return self._options.get(name, default)

    def meaning(self, name: str, meanings: Mapping[str, T]) -> T:
        """Return `meanings` of the value of `name`; raise ReleasedOptionError for another value."""
        if self[name] not in meanings:
            known = ", ".join(sorted(meanings))
            raise ReleasedOptionError(f"the option {name} is {self[name]!r}; known are {known}")
        return meanings[self[name]]

    def count(self, name: str) -> int:
        """Return a whole number, written 4 or 4.0."""
        assert self[name] == int(self[name]), name
        return int(self[name])

    def only(self, expected: Mapping[str, Any]) -> None:
        """Raise ReleasedOptionError for an option that is there with another value."""
        for name, value in expected.items():
            given = self._options.get(name, value)
            if given != value:
                raise ReleasedOptionError(
                    f"the option {name} is {given!r}; only {value!r} is supported"
                )

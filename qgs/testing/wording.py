"""What a user gave instead of a case, in words, and the case that was probably meant."""

from __future__ import annotations

import inspect
from typing import Any

from qgs.contracts import Component, ComponentConfig


def named(thing: Any) -> str:
    """`thing` as a message names it."""
    if inspect.isclass(thing):
        return f"the class {thing.__qualname__}"
    if inspect.isroutine(thing):
        return f"the function {thing.__qualname__}"
    if isinstance(thing, ComponentConfig):
        return f"the options {thing!r}"
    if isinstance(thing, Component):
        return f"an instance of {type(thing).__qualname__}"
    return repr(thing)


def case_of(thing: Any) -> str:
    """What to write for a case of `thing`: see `options_of`."""
    return f"Case({options_of(thing)})"


def options_of(thing: Any) -> str:
    """What to write for the options of `thing`: a component, its Config, or an instance of one."""
    kind = thing if inspect.isclass(thing) else type(thing)
    if issubclass(kind, Component):
        return f"{kind.__qualname__}.Config()"
    if issubclass(kind, ComponentConfig) and kind.__component__ is not None:
        return f"{kind.__component__.__qualname__}.Config({'' if kind is thing else '...'})"
    return "MyComponent.Config()"

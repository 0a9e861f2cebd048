"""Register components that break the contract, each with the check that must catch it."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from qgs.contracts import Component

C = TypeVar("C", bound=type[Component])

NONE: Mapping[str, Any] = {}


@dataclass(frozen=True)
class Mutant:
    """A component, the check that must catch it, and what the check must see.

    options: of the component. case: further arguments of the case.
    """

    component: type[Component]
    check: str
    seen: str
    options: Mapping[str, Any]
    case: Mapping[str, Any]

    def __str__(self) -> str:
        return f"{self.check}-{self.component.name}"


MUTANTS: list[Mutant] = []


def named(component: C) -> C:
    """Give a component the name of its class in snake case."""
    component.name = re.sub(r"(?<!^)(?=[A-Z])", "_", component.__name__).lower()
    return component


def mutant(
    check: str, seen: str, *, options: Mapping[str, Any] = NONE, case: Mapping[str, Any] = NONE
) -> Callable[[C], C]:
    """Register a component as a mutant."""

    def register(component: C) -> C:
        MUTANTS.append(Mutant(named(component), check, seen, options, case))
        return component

    return register

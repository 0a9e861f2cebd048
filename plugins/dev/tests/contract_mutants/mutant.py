"""Register components that break the contract, each with the check that must catch it."""

import re
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from qgs_dev import Case

from qgs.checkpoint.tensors import Shapes
from qgs.contracts import Component

C = TypeVar("C", bound=type[Component])


class Mutant(NamedTuple):
    """The check that must catch a component, what the check must see, and the component's case."""

    check: str
    seen: str
    case: Case

    def __str__(self) -> str:
        return f"{self.check}-{self.case.component.name}"


MUTANTS: list[Mutant] = []
SOUND: list[Case] = []


def named(component: C, **options: Any) -> Any:
    """Name a component as its class, in snake case, and return these options of it."""
    component.name = re.sub(r"(?<!^)(?=[A-Z])", "_", component.__name__).lower()
    return component.Config(**options)


def sound(component: C) -> C:
    """Register a component that must pass."""
    SOUND.append(Case(named(component)))
    return component


def mutant(
    check: str, seen: str, state_dict: Shapes | None = None, **options: Any
) -> Callable[[C], C]:
    """Register a component as a mutant. state_dict: of its case."""

    def register(component: C) -> C:
        case = Case(named(component, **options), state_dict=state_dict)
        MUTANTS.append(Mutant(check, seen, case))
        return component

    return register

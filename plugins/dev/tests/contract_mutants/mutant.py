"""Register components that break the contract, each with the check that must catch it."""

import re
from typing import NamedTuple

from qgs_dev import Case


class Mutant(NamedTuple):
    """The check that must catch a component, what the check must see, and the component's case."""

    check: str
    seen: str
    case: Case

    def __str__(self):
        return f"{self.check}-{self.case.component.name}"


MUTANTS = []
SOUND = []


def named(component, **options):
    """Name a component as its class, in snake case, and return these options of it."""
    component.name = re.sub(r"(?<!^)(?=[A-Z])", "_", component.__name__).lower()
    return component.Config(**options)


def sound(component):
    """Register a component that must pass."""
    SOUND.append(Case(named(component)))
    return component


def mutant(check, seen, state_dict=None, **options):
    """Register a component as a mutant. state_dict: of its case."""

    def register(component):
        case = Case(named(component, **options), state_dict=state_dict)
        MUTANTS.append(Mutant(check, seen, case))
        return component

    return register

"""All checks, by name, and the slots that each applies to."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from inspect import cleandoc
from typing import Literal, TypeAlias

from qgs.composer.slots import SLOTS
from qgs.testing.case import Case

Tier: TypeAlias = Literal["core", "extended"]
"""core: what every component needs to work at all; extended: slower, or rarer trouble."""

ALL_SLOTS = frozenset(SLOTS)
MODULES = ALL_SLOTS - {"supervision", "data"}
"""Slots whose components have a forward pass."""
PARAMETRIC = MODULES - {"renderer", "losses"}
"""Slots whose components are built with the sizes of the model."""
STATEFUL = frozenset(
    {"cross_attention", "self_attention", "refinement", "head", "centers", "losses"}
)
"""Slots whose components read the state of the queries."""
PER_QUERY = STATEFUL - {"losses"} | {"feed_forward"}
"""Slots whose components give something for every query they are given."""


@dataclass(frozen=True)
class Check:
    """One promise of the contract. contract: what it says, in one sentence."""

    name: str
    function: Callable[[Case], None]
    slots: Collection[str]
    tier: Tier
    contract: str


CHECKS: dict[str, Check] = {}


def check(
    slots: Collection[str], tier: Tier = "core"
) -> Callable[[Callable[[Case], None]], Callable[[Case], None]]:
    """Register `check_NAME(case)` as the check NAME of components of `slots`."""

    def register(function: Callable[[Case], None]) -> Callable[[Case], None]:
        name = function.__name__.removeprefix("check_")
        contract = " ".join(cleandoc(function.__doc__ or "").split("\n\n")[0].split())
        CHECKS[name] = Check(name, function, frozenset(slots), tier, contract)
        return function

    return register


def checks_for(case: Case, tiers: Iterable[Tier] = ("core", "extended")) -> list[Check]:
    """The checks that apply to the slot of `case`."""
    wanted = set(tiers)
    return [c for c in CHECKS.values() if case.slot in c.slots and c.tier in wanted]

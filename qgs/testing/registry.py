"""All checks, by name, and the slots that each applies to."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from inspect import cleandoc
from typing import Any, Literal, TypeAlias, get_args

from qgs.composer.errors import did_you_mean
from qgs.composer.slots import SLOTS
from qgs.testing.case import Case
from qgs.testing.wording import case_of, named

Tier: TypeAlias = Literal["core", "extended"]
"""core: what every component needs to work at all; extended: what takes seconds for each case."""
TIERS: tuple[Tier, ...] = get_args(Tier)

BASICS = ("builds", "runs")
"""Checks that nobody may be exempt from: without them the others mean nothing."""

LIKELY_CAUSES = ("forward_keeps_no_state", "eval_repeats_bitwise")
"""Checks without which many others cannot but fail: these compare one forward pass with another."""

ALL_SLOTS = frozenset(SLOTS)
MODULES = ALL_SLOTS - {"supervision", "data", "metrics"}
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


class _Checks(dict[str, Check]):
    def __missing__(self, name: Any) -> Check:
        raise KeyError(f"there is no check `{name}`; {did_you_mean(str(name), self, 'checks')}")


CHECKS: dict[str, Check] = _Checks()


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


def checks_for(case: Case, tiers: Iterable[Tier] = TIERS) -> list[Check]:
    """The checks that apply to the slot of `case`.

    Raises TypeError for what is no case, ValueError as `tiers_given` does.
    """
    case_given(case)
    wanted = tiers_given(tiers)
    found = [c for c in CHECKS.values() if case.slot in c.slots and c.tier in wanted]
    return sorted(found, key=_rank)


def _rank(check: Check) -> int:
    """Causes come before what they cause."""
    first = (*BASICS, *LIKELY_CAUSES)
    return first.index(check.name) if check.name in first else len(first)


def case_given(given: Any) -> None:
    """Raise TypeError for what is no case."""
    if not isinstance(given, Case):
        raise TypeError(f"{named(given)} is no case; give {case_of(given)}")


def tiers_given(given: Iterable[Tier]) -> tuple[Tier, ...]:
    """At least one tier; raises ValueError for anything else."""
    if isinstance(given, str):
        tier = given if given in TIERS else TIERS[0]
        raise ValueError(f'tiers is the text "{given}" and no list; write tiers=["{tier}"]')
    if not isinstance(given, Iterable):
        raise ValueError(f'tiers is {given!r} and no list; leave them out, or tiers=["core"]')
    tiers = tuple(given)
    if not tiers:
        raise ValueError('with no tiers nothing is checked; leave them out, or tiers=["core"]')
    for tier in tiers:
        if tier not in TIERS:
            raise ValueError(
                f"there is no tier `{tier}`; {did_you_mean(str(tier), TIERS, 'tiers')}"
            )
    return tiers

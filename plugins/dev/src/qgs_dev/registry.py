"""All checks by name, and the slots that each applies to."""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from inspect import cleandoc
from typing import Literal, TypeAlias, get_args

from qgs.contracts import ModelComponent
from qgs.recipe.slots import SLOTS
from qgs_dev.case import Case
from qgs_dev.inputs import ARGUMENTS

Tier: TypeAlias = Literal["core", "construction", "extended"]
"""core: what every component needs to work at all; construction: what `Component`, its `Config` and
`nn.Module` give a class that does nothing unusual; extended: takes seconds for each case."""
TIERS: tuple[Tier, ...] = get_args(Tier)

BASICS = ("builds", "runs")
"""Checks that cannot be expected to fail: without them the others say nothing."""

FIRST = (*BASICS, "forward_keeps_no_state", "eval_repeats_bitwise")
"""Checks that come first: when they fail, others do too, which compare two forward passes."""

ALL_SLOTS = frozenset(SLOTS)
MODULES = ALL_SLOTS & frozenset(ARGUMENTS)
"""Slots whose components are modules with a forward pass that the suite knows inputs for."""
PARAMETRIC = frozenset(n for n in MODULES if issubclass(SLOTS[n].contract, ModelComponent))
"""Slots whose components are built with the sizes of the model."""
STATEFUL = frozenset(
    {"layer", "cross_attention", "self_attention", "refinement", "head", "centers", "losses"}
    | {"feedback"}
)
"""Slots whose components read the state of the queries."""
READERS = STATEFUL | {"queries"}
"""Slots whose components read the state of the queries or the image memory."""
WITH_MEMORY = frozenset({"layer", "feedback"})
"""Slots whose components give a state and an image memory."""
PER_QUERY = STATEFUL - {"losses"} | {"feed_forward"}
"""Slots whose components give something for every query."""


@dataclass(frozen=True)
class Check:
    """One promise of the contract.

    contract: what it says, in one sentence. variants: whether it is checked of every case of a
    class; the others are checked of the first case alone.
    """

    name: str
    function: Callable[[Case], None]
    slots: Collection[str]
    tier: Tier
    contract: str
    variants: bool


CHECKS: dict[str, Check] = {}


def check(
    slots: Collection[str], tier: Tier = "core", variants: bool = False
) -> Callable[[Callable[[Case], None]], Callable[[Case], None]]:
    """Register `check_NAME(case)` as the check NAME of components of `slots`.

    The first paragraph of its docstring is the contract.
    """

    def register(function: Callable[[Case], None]) -> Callable[[Case], None]:
        name = function.__name__.removeprefix("check_")
        contract = " ".join(cleandoc(function.__doc__ or "").split("\n\n")[0].split())
        CHECKS[name] = Check(name, function, frozenset(slots), tier, contract, variants)
        return function

    return register


def checks_for(case: Case, tiers: Iterable[Tier] = TIERS, variant: bool = False) -> list[Check]:
    """The checks that apply to the slot of `case`, causes before what they cause.

    variant: whether another case of its class comes before it; then only those of `variants`.
    Raises ValueError for no tiers and for unknown ones.
    """
    wanted = checked_tiers(tiers)
    found = [c for c in CHECKS.values() if case.slot in c.slots and c.tier in wanted]
    found = [c for c in found if c.variants or not variant]
    return sorted(found, key=lambda c: FIRST.index(c.name) if c.name in FIRST else len(FIRST))


def checked_tiers(given: Iterable[Tier]) -> tuple[Tier, ...]:
    """`given` as a tuple; raises ValueError if it is empty, a text, or names unknown tiers."""
    tiers = tuple(given)
    if not tiers or not set(tiers) <= set(TIERS):
        raise ValueError(f"tiers is {given!r}; give a list of some of {', '.join(TIERS)}")
    return tiers

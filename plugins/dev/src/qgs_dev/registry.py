"""All checks by name, as checks.toml lists them, and the slots that each applies to."""

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from inspect import cleandoc
from typing import Literal, TypeAlias, get_args

from qgs.contracts import ModelComponent
from qgs.recipe.slots import SLOTS
from qgs_dev.case import Case
from qgs_dev.inputs import FACTS, data_file

Tier: TypeAlias = Literal["core", "construction", "extended"]
TIERS: tuple[Tier, ...] = get_args(Tier)

# Checks that cannot be expected to fail: without them the others say nothing.
BASICS = ("builds", "runs")

# Checks that come first: when they fail, others do too, which compare two forward passes.
FIRST = (*BASICS, "forward_keeps_no_state", "eval_repeats_bitwise")


@dataclass(frozen=True)
class Check:
    """One promise of the contract.

    variants: whether it is checked of every case of a class; the others are checked of the first
    case alone.
    """

    name: str
    function: Callable[[Case], None]
    slots: Collection[str]
    tier: Tier
    variants: bool

    @property
    def contract(self) -> str:
        """The promise in one sentence: the first paragraph of the function's docstring."""
        return " ".join(cleandoc(self.function.__doc__ or "").split("\n\n")[0].split())


def _listed() -> Iterator[Check]:
    """The checks of checks.toml: `check_NAME(case)` of the module of its subject is NAME."""
    subjects = data_file("checks.toml")
    groups = subjects.pop("groups")
    groups["all"] = [*SLOTS]
    groups["modules"] = [*FACTS]
    groups["parametric"] = [n for n in FACTS if issubclass(SLOTS[n].contract, ModelComponent)]
    for subject, rows in subjects.items():
        module = import_module(f"qgs_dev.checks.{subject}")
        for name, row in rows.items():
            slots = {slot for group in row["slots"] for slot in groups.get(group, [group])}
            yield Check(
                name=name,
                function=getattr(module, f"check_{name}"),
                slots=slots.difference(row.get("but", ())),
                tier=row.get("tier", "core"),
                variants=row.get("variants", False),
            )


CHECKS = {check.name: check for check in _listed()}


def checks_for(case: Case, tiers: Iterable[Tier] = TIERS, variant: bool = False) -> list[Check]:
    """The checks that apply to the slot of `case`, causes before what they cause.

    variant: whether another case of its class comes before it; then only those of `variants`.
    """
    wanted = {*tiers}
    # No check at all would pass.
    assert wanted, "no tiers"
    assert wanted <= {*TIERS}, f"tiers are {wanted}, not some of {TIERS}"
    found = [
        check
        for check in CHECKS.values()
        if case.slot in check.slots and check.tier in wanted and (check.variants or not variant)
    ]
    # False sorts before True.
    return sorted(found, key=lambda check: [check.name != name for name in FIRST])

"""The guide's list of the checks of the contract suite, written from the suite itself."""

from __future__ import annotations

from collections.abc import Collection

from qgs.composer.slots import SLOTS
from qgs.testing import CHECKS

INTRODUCTION = """# The contract suite

What every component must do, whoever wrote it. [Write a plugin](plugin.md) shows how a plugin's
tests make these checks; `qgs check-plugin NAME` makes them for all components of an installed
plugin.

`core` checks are what a component needs to work at all, `extended` ones take seconds for each case.
All are made unless `tiers=["core"]`, or `qgs check-plugin NAME --core`, leaves the slower ones out.

A component that cannot be built or called fails `builds` or `runs`, which tell the error with its
place in the component's own package. Checks that then end with an error too are skipped and refer
to it.

## Known failures

A component that cannot pass a check says so with a reason. An expected failure that passes is a
failure:

    @parametrize_with_checks([Case(Mine.Config())], expected_failures={"NAME": "the reason"})

A reason stands for a check that sees the contract broken. Where the check ends with an error
instead, the error is named by its class, and any other one is a failure:

    {"float64_stays_float64": ExpectedError(NotImplementedError, "the kernel has no float64")}

Where only some cases fail, give a function of the case:

    expected_failures=lambda case: {"NAME": "..."} if case.config.bandwidth == "fixed" else {}

A plugin states the same in `exemptions` of its `Plugin`, by component class, or by options:

    exemptions={Mine: {"NAME": "..."}, Mine.Config(bandwidth="fixed"): {"OTHER": "..."}}

`builds` and `runs` cannot be expected to fail: a component that does neither is held to nothing.

## The checks

"""


def check_list() -> str:
    """The whole page, Markdown."""
    rows = ["| check | tier | slots | what it checks |", "|---|---|---|---|"]
    for check in CHECKS.values():
        slots = _slots_in_words(check.slots)
        rows.append(f"| `{check.name}` | {check.tier} | {slots} | {check.contract} |")
    return INTRODUCTION + "\n".join(rows) + "\n"


def _slots_in_words(slots: Collection[str]) -> str:
    named = [f"`{slot}`" for slot in SLOTS if slot in slots]
    others = [f"`{slot}`" for slot in SLOTS if slot not in slots]
    if len(others) < len(named):
        return f"all but {', '.join(others)}" if others else "all"
    return ", ".join(named)


if __name__ == "__main__":
    print(check_list())

"""The guide's list of the checks of the contract suite, written from the suite itself."""

from __future__ import annotations

from collections.abc import Collection

from qgs.composer.slots import SLOTS
from qgs.testing import CHECKS

INTRODUCTION = """# The contract suite

What every component must do, whoever wrote it. [Write a plugin](plugin.md) shows how a plugin's
tests make these checks; `qgs check-plugin NAME` makes them for all components of an installed
plugin.

`core` checks are what a component needs to work at all, `extended` ones are slower or find rarer
trouble. A component that cannot pass a check says so with a reason, and an expected failure that
passes is a failure:

    @parametrize_with_checks([Case(Mine.Config())], expected_failures={"NAME": "the reason"})

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

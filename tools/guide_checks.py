"""The guide's list of the checks of the contract suite, written from the suite itself."""

from __future__ import annotations

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
        named = [f"`{slot}`" for slot in SLOTS if slot in check.slots]
        slots = "all" if len(named) == len(SLOTS) else ", ".join(named)
        rows.append(f"| `{check.name}` | {check.tier} | {slots} | {check.contract} |")
    return INTRODUCTION + "\n".join(rows) + "\n"


if __name__ == "__main__":
    print(check_list())

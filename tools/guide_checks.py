"""The guide's pages on the contract suite, written from the suite itself."""

from __future__ import annotations

import sys
from collections.abc import Collection
from itertools import groupby
from types import ModuleType

import qgs.testing
from qgs.composer.slots import SLOTS
from qgs.testing import CHECKS

INTRODUCTION = """# The contract suite

What every component must do, whoever wrote it. [Write a plugin](plugin.md) shows how a plugin's
tests make these checks; `qgs check-plugin NAME` makes them for all components of an installed
plugin. [Testing](api/testing.md) has the names in Python.

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

TESTING = """# Testing

All public names of `qgs.testing`, then all checks, with their contracts. [The contract
suite](../checks.md) tells which slots each check is for, [Write a plugin](../plugin.md) how to make
them.
"""

CHECKS_SECTION = """## CHECKS

Every check by its name: the slots it is for, its tier, its contract, and the function that makes it
of a `Case`.

| check | contract |
|---|---|"""

OPTIONS = "{members: false, show_root_heading: true, show_root_toc_entry: true, heading_level: 2}"

FIRST = ("Case", "parametrize_with_checks", "check_plugin")
"""Names that a plugin's author needs; the others follow in the order of the alphabet."""


def check_list() -> str:
    """The page that lists the checks by family, Markdown."""
    parts = [INTRODUCTION]
    for family, checks in groupby(CHECKS.values(), key=lambda check: check.function.__module__):
        module = sys.modules[family]
        parts += [f"### {family.rpartition('.')[2].capitalize()}", "", _summary(module), ""]
        parts += ["| check | tier | slots | contract |", "|---|---|---|---|"]
        for check in checks:
            slots = _slots_in_words(check.slots)
            parts.append(f"| `{check.name}` | {check.tier} | {slots} | {check.contract} |")
        parts.append("")
    return "\n".join(parts)


def testing_page() -> str:
    """The page of `qgs.testing` in the reference, for mkdocstrings to fill in."""
    names = [*FIRST, *sorted(set(qgs.testing.__all__) - {*FIRST, "CHECKS"})]
    parts = [TESTING, *map(_entry, names), CHECKS_SECTION]
    parts += [f"| `{check.name}` | {check.contract} |" for check in CHECKS.values()]
    return "\n".join(parts) + "\n"


def _entry(name: str) -> str:
    home = getattr(qgs.testing, name).__module__
    if home.startswith("qgs.testing."):
        return f"::: {home}.{name}\n    options: {OPTIONS}\n"
    return f"## {name}\n\n[`{home}.{name}`][{home}.{name}], among the contracts.\n"


def _summary(module: ModuleType) -> str:
    return (module.__doc__ or "").strip().split("\n\n")[0]


def _slots_in_words(slots: Collection[str]) -> str:
    named = [f"`{slot}`" for slot in SLOTS if slot in slots]
    others = [f"`{slot}`" for slot in SLOTS if slot not in slots]
    if len(others) < len(named):
        return f"all but {', '.join(others)}" if others else "all"
    return ", ".join(named)


if __name__ == "__main__":
    print(check_list())

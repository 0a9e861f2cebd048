"""`qgs check-plugin`: the contract suite on every component of an installed plugin."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from qgs.testing import Outcome


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("check-plugin")(check_plugin)


def check_plugin(
    name: Annotated[str, typer.Argument(help="Name of the plugin, as in `plugins: [NAME]`.")],
    core: Annotated[bool, typer.Option("--core", help="Leave out the slower checks.")] = False,
) -> None:
    """Hold every component of a plugin to its contract.

    Exit code 1 if one does not keep it, or cannot be built or called here. Components are checked
    with their default options and with the plugin's `examples`.
    """
    import torch
    from rich.console import Console

    from qgs.composer.registry import load_plugin
    from qgs.testing import check_plugin as outcomes_of
    from qgs.testing.plugins import without_case
    from qgs.testing.registry import TIERS

    torch.set_num_threads(1)
    console = Console(highlight=False, markup=False, soft_wrap=True)
    installed = load_plugin(name)
    console.print(
        f"plugin {name} of {installed.released_as}, contract version "
        f"{installed.plugin.contract_version}"
    )
    outcomes: list[Outcome] = []
    made = outcomes_of(name, ("core",) if core else TIERS)
    for _, group in groupby(made, key=lambda outcome: id(outcome.case)):
        of_case = list(group)
        _summarise(console, of_case)
        outcomes += of_case
    unchecked = without_case(installed)
    for component, why in unchecked.items():
        label = f"{component.slot}/{component.name}"
        fix = "list a Config of it in `examples` of the Plugin"
        console.print(f"not checked: {label}: {why}; {fix}")
    console.print(_total(outcomes))
    if unchecked or any(outcome.leaves_unchecked or not outcome.ok for outcome in outcomes):
        raise SystemExit(1)


def _summarise(console: Console, outcomes: list[Outcome]) -> None:
    """One line for a case, and what is to be known of each check that did not simply pass."""
    good = all(outcome.ok for outcome in outcomes)
    unchecked = any(outcome.leaves_unchecked for outcome in outcomes)
    verdict = "FAILED" if not good else "not checked" if unchecked else "ok    "
    passed = sum(outcome.verdict == "passed" for outcome in outcomes)
    label = outcomes[0].case.label
    console.print(f"{verdict} {label}: {passed} of {len(outcomes)} pass")
    for outcome in outcomes:
        if outcome.verdict == "expected failure":
            console.print(f"  expected to fail: {outcome.check.name}: {outcome.message}")
        elif not outcome.ok:
            console.print("\n".join(f"  {line}" for line in outcome.message.splitlines()))
    skipped = [outcome for outcome in outcomes if outcome.verdict == "skipped"]
    for reason in dict.fromkeys(outcome.message for outcome in skipped):
        alike = [outcome for outcome in skipped if outcome.message == reason]
        names = ", ".join(outcome.check.name for outcome in alike)
        many = alike[0].cause or any(outcome.leaves_unchecked for outcome in alike)
        console.print(f"  skipped: {f'{len(alike)} checks' if many else names}: {reason}")


def _total(outcomes: list[Outcome]) -> str:
    counts = {
        "failed": sum(not outcome.ok for outcome in outcomes),
        "expected to fail": sum(outcome.verdict == "expected failure" for outcome in outcomes),
        "skipped": sum(outcome.verdict == "skipped" for outcome in outcomes),
    }
    unchecked = {o.case.label for o in outcomes if o.leaves_unchecked}
    if unchecked:
        counts["not checked"] = len(unchecked)
    components = len({outcome.case.component for outcome in outcomes})
    told = ", ".join(f"{count} {what}" for what, count in counts.items())
    return f"{_count(components, 'component')}, {_count(len(outcomes), 'check')}, {told}"


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"

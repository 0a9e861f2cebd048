"""`qgs check-plugin`: the contract suite on every component of an installed plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from qgs.testing import Outcome

Tiers = Literal["core", "extended"]


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("check-plugin")(check_plugin)


def check_plugin(
    name: Annotated[str, typer.Argument(help="Name of the plugin, as in `plugins: [NAME]`.")],
    core: Annotated[bool, typer.Option("--core", help="Leave out the slower checks.")] = False,
) -> None:
    """Hold every component of a plugin to its contract; exit code 1 if one does not keep it.

    Components are checked with their default options and with the plugin's `examples`.
    """
    import torch
    from rich.console import Console

    from qgs.composer.registry import load_plugin
    from qgs.testing import check_plugin as outcomes_of
    from qgs.testing.plugins import without_case

    torch.set_num_threads(1)
    console = Console(highlight=False)
    installed = load_plugin(name)
    tiers: tuple[Tiers, ...] = ("core",) if core else ("core", "extended")
    console.print(
        f"plugin {name} of {installed.released_as}, contract version "
        f"{installed.plugin.contract_version}",
        markup=False,
    )
    outcomes = []
    for outcome in outcomes_of(name, tiers):
        if outcomes and outcomes[-1].case is not outcome.case:
            _summarise(console, [o for o in outcomes if o.case is outcomes[-1].case])
        outcomes.append(outcome)
    if outcomes:
        _summarise(console, [o for o in outcomes if o.case is outcomes[-1].case])
    unchecked = [f"{component.slot}/{component.name}" for component in without_case(installed)]
    for label in unchecked:
        console.print(
            f"not checked: {label} has options without a default; list a Config of it in "
            "`examples` of the Plugin",
            markup=False,
        )
    faults = sum(not outcome.ok for outcome in outcomes)
    checked = len({outcome.case.component for outcome in outcomes})
    console.print(f"{checked} components, {len(outcomes)} checks, {faults} failed", markup=False)
    if faults or unchecked:
        raise SystemExit(1)


def _summarise(console: Console, outcomes: list[Outcome]) -> None:
    """One line for a case, and what is to be known of each check that did not simply pass."""
    case = outcomes[0].case
    passed = sum(outcome.verdict == "passed" for outcome in outcomes)
    good = all(outcome.ok for outcome in outcomes)
    console.print(
        f"{'ok    ' if good else 'FAILED'} {case.label}: {passed} of {len(outcomes)} pass",
        markup=False,
        soft_wrap=True,
    )
    skipped: dict[str, list[str]] = {}
    for outcome in outcomes:
        if outcome.verdict == "skipped":
            skipped.setdefault(outcome.message, []).append(outcome.check.name)
        elif outcome.verdict == "expected failure":
            line = f"  expected to fail: {outcome.check.name}: {outcome.message}"
            console.print(line, markup=False, soft_wrap=True)
        elif not outcome.ok:
            text = "\n".join(f"  {line}" for line in outcome.message.splitlines())
            console.print(text, markup=False, soft_wrap=True)
    for reason, names in skipped.items():
        line = f"  skipped: {', '.join(names)}: {reason}"
        console.print(line, markup=False, soft_wrap=True)

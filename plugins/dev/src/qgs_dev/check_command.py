"""Command `qgs check-plugin`, which runs the contract suite on an installed plugin."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from qgs.recipe.registry import InstalledPlugin
    from qgs_dev.running import CheckResult

app = typer.Typer(add_completion=False)


@app.command()
def check_plugin(
    name: Annotated[str, typer.Argument(help="Name of the plugin, as in `plugins: [NAME]`.")],
    core: Annotated[bool, typer.Option("--core", help="Run the fast checks only.")] = False,
) -> None:
    """Test every component of a plugin against its contract.

    Each component is checked with its default options and with the plugin's `examples`. The exit
    code is 1 if a component breaks its contract, or cannot be built or called on this machine.
    """
    import torch

    from qgs.recipe.registry import load_plugin
    from qgs_dev import running

    # The tensors are small, so more threads would only wait for each other.
    torch.set_num_threads(1)
    installed = load_plugin(name)
    version = installed.plugin.contract_version
    typer.echo(f"plugin {name} of {installed.released_as}, contract version {version}")
    results: list[CheckResult] = []
    tiers = ("core", "construction") if core else running.TIERS
    # Each case is reported as soon as it is done.
    for run in running.runs_of(name):
        of_case = list(run.results(tiers))
        _print_case(of_case)
        results += of_case
    unchecked = running.without_case(installed)
    for component in unchecked:
        fix = "its default options are invalid; list a valid Config in `examples` of the Plugin"
        typer.echo(f"not checked: {component.slot}/{component.name}: {fix}")
    typer.echo(_total(results))
    good = all(result.ok and not result.leaves_unchecked for result in results)
    if not _models_load(installed) or unchecked or not good:
        raise typer.Exit(1)


def _models_load(installed: InstalledPlugin) -> bool:
    """Load each trained model of the plugin and print the result; return True if all load."""
    from qgs.checkpoint.model_file import load

    good = True
    for name, file in installed.models.items():
        try:
            load(file)
            typer.echo(f"ok     model {name}: {file.stat().st_size / 1e6:.1f} MB")
        except (OSError, ValueError) as error:
            good = False
            typer.echo(f"FAILED model {name}: {error}")
    return good


def _print_case(results: list[CheckResult]) -> None:
    """Print one line for a case, then one line for each result that is not a pass."""
    verdict = "ok    "
    if any(result.leaves_unchecked for result in results):
        verdict = "not checked"
    if not all(result.ok for result in results):
        verdict = "FAILED"
    passed = sum(result.verdict == "passed" for result in results)
    typer.echo(f"{verdict} {results[0].case.label}: {passed} of {len(results)} pass")
    skipped: dict[str, list[str]] = {}
    for result in results:
        if result.verdict == "skipped":
            skipped.setdefault(result.message, []).append(result.check.name)
        elif result.verdict == "expected failure":
            typer.echo(f"  expected to fail: {result.check.name}: {result.message}")
        elif not result.ok:
            typer.echo("  " + result.message.replace("\n", "\n  "))
    for reason, checks in skipped.items():
        names = ", ".join(checks) if len(checks) < 4 else f"{len(checks)} checks"
        typer.echo(f"  skipped: {names}: {reason}")


def _total(results: list[CheckResult]) -> str:
    from qgs.wording import counted

    verdicts = Counter(result.verdict for result in results)
    unchecked = {result.case.label for result in results if result.leaves_unchecked}
    components = {result.case.component for result in results}
    return (
        f"{counted(len(components), 'component')}, {counted(len(results), 'check')}, "
        f"{verdicts['failed'] + verdicts['unexpected pass']} failed, "
        f"{verdicts['expected failure']} expected to fail, {verdicts['skipped']} skipped, "
        f"{len(unchecked)} not checked"
    )

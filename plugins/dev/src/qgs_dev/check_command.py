"""`qgs check-plugin`: the contract suite on every component of an installed plugin."""

from itertools import groupby
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console

from qgs.checkpoint.model_file import load
from qgs.recipe.registry import load_plugin
from qgs_dev.plugins import check_plugin as results_of
from qgs_dev.plugins import without_case
from qgs_dev.registry import TIERS
from qgs_dev.running import CheckResult

app = typer.Typer(add_completion=False)


@app.command()
def check_plugin(
    name: Annotated[str, typer.Argument(help="Name of the plugin, as in `plugins: [NAME]`.")],
    core: Annotated[bool, typer.Option("--core", help="Leave out the slower checks.")] = False,
) -> None:
    """Test every component of a plugin against its contract.

    Exit code 1 if one does not keep it, or cannot be built or called here. Components are checked
    with their default options and with the plugin's `examples`.
    """
    torch.set_num_threads(1)
    console = Console(highlight=False, markup=False, soft_wrap=True)
    installed = load_plugin(name)
    console.print(
        f"plugin {name} of {installed.released_as}, contract version "
        f"{installed.plugin.contract_version}"
    )
    results: list[CheckResult] = []
    made = results_of(name, ("core", "construction") if core else TIERS)
    for _, group in groupby(made, key=lambda result: id(result.case)):
        of_case = list(group)
        _summarise(console, of_case)
        results += of_case
    unchecked = without_case(installed)
    for component, why in unchecked.items():
        label = f"{component.slot}/{component.name}"
        fix = "list a Config of it in `examples` of the Plugin"
        console.print(f"not checked: {label}: {why}; {fix}")
    console.print(_total(results))
    models = [_model_loads(console, name, file) for name, file in installed.models.items()]
    if (
        unchecked
        or not all(models)
        or any(result.leaves_unchecked or not result.ok for result in results)
    ):
        raise SystemExit(1)


def _model_loads(console: Console, name: str, file: Path) -> bool:
    """One line for a model that the plugin ships."""
    try:
        load(file)
    except (OSError, ValueError) as error:
        console.print(f"FAILED model {name}: {error}")
        return False
    console.print(f"ok     model {name}: {file.stat().st_size / 1e6:.1f} MB")
    return True


def _summarise(console: Console, results: list[CheckResult]) -> None:
    """One line for a case, and a line for each check that did not simply pass."""
    good = all(result.ok for result in results)
    unchecked = any(result.leaves_unchecked for result in results)
    verdict = "FAILED" if not good else "not checked" if unchecked else "ok    "
    passed = sum(result.verdict == "passed" for result in results)
    label = results[0].case.label
    console.print(f"{verdict} {label}: {passed} of {len(results)} pass")
    for result in results:
        if result.verdict == "expected failure":
            console.print(f"  expected to fail: {result.check.name}: {result.message}")
        elif not result.ok:
            console.print("\n".join(f"  {line}" for line in result.message.splitlines()))
    skipped = [result for result in results if result.verdict == "skipped"]
    for reason in dict.fromkeys(result.message for result in skipped):
        alike = [result for result in skipped if result.message == reason]
        names = ", ".join(result.check.name for result in alike)
        console.print(f"  skipped: {names if len(alike) < 4 else f'{len(alike)} checks'}: {reason}")


def _total(results: list[CheckResult]) -> str:
    counts = {
        "failed": sum(not result.ok for result in results),
        "expected to fail": sum(result.verdict == "expected failure" for result in results),
        "skipped": sum(result.verdict == "skipped" for result in results),
    }
    unchecked = {o.case.label for o in results if o.leaves_unchecked}
    if unchecked:
        counts["not checked"] = len(unchecked)
    components = len({result.case.component for result in results})
    summary = ", ".join(f"{count} {what}" for what, count in counts.items())
    return f"{_count(components, 'component')}, {_count(len(results), 'check')}, {summary}"


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"

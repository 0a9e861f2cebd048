"""The contract suite on all components of an installed plugin."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from qgs.composer.registry import (
    InstalledPlugin,
    PluginError,
    default_config,
    file_of,
    load_plugin,
)
from qgs.contracts import Component, ComponentConfig, Expected, ModelDims, Plugin
from qgs.testing.case import Case
from qgs.testing.expected import expectation_fault
from qgs.testing.places import raised
from qgs.testing.registry import TIERS, Tier, checks_for, tiers_given
from qgs.testing.running import CaseRun, Outcome
from qgs.testing.wording import named, options_of

DEPTHS = (2, 12)
"""Decoder depths that are tried, in turn, until the component's `problems` accepts one."""


def cases_of(installed: InstalledPlugin) -> list[Case]:
    """The plugin's examples, and every component with its default options.

    Raises TypeError for what is no InstalledPlugin, PluginError for `examples` that are no options
    of its components.
    """
    if not isinstance(installed, InstalledPlugin):
        raise TypeError(f"{named(installed)} is no installed plugin; {_loading(installed)}")
    plugin = installed.plugin
    for example in plugin.examples:
        fault = _example_fault(example, plugin.components)
        if fault:
            raise _unsound(installed, "examples", fault)
    configs = [default_config(component) for component in plugin.components]
    configs = [config for config in configs if config is not None]
    configs += [e for e in plugin.examples if e not in configs]
    return [_fitting(config) for config in configs]


def without_case(installed: InstalledPlugin) -> dict[type[Component], str]:
    """Components that have no example and cannot be made with default options, and why not."""
    checked = {case.component for case in cases_of(installed)}
    return {c: _lacking(c) for c in installed.plugin.components if c not in checked}


def exemptions_of(installed: InstalledPlugin, cases: list[Case]) -> list[Mapping[str, Expected]]:
    """The known failures of each of the `cases`: those of its class, and of its options.

    Raises PluginError for exemptions that no check of the cases can have.
    """
    exemptions = installed.plugin.exemptions
    for owner, exempted in exemptions.items():
        fault = _exemption_fault(owner, exempted, cases)
        if fault:
            raise _unsound(installed, "exemptions", fault)
    return [
        {
            name: expected
            for owner, exempted in exemptions.items()
            if _concerns(owner, case)
            for name, expected in exempted.items()
        }
        for case in cases
    ]


def check_plugin(name: str, tiers: Iterable[Tier] = TIERS) -> Iterator[Outcome]:
    """Every check of every case of the plugin `name`, case by case.

    Raises TypeError for what is no name, PluginError for a plugin that is unusable or has unsound
    examples or exemptions, and ValueError as `tiers_given` does.
    """
    wanted = tiers_given(tiers)
    if not isinstance(name, str):
        raise TypeError(f"{named(name)} is no name of a plugin; write one, such as 'locus'")
    installed = load_plugin(name)
    cases = cases_of(installed)
    runs = map(CaseRun, cases, exemptions_of(installed, cases))
    return (run.make(check) for run in runs for check in checks_for(run.case, wanted))


def _loading(given: Any) -> str:
    """What to write for an InstalledPlugin, after `qgs.composer.registry`'s functions."""
    if isinstance(given, Plugin):
        return "write cases_of(qgs.composer.registry.not_installed(plugin))"
    name = given if isinstance(given, str) else "locus"
    return f"write cases_of(qgs.composer.registry.load_plugin({name!r}))"


def _fitting(config: ComponentConfig) -> Case:
    """A case as small as the options allow."""
    cases = [Case(config, ModelDims(width=32, heads=2, depth=depth)) for depth in DEPTHS]
    return next((case for case in cases if _accepts(case)), cases[0])


def _accepts(case: Case) -> bool:
    """Whether `problems` has none; where it raises, the checks of the case tell it."""
    try:
        return not case.problems(case.size)
    except (Exception, SystemExit):
        return False


def _lacking(component: type[Component]) -> str:
    fields = component.Config.model_fields.items()
    required = [f"`{name}`" for name, field in fields if field.is_required()]
    if required:
        return f"there is no default for {', '.join(required)}"
    try:
        component.Config()
    except (Exception, SystemExit) as error:
        return f"its default options are refused: {raised(error, file_of(component))}"
    raise AssertionError("a component with default options has a case")


def _example_fault(example: Any, components: Sequence[type[Component]]) -> str:
    if not isinstance(example, ComponentConfig):
        return f"{named(example)} is no options; list {options_of(example)}"
    component = type(example).__component__
    if component is None or component not in components:
        return f"{named(example)} is of no component of the plugin"
    return ""


def _exemption_fault(owner: Any, exempted: Any, cases: list[Case]) -> str:
    concerned = [case for case in cases if _concerns(owner, case)]
    if not concerned:
        what = named(owner)
        if inspect.isclass(owner) and issubclass(owner, Component):
            return f"{what} is no component of the plugin that is checked"
        return f"{what} is neither a component of the plugin nor the options of one of its cases"
    if not isinstance(exempted, Mapping):
        return f"those of {named(owner)} are no mapping of checks to reasons"
    for name, expected in exempted.items():
        fault = expectation_fault(name, expected, concerned)
        if fault:
            return f"those of {named(owner)}: {fault}"
    return ""


def _concerns(owner: Any, case: Case) -> bool:
    return owner is case.component or (isinstance(owner, ComponentConfig) and owner == case.config)


def _unsound(installed: InstalledPlugin, what: str, fault: str) -> PluginError:
    return PluginError(
        f"the `{what}` of the plugin `{installed.plugin.name}` of {installed.released_as}: {fault}",
        f"mend the `{what}` of its Plugin",
    )

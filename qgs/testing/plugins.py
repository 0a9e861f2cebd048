"""The contract suite on all components of an installed plugin."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from qgs.composer.registry import InstalledPlugin, default_config, load_plugin
from qgs.contracts import Component, ComponentConfig, ModelDims, component_of
from qgs.testing.case import Case
from qgs.testing.registry import Tier, checks_for
from qgs.testing.running import Outcome, run_check

DEPTHS = (2, 12)
"""Decoder depths that are tried, in turn, until the component's `problems` accepts one."""


def cases_of(installed: InstalledPlugin) -> list[Case]:
    """The plugin's examples, and every component with its default options."""
    configs = [default_config(component) for component in installed.plugin.components]
    configs = [config for config in configs if config is not None]
    configs += [e for e in installed.plugin.examples if e not in configs]
    return [_fitting(config) for config in configs]


def _fitting(config: ComponentConfig) -> Case:
    """A case as small as the options allow."""
    cases = [Case(config, ModelDims(width=32, heads=2, depth=depth)) for depth in DEPTHS]
    return next((case for case in cases if not case.problems(case.size)), cases[0])


def without_case(installed: InstalledPlugin) -> list[type[Component]]:
    """Components that have options without a default, and no example."""
    checked = {case.component for case in cases_of(installed)}
    return [c for c in installed.plugin.components if c not in checked]


def check_plugin(name: str, tiers: Iterable[Tier] = ("core", "extended")) -> Iterator[Outcome]:
    """Every check of every case of the plugin `name`; raises PluginError for an unusable one."""
    installed = load_plugin(name)
    for config in installed.plugin.examples:
        component_of(config)
    wanted = tuple(tiers)
    for case in cases_of(installed):
        known = installed.plugin.exemptions.get(case.component, {})
        for check in checks_for(case, wanted):
            yield run_check(check, case, known.get(check.name))

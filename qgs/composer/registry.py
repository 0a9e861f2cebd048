"""Installed components: found by metadata, imported only when a recipe names their plugin."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points

import qgs
from qgs.composer.builtin import BUILTIN
from qgs.composer.slots import SLOTS
from qgs.contracts import (
    CONTRACT_VERSION,
    ENTRY_POINT_GROUP,
    Component,
    ComponentConfig,
    Plugin,
    WeightLayout,
)


class PluginError(ValueError):
    """A plugin that cannot be used: `reason` names its distribution, `fix` says what to do."""

    def __init__(self, reason: str, fix: str) -> None:
        super().__init__(f"{reason}; {fix}")
        self.reason = reason
        self.fix = fix


@dataclass(frozen=True)
class InstalledPlugin:
    """A plugin that is loaded and sound, and the distribution it came with."""

    plugin: Plugin
    distribution: str
    version: str

    @property
    def released_as(self) -> str:
        """Name and version of the distribution, as messages give them."""
        return f"{self.distribution} {self.version}"


@dataclass(frozen=True)
class Registry:
    """The components of the plugins that one recipe uses.

    unusable: plugins that it names and that could not be loaded.
    """

    plugins: Mapping[str, InstalledPlugin]
    unusable: frozenset[str] = frozenset()

    def components(self, slot: str) -> dict[str, type[Component]]:
        """`PLUGIN/NAME` to component, of one slot."""
        return {
            f"{name}/{component.name}": component
            for name, installed in self.plugins.items()
            for component in installed.plugin.components
            if component.slot == slot
        }


def default_config(component: type[Component]) -> ComponentConfig | None:
    """The options that `component` has by default; None if it has options without a default."""
    fields = component.Config.model_fields.values()
    return None if any(field.is_required() for field in fields) else component.Config()


def component_fault(installed: InstalledPlugin, fault: str) -> PluginError:
    """A component of `installed` breaks its contract; `fault` says which one, and how."""
    return PluginError(
        f"the plugin `{installed.plugin.name}` of {installed.released_as} fails: {fault}",
        f"update {installed.released_as}, or choose another component",
    )


def component_failure(
    kind: str, what: str, error: Exception, installed: InstalledPlugin
) -> PluginError:
    """The code of `kind`, a PLUGIN/NAME, raised `error` when asked for `what`."""
    return component_fault(
        installed, f"`{what}` of `{kind}` raises {type(error).__name__}: {error}"
    )


def builtin() -> InstalledPlugin:
    """The plugin `qgs`."""
    return InstalledPlugin(BUILTIN, "qgs", qgs.__version__)


def not_installed(plugin: Plugin) -> InstalledPlugin:
    """A plugin that came with no distribution."""
    return InstalledPlugin(plugin, "no distribution", "0")


def available_plugins() -> dict[str, list[EntryPoint]]:
    """Name to entry points of every installed plugin, by metadata alone."""
    found: dict[str, list[EntryPoint]] = {}
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        found.setdefault(entry.name, []).append(entry)
    return found


def load_plugin(name: str) -> InstalledPlugin:
    """Import and check the plugin `name`; raises PluginError."""
    if name == BUILTIN.name:
        return builtin()
    entries = available_plugins().get(name, [])
    if not entries:
        raise PluginError(
            f"no installed distribution offers a plugin `{name}`",
            f"install the one that does; installed plugins: {_names(available_plugins())}",
        )
    if len(entries) > 1:
        raise PluginError(
            f"several distributions offer a plugin `{name}`: "
            f"{', '.join(sorted(map(_distribution, entries)))}",
            "uninstall all of them but one",
        )
    return _load(entries[0])


def load_registry(names: Iterable[str]) -> Registry:
    """The built-in components and those of the plugins `names`; raises PluginError."""
    return Registry({"qgs": builtin(), **{name: load_plugin(name) for name in names}})


def load_sound_plugins() -> tuple[Registry, list[str]]:
    """The components of every installed plugin that can be used, and why the others cannot."""
    plugins, broken = {"qgs": builtin()}, []
    available = available_plugins()
    for entry in available.pop(BUILTIN.name, []):
        broken.append(f"{_distribution(entry)} offers a plugin `qgs`, the framework's own name")
    for name in sorted(available):
        try:
            plugins[name] = load_plugin(name)
        except PluginError as error:
            broken.append(str(error))
    return Registry(plugins), broken


def plugin_versions(names: Iterable[str]) -> dict[str, str]:
    """Plugin name to the version of its distribution, `qgs` included; raises PluginError."""
    return {name: plugin.version for name, plugin in load_registry(names).plugins.items()}


def _load(entry: EntryPoint) -> InstalledPlugin:
    distribution = _distribution(entry)
    update = f"update {distribution}, or take the plugin out of the recipe"
    try:
        plugin = entry.load()
    except (Exception, SystemExit) as error:
        raise PluginError(
            f"the plugin `{entry.name}` of {distribution} cannot be imported from "
            f"`{entry.value}`: {type(error).__name__}: {error}",
            update,
        ) from error
    if not isinstance(plugin, Plugin):
        raise PluginError(
            f"`{entry.value}` of {distribution} is no qgs.Plugin but {type(plugin).__name__}",
            update,
        )
    fault = _fault(plugin, entry)
    if fault:
        raise PluginError(f"the plugin `{entry.name}` of {distribution} {fault}", update)
    assert entry.dist is not None
    return InstalledPlugin(plugin, entry.dist.name, entry.dist.version)


def _fault(plugin: Plugin, entry: EntryPoint) -> str:
    if plugin.contract_version != CONTRACT_VERSION:
        return (
            f"was written for contract version {plugin.contract_version}; "
            f"this qgs has version {CONTRACT_VERSION}"
        )
    if plugin.name != entry.name:
        return f"calls itself `{plugin.name}`; the two names must be one"
    taken: set[tuple[str, str]] = set()
    for component in plugin.components:
        fault = _component_fault(component)
        if fault:
            return fault
        if (component.slot, component.name) in taken:
            return f"registers `{component.name}` twice in the slot `{component.slot}`"
        taken.add((component.slot, component.name))
    for layout in plugin.layouts:
        if not isinstance(layout, WeightLayout):
            return f"lists {layout!r}, which is no WeightLayout"
    return ""


def _component_fault(component: type[Component]) -> str:
    label = getattr(component, "__qualname__", repr(component))
    if not (inspect.isclass(component) and issubclass(component, Component)):
        return f"lists {label}, which is no qgs component"
    slot = SLOTS.get(getattr(component, "slot", ""))
    if slot is None or not issubclass(component, slot.contract):
        return f"lists {label}, which implements no slot's contract"
    if not isinstance(getattr(component, "name", None), str):
        return f"lists {label}, which has no `name`"
    if inspect.isabstract(component):
        missing = ", ".join(sorted(component.__abstractmethods__))
        return f"lists {label}, which leaves {missing} abstract"
    if not issubclass(component.Config, ComponentConfig) or "type" in component.Config.model_fields:
        return f"lists {label}, whose Config is no ComponentConfig or has an option `type`"
    return ""


def _distribution(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown distribution"


def _names(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "none"

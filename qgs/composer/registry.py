"""Installed components: found by metadata, imported only when a recipe names their plugin."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points

import qgs
from qgs.composer.builtin import BUILTIN
from qgs.composer.soundness import plugin_fault
from qgs.contracts import ENTRY_POINT_GROUP, Component, ComponentConfig, Plugin


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
        """Name and version of the distribution, as messages give them; "" for none."""
        return f"{self.distribution} {self.version}" if self.distribution else ""


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
    """The options that `component` has by default; None if they do not make a Config."""
    try:
        return component.Config()
    except (
        Exception,
        SystemExit,
    ):  # an option must be given, or the code of a stranger's validator fails
        return None


def component_fault(installed: InstalledPlugin, fault: str) -> PluginError:
    """A component of `installed` breaks its contract; `fault` says which one, and how."""
    release = installed.released_as
    origin = f" of {release}" if release else ""
    return PluginError(
        f"the plugin `{installed.plugin.name}`{origin} fails: {fault}",
        f"{f'update {release}' if release else 'mend it'}, or choose another component",
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
    return InstalledPlugin(plugin, "", "0")


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
            f"{', '.join(sorted(map(_release, entries)))}",
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
        broken.append(
            f"{_release(entry)} offers a plugin `qgs`, the framework's own name; "
            f"uninstall {_release(entry)}"
        )
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
    distribution = _release(entry)
    try:
        plugin = entry.load()
    except (Exception, SystemExit) as error:
        raise PluginError(
            f"the plugin `{entry.name}` of {distribution} cannot be imported from "
            f"`{entry.value}`: {type(error).__name__}: {error}",
            _import_fix(entry, error),
        ) from error
    fault = plugin_fault(plugin, entry.name)
    if fault:
        reason = f"the plugin `{entry.name}` of {distribution} {fault.reason}"
        raise PluginError(reason, fault.fix or _update(entry))
    assert entry.dist is not None
    return InstalledPlugin(plugin, entry.dist.name, entry.dist.version)


def _import_fix(entry: EntryPoint, error: BaseException) -> str:
    release = _release(entry)
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    own = entry.value.partition(":")[0].strip()
    if missing == own:
        return f"install {release} again, its files are gone; or do without the plugin"
    package = (missing or "").partition(".")[0]
    if package and package not in ("qgs", own.partition(".")[0]):
        return f"install `{package}`, which {release} needs, or do without the plugin"
    return _update(entry)


def _update(entry: EntryPoint) -> str:
    return f"update {_release(entry)}, or do without the plugin"


def _release(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown distribution"


def _names(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "none"

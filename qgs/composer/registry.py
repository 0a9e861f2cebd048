"""Installed components: found by metadata, imported only when a recipe names their plugin."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import Distribution, EntryPoint, entry_points

import qgs
from qgs.composer.builtin import BUILTIN
from qgs.composer.code_places import file_of, package_named, package_of, place_in
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
    """A plugin that is loaded and sound, and the distribution it came with.

    editable: whether its user is its author, who installed it from its source tree.
    """

    plugin: Plugin
    distribution: str
    version: str
    editable: bool = False

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


def component_error(installed: InstalledPlugin, fault: str, place: str = "") -> PluginError:
    """A component of `installed` breaks its contract; `fault` says which one, and how.

    place: FILE:LINE in its code, "" for none.
    """
    release = installed.released_as
    origin = f" of {release}" if release else ""
    at = f" (at {place})" if place else ""
    own = installed.editable or not release
    fix = f"mend {place or 'it'}" if own else f"update {release}"
    return PluginError(
        f"the plugin `{installed.plugin.name}`{origin} fails: {fault}{at}",
        f"{fix}, or choose another component",
    )


def component_failure(
    kind: str, what: str, error: Exception, installed: InstalledPlugin
) -> PluginError:
    """The code of `kind`, a PLUGIN/NAME, raised `error` when asked for `what`."""
    files = filter(None, map(file_of, installed.plugin.components))
    roots = {package_of(file) for file in files} - {package_of(qgs.__file__)}
    fault = f"`{what}` of `{kind}` raises {type(error).__name__}: {error}"
    return component_error(installed, fault, place_in(error, roots))


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
        place = place_in(error, package_named(entry.module))
        raise PluginError(
            f"the plugin `{entry.name}` of {distribution} cannot be imported from "
            f"`{entry.value}`: {type(error).__name__}: {error}{f' (at {place})' if place else ''}",
            _import_fix(entry, error, place),
        ) from error
    fault = plugin_fault(plugin, entry.name)
    if fault:
        reason = f"the plugin `{entry.name}` of {distribution} {fault.reason}"
        raise PluginError(reason, fault.fix or _repair(entry))
    assert entry.dist is not None
    return InstalledPlugin(plugin, entry.dist.name, entry.dist.version, _is_editable(entry.dist))


def _import_fix(entry: EntryPoint, error: BaseException, place: str) -> str:
    release = _release(entry)
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing == entry.module:
        return f"install {release} again, its files are gone; or do without the plugin"
    package = (missing or "").partition(".")[0]
    if package and package not in ("qgs", entry.module.partition(".")[0]):
        return f"install `{package}`, which {release} needs, or do without the plugin"
    return _repair(entry, place)


def _repair(entry: EntryPoint, place: str = "") -> str:
    """place: FILE:LINE of what is wrong, "" where only the entry point leads there."""
    if entry.dist and _is_editable(entry.dist):
        return f"mend {place or f'`{entry.value}`'}, or do without the plugin"
    return f"update {_release(entry)}, or do without the plugin"


def _is_editable(distribution: Distribution) -> bool:
    """Whether it was installed with `pip install -e`: the record of its origin (PEP 610)."""
    origin = json.loads(distribution.read_text("direct_url.json") or "{}")
    return bool(origin.get("dir_info", {}).get("editable"))


def _release(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown distribution"


def _names(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "none"

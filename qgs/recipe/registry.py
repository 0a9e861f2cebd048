"""Registry of components. A plugin is imported when a recipe or a command needs it."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import EntryPoints
from pathlib import Path

import qgs.data
import qgs.losses
import qgs.metrics
import qgs.renderers
import qgs.tokengs
from qgs import extensions
from qgs.contracts import CONTRACT_VERSION, Component, ComponentConfig, OptionError, Plugin
from qgs.contracts.plugin import ENTRY_POINT_GROUP
from qgs.recipe.errors import Problems
from qgs.recipe.slots import SLOTS
from qgs.recipe.yaml_text import MapNode, items_of
from qgs.version import __version__
from qgs.wording import did_you_mean


class PluginError(OptionError):
    """Error for an unusable plugin: `reason` names its distribution, `fix` says what to do."""


@dataclass(frozen=True)
class InstalledPlugin:
    """A plugin, and the distribution that installed it ("" if none did).

    folder: folder of the module that defines the Plugin.
    """

    plugin: Plugin
    distribution: str = ""
    version: str = "0"
    folder: Path = Path()

    @property
    def released_as(self) -> str:
        """Name and version of the distribution, for messages; "" without a distribution."""
        return f"{self.distribution} {self.version}" if self.distribution else ""

    @property
    def models(self) -> dict[str, Path]:
        """Paths of the plugin's trained models, by `PLUGIN/NAME`; a file may be missing."""
        plugin = self.plugin
        return {f"{plugin.name}/{name}": self.folder / at for name, at in plugin.models.items()}


BUILTIN = InstalledPlugin(
    Plugin(
        name="qgs",
        contract_version=CONTRACT_VERSION,
        components=(
            *qgs.tokengs.COMPONENTS,
            *qgs.renderers.COMPONENTS,
            *qgs.losses.COMPONENTS,
            *qgs.metrics.COMPONENTS,
            *qgs.data.COMPONENTS,
        ),
        examples=(
            qgs.tokengs.LayerSupervision.Config(layers=(1, 2)),
            qgs.data.PhotosSource.Config(path="photos"),  # type: ignore[call-arg]
        ),
    ),
    "query-gaussians",
    __version__,
)
"""The plugin `qgs`, with all components of the core."""


@dataclass(frozen=True)
class Registry:
    """The plugins that one recipe uses.

    complete: True if all plugins that the recipe names can be used.
    """

    plugins: Mapping[str, InstalledPlugin]
    complete: bool = True

    def components(self, slot: str) -> dict[str, type[Component]]:
        """Return the components of a slot, by `PLUGIN/NAME`."""
        return {
            f"{name}/{component.name}": component
            for name, installed in self.plugins.items()
            for component in installed.plugin.components
            if component.slot == slot
        }


def available_plugins() -> EntryPoints:
    """Return the entry points of all installed plugins, without importing them."""
    return extensions.installed(ENTRY_POINT_GROUP)


def load_plugins(tree: MapNode, problems: Problems, given: Sequence[Plugin]) -> Registry:
    """Load the plugins that a recipe names; add a problem for each plugin that cannot be used.

    tree: the merged recipe, whose lines the problems name. given: Plugin objects, which are used in
        place of installed plugins of the same names.
    """
    at_hand = {plugin.name: InstalledPlugin(plugin) for plugin in given}
    plugins = {"qgs": BUILTIN}
    written = items_of(tree.get("plugins"), tree.origin_of("plugins"))
    for index, (name, origin) in enumerate(written):
        try:
            plugins[name] = at_hand.get(name) or load_plugin(name)
        except PluginError as error:
            problems.add(origin, f"plugins.{index}", error.reason, error.fix, error)
    return Registry(plugins, complete=all(name in plugins for name, _ in written))


def load_usable_plugins() -> tuple[Registry, list[str]]:
    """Load all installed plugins; return the usable ones, and a message for each unusable one."""
    plugins = {"qgs": BUILTIN}
    broken = []
    # A plug-in of the framework's own name hides nothing.
    for name in sorted(available_plugins().names - {"qgs"}):
        try:
            plugins[name] = load_plugin(name)
        except PluginError as error:
            broken.append(str(error))
    return Registry(plugins), broken


def load_plugin(name: str) -> InstalledPlugin:
    """Import and check the plugin `name`; raise PluginError if it cannot be used."""
    if name == "qgs":
        return BUILTIN
    available = available_plugins()
    entries = available.select(name=name)
    if not entries:
        hint = did_you_mean(name, available.names, "installed plugins")
        fix = f"{extensions.INSTALL_ALL}; {hint}"
        raise PluginError(f"no installed distribution offers a plugin `{name}`", fix)
    if len(entries) > 1:
        releases = ", ".join(sorted(map(extensions.release_of, entries)))
        reason = f"several distributions offer a plugin `{name}`: {releases}"
        raise PluginError(reason, "keep one of these distributions, and uninstall the others")
    (entry,) = entries
    release = extensions.release_of(entry)
    assert entry.dist is not None
    named = f"the plugin `{name}` of {release}"
    try:
        plugin = entry.load()
    # A plug-in's module may do anything, `sys.exit` included.
    except (Exception, SystemExit) as error:
        message = f"cannot be imported from `{entry.value}`: {type(error).__name__}: {error}"
        fix = f"install what it needs, update or fix {release}, or do without the plugin"
        raise PluginError(f"{named} {message}", fix) from error
    if fault := _plugin_fault(plugin, name):
        raise PluginError(f"{named} {fault}", f"update or fix {release}, or do without the plugin")
    folder = Path(sys.modules[entry.module].__file__ or "").parent
    return InstalledPlugin(plugin, entry.dist.name, entry.dist.version, folder)


def _plugin_fault(plugin: object, name: str) -> str:
    """Return text on the fault of `plugin`; "" if it has none.

    Messages put the plugin's name before this text. name: name of the plugin's entry point.
    """
    if not isinstance(plugin, Plugin):
        return f"is not a qgs.Plugin: its entry point leads to an object of type {type(plugin)}"
    if plugin.contract_version != CONTRACT_VERSION:
        versions = f"version {plugin.contract_version}; this qgs has version {CONTRACT_VERSION}"
        return f"was written for contract {versions}"
    # Recipes name the entry point, messages the plug-in.
    if plugin.name != name:
        return f"calls itself `{plugin.name}`; the two names must be equal"
    for component in plugin.components:
        if not (isinstance(component, type) and getattr(component, "slot", None) in SLOTS):
            return f"lists {component!r}, which is not a component of any slot"
    return ""


def default_config(component: type[Component]) -> ComponentConfig | None:
    """Return a component's default options; None if an option has no default or is invalid."""
    try:
        return component.Config()
    except (Exception, SystemExit):
        return None

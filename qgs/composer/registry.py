"""Installed components: found by metadata, imported when a recipe or a command asks for them."""

import inspect
import json
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torch.nn import Module

import qgs
import qgs.components
import qgs.data
import qgs.losses
import qgs.metrics
import qgs.renderers
from qgs import extensions
from qgs.composer.errors import Problems
from qgs.composer.nodes import ListNode, MapNode, Origin, kind_of
from qgs.composer.slots import SLOTS
from qgs.contracts import (
    Component,
    ComponentConfig,
    Metric,
    Objective,
    OptionError,
    Renderer,
    WeightLayout,
)
from qgs.contracts.plugin import CONTRACT_VERSION, ENTRY_POINT_GROUP, Plugin
from qgs.contracts.schedule import number_kinds

BUILTIN = Plugin(
    name="qgs",
    contract_version=CONTRACT_VERSION,
    components=(
        *qgs.components.COMPONENTS,
        *qgs.renderers.COMPONENTS,
        *qgs.losses.COMPONENTS,
        *qgs.metrics.COMPONENTS,
        *qgs.data.COMPONENTS,
    ),
    layouts=(qgs.components.TOKENGS,),
    examples=(
        qgs.components.LatentBottleneck.Config(depth=2, blocks=(1, 2), latents=6, latent_depth=2),
        qgs.components.LayerSupervision.Config(layers=(1, 2)),
        qgs.data.ChunksSource.Config(path="chunks"),  # type: ignore[call-arg]
        qgs.data.Dl3dvSource.Config(path="dl3dv"),  # type: ignore[call-arg]
        qgs.data.PhotosSource.Config(path="photos"),  # type: ignore[call-arg]
    ),
)
RENDERER_DEVICES = ("cpu", "cuda", "mps")
"""Types of the devices that a renderer can render on."""


class PluginError(OptionError):
    """A plugin that cannot be used: `reason` names its distribution, `fix` says what to do."""


@dataclass(frozen=True)
class InstalledPlugin:
    """A sound plugin and its distribution, "" for none.

    editable: installed by its author, with `pip -e`. folder: of the module that holds the Plugin.
    """

    plugin: Plugin
    distribution: str = ""
    version: str = "0"
    editable: bool = False
    folder: Path = Path()

    @property
    def released_as(self) -> str:
        """Name and version of the distribution, as messages give them; "" for none."""
        return f"{self.distribution} {self.version}" if self.distribution else ""

    @property
    def models(self) -> dict[str, Path]:
        """`PLUGIN/NAME` of every model that it ships to its file, which may be missing."""
        models = self.plugin.models.items()
        return {f"{self.plugin.name}/{name}": self.folder / file for name, file in models}

    def repair(self, place: str) -> str:
        """What its user can do about a fault. place: FILE:LINE of it."""
        own = self.editable or not self.distribution
        return f"correct {place}" if own else f"update {self.released_as}"


@dataclass(frozen=True)
class Registry:
    """The plugins that one recipe uses. unusable: those that could not be loaded."""

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


def builtin() -> InstalledPlugin:
    """The plugin `qgs`."""
    return InstalledPlugin(BUILTIN, "query-gaussians", qgs.__version__)


def available_plugins() -> dict[str, list[EntryPoint]]:
    """Name to entry points of every installed plugin, by metadata alone."""
    found: dict[str, list[EntryPoint]] = {}
    for entry in extensions.installed(ENTRY_POINT_GROUP):
        found.setdefault(entry.name, []).append(entry)
    return found


def load_registry(names: Iterable[str]) -> Registry:
    """The built-in components and those of the plugins `names`; raises PluginError."""
    return Registry({"qgs": builtin(), **{name: load_plugin(name) for name in names}})


def load_plugins(tree: MapNode, problems: Problems, given: Sequence[Plugin] = ()) -> Registry:
    """The components of the recipe's `plugins`; a problem for each that cannot be used."""
    at_hand = {plugin.name: InstalledPlugin(plugin) for plugin in given}
    plugins, seen = {"qgs": builtin()}, dict[str, Origin]()
    written = tree.get("plugins")
    if written is not None and not isinstance(written, ListNode):
        reason = f"`plugins` is a list, this is {kind_of(written)}"
        problems.add(tree.origins["plugins"], "plugins", reason, "write `plugins: [NAME]`")
    written = written if isinstance(written, ListNode) else ListNode(tree.origin)
    for index, (name, origin) in enumerate(zip(written, written.origins, strict=True)):
        path = f"plugins.{index}"
        if not isinstance(name, str):
            reason = f"a plugin is a name, this is {kind_of(name)}"
            problems.add(origin, path, reason, "write `plugins: [NAME]`")
        elif name in seen:
            reason = f"the plugin `{name}` is already listed at {seen[name]}"
            problems.add(origin, path, reason, "list it once")
        else:
            seen[name] = origin
            try:
                plugins[name] = at_hand.get(name) or load_plugin(name)
            except PluginError as error:
                problems.add(origin, path, error.reason, error.fix, error)
    return Registry(plugins, unusable=frozenset(seen.keys() - plugins.keys()))


def load_sound_plugins() -> tuple[Registry, list[str]]:
    """The components of every installed plugin that can be used, and why the others cannot."""
    plugins, broken = {"qgs": builtin()}, []
    available = available_plugins()
    for release in map(_release, available.pop("qgs", [])):
        reason = f"{release} offers a plugin `qgs`, the framework's own name"
        broken.append(f"{reason}; uninstall {release}")
    for name in sorted(available):
        try:
            plugins[name] = load_plugin(name)
        except PluginError as error:
            broken.append(str(error))
    return Registry(plugins), broken


def load_plugin(name: str) -> InstalledPlugin:
    """Import and check the plugin `name`; raises PluginError."""
    if name == "qgs":
        return builtin()
    available = available_plugins()
    if not (entries := available.get(name)):
        installed = ", ".join(sorted(available)) or "none"
        wanted = qgs.DISTRIBUTIONS[ENTRY_POINT_GROUP].get(name, "the one that does")
        fix = f"install {wanted}; installed plugins: {installed}"
        raise PluginError(f"no installed distribution offers a plugin `{name}`", fix)
    if len(entries) > 1:
        releases = ", ".join(sorted(map(_release, entries)))
        reason = f"several distributions offer a plugin `{name}`: {releases}"
        raise PluginError(reason, "uninstall all of them but one")
    entry = entries[0]
    assert entry.dist is not None
    # The record of where a distribution came from (PEP 610): whether by `pip install -e`.
    record = json.loads(entry.dist.read_text("direct_url.json") or "{}")
    editable = bool(record.get("dir_info", {}).get("editable"))
    empty = Plugin(name, CONTRACT_VERSION, ())
    installed = InstalledPlugin(empty, entry.dist.name, entry.dist.version, editable)
    named = f"the plugin `{name}` of {installed.released_as}"
    try:
        plugin = entry.load()
    except (Exception, SystemExit) as error:
        package = entry.module.partition(".")[0]
        spec = find_spec(package)
        place = place_in(error, [package_of(spec.origin)] if spec and spec.origin else [])
        message = f"{type(error).__name__}: {error}{f' (at {place})' if place else ''}"
        reason = f"{named} cannot be imported from `{entry.value}`: {message}"
        fix = installed.repair(place or f"`{entry.value}`")
        missing = (error.name or "") if isinstance(error, ModuleNotFoundError) else ""
        if missing == entry.module:
            fix = f"install {installed.released_as} again, its files are gone"
        elif missing.partition(".")[0] not in ("", "qgs", package):
            fix = f"install `{missing.partition('.')[0]}`, which {installed.released_as} needs"
        raise PluginError(reason, f"{fix}, or do without the plugin") from error
    for fault in _plugin_faults(plugin, name):
        version = getattr(plugin, "contract_version", None)
        newer = type(version) is int and version > CONTRACT_VERSION
        fix = "update qgs" if newer else installed.repair(f"`{entry.value}`")
        raise PluginError(f"{named} {fault}", f"{fix}, or do without the plugin")
    return replace(installed, plugin=plugin, folder=_folder_of(entry.module))


def _folder_of(module: str) -> Path:
    file = sys.modules[module].__file__
    return Path(file).parent if file else Path()


def _release(entry: EntryPoint) -> str:
    assert entry.dist is not None
    return f"{entry.dist.name} {entry.dist.version}"


def _plugin_faults(plugin: object, name: str) -> Iterator[str]:
    """Faults of what the entry point `name` leads to, each the rest of "the plugin X ..."."""
    if not isinstance(plugin, Plugin):
        kind = type(plugin).__name__
        yield f"is no qgs.Plugin: its entry point leads to an object of type {kind}"
        return
    version: object = plugin.contract_version
    if type(version) is not int:
        yield f"must give `contract_version` as a whole number, not {version!r}"
    elif version != CONTRACT_VERSION:
        yield f"was written for contract version {version}; this qgs has version {CONTRACT_VERSION}"
    if plugin.name != name:
        yield f"calls itself `{plugin.name}`; the two names must be one"
    for attribute in ("components", "layouts", "examples"):
        value = getattr(plugin, attribute)
        if not isinstance(value, Sequence):
            comma = ", written `(Mine,)` for a single one" if inspect.isclass(value) else ""
            yield f"must give `{attribute}` as a tuple or a list{comma}, not {value!r}"
            return
    for attribute in ("models", "exemptions"):
        value = getattr(plugin, attribute)
        if not isinstance(value, Mapping):
            yield f"must give `{attribute}` as a mapping, not {value!r}"
            return
    if not plugin.components and not plugin.layouts and not plugin.models:
        yield "is empty: it lists no `components`, `layouts` or `models`"
    for model, file in plugin.models.items():
        if not isinstance(file, str) or not re.fullmatch(r"[^\s/]+", str(model)):
            yield f"ships {model!r}: {file!r}; models are file names by names without / and blank"
    taken: set[tuple[str, str]] = set()
    for component in plugin.components:
        fault = component_fault(component)
        if fault:
            yield f"lists {getattr(component, '__qualname__', repr(component))}, {fault}"
            return
        if (component.slot, component.name) in taken:
            yield f"registers `{component.name}` twice in the slot `{component.slot}`"
        taken.add((component.slot, component.name))
    for layout in plugin.layouts:
        if not isinstance(layout, WeightLayout):
            yield f"lists {layout!r}, which is no WeightLayout"


def component_fault(component: object) -> str:
    """Why nothing can be built of `component`; "" if it can."""
    if not (inspect.isclass(component) and issubclass(component, Component)):
        return "which is no qgs component"
    slot, name = SLOTS.get(getattr(component, "slot", "")), getattr(component, "name", None)
    if slot is None or not issubclass(component, slot.contract):
        return "which implements no slot's contract"
    if not isinstance(name, str):
        return "which has no `name`"
    if not re.fullmatch(r"[^\s/]+", name):  # else `type: PLUGIN/NAME` could not be told apart
        return f"whose name {name!r} is empty or has a slash or a blank"
    if inspect.isabstract(component):
        return f"which leaves {', '.join(sorted(component.__abstractmethods__))} abstract"
    if issubclass(component, Renderer):
        given: object = component.devices
        if not (isinstance(given, tuple) and given and set(given) <= set(RENDERER_DEVICES)):
            return f"whose `devices` is {given!r}; give some of {RENDERER_DEVICES} as a tuple"
    if issubclass(component, Metric) and not getattr(component, "definition", ""):
        return "which gives no `definition`; say in words what it measures, since protocols hash it"
    config: object = component.Config
    if not (inspect.isclass(config) and issubclass(config, ComponentConfig)):
        return "whose Config is no ComponentConfig"
    if not config.model_config.get("frozen"):
        return "whose Config is not frozen; leave `frozen` of its `model_config` at True"
    if "type" in config.model_fields:
        return "whose Config has an option `type`, which names the component itself"
    fields: Mapping[str, Any] = config.model_fields
    scheduled: object = component.scheduled
    known = {n for n, option in fields.items() if number_kinds(option.annotation)}
    if not (isinstance(scheduled, frozenset) and scheduled <= known):
        return f"whose `scheduled` is {scheduled!r}, not a frozenset of options that are numbers"
    if scheduled and not issubclass(component, Module | Objective):
        return f"which lists `scheduled` options; those of the slot `{component.slot}` stay"
    return _schema_fault(config)


@cache
def _schema_fault(config: type[ComponentConfig]) -> str:
    try:
        config.model_json_schema()
        return ""
    except Exception as error:
        return f"whose Config has options that YAML cannot express: {str(error).splitlines()[0]}"


def default_config(component: type[Component]) -> ComponentConfig | None:
    """Its default options; None if one must be given, or if a plugin's own validator fails."""
    try:
        return component.Config()
    except (Exception, SystemExit):
        return None


def component_error(installed: InstalledPlugin, fault: str, place: str = "") -> PluginError:
    """A component of `installed` breaks its contract. place: FILE:LINE in its code, or ""."""
    origin = f" of {installed.released_as}" if installed.distribution else ""
    at = f" (at {place})" if place else ""
    reason = f"the plugin `{installed.plugin.name}`{origin} fails: {fault}{at}"
    return PluginError(reason, f"{installed.repair(place or 'it')}, or choose another component")


def component_failure(
    kind: str, what: str, error: Exception, installed: InstalledPlugin
) -> PluginError:
    """The code of `kind`, a PLUGIN/NAME, raised `error` when asked for `what`."""
    files = filter(None, map(file_of, installed.plugin.components))
    roots = {package_of(file) for file in files} - {package_of(qgs.__file__)}
    fault = f"`{what}` of `{kind}` raises {type(error).__name__}: {error}"
    return component_error(installed, fault, place_in(error, roots))


def file_of(component: type) -> str | None:
    """The file that defines a class; None for one that was defined in no file."""
    return getattr(sys.modules.get(component.__module__), "__file__", None)


def package_of(file: str) -> Path:
    """The outermost package folder that holds the module `file`, or the file itself."""
    path = Path(file).resolve()
    while (path.parent / "__init__.py").exists():
        path = path.parent
    return path


def place_of(function: Callable[..., Any]) -> str:
    """FILE:LINE where a function starts; "" for one that is not written in Python."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return f"{code.co_filename}:{code.co_firstlineno}" if code else ""


def place_in(error: BaseException, roots: Iterable[Path]) -> str:
    """FILE:LINE of the last place below one of `roots` that `error` passed; "" for none."""
    frames = traceback.extract_tb(error.__traceback__)
    passed = [(frame.filename, frame.lineno) for frame in frames]
    if isinstance(error, SyntaxError) and error.filename:
        passed.append((error.filename, error.lineno))
    inside = tuple(roots)
    for file, line in reversed(passed):
        if any(Path(file).resolve().is_relative_to(root) for root in inside):
            return f"{file}:{line}"
    return ""

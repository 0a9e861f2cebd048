"""From what is written at a place to a component class and its Config."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from pydantic import ValidationError

from qgs.composer.errors import Problems
from qgs.composer.explain import explain, place_of
from qgs.composer.nodes import (
    ListNode,
    MapNode,
    Node,
    Origin,
    Path,
    ScalarNode,
    is_null,
    kind_of,
    locate,
    to_plain,
)
from qgs.composer.places import Place
from qgs.composer.registry import (
    InstalledPlugin,
    Registry,
    available_plugins,
    component_failure,
)
from qgs.composer.slots import SLOTS, type_at
from qgs.composer.suggest import did_you_mean, nearest
from qgs.contracts import Component, ComponentConfig

ConfigT = TypeVar("ConfigT", bound=ComponentConfig)


@dataclass(frozen=True)
class Chosen:
    """The component that stands at a place: its `type`, class, options, and where it came from."""

    place: Place
    type: str
    component: type[Component]
    config: ComponentConfig
    installed: InstalledPlugin

    @property
    def written_at(self) -> str:
        """The dotted path under which a user finds it."""
        return ".".join(self.place.source)


def decode_places(
    places: Mapping[Path, Place], registry: Registry, problems: Problems
) -> dict[Path, Chosen | None]:
    """The component of every place, None where there is none to be had (with a problem)."""
    return {path: _decode_place(place, registry, problems) for path, place in places.items()}


def decode_config(
    config: type[ConfigT], node: Node, path: Path, problems: Problems
) -> ConfigT | None:
    """`node` as a `config`, in pydantic's strict JSON mode; None, and problems, where it is not."""
    try:
        return config.model_validate_json(json.dumps(to_plain(node)))
    except ValidationError as error:
        for detail in error.errors():
            steps = place_of(detail, node)
            reason, fix = explain(detail, _value_at(node, steps), config)
            problems.add(locate(node, steps), ".".join([*path, *map(str, steps)]), reason, fix)
        return None


def _decode_place(place: Place, registry: Registry, problems: Problems) -> Chosen | None:
    node = MapNode(place.origin) if place.node is None or is_null(place.node) else place.node
    if not isinstance(node, MapNode):
        problems.add(
            place.origin,
            ".".join(place.source),
            f"a component is a mapping, this is {kind_of(node)}",
            "write `{type: PLUGIN/NAME, option: value}`",
        )
        return None
    origin = node.keys.get("type", place.origin)
    name = type_at(node, place.path)
    component = _find(name, place, registry, origin, problems)
    if component is None:
        return None
    installed = registry.plugins[name.partition("/")[0]]
    try:
        config = decode_config(component.Config, node.without("type"), place.source, problems)
    except Exception as error:
        failure = component_failure(name, "Config", error, installed)
        problems.add(origin, ".".join(place.source), failure.reason, failure.fix, error)
        return None
    return None if config is None else Chosen(place, name, component, config, installed)


def _find(
    name: object, place: Place, registry: Registry, origin: Origin, problems: Problems
) -> type[Component] | None:
    installed = registry.components(place.slot.name)
    if isinstance(name, str) and name in installed:
        return installed[name]
    if isinstance(name, str) and name.partition("/")[0] in registry.unusable:
        return None  # its plugin is a problem already
    reason, fix = _why_not(name, place, registry)
    problems.add(origin, ".".join([*place.source, "type"]), reason, fix)
    return None


def _why_not(name: object, place: Place, registry: Registry) -> tuple[str, str]:
    slot = place.slot.name
    installed = registry.components(slot)
    if name is None:
        reason = f"the slot `{slot}` has no default component"
        return reason, f"add `type:`, one of {', '.join(sorted(installed))}"
    if not isinstance(name, str):
        given = name if isinstance(name, MapNode | ListNode) else ScalarNode(Origin(""), name)
        reason = f"`type` names a component, got {kind_of(given)}"
        return reason, f"choose {', '.join(sorted(installed))}"
    plugin, slash, _ = name.partition("/")
    if not slash:
        return _no_plugin_named(name, installed)
    if plugin not in registry.plugins:
        return _not_loaded(name, plugin, registry)
    elsewhere = [other for other in SLOTS if name in registry.components(other)]
    if elsewhere:
        reason = f"`{name}` belongs in the slot `{elsewhere[0]}`, not in `{slot}`"
        return reason, f"choose {', '.join(sorted(installed))}"
    reason = f"there is no component `{name}` for the slot `{slot}`"
    return reason, did_you_mean(name, installed, "components")


def _no_plugin_named(name: str, installed: Mapping[str, object]) -> tuple[str, str]:
    if "." in name or ":" in name:
        reason = f"`{name}` is an import path; `type` only names installed components"
        fix = "offer the class in a plugin (entry points `qgs.plugins`), name it PLUGIN/NAME"
        return reason, fix
    reason = f"`{name}` names no plugin: components are called PLUGIN/NAME"
    same = [known for known in installed if known.split("/")[1] == name]
    return reason, f"did you mean `{same[0]}`?" if same else did_you_mean(
        name, installed, "components"
    )


def _not_loaded(name: str, plugin: str, registry: Registry) -> tuple[str, str]:
    reason = f"`{name}` is of the plugin `{plugin}`, which this recipe does not use"
    if plugin in available_plugins():
        listed = [known for known in registry.plugins if known != "qgs"] + [plugin]
        return reason, f"add `plugins: [{', '.join(listed)}]`"
    near = nearest(plugin, [*registry.plugins, *available_plugins()])
    if near:
        return reason, f"did you mean the plugin `{near}`?"
    return reason, f"install the distribution of `{plugin}` and add `plugins: [{plugin}]`"


def _value_at(node: Node, steps: tuple[str | int, ...]) -> Node | None:
    for step in steps:
        if isinstance(node, MapNode):
            if str(step) not in node.items:
                return None
            node = node.items[str(step)]
        elif not isinstance(node, ScalarNode):
            node = node.items[int(step)]
    return node

"""What is wrong with a plugin object, seen before any of its components is used."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from qgs.composer.slots import SLOTS
from qgs.contracts import (
    CONTRACT_VERSION,
    Component,
    ComponentConfig,
    Plugin,
    Renderer,
    WeightLayout,
)

NAME = re.compile(r"[^\s/]+")
"""Of a component: `type: PLUGIN/NAME` must be read as it was written."""

DEVICES = ("cpu", "cuda")
"""Types of the devices that a renderer can render on."""


@dataclass(frozen=True)
class Fault:
    """reason: what a plugin does wrong, as the rest of "the plugin X ...".

    fix: what its user can do, "" for no more than to update it.
    """

    reason: str
    fix: str = ""


def plugin_fault(plugin: object, name: str) -> Fault | None:
    """The first fault of what the entry point `name` leads to; None for a sound plugin."""
    if not isinstance(plugin, Plugin):
        kind = type(plugin).__name__
        return Fault(f"is no qgs.Plugin: its entry point leads to an object of type {kind}")
    return next(_faults(plugin, name), None)


def _faults(plugin: Plugin, name: str) -> Iterator[Fault]:
    version: object = plugin.contract_version
    if type(version) is not int:
        yield Fault(f"must give `contract_version` as a whole number, not {version!r}")
    elif version != CONTRACT_VERSION:
        yield _other_contracts(version)
    if plugin.name != name:
        yield Fault(f"calls itself `{plugin.name}`; the two names must be one")
    for attribute in ("components", "layouts", "examples"):
        value = getattr(plugin, attribute)
        if not isinstance(value, Sequence):
            comma = ", written `(Mine,)` for a single one" if inspect.isclass(value) else ""
            yield Fault(f"must give `{attribute}` as a tuple or a list{comma}, not {value!r}")
            return
    if not plugin.components and not plugin.layouts:
        yield Fault("is empty: it lists neither `components` nor `layouts`")
    if not isinstance(plugin.exemptions, Mapping):
        yield Fault(f"must give `exemptions` as a mapping, not {plugin.exemptions!r}")
    yield from _component_faults(plugin.components)
    for layout in plugin.layouts:
        if not isinstance(layout, WeightLayout):
            yield Fault(f"lists {layout!r}, which is no WeightLayout")


def _other_contracts(version: int) -> Fault:
    reason = f"was written for contract version {version}; this qgs has version {CONTRACT_VERSION}"
    newer = version > CONTRACT_VERSION
    return Fault(reason, "update qgs, or do without the plugin" if newer else "")


def _component_faults(components: Sequence[object]) -> Iterator[Fault]:
    taken: set[tuple[str, str]] = set()
    for component in components:
        reason = component_fault(component)
        if reason:
            yield Fault(f"lists {getattr(component, '__qualname__', repr(component))}, {reason}")
            return
        assert inspect.isclass(component)
        assert issubclass(component, Component)
        if (component.slot, component.name) in taken:
            yield Fault(f"registers `{component.name}` twice in the slot `{component.slot}`")
        taken.add((component.slot, component.name))


def component_fault(component: object) -> str:
    """Why nothing can be built of `component`; "" if it can."""
    if not (inspect.isclass(component) and issubclass(component, Component)):
        return "which is no qgs component"
    slot = SLOTS.get(getattr(component, "slot", ""))
    if slot is None or not issubclass(component, slot.contract):
        return "which implements no slot's contract"
    name = getattr(component, "name", None)
    if not isinstance(name, str):
        return "which has no `name`"
    if not NAME.fullmatch(name):
        return f"whose name {name!r} is empty or has a slash or a blank"
    if inspect.isabstract(component):
        return f"which leaves {', '.join(sorted(component.__abstractmethods__))} abstract"
    if issubclass(component, Renderer) and not _are_devices(component.devices):
        return f"whose `devices` is {component.devices!r}; give some of {DEVICES} as a tuple"
    return _config_fault(component.Config)


def _are_devices(given: object) -> bool:
    return isinstance(given, tuple) and bool(given) and all(name in DEVICES for name in given)


def _config_fault(config: object) -> str:
    if not (inspect.isclass(config) and issubclass(config, ComponentConfig)):
        return "whose Config is no ComponentConfig"
    if "type" in config.model_fields:
        return "whose Config has an option `type`, which names the component itself"
    return _schema_fault(config)


@cache
def _schema_fault(config: type[ComponentConfig]) -> str:
    try:
        config.model_json_schema()
    except Exception as error:
        told = str(error).splitlines()[0]
        return f"whose Config has options that YAML cannot express: {told}"
    return ""

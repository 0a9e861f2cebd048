"""Faults of a class that recipes cannot use as a component."""

import re
from collections.abc import Mapping
from typing import Any

from torch.nn import Module

from qgs.contracts import (
    Component,
    Metric,
    Objective,
    Optimizer,
    Renderer,
    ViewSampler,
)
from qgs.contracts.schedule import number_kinds

# Types of the devices that a renderer can render on.
DEVICES = ("cpu", "cuda", "mps")


def component_fault(component: type[Component]) -> str:
    """Why a recipe cannot use the class `component`, as a relative clause; "" if it can."""
    name = getattr(component, "name", None)
    if not isinstance(name, str):
        return "which has no `name`"
    # Else `type: PLUGIN/NAME` would be ambiguous.
    if not re.fullmatch(r"[^\s/]+", name):
        return f"whose name {name!r} is empty or has a slash or a blank"
    if issubclass(component, Renderer):
        given: object = component.devices
        if not (isinstance(given, tuple) and given and set(given) <= set(DEVICES)):
            return f"whose `devices` is {given!r}; give some of {DEVICES} as a tuple"
    if issubclass(component, Metric) and not getattr(component, "definition", ""):
        return "which gives no `definition`; describe what it measures, since protocols hash it"
    config = component.Config
    if not config.model_config.get("frozen"):
        return "whose Config is not frozen; leave `frozen` of its `model_config` at True"
    if "type" in config.model_fields:
        return "whose Config has an option `type`, which names the component itself"
    fields: Mapping[str, Any] = config.model_fields
    scheduled: object = component.scheduled
    known = {n for n, option in fields.items() if number_kinds(option.annotation)}
    if not (isinstance(scheduled, frozenset) and scheduled <= known):
        return f"whose `scheduled` is {scheduled!r}, not a frozenset of options that are numbers"
    # Others are built once, and have no step to follow.
    if scheduled and not issubclass(component, Module | Objective | Optimizer | ViewSampler):
        return f"which lists `scheduled` options; those of the slot `{component.slot}` stay"
    return ""

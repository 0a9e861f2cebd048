"""What a component says that it provides, held against what it can give and what it gives."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from torch import nn

from qgs.composer.decode import Chosen
from qgs.composer.registry import InstalledPlugin, component_fault
from qgs.contracts import (
    MEMORY_FIELDS,
    Component,
    Encoder,
    Fields,
    FieldSpec,
    Queries,
    Refinement,
    Renderer,
)
from qgs.types import QueryState


def refuse_unkeepable(chosen: Chosen, provided: Fields) -> None:
    """Raise PluginError if `chosen` provides what no component of its slot can write."""
    writable = _writable(chosen.component)
    beyond = [] if writable is None else [name for name in provided if name not in writable]
    if beyond:
        raise component_fault(
            chosen.installed,
            f"`{chosen.type}` says that it provides {', '.join(beyond)}, which a component of the "
            f"slot `{chosen.component.slot}` has no way to write",
        )


def hold_to_promise(module: nn.Module, chosen: Chosen) -> None:
    """Make `module` raise PluginError when it returns a state without the fields it provides."""
    if issubclass(chosen.component, Queries | Refinement):
        provided = dict(chosen.component.provides(chosen.config))
        if provided:
            module.register_forward_hook(_Promise(chosen.type, chosen.installed, provided))


def _writable(component: type[Component]) -> Collection[str] | None:
    """Names of the fields that a component of this slot can write; None for any."""
    if issubclass(component, Queries | Refinement):
        return None
    if issubclass(component, Encoder):
        return MEMORY_FIELDS
    if issubclass(component, Renderer):
        return Renderer.provides(Renderer.Config())
    return ()


@dataclass(frozen=True)
class _Promise:
    """A forward hook that looks for the `provided` fields in the state returned."""

    type: str
    installed: InstalledPlugin
    provided: Fields

    def __call__(self, module: nn.Module, arguments: Any, state: QueryState) -> None:
        for name, spec in self.provided.items():
            if name not in state.fields:
                found = ", ".join(state.fields) or "no field at all"
                raise self._broken(name, spec, f"the state that it returns has {found}")
            shape = tuple(state.fields[name].shape[2:])
            if len(shape) != len(spec.shape) or any(
                isinstance(size, int) and size != given
                for size, given in zip(spec.shape, shape, strict=True)
            ):
                raise self._broken(name, spec, f"it returns one of trailing shape {shape}")

    def _broken(self, name: str, spec: FieldSpec, what: str) -> Exception:
        fault = f"`{self.type}` says that it provides {name} ({spec}), but {what}"
        return component_fault(self.installed, fault)

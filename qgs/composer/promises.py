"""What a component says that it provides, held against what it can give and what it gives."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from torch import nn

from qgs.composer.code_places import place_of
from qgs.composer.decode import Chosen
from qgs.composer.registry import InstalledPlugin, component_error
from qgs.contracts import (
    MEMORY_FIELDS,
    Component,
    Encoder,
    Fields,
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
        raise component_error(
            chosen.installed,
            f"`{chosen.type}` says that it provides {', '.join(beyond)}, which a component of the "
            f"slot `{chosen.component.slot}` has no way to write",
        )


def hold_to_promise(module: nn.Module, chosen: Chosen) -> None:
    """Make `module` raise PluginError when it does not give the state that it must.

    That has the fields that it provides, and those of the state that it was given.
    """
    if issubclass(chosen.component, Queries | Refinement):
        provided = dict(chosen.component.provides(chosen.config))
        place = place_of(chosen.component.forward)
        module.register_forward_hook(_Promise(chosen.type, chosen.installed, provided, place))


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
    place: str

    def __call__(self, module: nn.Module, arguments: Any, state: Any) -> None:
        if not isinstance(state, QueryState):
            raise self._broken(f"returns {type(state).__name__}, not a QueryState")
        found = ", ".join(state.fields) or "no field at all"
        for name, spec in self.provided.items():
            says = f"says that it provides {name} ({spec}), but"
            if name not in state.fields:
                raise self._broken(f"{says} the state that it returns has {found}")
            shape = tuple(state.fields[name].shape[2:])
            if not fits(shape, spec.shape):
                raise self._broken(f"{says} it returns one of trailing shape {shape}")
        for given in arguments:
            lost = [n for n in getattr(given, "fields", ()) if n not in state.fields]
            if lost:
                raise self._broken(
                    f"loses {', '.join(lost)}: the state that it returns has {found}; "
                    "`state.replace(...)` keeps what it does not change"
                )

    def _broken(self, what: str) -> Exception:
        return component_error(self.installed, f"`{self.type}` {what}", self.place)


def fits(shape: tuple[int, ...], wanted: Sequence[int | str | None]) -> bool:
    """Whether `shape` has the sizes that are `wanted`; one that is no number may be any."""
    return len(shape) == len(wanted) and all(
        not isinstance(size, int) or size == given
        for size, given in zip(wanted, shape, strict=True)
    )

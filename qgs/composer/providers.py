"""Which change of a recipe would meet a requirement."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal, get_args, get_origin

from qgs.composer.declared import needs, offers
from qgs.composer.decode import Chosen
from qgs.composer.registry import Registry, default_config
from qgs.composer.slots import LAYER_SLOTS
from qgs.composer.yaml12 import dump
from qgs.contracts import Component, ComponentConfig, Fields

_FLOW = ("encoder", "queries", *LAYER_SLOTS, "head", "centers", "renderer", "losses")
"""Slots that read or write fields, in the order in which a layer's prediction is made."""


def fix_unmet(missing: Fields, chosen: Chosen, before: Sequence[Chosen], registry: Registry) -> str:
    """What to do when `chosen` needs fields that nothing `before` it provides.

    One change that meets them all, or changes for each of them.
    """
    fixes = dict.fromkeys(
        f"set `{earlier.written_at}.{option}: {value}` on `{earlier.type}`"
        for earlier in before
        for option, value, config in variants(earlier.config)
        if missing.keys() <= offers(earlier.component, config).keys()
    )
    if not fixes:
        fixes = dict.fromkeys(_installed_providers(missing, chosen.place.slot.name, registry))
    for option, value, config in variants(chosen.config):
        needed = needs(chosen.component, config)
        if needed is not None and not missing.keys() & needed.keys():
            names = " and no ".join(missing)
            fixes[f"set `{chosen.written_at}.{option}: {value}`, which needs no {names}"] = None
    if fixes:
        return ", or ".join(fixes)
    if len(missing) == 1:
        return f"install a plugin with a component that provides {next(iter(missing))}"
    return "; ".join(
        f"for {name}: {fix_unmet({name: spec}, chosen, before, registry)}"
        for name, spec in missing.items()
    )


def fix_mismatch(reader: Chosen, writer: Chosen) -> str:
    """What to do when two components disagree about a field."""
    ours, theirs = reader.config, writer.config
    differing = [
        option
        for option in type(ours).model_fields
        if option in type(theirs).model_fields and getattr(ours, option) != getattr(theirs, option)
    ]
    if not differing:
        return f"choose another component than `{reader.type}` or `{writer.type}`"
    words = [f"{option}: {_word(getattr(theirs, option))}" for option in differing]
    return f"set `{', '.join(words)}` on `{reader.type}`, as on `{writer.type}`"


def _installed_providers(missing: Fields, reader: str, registry: Registry) -> Iterator[str]:
    """Components that provide the fields by themselves, in slots that run before `reader`."""
    for slot in _FLOW[: _FLOW.index(reader)]:
        for kind, component in registry.components(slot).items():
            for note, config in _default_configs(component):
                if missing.keys() <= offers(component, config).keys():
                    yield f"use `{kind}`{note} in the slot `{slot}`"
                    break


def _default_configs(component: type[Component]) -> Iterator[tuple[str, ComponentConfig]]:
    config = default_config(component)
    if config is None:
        return
    yield "", config
    for option, value, variant in variants(config):
        yield f" with `{option}: {value}`", variant


def variants(config: ComponentConfig) -> Iterator[tuple[str, str, ComponentConfig]]:
    """`config` with one choice made otherwise: option, new value in YAML, new config."""
    for option, field in type(config).model_fields.items():
        choices: tuple[object, ...] = ()
        if field.annotation is bool:
            choices = (True, False)
        elif get_origin(field.annotation) is Literal:
            choices = get_args(field.annotation)
        for choice in choices:
            if choice != getattr(config, option):
                yield option, _word(choice), config.model_copy(update={option: choice})


def _word(value: object) -> str:
    return dump(value).removesuffix("\n").removesuffix("\n...")

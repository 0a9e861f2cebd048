"""The plugin, which a distribution offers to recipes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from qgs.contracts.component import Component, ComponentConfig

CONTRACT_VERSION = 1
"""Goes up when components written for the old contracts no longer fit."""

ENTRY_POINT_GROUP = "qgs.plugins"
"""Entry points at which a distribution lists its `Plugin` object, under the plugin's name."""


@dataclass(frozen=True)
class Plugin:
    """Components under one name. Importing it has no side effect.

    name: the part of `type: NAME/component` before the slash.
    contract_version: the CONTRACT_VERSION that the components were written for.
    components: component classes; a `name` is unique within its slot.
    examples: options that `qgs check-plugin` tries in addition to the defaults of every component.
    models: files of trained models by name, relative to the folder of the module that the entry
        point names; PLUGIN/NAME stands for the path in every command. A card in the same
        folder describes the model: models/mine.md for models/mine.safetensors.
    exemptions: checks of the contract suite that a component is known to fail, and why; by class,
        or by options where it passes with others.
    """

    name: str
    contract_version: int
    components: Sequence[type[Component]]
    examples: Sequence[ComponentConfig] = ()
    models: Mapping[str, str] = field(default_factory=dict)
    exemptions: Mapping[type[Component] | ComponentConfig, Mapping[str, str]] = field(
        default_factory=dict
    )

"""Contract of plugins: the components that an installed distribution offers to recipes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from qgs.contracts.component import Component, ComponentConfig

CONTRACT_VERSION = 1
"""Version of the contracts. A new version breaks components written for the old one."""

ENTRY_POINT_GROUP = "qgs.plugins"
"""Entry point group in which a distribution lists its `Plugin`, under the plugin's name."""


@dataclass(frozen=True)
class Plugin:
    """Components of one distribution. Importing a plugin must have no side effects.

    name: the part of `type: NAME/component` before the slash.
    contract_version: the CONTRACT_VERSION that the components were written for.
    components: component classes; the `name` of each is unique within its slot.
    examples: options that `qgs check-plugin` tries in addition to the defaults of every component.
    models: files of trained models by name, relative to the folder of the module that the entry
        point names. Commands accept PLUGIN/NAME in place of a file's path. A Markdown file of the
        same name describes each model: models/mine.md for models/mine.safetensors.
    exemptions: checks of the contract that are known to fail, as {component class or options:
        {check: reason}}. The key is options if the component fails only with these options.
    """

    name: str
    contract_version: int
    components: Sequence[type[Component]]
    examples: Sequence[ComponentConfig] = ()
    models: Mapping[str, str] = field(default_factory=dict)
    exemptions: Mapping[type[Component] | ComponentConfig, Mapping[str, str]] = field(
        default_factory=dict
    )

"""What a distribution offers to recipes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from qgs.contracts.component import Component, ComponentConfig
from qgs.contracts.weights import WeightLayout

CONTRACT_VERSION = 1
"""Raised when a contract changes so that components written for the old one no longer fit."""

ENTRY_POINT_GROUP = "qgs.plugins"
"""A distribution lists its `Plugin` object here, under the plugin's name."""


@dataclass(frozen=True)
class ExpectedError:
    """Why a check of `qgs.testing` of a component ends with an error, such as a missing kernel.

    error: the class of the error, or several; another error is a failure of the check.
    reason: why that is right.
    """

    error: type[Exception] | tuple[type[Exception], ...]
    reason: str


Expected: TypeAlias = str | ExpectedError
"""A failure that is known: why a component breaks the contract, or an error with the reason."""


@dataclass(frozen=True)
class Plugin:
    """Components under one name. Making or importing one has no side effect.

    name: the part of `type: NAME/component` before the slash.
    contract_version: the CONTRACT_VERSION that the components were written for.
    components: final component classes; their `name` is unique within their slot.
    layouts: published state dicts of models that these components make.
    examples: options that `qgs check-plugin` tries besides the defaults of every component.
    exemptions: checks of `qgs.testing` that a component is known to fail, each with the reason;
        by class, or by options where the component passes with others.
    """

    name: str
    contract_version: int
    components: Sequence[type[Component]]
    layouts: Sequence[WeightLayout] = ()
    examples: Sequence[ComponentConfig] = ()
    exemptions: Mapping[type[Component] | ComponentConfig, Mapping[str, Expected]] = field(
        default_factory=dict
    )

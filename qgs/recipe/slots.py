"""Slots of a recipe, which are kinds of component, and the default component of each slot."""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from qgs import contracts
from qgs.recipe.yaml_text import KeyPath, MapNode


@dataclass(frozen=True)
class Slot:
    """One kind of component that a recipe chooses, such as the encoder.

    default: `type` of the component if the recipe names none; None if the recipe must name one.
    The remaining fields matter only for slots that are top-level sections.
    defaults: types, by name, of the components in a recipe that lacks the section. If empty, the
        section is a single component.
    defaults_stay: True if a recipe's components are added to `defaults`, and `NAME: null` removes
        the default called NAME; False if a recipe's components replace `defaults`.
    """

    contract: type[contracts.Component]
    default: str | None = None
    defaults: Mapping[str, str] = field(default_factory=dict)
    defaults_stay: bool = False

    @property
    def name(self) -> str:
        """Name of the slot, equal to `Component.slot`."""
        return self.contract.slot


# In the order of computation: a message names components of earlier slots.
SLOTS = {
    slot.name: slot
    for slot in (
        Slot(contracts.Encoder, "qgs/multiview_vit"),
        Slot(contracts.Queries, "qgs/latent"),
        Slot(contracts.DecoderLayer, "qgs/cross_self_mlp"),
        Slot(contracts.CrossAttention, "qgs/content"),
        Slot(contracts.SelfAttention, "qgs/content"),
        Slot(contracts.FeedForward, "qgs/mlp"),
        Slot(contracts.Refinement, "qgs/none"),
        Slot(contracts.Feedback, "qgs/none"),
        Slot(contracts.Head, "qgs/gaussian_head"),
        Slot(contracts.Centers, "qgs/free"),
        Slot(contracts.Supervision, "qgs/layers"),
        Slot(contracts.Renderer, "qgs/auto"),
        Slot(
            contracts.Loss,
            defaults={"photometric": "qgs/photometric", "visibility": "qgs/visibility"},
        ),
        Slot(contracts.Objective, "qgs/one_pass"),
        Slot(
            contracts.Metric,
            defaults={"psnr": "qgs/psnr", "ssim": "qgs/ssim", "dispersion": "qgs/dispersion"},
            defaults_stay=True,
        ),
        Slot(contracts.Optimizer, "qgs/adamw"),
        Slot(contracts.SceneSource),
        Slot(contracts.ViewSampler, "qgs/span"),
    )
}
# In the order of parameter initialisation: another order changes the model of a seed.
AFTER_LAYERS = ("feedback", "head", "centers", "supervision", "renderer")
MODEL_SLOTS = ("encoder", "queries", *AFTER_LAYERS)
SECTIONS = {
    name: SLOTS[name]
    for name in ("losses", "objective", "data", "view_sampler", "metrics", "optimizer")
}
"""Slots that are top-level sections of a recipe."""


def slot_at(path: KeyPath) -> Slot | None:
    """Return the slot at `path` of a recipe; None if `path` is not that of a component."""
    # A section's slot is the first key, the slot of a part of the model the last.
    return next((SLOTS[key] for key in (*path[:1], *path[-1:]) if key in SLOTS), None)


def summary_of(described: object) -> str:
    """Return the first paragraph of a docstring, on one line."""
    return " ".join((inspect.getdoc(described) or "").split("\n\n")[0].split())


def type_at(node: Any, path: KeyPath) -> Any:
    """Return the `type` of the component at `path` of a recipe. node: the value at this path.

    If `node` is null, or its `type` is null or not set, the result is the default of the slot at
    `path`, or None if there is no such slot.
    """
    if isinstance(node, MapNode) and node.get("type") is not None:
        return node["type"]
    slot = slot_at(path)
    return slot.default if slot else None

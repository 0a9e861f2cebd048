"""The places of a recipe that hold components, and what stands there by default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from qgs.composer.nodes import KeyPath, MapNode, Node, ScalarNode, is_null
from qgs.contracts import (
    Centers,
    Component,
    CrossAttention,
    Encoder,
    FeedForward,
    Head,
    Loss,
    Metric,
    Optimizer,
    Queries,
    Refinement,
    Renderer,
    SceneSource,
    SelfAttention,
    Supervision,
)


@dataclass(frozen=True)
class Slot:
    """One kind of place. default: the `type` of a place that names none; None if it must."""

    contract: type[Component]
    default: str | None

    @property
    def name(self) -> str:
        """The slot's name, as components know it."""
        return self.contract.slot


SLOTS = {
    slot.name: slot
    for slot in (
        Slot(Encoder, "qgs/multiview_vit"),
        Slot(Queries, "qgs/latent"),
        Slot(CrossAttention, "qgs/content"),
        Slot(SelfAttention, "qgs/content"),
        Slot(FeedForward, "qgs/mlp"),
        Slot(Refinement, "qgs/none"),
        Slot(Head, "qgs/gaussian_head"),
        Slot(Centers, "qgs/free"),
        Slot(Supervision, "qgs/layers"),
        Slot(Renderer, "qgs/auto"),
        Slot(Loss, None),
        Slot(Metric, None),
        Slot(SceneSource, None),
        Slot(Optimizer, "qgs/adamw"),
    )
}

MODEL_SLOTS = ("encoder", "queries", "head", "centers", "supervision", "renderer")
LAYER_SLOTS = ("cross_attention", "self_attention", "feed_forward", "refinement")


@dataclass(frozen=True)
class Section:
    """A top-level section of components, called like its slot.

    named: whether it maps names to components; else it is one component, and there is always one
        if its slot has a default type.
    defaults: name to type of the components of a recipe that has no such section.
    defaults_stay: whether they also stand beside those that are written; `NAME: null` drops one.
    """

    named: bool = False
    defaults: Mapping[str, str] = field(default_factory=dict)
    defaults_stay: bool = False


DEFAULT_LOSSES = {"photometric": "qgs/photometric", "visibility": "qgs/visibility"}
DEFAULT_METRICS = {"psnr": "qgs/psnr", "ssim": "qgs/ssim", "dispersion": "qgs/dispersion"}

SECTIONS = {
    "losses": Section(named=True, defaults=DEFAULT_LOSSES),
    "data": Section(),
    "metrics": Section(named=True, defaults=DEFAULT_METRICS, defaults_stay=True),
    "optimizer": Section(),
}


def slot_at(path: KeyPath) -> Slot | None:
    """The slot at a place of a recipe; None where no component belongs."""
    match path:
        case ("model", name) if name in MODEL_SLOTS:
            return SLOTS[name]
        case ("model", "decoder", name) if name in LAYER_SLOTS:
            return SLOTS[name]
        case ("model", "decoder", "layers", _, name) if name in LAYER_SLOTS:
            return SLOTS[name]
        case (name,) if name in SECTIONS and not SECTIONS[name].named:
            return SLOTS[name]
        case (name, _) if name in SECTIONS and SECTIONS[name].named:
            return SLOTS[name]
    return None


def type_at(node: Node | None, path: KeyPath) -> Any:
    """The `type` of the component written as `node` at `path`: its own, or the slot's default.

    `type: null` leaves the default, as `null` does in place of a component.
    """
    if isinstance(node, MapNode) and not is_null(node.items.get("type")):
        written = node.items["type"]
        return written.value if isinstance(written, ScalarNode) else written
    slot = slot_at(path)
    return slot.default if slot else None

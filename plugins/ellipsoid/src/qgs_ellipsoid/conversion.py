"""LocusGS as a special case: its weights with an ellipsoid of three equal radii."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


def from_locus(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A LocusGS state dict as one of the same recipe with `ellipsoid` components.

    Radii become three equal ones and the rotation is the identity. A refinement that changes the
    radius changes all three by as much; for its rotation, which LocusGS lacks, the recipe says
    `rotation: false`, or the head's initial weights are kept by loading with `strict=False`.
    Raises ValueError for weights without anchors that have a radius.
    """
    if "queries.raw_radius" not in weights:
        raise ValueError(
            "there is no `queries.raw_radius`: the weights are of no LocusGS whose anchors have a "
            "radius; give the state dict of a model with `locus/anchored` and `radius: true`"
        )
    converted = {_renamed(name): _tripled(name, values) for name, values in weights.items()}
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0]).to(weights["queries.raw_radius"])
    converted["queries.rotation"] = identity.repeat(len(weights["queries.raw_radius"]), 1)
    return converted


def _renamed(name: str) -> str:
    name = name.replace("queries.raw_radius", "queries.raw_radii")
    name = name.replace("refinements.0.center_mlp.", "refinements.0.heads.center.")
    return name.replace("refinements.0.radius_mlp.", "refinements.0.heads.radii.")


def _tripled(name: str, values: Tensor) -> Tensor:
    if name == "queries.raw_radius":
        return values.repeat(1, 3)
    if name.startswith("refinements.0.radius_mlp.fc2."):
        return values.repeat(3, *(1 for _ in values.shape[1:]))
    return values.clone()

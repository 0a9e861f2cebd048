"""LocusGS as a special case: its weights with an ellipsoid of three equal radii."""

from collections.abc import Mapping

import torch
from torch import Tensor


def from_locus(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state dict of a LocusGS for the same recipe with ellipsoidal anchors and LocusGS's head.

    A radius becomes three equal ones, with equal steps in the refinement; rotations are the
    identity. A model with `rotation: false` computes what LocusGS does. The result has no weights
    of a refinement of rotations (load with `strict=False`). Raises ValueError for weights without
    radii.
    """
    if "queries.raw_radius" not in weights:
        raise ValueError(
            "there is no `queries.raw_radius`: the weights are of no LocusGS whose anchors have a "
            "radius; give the state dict of a model with `locus/anchored` and `radius: true`"
        )
    converted = {name: _tripled(name, values) for name, values in weights.items()}
    converted["queries.raw_radii"] = converted.pop("queries.raw_radius")
    # A ball has no orientation, so any rotation would do.
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0]).to(weights["queries.raw_radius"])
    converted["queries.rotation"] = identity.repeat(len(weights["queries.raw_radius"]), 1)
    return converted


def _tripled(name: str, values: Tensor) -> Tensor:
    if name == "queries.raw_radius":
        return values.repeat(1, 3)
    # Rows of the last layer are the radii: three equal ones step together.
    if name.startswith("refinements.0.radius_mlp.fc2."):
        return values.repeat(3, *(1 for _ in values.shape[1:]))
    return values.clone()

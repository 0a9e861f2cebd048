"""Baselines that a model must beat: a copied input view, and the mean colour."""

import torch
from torch import Tensor

from qgs.contracts import Column
from qgs.precision import full_precision
from qgs.types import Cameras, Views


def nearest_input(inputs: Views, targets: Cameras) -> Tensor:
    """Return the nearest input image for every target camera (B, T) -> (B, T, 3, H, W).

    The nearest one has the least `pose_distance`.
    """
    index = pose_distance(inputs.cameras.c2w, targets.c2w).argmin(-1)
    scene = torch.arange(index.shape[0], device=index.device)[:, None]
    return inputs.images[scene, index]


def mean_colour(inputs: Views, targets: Cameras) -> Tensor:
    """Fill images with the mean RGB of a scene's input views -> (B, T, 3, H, W)."""
    colour = inputs.images.mean((1, 3, 4))
    return colour[:, None, :, None, None].expand(-1, targets.shape[1], -1, *targets.size)


BASELINES = {"nearest_input": nearest_input, "mean_colour": mean_colour}
"""Baselines by their names in results; tables replace underscores by blanks."""


def worse_than_nearest(
    column: Column, model: float | None, nearest: float | None, remedy: str
) -> str:
    """Return a remark with `remedy` if `nearest_input` scores better than the model, else ""."""
    if not column.beats(nearest, model):
        return ""
    return (
        f"the result is worse than a copy of the nearest photo: {column.heading} "
        f"{column.shown(model)} against {column.shown(nearest)}; {remedy}"
    )


@full_precision
def pose_distance(inputs: Tensor, targets: Tensor) -> Tensor:
    """Return distances (B, T, V) between input poses (B, V, 4, 4) and targets (B, T, 4, 4).

    A distance is that of the camera centres, divided by the spread of the inputs, plus the angle
    between the axes in radians.
    """
    centres = inputs[..., :3, 3]
    seen_from = targets[..., :3, 3]
    # In units of the inputs' spread, so that a distance counts in any world.
    extent = torch.cdist(centres, centres).amax((-1, -2), keepdim=True)
    distance = torch.cdist(seen_from, centres) / torch.where(extent > 0, extent, 1.0)
    cosine = targets[..., :3, 2] @ inputs[..., :3, 2].mT
    # Metres and radians add up: both are about 1 for a view of another place.
    return distance + cosine.clamp(-1, 1).acos()

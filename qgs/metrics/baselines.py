"""Baselines that a model must beat: a copy of an input view, and the mean colour."""

import torch
from torch import Tensor

from qgs.contracts import Column
from qgs.precision import full_precision
from qgs.types import Cameras, Views


def nearest_input(inputs: Views, targets: Cameras) -> Tensor:
    """Return for each target the input image whose pose is nearest: (B, T, 3, H, W).

    targets: T cameras per scene, (B, T). `pose_distance` defines the distance.
    """
    index = pose_distance(inputs.cameras.c2w, targets.c2w).argmin(-1)
    scene = torch.arange(len(index), device=index.device)[:, None]
    return inputs.images[scene, index]


def mean_colour(inputs: Views, targets: Cameras) -> Tensor:
    """Return T images per scene (B, T, 3, H, W) with the mean RGB of the scene's input views."""
    colour = inputs.images.mean((1, 3, 4))
    return colour[:, None, :, None, None].expand(-1, targets.shape[1], -1, *targets.size)


BASELINES = {"nearest_input": nearest_input, "mean_colour": mean_colour}
"""Baselines by their names in results; tables show spaces for underscores."""


def worse_than_nearest(
    column: Column, model: float | None, nearest: float | None, remedy: str
) -> str:
    """Return a remark if the baseline `nearest_input` scores better than the model, else "".

    model, nearest: values of the metric of `column`, for the model and for the baseline. remedy:
        advice at the end of the remark.
    """
    if not column.beats(nearest, model):
        return ""
    return (
        f"the result is worse than a copy of the nearest photo: {column.heading} "
        f"{column.shown(model)}, copy {column.shown(nearest)}; {remedy}"
    )


@full_precision
def pose_distance(inputs: Tensor, targets: Tensor) -> Tensor:
    """Return distances (B, T, V) from T target poses to V input poses of each scene.

    A distance is the distance between camera centres, divided by the largest distance between input
    cameras, plus the angle between optical axes in radians. inputs: (B, V, 4, 4). targets: (B, T,
    4, 4).
    """
    centres = inputs[..., :3, 3]
    seen_from = targets[..., :3, 3]
    # In units of the inputs' spread, so that a distance counts in any world.
    extent = torch.cdist(centres, centres).amax((-1, -2), keepdim=True)
    distance = torch.cdist(seen_from, centres) / torch.where(extent > 0, extent, 1.0)
    cosine = targets[..., :3, 2] @ inputs[..., :3, 2].mT
    # Metres and radians add up: both are about 1 for a view of another place.
    return distance + cosine.clamp(-1, 1).acos()

"""Show a file of Gaussians as other viewers do, after a move into a world for the renderer."""

import torch
from torch import Tensor

from qgs.geometry.poses import scaled
from qgs.geometry.transforms import moved
from qgs.renderers import AutoRenderer
from qgs.types import Gaussians

VIEWER = AutoRenderer(AutoRenderer.Config(background=(0, 0, 0), far=1e4))
"""Renderer over black, however far Gaussians are, as in most viewers."""


def in_own_world(world: tuple[Tensor, Tensor], gaussians: Gaussians) -> Gaussians:
    """Move Gaussians (1, G) from the photos' world into `world`.

    world: reference pose (4, 4) and scale, see `own_world`. `in_world` does the same for cameras.
    """
    reference, scale = world
    pose = scaled(torch.linalg.inv(reference.double()), scale)
    return moved(gaussians, pose, float(scale))

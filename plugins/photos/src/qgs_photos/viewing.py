"""Render Gaussians as common viewers show them, and move them between world frames."""

import torch

from qgs.geometry.poses import scaled
from qgs.geometry.transforms import moved
from qgs.renderers import AutoRenderer
from qgs.types import Gaussians, World

VIEWER = AutoRenderer(AutoRenderer.Config(background=(0, 0, 0), far=1e4))
"""Renderer with a black background and a distant far plane, as in most viewers."""


def in_own_world(world: World, gaussians: Gaussians) -> Gaussians:
    """Move Gaussians (1, G) from the photos' world into `world`.

    world: reference pose (4, 4) and scale, see `own_world`. `in_world` does the same for cameras.
    """
    reference, scale = world
    pose = scaled(torch.linalg.inv(reference.double()), scale)
    return moved(gaussians, pose, float(scale))

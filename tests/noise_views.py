"""Pairs of photos of noise, by cameras that are turned and moved a little."""

import torch

from qgs.types import Cameras, Views


def noise_views(height, width, scenes=2, seed=0):
    """Two views of each scene."""
    generator = torch.Generator().manual_seed(seed)
    turns = 0.1 * torch.randn(scenes, 2, 3, 3, generator=generator)
    c2w = torch.eye(4).repeat(scenes, 2, 1, 1)
    c2w[..., :3, :3] = torch.linalg.matrix_exp(turns - turns.mT)
    c2w[..., :3, 3] = 0.2 * torch.randn(scenes, 2, 3, generator=generator)
    lens = torch.tensor([0.9 * width, width, width / 2 - 0.5, height / 2 + 0.5])
    images = torch.rand(scenes, 2, 3, height, width, generator=generator)
    return Views(images, Cameras(c2w, lens.expand(scenes, 2, 4), (height, width)))

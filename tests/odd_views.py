"""Views whose cameras confuse nothing with anything, and tiles of their pixels."""

import torch
from walk import pinhole

from qgs.types import Views


def odd_views(count=2, height=16, width=16, scenes=2, seed=0):
    """Noise; cameras are turned and moved a little, with unequal focal lengths, off centre."""
    generator = torch.Generator().manual_seed(seed)
    turns = 0.1 * torch.randn(scenes, count, 3, 3, generator=generator)
    c2w = torch.eye(4).repeat(scenes, count, 1, 1)
    c2w[..., :3, :3] = torch.linalg.matrix_exp(turns - turns.mT)
    c2w[..., :3, 3] = 0.2 * torch.randn(scenes, count, 3, generator=generator)
    lens = (0.9 * width, width, width / 2 - 0.5, height / 2 + 0.5)
    images = torch.rand(scenes, count, 3, height, width, generator=generator)
    return Views(images, pinhole(c2w, lens, (height, width)))


def in_tiles(maps_BVHWC, rows, columns, in_turn=False):
    """(B, N, K, C): tiles of so many rows and columns of all photos, in turn or one by one."""
    parts = maps_BVHWC.unflatten(3, (-1, columns)).unflatten(2, (-1, rows))
    found = parts.transpose(3, 4).flatten(4, 5).flatten(2, 3)
    return (found.transpose(1, 2) if in_turn else found).flatten(1, 2)

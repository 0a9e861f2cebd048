"""Views whose cameras confuse nothing with anything."""

from dataclasses import replace

import torch
from qgs_plugintools import Case
from qgs_plugintools.inputs import Maker, Sizes

from qgs.components import LatentQueries


def odd_views(count=2, height=16, width=16, scenes=2, seed=0):
    """Noise; cameras are turned and moved, with unequal focal lengths, off centre."""
    sizes = Sizes(batch=scenes, views=count, image=(height, width))
    made = Maker(Case(LatentQueries.Config()), sizes, torch.Generator().manual_seed(seed)).views()
    lens = made.cameras.intrinsics * torch.tensor([1.0, 1.1, 0.9, 1.05])
    return replace(made, cameras=replace(made.cameras, intrinsics=lens))

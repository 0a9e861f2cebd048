"""Inputs of the tests."""

from dataclasses import replace
from pathlib import Path

import torch
from qgs_globalsplat.losses import Frustum
from qgs_plugintools import Case
from qgs_plugintools.inputs import Maker, Sizes

from qgs.contracts import ModelDims
from qgs.types import Views

RECIPES = Path(__file__).parents[3] / "recipes"
TINY = RECIPES / "tiny/globalsplat.yaml"
SMALL = (
    *("model.width=32", "model.heads=2", "model.decoder.depth=1", "model.supervision.layers=[1]"),
    *("model.queries.count=40", "model.encoder.patch_size=4", "data.image_size=[16, 16]"),
)
DIMS = ModelDims(width=16, heads=2, depth=2)


def made(component, **options):
    return component(component.Config(**options), DIMS)


def views(count: int = 2) -> Views:
    """16 x 24 pixels of two scenes, with unequal focal lengths, off centre."""
    sizes = Sizes(views=count, image=(16, 24))
    made = Maker(Case(Frustum.Config()), sizes, torch.Generator()).views()
    lens = torch.tensor([20.0, 18.0, 7.0, 6.5]).expand(2, count, 4)
    return replace(made, cameras=replace(made.cameras, intrinsics=lens))

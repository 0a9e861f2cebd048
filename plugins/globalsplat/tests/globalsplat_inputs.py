"""The small recipe, and components of a small model."""

from pathlib import Path

from qgs.contracts import ModelDims

RECIPES = Path(__file__).parents[3] / "recipes"
TINY = RECIPES / "tiny/globalsplat.yaml"
SMALL = (
    *("model.width=32", "model.heads=2", "model.decoder.depth=1", "model.supervision.layers=[1]"),
    *("model.queries.count=40", "model.encoder.patch_size=4", "data.image_size=[16, 16]"),
)
DIMS = ModelDims(width=16, heads=2, depth=2)


def made(component, **options):
    return component(component.Config(**options), DIMS)

"""Components of a small model."""

from qgs.contracts import ModelDims

DIMS = ModelDims(width=16, heads=2, depth=2)


def made(component, dims=DIMS, **options):
    return component(component.Config(**options), dims)

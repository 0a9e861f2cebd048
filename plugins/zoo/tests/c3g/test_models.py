"""Whole models: recipes, sizes as published, and parts of LocusGS beside C3G's."""

import pytest
import torch
from odd_views import odd_views

from qgs.containers import named_tensors
from qgs.contracts.schedule import follow
from qgs.recipe import resolve

NARROW = ("model.width=16", "model.heads=2", "model.queries.count=6")
SHALLOW = ("model.decoder.depth=2", "model.supervision.layers=[2]")


def size(module):
    return sum(p.numel() for p in module.parameters())


def test_the_published_recipe():
    """Its sizes, a Gaussian for each query, and a dilation divided by 3 every 1000 steps."""
    recipe = resolve("c3g/re10k.yaml")
    assert recipe.training.judge_inputs
    model = recipe.build_model("meta")
    trained = 71_368_718  # beside the backbone, for which a ViT stands
    assert (size(model.encoder), size(model)) == (314_199_296, 314_199_296 + trained)
    assert (model.queries.count, model.head.gaussians_per_query) == (2048, 1)
    found = {}
    for step in (0, 999, 1000, 1001, 2500, 3000, 3999, 4000, 449_999):
        follow([model.renderer], step)
        found[step] = model.renderer.config.dilation
    assert found == pytest.approx({step: max(0.3, 10 / 3 ** (step // 1000)) for step in found})


def test_every_parameter_that_trains_is_read():
    """Processes that train together wait for a gradient of each of them."""
    for name, side in (("tiny/c3g", 16), ("c3g/re10k", 28)):
        recipe = resolve(f"{name}.yaml", [*NARROW, *SHALLOW])
        model = recipe.build_model().train()
        gaussians = model(odd_views(2, side, side)).gaussians
        torch.stack([x.sum() for _, x in named_tensors(gaussians)]).sum().backward()
        unread = {name for name, p in model.named_parameters() if p.grad is None}
        factors = recipe.rate_factors(model).items()
        assert unread == {name for name, factor in factors if factor == 0}, name
        assert len(unread) == 4, name

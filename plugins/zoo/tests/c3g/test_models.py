"""Recipes, sizes as published, the layer and the head by their formulas."""

import pytest
import torch
import torch.nn.functional as F
from odd_views import odd_views
from qgs_zoo.c3g.joint import C3GHead, JointLayer
from small_parts import DIMS, attended, made, shaken
from torch.testing import assert_close

from qgs import QueryState
from qgs.containers import named_tensors
from qgs.contracts import LayerParts
from qgs.model_text import parameter_counts
from qgs.recipe import resolve
from qgs.types import ImageMemory

SMALL = """
model.width=16 model.heads=2 model.queries.count=6
model.decoder.depth=2 model.supervision.layers=[2]
"""


def test_the_published_recipe():
    """Its sizes, a Gaussian for each query, and a dilation divided by 3 every 1000 steps."""
    recipe = resolve("c3g/re10k.yaml")
    assert recipe.training.judge_inputs
    model = recipe.build_model("meta")
    counts = parameter_counts(model)
    assert counts.pop("encoder") == 314_199_296  # the backbone, for which a ViT stands
    assert sum(counts.values()) == 71_368_718
    assert model.queries.count == 2048
    assert model.head.gaussians_per_query == 1
    dilation = model.renderer.schedules["dilation"].number
    for step in (0, 999, 1000, 1001, 2500, 3000, 3999, 4000, 449_999):
        assert dilation(step) == pytest.approx(max(0.3, 10 / 3 ** (step // 1000)))


def test_every_parameter_that_trains_is_read():
    """Processes that train together wait for a gradient of each of them."""
    for name, side in (("tiny/c3g", 16), ("c3g/re10k", 28)):
        recipe = resolve(f"{name}.yaml", SMALL.split())
        model = recipe.build_model().train()
        gaussians = model(odd_views(2, side, side)).gaussians
        torch.stack([x.sum() for _, x in named_tensors(gaussians)]).sum().backward()
        unread = {name for name, p in model.named_parameters() if p.grad is None}
        factors = recipe.rate_factors(model).items()
        assert unread == {name for name, factor in factors if factor == 0}, name
        assert len(unread) == 4, name


def test_a_layer_follows_its_formula():
    for ratio, eps, options in ((2, 1e-5, {}), (3, 0.1, {"mlp_ratio": 3.0, "norm_eps": 0.1})):
        layer = shaken(made(JointLayer, LayerParts(DIMS, {}, 1.0), **options))
        tokens = torch.randn(2, 11, 16).double()
        state, memory = layer(QueryState(tokens[:, 6:]), ImageMemory(tokens[:, :6]))
        result = tokens + layer.proj(attended(*layer.qkv(layer.norm(tokens)).split(16, -1)))
        result = result + layer.mlp(layer.mlp_norm(result))
        assert_close(torch.cat([memory.features, state.features], 1), result)
        assert layer.mlp.fc1.out_features == 16 * ratio
        assert layer.norm.eps == layer.mlp_norm.eps == eps
        assert all(layer.decays(name, p) for name, p in layer.named_parameters())


def test_the_head_follows_its_formula():
    head = made(C3GHead, gaussians_per_query=3, scale_unit=0.02).double()
    with torch.no_grad():
        head.linear.weight *= 5
        head.linear.bias[4] = 1e5  # scales have no cap
    state = QueryState(torch.randn(2, 5, 16).double())
    raw = head.linear(head.norm(state.features)).view(2, 5, 3, 14)
    offsets, opacity, scale, quats, sh = raw.split((3, 1, 3, 4, 3), -1)
    colors = 0.5 + 0.28209479177387814 * sh
    assert colors.min() < 0 < 1 < colors.max()
    out = head(state)
    found = (out.offsets, out.scales, out.quats, out.opacities, out.colors)
    scale = 0.02 * F.softplus(scale)
    quats = F.normalize(quats, dim=-1)
    assert_close(found, (offsets, scale, quats, opacity[..., 0].sigmoid(), colors.clamp(0, 1)))
    assert all(head.decays(name, p) for name, p in head.named_parameters())

"""The layer, the head and the centres, each by its formula."""

import math

import pytest
import torch
import torch.nn.functional as F
from qgs_c3g.head import C3GHead
from qgs_c3g.joint import JointLayer
from torch import Tensor

from qgs import QueryState
from qgs.contracts import LayerParts, ModelDims
from qgs.types import ImageMemory

DIMS = ModelDims(width=16, heads=2, depth=2)


def layer(scale: float = 1.0, **options: float) -> JointLayer:
    """In float64, with parameters far from their start."""
    made = JointLayer(JointLayer.Config(**options), LayerParts(DIMS, {}, scale)).double()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
    return made


def state(queries: int = 5, mask: Tensor | None = None) -> QueryState:
    features = torch.randn(2, queries, 16, dtype=torch.float64)
    return QueryState(features, {"some.field": torch.randn(2, queries, 3)}, mask)


def memory() -> ImageMemory:
    heads = torch.randn(2, 2, 6, 8, dtype=torch.float64)
    features = torch.randn(2, 6, 16, dtype=torch.float64)
    return ImageMemory(features, heads, -heads, torch.randn(2, 6, 6), (1, 2, 3))


def by_formula(made: JointLayer, tokens: Tensor) -> Tensor:
    """One token after the other, head by head, from the names of the weights."""
    p, result = dict(made.named_parameters()), tokens.clone()
    normed = F.layer_norm(tokens, (16,), p["norm.weight"], p["norm.bias"], made.config.norm_eps)
    q, k, v = (normed @ p["qkv.weight"].T).split(16, -1)
    for scene in range(len(tokens)):
        for token in range(tokens.shape[1]):
            read = []
            for head in (slice(0, 8), slice(8, 16)):
                logits = k[scene, :, head] @ q[scene, token, head] / math.sqrt(8)
                read.append(logits.softmax(0) @ v[scene, :, head])
            update = p["proj.weight"] @ torch.cat(read) + p["proj.bias"]
            result[scene, token] = tokens[scene, token] + update
    eps = made.config.norm_eps
    hidden = F.layer_norm(result, (16,), p["mlp_norm.weight"], p["mlp_norm.bias"], eps)
    hidden = F.gelu(hidden @ p["mlp.fc1.weight"].T + p["mlp.fc1.bias"])
    return result + hidden @ p["mlp.fc2.weight"].T + p["mlp.fc2.bias"]


@pytest.mark.parametrize("options", [{}, {"mlp_ratio": 3.0, "norm_eps": 0.1}])
def test_a_layer_follows_its_formula(options: dict[str, float]) -> None:
    made, start, seen = layer(**options), state(), memory()
    after, read = made(start, seen)
    expected = by_formula(made, torch.cat([seen.features, start.features], 1))
    torch.testing.assert_close(torch.cat([read.features, after.features], 1), expected)
    assert made.mlp.fc1.out_features == 16 * options.get("mlp_ratio", 2.0)


def test_the_head_follows_its_formula() -> None:
    config = C3GHead.Config(gaussians_per_query=3, scale_unit=0.02)
    head, start = C3GHead(config, DIMS).double(), state()
    with torch.no_grad():
        head.linear.weight *= 5
        head.norm.weight += torch.randn(16)
    normed = F.layer_norm(start.features, (16,), head.norm.weight, head.norm.bias)
    raw = head.linear(normed).view(2, 5, 3, 14)
    out = head(start)
    assert torch.equal(out.offsets, raw[..., :3])
    torch.testing.assert_close(out.opacities, 1 / (1 + torch.exp(-raw[..., 3])))
    torch.testing.assert_close(out.scales, 0.02 * torch.log1p(torch.exp(raw[..., 4:7])))
    length = raw[..., 7:11].square().sum(-1, keepdim=True).sqrt()
    torch.testing.assert_close(out.quats, raw[..., 7:11] / length)
    colors = (0.5 + 0.28209479177387814 * raw[..., 11:]).clamp(0, 1)
    torch.testing.assert_close(out.colors, colors)
    assert 0 in colors
    assert 1 in colors


def test_scales_have_no_cap() -> None:
    raw = torch.zeros(1, 1, 1, 14)
    raw[..., 4:7] = 1e5
    out = C3GHead(C3GHead.Config(), DIMS).activate(raw)
    torch.testing.assert_close(out.scales, torch.full((1, 1, 1, 3), 100.0))


def test_the_head_starts_as_published() -> None:
    head = C3GHead(C3GHead.Config(), DIMS)
    assert head.gaussians_per_query == 1
    assert head.linear.out_features == 14
    bound = 1 / math.sqrt(16)
    assert 0.5 * bound < head.linear.weight.abs().max() <= bound
    assert head.config.scale_unit == 1e-3


def test_weight_decay_is_on_all_parameters() -> None:
    for made in (layer(), C3GHead(C3GHead.Config(), DIMS)):
        assert all(made.decays(name, p) for name, p in made.named_parameters())

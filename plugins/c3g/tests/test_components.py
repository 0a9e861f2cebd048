"""The layer and the head, each by its formula."""

import math

import torch
from qgs_c3g.head import C3GHead
from qgs_c3g.joint import JointLayer
from small_parts import DIMS, attended, made
from torch.testing import assert_close

from qgs import QueryState
from qgs.contracts import LayerParts
from qgs.types import ImageMemory


def by_formula(made, tokens):
    """Attention of all tokens, then the MLP."""
    read = attended(*made.qkv(made.norm(tokens)).split(16, -1))
    result = tokens + made.proj(read)
    return result + made.mlp(made.mlp_norm(result))


def test_a_layer_follows_its_formula():
    for ratio, eps, options in ((2, 1e-5, {}), (3, 0.1, {"mlp_ratio": 3.0, "norm_eps": 0.1})):
        made = JointLayer(JointLayer.Config(**options), LayerParts(DIMS, {}, 1.0)).double()
        with torch.no_grad():
            for parameter in made.parameters():
                parameter += 0.3 * torch.randn_like(parameter)
        queries, tokens = torch.randn(2, 5, 16).double(), torch.randn(2, 6, 16).double()
        state, memory = made(QueryState(queries), ImageMemory(tokens))
        expected = by_formula(made, torch.cat([tokens, queries], 1))
        assert_close(torch.cat([memory.features, state.features], 1), expected)
        assert made.mlp.fc1.out_features == 16 * ratio
        assert made.norm.eps == made.mlp_norm.eps == eps
        assert all(made.decays(name, p) for name, p in made.named_parameters())


def test_the_head_follows_its_formula():
    head = made(C3GHead, gaussians_per_query=3, scale_unit=0.02).double()
    with torch.no_grad():
        head.linear.weight *= 5
        head.linear.bias[4] = 1e5  # scales have no cap
    state = QueryState(torch.randn(2, 5, 16).double())
    raw = head.linear(head.norm(state.features)).view(2, 5, 3, 14)
    offsets, opacity, scale, quats, sh = raw.split((3, 1, 3, 4, 3), -1)
    colors = 0.5 + 0.28209479177387814 * sh
    assert colors.min() < 0
    assert colors.max() > 1
    out = head(state)
    assert_close(out.offsets, offsets)
    assert_close(out.opacities, 1 / (1 + torch.exp(-opacity[..., 0])))
    assert_close(out.scales, 0.02 * scale.logaddexp(raw.new_zeros(())))
    assert_close(out.quats, quats / quats.square().sum(-1, keepdim=True).sqrt())
    assert_close(out.colors, colors.clamp(0, 1))


def test_the_head_starts_as_published():
    head = made(C3GHead)
    assert head.linear.weight.shape == (14, 16)
    assert 0.125 < head.linear.weight.abs().max() <= 1 / math.sqrt(16)
    assert head.config.scale_unit == 1e-3
    assert all(head.decays(name, p) for name, p in head.named_parameters())

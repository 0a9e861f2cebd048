"""The layer and the head, each by its formula."""

import torch
import torch.nn.functional as F
from qgs_zoo.c3g.joint import C3GHead, JointLayer
from small_parts import DIMS, attended, made, shaken
from torch.testing import assert_close

from qgs import QueryState
from qgs.contracts import LayerParts
from qgs.types import ImageMemory


def test_a_layer_follows_its_formula():
    for ratio, eps, options in ((2, 1e-5, {}), (3, 0.1, {"mlp_ratio": 3.0, "norm_eps": 0.1})):
        layer = shaken(made(JointLayer, LayerParts(DIMS, {}, 1.0), **options))
        tokens = torch.randn(2, 11, 16).double()
        state, memory = layer(QueryState(tokens[:, 6:]), ImageMemory(tokens[:, :6]))
        read = attended(*layer.qkv(layer.norm(tokens)).split(16, -1))
        result = tokens + layer.proj(read)
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

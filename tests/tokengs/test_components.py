"""The TokenGS components, each on its own."""

import math

import torch
from small_parts import made
from tables import assert_near
from torch.testing import assert_close

from qgs import QueryState
from qgs.contracts import ModelDims
from qgs.tokengs import CrossAttentionCore, GaussianHead, OffsetCenters, posact


def test_posact_its_slope_at_zero_and_its_limits():
    t = torch.tensor([-3.0, -1e-4, 0.0, 1e-4, 3.0], requires_grad=True)
    y = posact(t)
    assert_close(y, t.sign() * (t.abs().exp() - 1), rtol=1e-3, atol=1e-7)
    assert_close(torch.autograd.grad(y.sum(), t)[0], t.abs().exp())
    saturated = torch.tensor([-1e4, -95.0, 95.0, 1e4], requires_grad=True)
    y = posact(saturated, 100.0, 1000.0)
    assert y.tolist() == [-1000.0, -1000.0, 1000.0, 1000.0]
    assert torch.autograd.grad(y.sum(), saturated)[0].isfinite().all()


def test_head_starts_with_the_spread_and_at_the_depth_it_is_told():
    options = {"gaussians_per_query": 32, "init_std": 0.02, "position_std": 0.2}
    head = made(GaussianHead, ModelDims(256, 4, 1), z_init=math.log(1.1), **options)
    weight = head.linear.weight.detach().unflatten(0, (32, 14))
    assert_near(weight[:, :3].std(), 0.2, rtol=0.05)
    assert_near(weight[:, 3:].std(), 0.02, rtol=0.05)
    offsets = head(QueryState(torch.zeros(1, 1, 256))).offsets
    assert_close(posact(offsets), torch.tensor([0, 0, 0.1]).expand(1, 1, 32, 3))


def test_offset_centers_are_the_offsets_further_along_z_in_float32():
    offsets = torch.randn(2, 5, 1, 3).bfloat16()
    means = made(OffsetCenters, z_offset=-2.0)(offsets, QueryState(torch.zeros(2, 5, 16)))
    assert_close(means, offsets.float() + torch.tensor([0, 0, -2.0]))


def test_a_bias_is_for_all_heads_or_for_each():
    core = CrossAttentionCore(16, 2)
    features = torch.randn(2, 3, 16)
    bias = torch.randn(2, 2, 3, 5)
    keys, values = torch.randn(2, 2, 2, 5, 8).unbind()
    logits = core.project(features) @ keys.mT / 8**0.5
    for given, by_head in (
        (bias, bias),
        (bias[:, 0], bias[:, :1]),
        (bias[:1, :1, :1], bias[:1, :1, :1].expand(2, 1, 3, 5)),
    ):
        weights = (logits + by_head).softmax(-1)
        read = (weights @ values).transpose(1, 2).flatten(2)
        assert_close(core(features, keys, values, given), core.out_proj(read))

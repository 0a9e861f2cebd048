"""The TokenGS components, each on its own."""

import math

import pytest
import torch

from qgs import Cameras, QueryState, Views
from qgs.components import (
    CrossAttentionCore,
    FreeCenters,
    GaussianHead,
    LayerSupervision,
    MultiViewViT,
    OffsetCenters,
    posact,
)
from qgs.contracts import AttentionWeights, ModelDims, RecipeContext

DIMS = ModelDims(width=16, heads=2, depth=2)


def _views(batch: int = 1, views: int = 2, size: tuple[int, int] = (16, 24)) -> Views:
    height, width = size
    c2w = torch.eye(4).repeat(batch, views, 1, 1)
    c2w[..., 0, 3] = torch.arange(views) * 0.2
    intrinsics = torch.tensor([width, width, width / 2, height / 2]).float()
    cameras = Cameras(c2w, intrinsics.expand(batch, views, 4), size)
    return Views(torch.rand(batch, views, 3, *size), cameras)


def test_posact_and_its_slope_at_zero() -> None:
    t = torch.tensor([-3.0, -1e-4, 0.0, 1e-4, 3.0], requires_grad=True)
    y = posact(t)
    torch.testing.assert_close(y, t.sign() * (t.abs().exp() - 1), rtol=1e-3, atol=1e-7)
    y.sum().backward()
    torch.testing.assert_close(t.grad, t.abs().exp())


def test_posact_limits_keep_saturated_inputs_finite() -> None:
    t = torch.tensor([-1e4, -95.0, 95.0, 1e4], requires_grad=True)
    y = posact(t, 100.0, 1000.0)
    y.sum().backward()
    assert y.tolist() == [-1000.0, -1000.0, 1000.0, 1000.0]
    assert torch.isfinite(t.grad).all()


def test_memory_has_the_documented_shapes_and_rays_in_float32() -> None:
    encoder = MultiViewViT(MultiViewViT.Config(depth=1), DIMS)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        memory = encoder(_views(batch=2, views=3))
    assert memory.grid == (3, 2, 3)
    assert memory.keys.shape == memory.values.shape == (2, 2, 18, 8)
    assert memory.features.shape == (2, 18, 16)
    assert memory.patch_rays.shape == (2, 18, 6)
    assert memory.patch_rays.dtype == torch.float32
    assert memory.values.dtype == torch.bfloat16


def test_an_image_that_patches_do_not_divide() -> None:
    encoder = MultiViewViT(MultiViewViT.Config(), DIMS)
    with pytest.raises(ValueError, match="20 x 24 cannot be cut into patches of 8"):
        encoder(_views(size=(20, 24)))
    problems = MultiViewViT.problems(MultiViewViT.Config(), RecipeContext(DIMS, (20, 24)))
    assert [problem.option for problem in problems] == ["patch_size"]


def test_head_activations() -> None:
    config = GaussianHead.Config(gaussians_per_query=2)
    head = GaussianHead(config, DIMS)
    zero = head.activate(torch.zeros(1, 1, 2, 14))
    torch.testing.assert_close(zero.scales, torch.full((1, 1, 2, 3), 0.075 / math.e))
    torch.testing.assert_close(zero.opacities, torch.full((1, 1, 2), 1 / (1 + math.exp(2))))
    torch.testing.assert_close(zero.colors, torch.full((1, 1, 2, 3), 0.5))
    wild = head.activate(torch.randn(4, 3, 2, 14) * 1e4)
    assert wild.scales.max() <= 0.075
    torch.testing.assert_close(wild.quats.norm(dim=-1), torch.ones(4, 3, 2))


def test_head_starts_with_the_spread_it_is_told() -> None:
    dims = ModelDims(width=256, heads=4, depth=1)
    config = GaussianHead.Config(gaussians_per_query=32, init_std=0.02, position_std=0.2)
    weight = GaussianHead(config, dims).linear.weight.detach().unflatten(0, (32, 14))
    assert weight[:, :3].std() == pytest.approx(0.2, rel=0.05)
    assert weight[:, 3:].std() == pytest.approx(0.02, rel=0.05)


def test_head_starts_at_the_depth_it_is_told() -> None:
    head = GaussianHead(GaussianHead.Config(gaussians_per_query=4, z_init=math.log(1.1)), DIMS)
    offsets = head(QueryState(torch.zeros(1, 1, 16))).offsets
    torch.testing.assert_close(posact(offsets), torch.tensor([0, 0, 0.1]).expand(1, 1, 4, 3))


def test_free_centers_ignore_the_state() -> None:
    centers = FreeCenters(FreeCenters.Config(z_offset=1.0), DIMS)
    offsets = torch.randn(1, 2, 3, 3)
    means = centers(offsets, QueryState(torch.zeros(1, 2, 16)))
    torch.testing.assert_close(means, posact(offsets) + torch.tensor([0.0, 0.0, 1.0]))


def test_offset_centers_are_the_offsets_further_along_z_in_float32() -> None:
    offsets = torch.randn(2, 5, 1, 3, dtype=torch.bfloat16)
    state = QueryState(torch.zeros(2, 5, 16))
    for z in (1.0, 1.5, -2.0):
        means = OffsetCenters(OffsetCenters.Config(z_offset=z), DIMS)(offsets, state)
        assert means.dtype == torch.float32
        assert torch.equal(means, offsets.float() + torch.tensor([0.0, 0.0, z]))


@pytest.mark.parametrize(
    ("layers", "expected"),
    [
        ((12,), {12: 1.0}),
        ((6, 12), {6: 1 / 3, 12: 2 / 3}),
        ((1, 2, 4), {1: 1 / 6, 2: 2 / 6, 4: 0.5}),
    ],
)
def test_supervision_weights(layers: tuple[int, ...], expected: dict[int, float]) -> None:
    weights = LayerSupervision(LayerSupervision.Config(layers=layers)).weights()
    assert weights == pytest.approx(expected)


def test_a_bias_is_for_all_heads_or_for_each() -> None:
    core = CrossAttentionCore(16, 2)
    features, bias = torch.randn(2, 3, 16), torch.randn(2, 2, 3, 5)
    keys, values = torch.randn(2, 2, 2, 5, 8).unbind()
    alike = bias[:, :1].expand_as(bias)
    shared = core(features, keys, values, bias[:, 0])
    for same in (bias[:, :1], alike):
        torch.testing.assert_close(core(features, keys, values, same), shared)
    logits = core.project(features) @ keys.mT / 8**0.5 + bias
    read = (logits.softmax(-1) @ values).transpose(1, 2).flatten(2)
    torch.testing.assert_close(core(features, keys, values, bias), core.out_proj(read))
    queries = torch.tensor([2, 0])
    explained = core.explain(features, keys, queries, bias)
    torch.testing.assert_close(explained.geometry, bias[:, :, queries])
    torch.testing.assert_close(explained.weights, logits.softmax(-1)[:, :, queries])
    assert core.explain(features, keys, queries, bias[:, 0]).geometry.shape == (2, 1, 2, 5)
    assert core.explain(features, keys, queries, bias[:1, :1, :1]).geometry.shape == (2, 1, 2, 5)


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (((2, 3, 5), None, (2, 3, 5)), r"content must have shape \(B, h, Q, T\), got \(2, 3, 5\)"),
        (
            ((2, 4, 3, 5), (2, 3, 5), (2, 4, 3, 5)),
            r"\(2, 1, 3, 5\) or \(2, 4, 3, 5\), got \(2, 3, 5\)",
        ),
        (((2, 4, 3, 5), (1, 1, 3, 5), (2, 4, 3, 5)), r"geometry must .*got \(1, 1, 3, 5\)"),
        (((2, 4, 3, 5), None, (2, 4, 3, 6)), r"weights must .*\(2, 4, 3, 5\), got \(2, 4, 3, 6\)"),
    ],
)
def test_attention_of_other_shapes_is_refused(shapes, message) -> None:
    parts = [None if shape is None else torch.zeros(shape) for shape in shapes]
    with pytest.raises(ValueError, match=message):
        AttentionWeights(*parts)

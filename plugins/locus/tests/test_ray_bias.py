"""The bias and its kernels against the formula of the paper, and its invariances."""

import pytest
import torch
from qgs_locus.kernels.attention_bias import BLOCK
from qgs_locus.ray_bias import RayBias, dense_bias, normalised_rays, ray_tokens
from torch import Tensor


def _rays(count: int, dtype: torch.dtype = torch.float32) -> Tensor:
    origins = torch.randn(2, count, 3, dtype=dtype) * 0.5
    directions = torch.nn.functional.normalize(torch.randn(2, count, 3, dtype=dtype), dim=-1)
    # Patch means are shorter than unit vectors.
    return torch.cat([torch.linalg.cross(origins, directions), directions], -1) * 0.97


def weighted(center, sigma_sq, rays, bias_min, gamma) -> Tensor:
    return gamma * dense_bias(center, sigma_sq, rays, bias_min)


def test_the_formula_is_the_distance_of_a_point_to_a_line() -> None:
    """Against the least distance over points of the line, which is no formula of Plücker rays."""
    origins, directions = torch.randn(2, 1, 7, 3).double()
    directions = directions / directions.norm(dim=-1, keepdim=True)
    center, sigma = torch.randn(1, 5, 3).double(), 0.3
    steps = torch.linspace(-20, 20, 400_001).double()[:, None]
    rays = torch.cat([torch.linalg.cross(origins, directions), directions], -1)
    found = dense_bias(center, sigma**2, rays, -1e9)
    for n in range(5):
        for j in range(7):
            points = origins[0, j] + steps * directions[0, j]
            distance = (points - center[0, n]).norm(dim=-1).min()
            assert found[0, n, j] == pytest.approx(-0.5 * (distance / sigma).item() ** 2, rel=1e-3)


@pytest.mark.parametrize("bandwidth", ["radius", "fixed"])
def test_kernel_equals_the_formula(bandwidth: str) -> None:
    center, rays, gamma = torch.randn(2, 50, 3), _rays(200), torch.tensor(0.1)
    sigma_sq = 0.01 if bandwidth == "fixed" else torch.rand(2, 50, 1) * 0.05 + 1e-3
    fast = RayBias.of(center, sigma_sq, ray_tokens(rays), -20.0, gamma).dense()
    direct = weighted(center, sigma_sq, rays, -20.0, gamma)
    assert fast.shape == (2, 50, 200)
    torch.testing.assert_close(fast, direct, rtol=0, atol=1e-4 * float(gamma))
    assert direct.min() == -2.0, "some pairs must reach the clamp"
    assert direct.max() > -0.5, "some pairs must not"


@pytest.mark.parametrize("distance", [1.0, 10.0, 50.0])
def test_kernel_is_as_exact_as_the_formula_far_from_the_cameras(distance: float) -> None:
    depth = distance * torch.rand(2, 50, 1) + 0.1
    center = torch.cat([depth * (torch.rand(2, 50, 2) - 0.5), depth], -1)
    on_center = torch.nn.functional.normalize(center + 0.01 * torch.randn(2, 50, 3), dim=-1)
    origins = 0.1 * torch.randn(2, 50, 3)
    rays = torch.cat([torch.linalg.cross(origins, on_center), on_center], -1)
    one, smallest = torch.ones(()), 1e-3
    exact = weighted(center.double(), smallest, rays.double(), -20.0, one.double())
    direct = weighted(center, smallest, rays, -20.0, one)
    fast = RayBias.of(center, smallest, ray_tokens(rays), -20.0, one).dense()
    assert ((exact > -20) & (exact < -0.01)).any()
    assert (fast - exact).abs().max() <= 1.5 * (direct - exact).abs().max()


def test_blocks_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = torch.randn(2, 50, 3), torch.rand(2, 50, 1), ray_tokens(_rays(20)), -20.0
    whole = RayBias.of(*inputs, torch.tensor(0.1)).dense()
    monkeypatch.setitem(BLOCK, "cpu", 2 * 20 * 7)
    assert torch.equal(RayBias.of(*inputs, torch.tensor(0.1)).dense(), whole)


@pytest.mark.parametrize("tokens", [1, 17, 4100])
def test_kernels_differ_from_float64_by_rounding_alone(tokens: int) -> None:
    center, rays = torch.randn(2, 30, 3) + torch.tensor([0.0, 0.0, 1.5]), _rays(tokens)
    inputs = [center, 1e-3 + 0.3 * torch.rand(2, 30, 1), torch.tensor(0.4)]
    weight = torch.rand(2, 30, tokens)

    def found(dtype: torch.dtype) -> tuple[Tensor, ...]:
        center, sigma_sq, gamma = leaves = [x.to(dtype).requires_grad_() for x in inputs]
        bias = RayBias.of(center, sigma_sq, ray_tokens(rays.to(dtype)), -20.0, gamma).dense()
        return bias, *torch.autograd.grad(bias, leaves, weight.to(dtype))

    for seen, exact in zip(found(torch.float32), found(torch.float64), strict=True):
        assert (seen - exact).norm() <= 2e-6 * exact.norm()


def test_gradients_equal_those_of_the_formula() -> None:
    inputs = [
        torch.randn(2, 6, 3, dtype=torch.float64),
        torch.rand(2, 6, 1, dtype=torch.float64) + 0.05,
        _rays(9, torch.float64),
        torch.tensor(0.3, dtype=torch.float64),
    ]
    weight = torch.randn(2, 6, 9, dtype=torch.float64)

    def ours(center, sigma_sq, rays, bias_min, gamma) -> Tensor:
        return RayBias.of(center, sigma_sq, ray_tokens(rays), bias_min, gamma).dense()

    def gradients(function) -> tuple[Tensor, ...]:
        leaves = [x.clone().requires_grad_() for x in inputs]
        center, sigma_sq, rays, gamma = leaves
        (function(center, sigma_sq, rays, -2.0, gamma) * weight).sum().backward()
        return tuple(leaf.grad for leaf in leaves)

    for fast, direct in zip(gradients(ours), gradients(weighted), strict=True):
        torch.testing.assert_close(fast, direct)


def test_a_point_on_the_ray_has_no_penalty() -> None:
    rays = _rays(5, torch.float64)
    moments, directions = normalised_rays(rays)
    on_ray = torch.linalg.cross(directions, moments) + 1.7 * directions
    bias = RayBias.of(
        on_ray, 1e-3, ray_tokens(rays), -20.0, torch.ones((), dtype=torch.float64)
    ).dense()
    torch.testing.assert_close(bias.diagonal(dim1=1, dim2=2), torch.zeros(2, 5).double())


def test_autocast_leaves_the_bias_in_float32() -> None:
    center, rays = torch.randn(2, 8, 3), _rays(16)
    features = ray_tokens(rays)
    plain = RayBias.of(center, 0.01, features, -20.0, torch.tensor(0.1)).dense()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = RayBias.of(center, 0.01, ray_tokens(rays), -20.0, torch.tensor(0.1)).dense()
    assert mixed.dtype == torch.float32
    torch.testing.assert_close(mixed, plain, rtol=0, atol=0)

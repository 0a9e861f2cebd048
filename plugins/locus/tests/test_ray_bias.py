"""The factored bias against the formula of the paper, and its invariances."""

import pytest
import torch
from qgs_locus.ray_bias import BLOCK, ray_bias, ray_bias_direct, ray_features
from torch import Tensor

from qgs.geometry.rays import normalised_rays


def _rays(count: int, dtype: torch.dtype = torch.float32) -> Tensor:
    origins = torch.randn(2, count, 3, dtype=dtype) * 0.5
    directions = torch.nn.functional.normalize(torch.randn(2, count, 3, dtype=dtype), dim=-1)
    # Patch means are shorter than unit vectors.
    return torch.cat([torch.linalg.cross(origins, directions), directions], -1) * 0.97


@pytest.mark.parametrize("bandwidth", ["radius", "fixed"])
def test_factored_equals_direct(bandwidth: str) -> None:
    center, rays, gamma = torch.randn(2, 50, 3), _rays(200), torch.tensor(0.1)
    sigma_sq = 0.01 if bandwidth == "fixed" else torch.rand(2, 50, 1) * 0.05 + 1e-3
    fast = ray_bias(center, sigma_sq, ray_features(rays), -20.0, gamma)
    direct = ray_bias_direct(center, sigma_sq, rays, -20.0, gamma)
    assert fast.shape == (2, 50, 200)
    torch.testing.assert_close(fast, direct, rtol=0, atol=1e-4 * float(gamma))
    assert direct.min() == -2.0, "some pairs must reach the clamp"
    assert direct.max() > -0.5, "some pairs must not"


@pytest.mark.parametrize("distance", [1.0, 10.0, 50.0])
def test_factored_is_as_exact_as_direct_far_from_the_cameras(distance: float) -> None:
    depth = distance * torch.rand(2, 50, 1) + 0.1
    center = torch.cat([depth * (torch.rand(2, 50, 2) - 0.5), depth], -1)
    on_center = torch.nn.functional.normalize(center + 0.01 * torch.randn(2, 50, 3), dim=-1)
    origins = 0.1 * torch.randn(2, 50, 3)
    rays = torch.cat([torch.linalg.cross(origins, on_center), on_center], -1)
    one, smallest = torch.ones(()), 1e-3
    exact = ray_bias_direct(center.double(), smallest, rays.double(), -20.0, one.double())
    direct = ray_bias_direct(center, smallest, rays, -20.0, one)
    fast = ray_bias(center, smallest, ray_features(rays), -20.0, one)
    assert ((exact > -20) & (exact < -0.01)).any()
    assert (fast - exact).abs().max() <= 1.5 * (direct - exact).abs().max()


def test_blocks_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = torch.randn(2, 50, 3), torch.rand(2, 50, 1), ray_features(_rays(20)), -20.0
    whole = ray_bias(*inputs, torch.tensor(0.1))
    monkeypatch.setitem(BLOCK, "cpu", 2 * 20 * 7)
    assert torch.equal(ray_bias(*inputs, torch.tensor(0.1)), whole)


def test_gradients_of_factored_equal_those_of_direct() -> None:
    inputs = [
        torch.randn(2, 6, 3, dtype=torch.float64),
        torch.rand(2, 6, 1, dtype=torch.float64) + 0.05,
        _rays(9, torch.float64),
        torch.tensor(0.3, dtype=torch.float64),
    ]
    weight = torch.randn(2, 6, 9, dtype=torch.float64)

    def factored(center, sigma_sq, rays, bias_min, gamma) -> Tensor:
        return ray_bias(center, sigma_sq, ray_features(rays), bias_min, gamma)

    def gradients(function) -> tuple[Tensor, ...]:
        leaves = [x.clone().requires_grad_() for x in inputs]
        center, sigma_sq, rays, gamma = leaves
        (function(center, sigma_sq, rays, -2.0, gamma) * weight).sum().backward()
        return tuple(leaf.grad for leaf in leaves)

    for fast, direct in zip(gradients(factored), gradients(ray_bias_direct), strict=True):
        torch.testing.assert_close(fast, direct)


def test_a_point_on_the_ray_has_no_penalty() -> None:
    rays = _rays(5, torch.float64)
    moments, directions = normalised_rays(rays)
    on_ray = torch.linalg.cross(directions, moments) + 1.7 * directions
    bias = ray_bias(on_ray, 1e-3, ray_features(rays), -20.0, torch.ones((), dtype=torch.float64))
    torch.testing.assert_close(bias.diagonal(dim1=1, dim2=2), torch.zeros(2, 5).double())


def test_autocast_leaves_the_bias_in_float32() -> None:
    center, rays = torch.randn(2, 8, 3), _rays(16)
    features = ray_features(rays)
    plain = ray_bias(center, 0.01, features, -20.0, torch.tensor(0.1))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = ray_bias(center, 0.01, ray_features(rays), -20.0, torch.tensor(0.1))
    assert mixed.dtype == torch.float32
    torch.testing.assert_close(mixed, plain, rtol=0, atol=0)

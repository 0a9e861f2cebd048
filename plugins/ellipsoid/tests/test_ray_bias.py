"""The bias and its kernels in float64, and against a search along the ray."""

from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from qgs_ellipsoid.fields import anchor_rotation
from qgs_ellipsoid.ray_bias import (
    EllipsoidBias,
    ray_tokens,
)
from qgs_locus.kernels.attention_bias import BLOCK
from qgs_locus.ray_bias import RayBias
from qgs_locus.ray_bias import ray_tokens as isotropic_tokens
from torch import Tensor

ONE = torch.ones((), dtype=torch.float64)


def ellipsoid_bias_direct(
    center: Tensor,
    rotation: Tensor,
    sigma_sq: Tensor,
    rays: Tensor,
    bias_min: float,
    gamma: Tensor,
) -> Tensor:
    """The formula in coordinates where the ellipsoid is a unit ball: y = diag(1 / sigma) R' x."""
    moments, directions = (rays / rays[..., 3:].norm(dim=-1, keepdim=True)).split(3, -1)
    point = torch.linalg.cross(directions, moments)  # of the ray, nearest to the origin
    to_ball = (rotation / sigma_sq.sqrt()[..., None, :]).mT[:, :, None]
    from_center = (point[:, None] - center[:, :, None])[..., None]
    start, along = (
        (to_ball @ from_center)[..., 0],
        (to_ball @ directions[:, None, :, :, None])[..., 0],
    )
    squared = torch.linalg.cross(start, along).square().sum(-1) / along.square().sum(-1)
    return gamma * (-0.5 * squared).clamp(bias_min, 0)


def _lines(count: int) -> tuple[Tensor, Tensor]:
    """Origins and directions (2, count, 3), float64."""
    origins = 0.5 * torch.randn(2, count, 3, dtype=torch.float64)
    return origins, F.normalize(torch.randn(2, count, 3, dtype=torch.float64), dim=-1)


def _plucker(origins: Tensor, directions: Tensor) -> Tensor:
    """Patch means are shorter than unit vectors."""
    return torch.cat([torch.linalg.cross(origins, directions), directions], -1) * 0.97


def _anchors(count: int, thinnest: float = 1e-3) -> tuple[Tensor, Tensor, Tensor]:
    """Centres, rotations and squared bandwidths, float64."""
    center = torch.randn(2, count, 3, dtype=torch.float64)
    rotation = anchor_rotation(torch.randn(2, count, 4, dtype=torch.float64))
    return center, rotation, thinnest + 0.05 * torch.rand(2, count, 3, dtype=torch.float64)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_kernel_equals_the_formula(dtype: torch.dtype) -> None:
    exact, rays = _anchors(50), _plucker(*_lines(200))
    direct = ellipsoid_bias_direct(*exact, rays, -20.0, 0.1 * ONE)
    anchors = [x.to(dtype) for x in exact]
    fast = EllipsoidBias.of(
        *anchors, ray_tokens(rays.to(dtype)), -20.0, (0.1 * ONE).to(dtype)
    ).dense()
    assert fast.shape == (2, 50, 200)
    assert fast.dtype == dtype
    tolerance = 1e-12 if dtype == torch.float64 else 1e-4
    torch.testing.assert_close(fast.double(), direct, rtol=0, atol=tolerance)
    assert direct.min() == -2.0, "some pairs must reach the clamp"
    assert direct.max() > -0.5, "some pairs must not"


def test_the_formula_is_the_least_distance_along_the_ray() -> None:
    center, rotation, sigma_sq = _anchors(6)
    origins, directions = _lines(5)
    metric = rotation @ torch.diag_embed(1 / sigma_sq) @ rotation.mT
    along = torch.linspace(-30, 30, 200_001, dtype=torch.float64)
    bias = ellipsoid_bias_direct(
        center, rotation, sigma_sq, _plucker(origins, directions), -1e9, ONE
    )
    for anchor in range(6):
        for ray in range(5):
            points = origins[0, ray] + along[:, None] * directions[0, ray] - center[0, anchor]
            least = torch.einsum("ti,ij,tj->t", points, metric[0, anchor], points).min()
            torch.testing.assert_close(bias[0, anchor, ray], -least / 2, rtol=1e-4, atol=1e-3)


def test_equal_bandwidths_give_the_bias_of_locusgs_however_the_anchor_is_turned() -> None:
    (center, rotation, sigma_sq), rays = _anchors(50), _plucker(*_lines(200))
    same = sigma_sq[..., :1]
    ours = EllipsoidBias.of(
        center, rotation, same.expand(-1, -1, 3), ray_tokens(rays), -20.0, 0.1 * ONE
    ).dense()
    theirs = RayBias.of(center, same, isotropic_tokens(rays), -20.0, 0.1 * ONE).dense()
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-12)


@pytest.mark.parametrize("distance", [1.0, 10.0, 50.0])
def test_kernel_is_as_exact_as_the_formula_far_from_the_cameras(distance: float) -> None:
    depth = distance * torch.rand(2, 50, 1) + 0.1
    center = torch.cat([depth * (torch.rand(2, 50, 2) - 0.5), depth], -1)
    directions = F.normalize(center + 0.01 * torch.randn(2, 50, 3), dim=-1)
    origins = 0.1 * torch.randn(2, 50, 3)
    rays = torch.cat([torch.linalg.cross(origins, directions), directions], -1)
    rotation = anchor_rotation(torch.randn(2, 50, 4))
    sigma_sq = 1e-3 * torch.tensor([1.0, 10.0, 100.0]).expand(2, 50, 3)
    exactly = [x.double() for x in (center, rotation, sigma_sq)]
    exact = ellipsoid_bias_direct(*exactly, rays.double(), -20.0, ONE)
    direct = ellipsoid_bias_direct(center, rotation, sigma_sq, rays, -20.0, ONE.float())
    fast = EllipsoidBias.of(
        center, rotation, sigma_sq, ray_tokens(rays), -20.0, ONE.float()
    ).dense()
    assert ((exact > -20) & (exact < -0.01)).any()
    assert (fast - exact).abs().max() <= 1.5 * (direct - exact).abs().max()


def test_a_needle_is_measured_exactly() -> None:
    center, rotation, _ = _anchors(20)
    sigma_sq = torch.tensor([1e-3, 1e-3, 1e3], dtype=torch.float64).expand(2, 20, 3)
    rays = _plucker(*_lines(30))
    fast = EllipsoidBias.of(center, rotation, sigma_sq, ray_tokens(rays), -1e9, ONE).dense()
    direct = ellipsoid_bias_direct(center, rotation, sigma_sq, rays, -1e9, ONE)
    torch.testing.assert_close(fast, direct, rtol=1e-6, atol=1e-6)


def test_gradients_equal_those_of_the_formula() -> None:
    center, _, sigma_sq = _anchors(6, thinnest=0.05)
    quats = torch.randn(2, 6, 4, dtype=torch.float64)
    inputs = [center, quats, sigma_sq, *_lines(9), 0.3 * ONE]
    weight = torch.randn(2, 6, 9, dtype=torch.float64)

    def ours(center, rotation, sigma_sq, rays, bias_min, gamma) -> Tensor:
        return EllipsoidBias.of(
            center, rotation, sigma_sq, ray_tokens(rays), bias_min, gamma
        ).dense()

    def gradients(function: Callable[..., Tensor]) -> tuple[Tensor, ...]:
        leaves = [x.clone().requires_grad_() for x in inputs]
        center, quats, sigma_sq, origins, directions, gamma = leaves
        rotation, rays = anchor_rotation(quats), _plucker(origins, directions)
        bias = function(center, rotation, sigma_sq, rays, -4.0, gamma)
        assert (bias > -4.0 * gamma).any()
        assert (bias <= -4.0 * gamma).any()
        return torch.autograd.grad((bias * weight).sum(), leaves)

    for fast, direct in zip(gradients(ours), gradients(ellipsoid_bias_direct), strict=True):
        torch.testing.assert_close(fast, direct)


@pytest.mark.parametrize(("depth", "longest"), [(3.0, 1e-2), (30.0, 1.0)])
def test_gradients_keep_their_digits_in_float32(depth: float, longest: float) -> None:
    center = torch.randn(2, 30, 3) + torch.tensor([0.0, 0.0, depth])
    quats = torch.randn(2, 30, 4)
    sigma_sq = torch.tensor([1e-3, 1e-3, longest]).repeat(2, 30, 1)
    origins = 0.1 * torch.randn(2, 30, 3)
    directions = F.normalize(center - origins + 0.03 * torch.randn(2, 30, 3), dim=-1)
    rays = torch.cat([torch.linalg.cross(origins, directions), directions], -1)
    weight = torch.randn(2, 30, 30)

    def gradients(fast: bool, dtype: torch.dtype) -> tuple[Tensor, ...]:
        leaves = [x.to(dtype).requires_grad_() for x in (center, quats, sigma_sq)]
        rotation, gamma = anchor_rotation(leaves[1]), ONE.to(dtype)
        place = (leaves[0], rotation, leaves[2])
        if fast:
            bias = EllipsoidBias.of(*place, ray_tokens(rays.to(dtype)), -1e9, gamma).dense()
        else:
            bias = ellipsoid_bias_direct(*place, rays.to(dtype), -1e9, gamma)
        return torch.autograd.grad((bias * weight.to(dtype)).sum(), leaves)

    exact = gradients(fast=False, dtype=torch.float64)
    seen, direct = (gradients(fast, torch.float32) for fast in (True, False))
    for best, ours, theirs in zip(exact, seen, direct, strict=True):
        error, usual = ((x - best).norm() / best.norm() for x in (ours, theirs))
        assert error <= max(3 * usual, 1e-6)


def test_blocks_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    anchors, rays = _anchors(50), ray_tokens(_plucker(*_lines(20)))

    def with_gradients() -> tuple[Tensor, ...]:
        leaves = [x.clone().requires_grad_() for x in (*anchors, rays)]
        bias = EllipsoidBias.of(*leaves, -20.0, ONE).dense()
        return bias, *torch.autograd.grad(bias.square().sum(), leaves)

    whole = with_gradients()
    monkeypatch.setitem(BLOCK, "cpu", 2 * 20 * 7)
    for seen, expected in zip(with_gradients(), whole, strict=True):
        torch.testing.assert_close(seen, expected)


def test_a_ray_without_direction_stays_finite() -> None:
    center, rotation, sigma_sq = _anchors(4)
    rays = torch.zeros(2, 3, 6, dtype=torch.float64)
    leaves = [x.requires_grad_() for x in (center, rotation, sigma_sq)]
    bias = EllipsoidBias.of(*leaves, ray_tokens(rays), -20.0, ONE).dense()
    assert bias.isfinite().all()
    assert all(g.isfinite().all() for g in torch.autograd.grad(bias.sum(), leaves))


def test_autocast_leaves_the_bias_in_float32() -> None:
    center, rotation, sigma_sq = (x.float() for x in _anchors(8))
    rays = _plucker(*_lines(16)).float()
    plain = EllipsoidBias.of(
        center, rotation, sigma_sq, ray_tokens(rays), -20.0, ONE.float()
    ).dense()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = EllipsoidBias.of(
            center, rotation, sigma_sq, ray_tokens(rays), -20.0, ONE.float()
        ).dense()
    assert mixed.dtype == torch.float32
    assert torch.equal(mixed, plain)

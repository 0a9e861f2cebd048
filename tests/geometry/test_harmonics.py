"""Spherical harmonics against SciPy's Legendre functions, and as a camera sees them."""

import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from scipy.special import lpmv
from torch import Tensor

from qgs.geometry.harmonics import harmonics, rotated, seen_colors
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import SH_COUNTS, Cameras, Gaussians

TURN = quat_to_matrix(F.normalize(torch.tensor([0.3, -0.5, 0.8, 0.2], dtype=torch.float64), dim=0))


def directions(count: int = 50) -> Tensor:
    drawn = torch.randn(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return F.normalize(drawn, dim=-1)


def coefficients(*shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    return torch.randn(*shape, 3, generator=generator, dtype=torch.float64)


def legendre(degree: int, order: int, d: Tensor) -> Tensor:
    """The real harmonic from its definition; SciPy's functions have the Condon-Shortley phase."""
    m = abs(order)
    x, y, z = d.unbind(-1)
    angle = m * torch.atan2(y, x)
    factor = (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - m)
    factor = math.sqrt(factor / math.factorial(degree + m)) * (math.sqrt(2) if m else 1)
    return factor * torch.from_numpy(lpmv(m, degree, z.numpy())) * (
        angle.sin() if order < 0 else angle.cos()
    )  # fmt: skip


def test_they_are_the_real_harmonics_by_degree_and_order() -> None:
    d = directions()
    expected = [legendre(n, m, d) for n in (1, 2, 3) for m in range(-n, n + 1)]
    torch.testing.assert_close(harmonics(d, 15), torch.stack(expected, -1))


def test_fewer_degrees_are_the_first_functions() -> None:
    for count in SH_COUNTS:
        assert torch.equal(harmonics(directions(), count), harmonics(directions(), 15)[:, :count])


def test_signs_are_those_of_3dgs() -> None:
    """Of y, z, x in degree 1; along z only functions of order 0 are left."""
    axes = harmonics(torch.eye(3), 3)
    expected = 0.4886025 * torch.tensor([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
    torch.testing.assert_close(axes, expected)
    along_z = harmonics(torch.tensor([0.0, 0.0, 1.0]), 15)
    assert along_z.nonzero()[:, 0].tolist() == [1, 5, 11]
    torch.testing.assert_close(along_z[[5, 11]], torch.tensor([0.6307831, 0.7463527]))


@pytest.mark.parametrize("count", SH_COUNTS)
def test_turned_coefficients_give_the_values_of_before(count: int) -> None:
    d, sh = directions(), coefficients(4, count)
    before = torch.einsum("pc,gcx->pgx", harmonics(d, count), sh)
    after = torch.einsum("pc,gcx->pgx", harmonics(d @ TURN.T, count), rotated(sh, TURN))
    torch.testing.assert_close(after, before)
    torch.testing.assert_close(rotated(rotated(sh, TURN), TURN.T), sh)
    torch.testing.assert_close(rotated(sh, torch.eye(3)), sh)


def test_degrees_do_not_mix_when_turned() -> None:
    sh = coefficients(1, 15)
    sh[:, 3:8] = 0
    torch.testing.assert_close(rotated(sh, TURN)[:, 3:8], torch.zeros_like(sh[:, 3:8]))


def scene() -> tuple[Gaussians, Cameras]:
    """Gaussians (2, 5) in cameras (2, 3), float64."""
    means = coefficients(2, 5)
    quats = F.normalize(torch.ones(2, 5, 4).double(), dim=-1)
    c2w = torch.eye(4).double().repeat(2, 3, 1, 1)
    c2w[..., :3, :3], c2w[..., :3, 3] = TURN, 2 * coefficients(2, 3) + 5
    cameras = Cameras(c2w, torch.ones(2, 3, 4).double(), (8, 8))
    colors = means.sigmoid()
    return Gaussians(
        means, means.abs(), quats, colors[..., 0], colors, coefficients(2, 5, 8)
    ), cameras


def test_a_view_sees_the_direction_from_its_camera_to_the_mean() -> None:
    gaussians, cameras = scene()
    found = seen_colors(gaussians, cameras)
    assert found.shape == (2, 3, 5, 3)
    step = gaussians.means[1, 4] - cameras.c2w[1, 2, :3, 3]
    values = harmonics(step / step.norm(), 8)
    expected = gaussians.colors[1, 4] + (values[:, None] * gaussians.sh[1, 4]).sum(0)
    torch.testing.assert_close(found[1, 2, 4], expected.clamp_min(0))
    assert found.min() == 0
    assert found.max() > 1


def test_colours_pass_gradcheck() -> None:
    gaussians, cameras = scene()

    def colours(means: Tensor, colors: Tensor, sh: Tensor, c2w: Tensor) -> Tensor:
        some = Gaussians(means, gaussians.scales, gaussians.quats, gaussians.opacities, colors, sh)
        return seen_colors(some, Cameras(c2w, cameras.intrinsics, cameras.size))

    leaves = (gaussians.means, gaussians.colors + 3, gaussians.sh, cameras.c2w)
    assert torch.autograd.gradcheck(colours, [leaf.clone().requires_grad_() for leaf in leaves])


def test_half_precision_is_raised_and_autocast_left() -> None:
    gaussians, cameras = (part.to(torch.float32) for part in scene())
    with torch.autocast("cpu", torch.bfloat16):
        inside = seen_colors(gaussians, cameras)
        assert seen_colors(gaussians.to(torch.bfloat16), cameras).dtype == torch.float32
        assert rotated(gaussians.sh, TURN).dtype == torch.float32
    torch.testing.assert_close(inside, seen_colors(*scene()).float(), rtol=1e-5, atol=1e-5)


def test_gaussians_without_harmonics_are_refused() -> None:
    gaussians, cameras = scene()
    with pytest.raises(ValueError, match="no spherical harmonics"):
        seen_colors(replace(gaussians, sh=None), cameras)

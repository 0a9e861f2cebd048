"""Spherical harmonics against SciPy's, and as a camera sees them."""

import numpy as np
import torch
import torch.nn.functional as F
from renderers.scenes import make_scene
from scipy.special import sph_harm_y
from torch.testing import assert_close

from qgs.geometry.harmonics import harmonics, rotated, seen_colors
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import SH_COUNTS

TURN = quat_to_matrix(F.normalize(torch.tensor([0.3, -0.5, 0.8, 0.2]).double(), dim=0))


def directions():
    return F.normalize(torch.randn(50, 3).double(), dim=-1)


def real_harmonic(degree, order, d):
    """From the complex one, which has the Condon-Shortley phase."""
    x, y, z = d.numpy().T
    found = sph_harm_y(degree, abs(order), np.arccos(z), np.arctan2(y, x))
    part = found.imag if order < 0 else found.real
    return torch.from_numpy(part * (2**0.5 if order else 1))


def test_they_are_the_real_harmonics_by_degree_and_order():
    d = directions()
    expected = [real_harmonic(n, m, d) for n in (1, 2, 3) for m in range(-n, n + 1)]
    for count in SH_COUNTS:
        assert_close(harmonics(d, count), torch.stack(expected[:count], -1))


def test_turned_coefficients_give_the_values_of_before_degree_by_degree():
    d = directions()
    mixed = torch.randn(4, 15, 3).double()
    mixed[0, 3:8] = 0
    for count in SH_COUNTS:
        sh = mixed[:, :count]
        turned = rotated(sh, TURN)
        before = torch.einsum("pc,gcx->pgx", harmonics(d, count), sh)
        after = torch.einsum("pc,gcx->pgx", harmonics(d @ TURN.T, count), turned)
        assert_close(after, before)
        assert_close(turned[0, 3:8], sh[0, 3:8])
        assert_close(rotated(sh, torch.eye(3)), sh)


def test_a_view_sees_the_direction_from_its_camera_to_the_mean():
    gaussians, cameras = make_scene(2, 3, 5, harmonics=8, dtype=torch.float64)
    gaussians = gaussians.replace(sh=10 * gaussians.sh)
    found = seen_colors(gaussians, cameras)
    assert found.shape == (2, 3, 5, 3)
    step = gaussians.means[1, 4] - cameras.c2w[1, 2, :3, 3]
    values = harmonics(step / step.norm(), 8)
    expected = gaussians.colors[1, 4] + (values[:, None] * gaussians.sh[1, 4]).sum(0)
    assert_close(found[1, 2, 4], expected.clamp_min(0))
    assert found.min() == 0
    assert found.max() > 1
    bare = gaussians.replace(sh=None)
    assert torch.equal(seen_colors(bare, cameras), bare.colors[:, None])

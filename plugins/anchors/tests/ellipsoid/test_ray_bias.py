"""The biases of LocusGS and of ellipsoids, and their kernels, against float64.

Anchors have one radius, as LocusGS's, or three.
"""

import pytest
import torch
import torch.nn.functional as F
from qgs_anchors.ellipsoid.components import anchor_rotation
from qgs_anchors.ellipsoid.ray_bias import EllipsoidBias, ray_tokens
from qgs_locus import ray_bias as locus
from tables import assert_equal
from torch.testing import assert_close

both = pytest.mark.parametrize("radii", [1, 3])
# Inputs: centres and squared bandwidths of anchors, gamma, quaternions, origins and directions.


def drawn(anchors, rays, radii=3, thinnest=1e-3):
    sigma_sq = thinnest + 0.05 * torch.rand(2, anchors, radii)
    lines = 0.5 * torch.randn(2, rays, 3), F.normalize(torch.randn(2, rays, 3), dim=-1)
    gamma = torch.tensor(0.1)
    return torch.randn(2, anchors, 3), sigma_sq, gamma, torch.randn(2, anchors, 4), *lines


def double(inputs):
    return tuple(x.double() for x in inputs)


def on_the_ray(inputs, bias_min=-20.0):
    """By p' A p - (p' A d)^2 / d' A d, where p leads from the anchor to a point of the ray."""
    center, sigma_sq, gamma, quats, origins, directions = inputs
    rotation = anchor_rotation(quats)
    metric = rotation @ torch.diag_embed(1 / sigma_sq.expand(-1, -1, 3)) @ rotation.mT
    p = origins[:, None] - center[:, :, None]
    d = directions[:, None].expand_as(p)
    pp, pd, dd = (((a @ metric) * b).sum(-1) for a, b in ((p, p), (p, d), (d, d)))
    return gamma * (-0.5 * (pp - pd**2 / dd)).clamp(bias_min, 0)


def rays_of(inputs):
    """Patch means are shorter than unit vectors."""
    *_, origins, directions = inputs
    return 0.97 * torch.cat([torch.linalg.cross(origins, directions), directions], -1)


def bias(inputs, bias_min=-20.0):
    center, sigma_sq, gamma, quats, *_ = inputs
    rays = rays_of(inputs)
    if sigma_sq.shape[-1] == 1:
        return locus.RayBias.of(center, sigma_sq, locus.ray_tokens(rays), bias_min, gamma).dense()
    place = center, anchor_rotation(quats), sigma_sq
    return EllipsoidBias.of(*place, ray_tokens(rays), bias_min, gamma).dense()


def gradients(of, inputs, learnt, bias_min=-20.0):
    """Of the bias, weighed, for the first inputs. Rays that learn keep kernels out of it."""
    leaves = [x.detach().clone().requires_grad_(n < learnt) for n, x in enumerate(inputs)]
    torch.manual_seed(1)
    found = of(leaves, bias_min)
    weight = torch.rand(found.shape).to(found)
    return torch.autograd.grad(found, leaves[:learnt], weight, materialize_grads=True)


def assert_digits(found, best):
    for x, of_float64 in zip(found, best, strict=True):
        assert (x - of_float64).norm() <= 1e-6 * of_float64.norm()


@both
def test_the_bias_is_by_the_least_distance_along_the_ray(radii):
    inputs = drawn(50, 200, radii)
    inputs[0][:, 0] = (inputs[4] + 1.7 * inputs[5])[:, 0]  # on a ray
    best = on_the_ray(double(inputs))
    assert_equal(bias(double(inputs)), best, atol=1e-12)
    fast = bias(inputs)
    assert_equal(fast.double(), best, atol=1e-5)
    with torch.autocast("cpu", torch.bfloat16):
        assert_equal(bias(inputs), fast)
    assert fast.dtype == torch.float32
    assert best.min() < -1.999 < -0.5 < best.max(), "some pairs must reach the clamp, some not"


def test_the_text_of_locusgs_says_the_same():
    inputs = double(drawn(50, 200, 1))
    center, sigma_sq, gamma, *_ = inputs
    assert_close(gamma * locus.dense_bias(center, sigma_sq, rays_of(inputs), -20.0), bias(inputs))


def test_a_needle_is_measured_exactly():
    center, sigma_sq, *rest = double(drawn(20, 30))
    inputs = center, sigma_sq.new_tensor([1e-3, 1e-3, 1e3]).expand_as(sigma_sq), *rest
    assert_close(bias(inputs, -1e9), on_the_ray(inputs, -1e9), rtol=1e-6, atol=1e-7)


@both
@pytest.mark.parametrize(("distance", "error"), [(1.0, 3e-5), (10.0, 7e-5), (50.0, 3e-4)])
def test_kernels_are_exact_far_from_the_cameras(distance, error, radii):
    _, _, _, quats, origins, noise = drawn(50, 50)
    depth = distance * torch.rand(2, 50, 1) + 0.1
    center = torch.cat([depth * (torch.rand(2, 50, 2) - 0.5), depth], -1)
    sigma_sq = torch.tensor([1e-3, 1e-2, 1.0]).expand(2, 50, 3)[..., :radii]
    directions = F.normalize(center + 0.01 * noise, dim=-1)
    inputs = center, sigma_sq, torch.ones(()), quats, 0.2 * origins, directions
    best = on_the_ray(double(inputs))
    assert ((best > -20) & (best < -0.01)).any()
    assert (bias(inputs) - best).abs().max() < error
    learnt = 3 if radii == 1 else 4  # how a ball is turned says nothing
    best = gradients(on_the_ray, double(inputs), learnt, -1e9)
    assert_digits(gradients(bias, inputs, learnt, -1e9), best)


@both
@pytest.mark.parametrize("rays", [1, 17, 4100])
def test_gradients_equal_those_of_the_formula(rays, radii):
    inputs = drawn(6, rays, radii, thinnest=0.05)
    best = gradients(on_the_ray, double(inputs), 6)
    assert_close(gradients(bias, double(inputs), 6), best)
    assert_digits(gradients(bias, inputs, 3), best[:3])

"""Containers refuse what does not fit together, where it is made."""

import torch
from tables import must_refuse
from torch import zeros

from qgs.containers import concatenated
from qgs.types import (
    Cameras,
    GaussianAttributes,
    Gaussians,
    ImageMemory,
    QueryState,
    Rendering,
    SpatialSupport,
    Views,
)

CAMERA = Cameras(torch.eye(4)[None, None], torch.ones(1, 1, 4), (8, 8))


THREE = zeros(1, 2, 5, 3)
ONE = zeros(1, 2, 5)
ALPHA = zeros(1, 2, 1, 4, 5)
BALLS = [x[:, 0] for x in (THREE, THREE, zeros(1, 2, 5, 4), ONE, THREE)]


def test_what_does_not_fit_together_is_refused():
    must_refuse(r"features must have shape \(B, N, D\)", QueryState, zeros(3, 4))
    must_refuse(r"intrinsics .*\(2, 3, 4\), got", Cameras, zeros(2, 3, 4, 4), zeros(3, 4), (8, 8))
    must_refuse("divide 8-bit images by 255", Views, zeros(1, 1, 3, 8, 8).byte(), CAMERA)
    must_refuse(r"Attributes\.quats", GaussianAttributes, THREE, THREE, THREE, ONE, THREE)
    must_refuse(r"Gaussians\.sh .*\(1, 5, C, 3\), got", Gaussians, *BALLS, zeros(1, 5, 3))
    must_refuse(r"sh has 4 coefficients.* 3, 8 or 15", Gaussians, *BALLS, zeros(1, 5, 4, 3))
    must_refuse("sh", concatenated, [Gaussians(*BALLS), Gaussians(*BALLS, zeros(1, 5, 3, 3))], 1)
    must_refuse(r"Rendering\.depth", Rendering, zeros(1, 2, 3, 4, 5), ALPHA, ALPHA[..., :4])
    must_refuse(r"SpatialSupport\.axes", SpatialSupport, zeros(1, 2, 3), zeros(1, 2, 3))


def test_memo_does_not_leak_between_gradient_modes():
    keys = zeros(2, 4, 6, 8)
    rays = torch.ones(2, 6, 6, requires_grad=True)
    memory = ImageMemory(
        keys=keys, values=keys, features=zeros(2, 6, 32), patch_rays=rays, grid=(1, 2, 3)
    )

    def doubled():
        return memory.once("test.doubled", lambda: 2 * rays)

    with torch.no_grad():
        assert not doubled().requires_grad
    with torch.inference_mode():
        assert doubled().is_inference()
    assert doubled().requires_grad
    assert doubled() is doubled()

"""The soft frustum and the regularisers, view by view and point by point."""

import math
from dataclasses import replace

import pytest
import torch
from globalsplat_inputs import cameras, views
from qgs_globalsplat.losses import Frustum, Regularisers, beyond_frusta
from torch import Tensor

from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering

SOFT, NEAR = 0.1, 0.2


def points() -> Tensor:
    """In front, at the sides, behind."""
    return torch.randn(2, 9, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [0.6, 0.6, 2.0]
    )


def beyond_one(point: Tensor, c2w: Tensor, lens: Tensor, size: tuple[int, int]) -> float:
    """Softplus of the distances beyond five planes, each through the centre and two corners."""
    height, width = size
    local = c2w[:3, :3].T @ (point - c2w[:3, 3])
    fx, fy, cx, cy = lens.tolist()
    corners = [
        torch.tensor([(u - cx) / fx, (v - cy) / fy, 1.0])
        for u, v in ((0, 0), (width, 0), (width, height), (0, height))
    ]
    total = 0.0
    for first, second in zip(corners, corners[1:] + corners[:1], strict=True):
        normal = torch.linalg.cross(first, second)
        normal = normal / normal.norm()
        inside = torch.tensor([0.0, 0.0, 1.0]) @ normal
        total += math.log1p(math.exp(-(local @ normal * inside.sign()).item() / SOFT))
    return total + math.log1p(math.exp((NEAR - local[2].item()) / SOFT))


def test_the_frustum_of_each_view() -> None:
    seen, at = cameras(3), points()
    found = beyond_frusta(at, seen, SOFT, NEAR)
    for scene in range(2):
        for number in range(9):
            each = [
                beyond_one(
                    at[scene, number], seen.c2w[scene, v], seen.intrinsics[scene, v], (12, 16)
                )
                for v in range(3)
            ]
            soft = -SOFT * math.log(sum(math.exp(-x) for x in each) / 3)
            assert found[scene, number].item() == pytest.approx(soft, rel=1e-4, abs=1e-6)


def test_what_a_view_sees_costs_little_and_what_none_sees_is_pulled_in() -> None:
    seen = cameras(2)
    at = torch.tensor([[0.1, 0.0, 3.0], [0.0, 0.0, -2.0], [9.0, 0.0, 1.0]]).repeat(2, 1, 1)
    at.requires_grad_()
    found = beyond_frusta(at, seen, 0.02, NEAR)
    assert found[0, 0] < 1e-6
    assert found[0, 1] > 2
    found.sum().backward()
    assert at.grad[0, 1, 2] < -0.5  # forward, from behind
    assert at.grad[0, 2, 0] > 0.5  # to the middle


def test_the_input_cameras_count_and_no_others() -> None:
    inputs, elsewhere = views(2), views(2)
    away = replace(elsewhere, cameras=replace(elsewhere.cameras, c2w=-elsewhere.cameras.c2w))
    loss, given = Frustum(Frustum.Config(weight=1.0)), prediction()
    (one,) = loss(given, nothing(inputs.cameras), away, inputs).values()
    (other,) = loss(given, nothing(inputs.cameras), inputs, inputs).values()
    (turned,) = loss(given, nothing(inputs.cameras), inputs, away).values()
    assert one == other != turned


def test_regularisers_are_means() -> None:
    given = prediction()
    loss = Regularisers(Regularisers.Config(opacity_weight=0.5, scale_weight=2.0))
    terms = loss(given, nothing(cameras()), views(), views())
    torch.testing.assert_close(terms["mean_opacity"], 0.5 * given.gaussians.opacities.mean())
    torch.testing.assert_close(terms["mean_scale"], 2.0 * given.gaussians.scales.mean())


def test_gaussians_of_tokens_that_decode_none_do_not_count() -> None:
    mask = torch.tensor([[True, True, False], [True, False, False]])
    given, loss = prediction(mask), Regularisers(Regularisers.Config(opacity_weight=1.0))
    terms = loss(given, nothing(cameras()), views(), views())
    opacities = given.gaussians.opacities
    wanted = (opacities[0, :4].mean() + opacities[1, :2].mean()) / 2
    torch.testing.assert_close(terms["mean_opacity"], wanted)
    frustum = Frustum(Frustum.Config(weight=1.0))(given, nothing(cameras()), views(), views())
    per_point = beyond_frusta(given.gaussians.means, cameras(), 0.05, 0.05)
    wanted = (per_point[0, :4].mean() + per_point[1, :2].mean()) / 2
    torch.testing.assert_close(frustum["frustum"], wanted)


def prediction(mask: Tensor | None = None) -> LayerPrediction:
    torch.manual_seed(0)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(2, 6, 4)
    rest = torch.rand(2, 6, 3), quats, torch.rand(2, 6), torch.rand(2, 6, 3)
    return LayerPrediction(
        Gaussians(points()[:, :6], *rest), QueryState(torch.zeros(2, 3, 4), {}, mask)
    )


def nothing(seen: Cameras) -> Rendering:
    return Rendering(*(torch.zeros(2, 0, c, *seen.size) for c in (3, 1, 1)))

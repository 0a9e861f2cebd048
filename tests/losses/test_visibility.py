"""Gradients and options of visibility; golden/test_files.py compares it with the released code."""

import pytest
import torch
from torch import Tensor

from qgs.contracts import ModelDims, RecipeContext
from qgs.losses import Visibility, view_visibility
from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering, Views

BEHIND = [0, 5]


@pytest.fixture
def cameras(golden: dict[str, Tensor]) -> Cameras:
    return Cameras(golden["c2w"], golden["intrinsics"], (16, 24))


@pytest.mark.parametrize(
    "options",
    [{}, {"behind": 0.025}, {"clamp": None}, {"z_guard": 1e-3}],
    ids=["published", "invisible", "noclamp", "anchors"],
)
def test_gradients_are_finite_everywhere(
    golden: dict[str, Tensor], cameras: Cameras, options: dict
) -> None:
    nearly_zero = torch.tensor([[0.3, 0.1, 1e-30], [1e-30, 0.0, 1e-30], [0.0, 0.2, -1e-12]])
    points = torch.cat([golden["points"], nearly_zero.expand(2, 3, 3)], 1).requires_grad_()
    values = view_visibility(points, cameras[:, :1], **options)
    (gradient,) = torch.autograd.grad(values.sum(), points)
    assert values.isfinite().all()
    assert gradient.isfinite().all()
    assert gradient.count_nonzero() > 0


def test_points_behind_a_camera_are_invisible_on_demand(
    golden: dict[str, Tensor], cameras: Cameras
) -> None:
    first = cameras[:1, :1]
    points = golden["points"][:1]
    published = view_visibility(points, first)[0]
    corrected = view_visibility(points, first, behind=0.025)[0]
    in_front = points[0, :, 2] > 0.025
    assert (published[BEHIND] == 0).all()
    assert (corrected[BEHIND] == 1).all()
    torch.testing.assert_close(corrected[in_front], published[in_front])


@pytest.mark.parametrize("behind", ["published", "invisible"])
def test_component_weighs_the_mean_over_gaussians(
    golden: dict[str, Tensor], cameras: Cameras, behind: str
) -> None:
    loss = Visibility(Visibility.Config(weight=0.1, behind_camera=behind))
    means = golden["points"]
    gaussians = Gaussians(
        means, means.abs() + 0.1, torch.ones(2, 40, 4), golden["opacity"][..., 0], means.sigmoid()
    )
    images = golden["images_gt"]
    target = Views(images, cameras)
    rendering = Rendering(images, golden["alphas_pred"], golden["alphas_pred"])
    terms = loss(LayerPrediction(gaussians, QueryState(means)), rendering, target, target)
    near = 0.025 if behind == "invisible" else None
    torch.testing.assert_close(
        terms, {"visibility": 0.1 * view_visibility(means, cameras, behind=near).mean()}
    )


@pytest.mark.parametrize(
    ("options", "option"),
    [
        ({"near": 0.1}, "near"),
        ({"infinite_pixel": 10.0}, "infinite_pixel"),
        ({"behind_camera": "invisible", "clamp": None}, "clamp"),
    ],
)
def test_options_that_cannot_work_are_refused(options: dict, option: str) -> None:
    context = RecipeContext(ModelDims(width=8, heads=1, depth=1))
    problems = Visibility.problems(Visibility.Config(**options), context)
    assert [problem.option for problem in problems] == [option]
    clean = Visibility.Config(behind_camera="invisible", near=0.1)
    assert not list(Visibility.problems(clean, context))


def test_infinite_pixel_is_where_points_at_zero_depth_go(
    golden: dict[str, Tensor], cameras: Cameras
) -> None:
    near, far = (
        view_visibility(golden["points"], cameras[:, :1], clamp=None, infinite_pixel=pixel)
        for pixel in (1e3, 1e6)
    )
    assert near[0, 1] < far[0, 1]
    assert torch.equal(near[0, 5:], far[0, 5:])

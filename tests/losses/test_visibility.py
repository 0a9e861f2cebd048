"""Visibility against the released code, and its gradients."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from qgs.contracts import ModelDims, RecipeContext
from qgs.losses import Visibility, view_visibility
from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering, Views

GOLDEN = Path(__file__).parents[1] / "golden" / "loss_a.safetensors"
TOLERANCE = {"rtol": 1e-4, "atol": 5e-5}
CLAMPS = {"clamp1": 1.0, "clamp0p25": 0.25, "noclamp": None}
ANCHOR_GUARD = 1e-3
BEHIND = [0, 5]


@pytest.fixture(scope="module")
def golden() -> dict[str, Tensor]:
    return load_file(GOLDEN)


@pytest.fixture(scope="module")
def cameras(golden: dict[str, Tensor]) -> Cameras:
    return Cameras(golden["c2w"], golden["intrinsics"], (16, 24))


def test_cameras_agree_with_the_released_convention(
    golden: dict[str, Tensor], cameras: Cameras
) -> None:
    torch.testing.assert_close(cameras.w2c.transpose(-1, -2), golden["cam_view"], **TOLERANCE)


@pytest.mark.parametrize("clamp", CLAMPS)
def test_tokengs_visibility(golden: dict[str, Tensor], cameras: Cameras, clamp: str) -> None:
    per_point = view_visibility(golden["points"], cameras, clamp=CLAMPS[clamp])
    first = view_visibility(golden["points"], cameras[:, :1], clamp=CLAMPS[clamp])
    expected = {
        name: golden[f"expected.tokengs.visibility_{name}.{clamp}"]
        for name in ("per_point", "per_scene", "per_scene_view0")
    }
    torch.testing.assert_close(per_point, expected["per_point"], **TOLERANCE)
    torch.testing.assert_close(per_point.mean(1), expected["per_scene"], **TOLERANCE)
    torch.testing.assert_close(first.mean(1), expected["per_scene_view0"], **TOLERANCE)


@pytest.mark.parametrize(("clamp", "view0"), list(itertools.product(CLAMPS, ["", "_view0"])))
def test_anchor_visibility(
    golden: dict[str, Tensor], cameras: Cameras, clamp: str, view0: str
) -> None:
    seen_by = cameras[:, :1] if view0 else cameras
    per_point = view_visibility(
        golden["points"], seen_by, clamp=CLAMPS[clamp], z_guard=ANCHOR_GUARD
    )
    prefix = "expected.locusgs.anchor_visibility"
    torch.testing.assert_close(per_point, golden[f"{prefix}_per_point{view0}.{clamp}"], **TOLERANCE)
    torch.testing.assert_close(per_point.mean(), golden[f"{prefix}{view0}.{clamp}"], **TOLERANCE)


@pytest.mark.parametrize(
    "options",
    [{}, {"behind": 0.025}, {"clamp": None}, {"z_guard": ANCHOR_GUARD}],
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
    terms = loss(LayerPrediction(gaussians, QueryState(means)), rendering, target)
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

"""The loss on true depth: by hand, on rooms, and on photos with depth maps."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import MODEL
from PIL import Image

from qgs.composer import resolve
from qgs.contracts import ViewsConfig
from qgs.data.samples import make_sample, stack_views
from qgs.engine.training import train
from qgs.losses.depth import DepthSurface, surface_errors
from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering, Views
from qgs.wording import warn_once

ROOMS = {
    "recipe": 1,
    "plugins": ["rooms"],
    "model": MODEL,
    "data": {"type": "rooms/procedural", "image_size": [16, 16], "scenes": 2, "test_scenes": 1},
    "views": {"inputs": 2, "targets": 2, "gap": [2, 4], "scale_factor": 0.4},
    "losses": {"depth": {"type": "qgs/depth_surface", "weight": 1.0}},
    "training": {"steps": 3, "batch_size": 2, "precision": "float32", "save_every": 0},
    "optimizer": {"warmup": 1},
}


def wall(distance: float = 2.0) -> Views:
    """A camera at the origin of 4 x 4 pixels of 90 degrees; its right half sees nothing."""
    cameras = Cameras(torch.eye(4)[None, None], torch.tensor([[[2.0, 2.0, 2.0, 2.0]]]), (4, 4))
    depth = torch.full((1, 1, 1, 4, 4), distance)
    depth[..., 2:] = 0
    return Views(torch.zeros(1, 1, 3, 4, 4), cameras, depths=depth)


POINTS = torch.tensor([[
    [-0.5, 0.0, 2.5],  # half a unit behind the wall: 0.5 - beta / 2
    [-0.5, 0.0, 1.9],  # 0.1 before it, within beta: 0.1^2 / (2 beta)
    [0.5, 0.0, 1.0],   # where the depth is unknown
    [-3.0, 0.0, 1.0],  # left of the image
    [-0.5, 0.0, -2.0],  # behind the camera
]])  # fmt: skip


def prediction(means: torch.Tensor) -> LayerPrediction:
    count = means.shape[1]
    gaussians = Gaussians(
        means, torch.ones(1, count, 3), torch.ones(1, count, 4), torch.ones(1, count),
        torch.ones(1, count, 3),
    )  # fmt: skip
    return LayerPrediction(gaussians, QueryState(torch.zeros(1, count, 2)))


def test_by_hand() -> None:
    errors, seen = surface_errors(POINTS, wall(), beta=0.2, near=0.1)
    assert seen[0, 0].tolist() == [True, True, False, False, False]
    assert errors[0, 0, :2].tolist() == pytest.approx([0.4, 0.025])
    means = POINTS.clone().requires_grad_()
    nothing = Rendering(*(torch.zeros(1, 0, c, 4, 4) for c in (3, 1, 1)))
    loss = DepthSurface(DepthSurface.Config(beta=0.2, near=0.1, inputs=False))
    term = loss.term(prediction(means), nothing, wall(), wall())
    assert float(term.detach()) == pytest.approx((0.4 + 0.025) / 2)
    term.backward()
    # z alone moves: 1 / 2 beyond beta, (1.9 - 2) / beta / 2 within it
    assert means.grad is not None
    assert means.grad[0, :, 2].tolist() == pytest.approx([0.5, -0.25, 0, 0, 0])
    assert not means.grad[0, :, :2].any()


def term(means: torch.Tensor, views: Views) -> torch.Tensor:
    nothing = Rendering(*(torch.zeros(1, 0, c, 4, 4) for c in (3, 1, 1)))
    loss = DepthSurface(DepthSurface.Config(beta=0.2, near=0.1, inputs=False))
    return loss.term(prediction(means), nothing, views, views)


def test_a_view_that_is_target_and_input_counts_once() -> None:
    """As of `training.judge_inputs`: the nearest of equal views is one view."""
    found = []
    for inputs in (False, True):
        means = POINTS.clone().requires_grad_()
        nothing = Rendering(*(torch.zeros(1, 0, c, 4, 4) for c in (3, 1, 1)))
        loss = DepthSurface(DepthSurface.Config(inputs=inputs))
        value = loss.term(prediction(means), nothing, wall(), wall())
        found.append((value.detach(), *torch.autograd.grad(value, means)))
    assert float(found[0][0]) > 0
    torch.testing.assert_close(found[1], found[0])


def test_a_batch_without_depth_maps_adds_nothing_and_is_logged_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    warn_once.cache_clear()
    means = POINTS.clone().requires_grad_()
    for _ in range(2):
        value = term(means, Views(wall().images, wall().cameras))
        value.backward()
        assert value.item() == 0
    assert means.grad is not None
    assert not means.grad.any()
    assert caplog.text.count("no depth maps") == 1


def test_a_centre_that_is_nan_gives_nan() -> None:
    means = POINTS.clone()
    means[0, 1] = torch.nan
    assert term(means, wall()).isnan()


def test_a_hidden_surface_is_not_drawn_to_what_hides_it() -> None:
    """A screen at z = 1 hides the wall at z = 2 from the first camera; the second is behind it."""
    c2w = torch.eye(4).repeat(1, 2, 1, 1)
    c2w[0, 1, 2, 3] = 1.0
    cameras = Cameras(c2w, torch.full((1, 2, 4), 2.0), (4, 4))
    views = Views(torch.zeros(1, 2, 3, 4, 4), cameras, depths=torch.ones(1, 2, 1, 4, 4))
    means = torch.tensor([[[0.2, 0.1, 1.0], [0.2, 0.1, 2.0], [-0.3, -0.2, 2.0]]])
    _, seen = surface_errors(means, views, 0.2, 0.1)
    assert seen[0].tolist() == [[True, True, True], [False, True, True]]
    means.requires_grad_()
    value = term(means, views)
    value.backward()
    assert value.item() == 0
    assert means.grad is not None
    assert not means.grad.any()
    assert term(means.detach() + torch.tensor([0, 0, 0.1]), views) > 0


@pytest.mark.parametrize("mirror", [False, True])
def test_points_of_the_surface_have_no_error(mirror: bool) -> None:
    """Depths are scaled and mirrored with their cameras: each pixel's point lies on all maps."""
    recipe = resolve(ROOMS)
    scene = recipe.build_data().scenes("train")[0]
    views = ViewsConfig(inputs=2, targets=1, gap=(1, 2), scale_factor=0.4)
    sample = make_sample(scene, (0, 1), (2,), views, mirror, depths=True)
    inputs = sample.inputs
    assert inputs.depths is not None
    own = scene.depths([0])
    assert own is not None
    flipped = own.flip(-1) if mirror else own
    torch.testing.assert_close(inputs.depths[0, 0], 0.4 * flipped[0])
    fx, fy, cx, cy = inputs.cameras.intrinsics[0, 0]
    rows, columns = torch.meshgrid(*[torch.arange(16) + 0.5] * 2, indexing="ij")
    z = inputs.depths[0, 0, 0]
    local = torch.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], -1).reshape(1, -1, 3)
    pose = inputs.cameras.c2w[:, 0]
    points = local @ pose[..., :3, :3].mT + pose[..., None, :3, 3]
    errors, seen = surface_errors(points, inputs, beta=1e-6, near=1e-3)
    assert seen[0, 0].float().mean() > 0.9
    assert float((errors * seen)[0, 0].max()) < 1e-4
    # the other view sees another side of some edges, and the same walls elsewhere
    assert float(errors[0, 1][seen[0, 1]].median()) < 0.02
    assert make_sample(scene, (0, 1), (2,), views, mirror).inputs.depths is None


def test_noisy_views_and_scenes_without_maps_have_unknown_depth() -> None:
    scene = resolve(ROOMS).build_data().scenes("train")[0]
    views = ViewsConfig(inputs=3, targets=1, gap=(1, 3), pose_noise=5.0)
    rng = np.random.default_rng(0)
    sample = make_sample(scene, (0, 1, 2), (3,), views, False, rng, depths=True)
    assert sample.inputs.depths is not None
    assert [bool(depth.any()) for depth in sample.inputs.depths[0]] == [True, False, False]
    bare = make_sample(scene, (0, 1, 2), (3,), views, False, rng)
    both = stack_views([sample.inputs, bare.inputs])
    assert both.depths is not None
    assert not both.depths[1].any()


def photos(folder: Path) -> None:
    """A room as a folder of photos with depth maps in millimetres, but for one frame."""
    scene = resolve(ROOMS).build_data().scenes("train")[0]
    frames, axes = range(8), torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double()
    images, depths = scene.images(frames), scene.depths(frames)
    assert depths is not None
    folder.mkdir()
    listed = []
    for i in frames:
        pixels = images[i].permute(1, 2, 0).mul(255).round().byte().numpy()
        Image.fromarray(pixels).save(folder / f"{i}.png")
        Image.fromarray((depths[i, 0] * 1000).round().numpy().astype(np.uint16)).save(
            folder / f"{i}_depth.png"
        )
        frame = {"file_path": f"{i}.png"}
        frame["transform_matrix"] = (scene.cameras.c2w[i].double() @ axes).tolist()
        listed.append(frame | ({"depth_file_path": f"{i}_depth.png"} if i != 5 else {}))
    fx, fy, cx, cy = scene.cameras.intrinsics[0].tolist()
    top = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": 16, "h": 16}
    (folder / "transforms.json").write_text(json.dumps({**top, "frames": listed}))


@pytest.mark.parametrize("kind", ["rooms", "photos"])
def test_a_training_has_the_loss(tmp_path: Path, kind: str) -> None:
    tree = dict(ROOMS)
    if kind == "photos":
        photos(tmp_path / "room")
        tree["data"] = {"type": "qgs/photos", "path": str(tmp_path / "room"), "holdout": 0}
        tree["data"]["image_size"] = [16, 16]
    history = train(resolve(tree), tmp_path / "run").folder.history()
    assert len(history) == 3
    assert all(0 < record["depth_surface"] < 10 for record in history), history

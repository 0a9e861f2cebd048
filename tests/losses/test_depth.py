"""The loss on true depth: by hand, and on rooms."""

import numpy as np
import pytest
import torch
from losses.judging import judged
from torch.testing import assert_close
from training_runs import run, tiny

from qgs.contracts import ViewsConfig
from qgs.data.samples import make_sample, stack_views
from qgs.losses.depth import DepthSurface, surface_errors
from qgs.types import Cameras, Views
from qgs.wording import warn_once

ROOMS = tiny("tokengs", "losses.depth={type: qgs/depth_surface, weight: 1.0}")
POSE = torch.tensor([[0, 0, 1.0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
LENS = torch.tensor([2.0, 2.0, 3.0, 2.0])
DEPTHS = torch.zeros(1, 1, 1, 4, 6)
DEPTHS[..., 1, 2] = 2
WALL = Views(
    torch.zeros(1, 1, 3, 4, 6), Cameras(POSE[None, None], LENS[None, None], (4, 6)), depths=DEPTHS
)
"""A turned camera of 4 x 6 pixels, one of which sees something."""
SEEN_FROM_IT = torch.tensor([
    [-0.5, -0.5, 2.5],  # half a unit behind the wall: 0.5 - beta / 2
    [-0.5, -0.5, 1.9],  # 0.1 before it, within beta: 0.1^2 / (2 beta)
    [0.5, -0.5, 1.0],  # where the depth is unknown
    [-3.0, 0.0, 1.0],  # left of the image
    [-0.02, -0.02, -2.0],  # behind the camera
    [-0.004, -0.004, 0.05]  # too near
])  # fmt: skip
POINTS = SEEN_FROM_IT[None] @ POSE[:3, :3].T


def term(means, views, **options):
    config = DepthSurface.Config(beta=0.2, near=0.1, **options)
    return judged(DepthSurface(config), views, means)["depth_surface"]


def test_by_hand():
    """A view that is target and input (`training.judge_inputs`) counts once."""
    errors, seen = surface_errors(POINTS, WALL, beta=0.2, near=0.1)
    assert seen[0, 0].tolist() == [True, True, False, False, False, False]
    assert errors[0, 0, :2].tolist() == pytest.approx([0.4, 0.025])
    for inputs in (False, True):
        means = POINTS.clone().requires_grad_()
        loss = term(means, WALL, inputs=inputs)
        loss.backward()
        assert loss.item() == pytest.approx((0.4 + 0.025) / 2)
        gradient = means.grad[0] @ POSE[:3, :3]
        # z alone moves: 1 / 2 beyond beta, (1.9 - 2) / beta / 2 within it
        assert gradient[:, 2].tolist() == pytest.approx([0.5, -0.25, 0, 0, 0, 0])
        assert not gradient[:, :2].any()


def test_a_batch_without_depth_maps_adds_nothing_and_is_logged_once(caplog):
    warn_once.cache_clear()
    means = POINTS.clone().requires_grad_()
    for _ in range(2):
        value = term(means, WALL.replace(depths=None))
        value.backward()
        assert value == 0
        assert not means.grad.any()
    assert caplog.text.count("no depth maps") == 1


def test_a_centre_that_is_nan_gives_nan():
    means = POINTS.clone()
    means[0, 1] = torch.nan
    assert term(means, WALL).isnan()


def test_a_hidden_surface_is_not_drawn_to_what_hides_it():
    """A screen at z = 1 hides the wall at z = 2 from the first camera; the second is behind it."""
    cameras = Cameras(torch.eye(4).repeat(1, 2, 1, 1), torch.full((1, 2, 4), 2.0), (4, 4))
    cameras.c2w[0, 1, 2, 3] = 1.0
    depths = torch.ones(1, 2, 1, 4, 4)
    views = Views(depths.expand(-1, -1, 3, -1, -1), cameras, depths=depths)
    means = torch.tensor([[[0.2, 0.1, 1.0], [0.2, 0.1, 2.0], [-0.3, -0.2, 2.0]]])
    _, seen = surface_errors(means, views, 0.2, 0.1)
    assert seen[0].tolist() == [[True, True, True], [False, True, True]]
    means.requires_grad_()
    value = term(means, views)
    value.backward()
    assert value == 0
    assert not means.grad.any()
    assert term(means.detach() + torch.tensor([0, 0, 0.1]), views) > 0


def test_depths_are_scaled_and_mirrored_and_unknown_in_noisy_views_and_without_maps():
    scene = ROOMS.build_data().scenes("train")[0]
    views = ViewsConfig(inputs=3, targets=1, gap=(1, 3), scale_factor=0.4, pose_noise=5.0)

    def inputs(mirror=False, noise=None, depths=True):
        return make_sample(scene, (0, 1, 2), (3,), views, mirror, noise, depths=depths).inputs

    own = 0.4 * scene.depths([0, 1, 2])
    assert_close(inputs().depths[0], own)
    assert_close(inputs(mirror=True).depths[0], own.flip(-1))
    noisy = inputs(noise=np.random.default_rng(0)).depths[0]
    assert [bool(depth.any()) for depth in noisy] == [True, False, False]
    bare = inputs(depths=False)
    assert bare.depths is None
    assert not stack_views([inputs(), bare]).depths[1].any()


def test_a_training_has_the_loss(tmp_path):
    history = run(ROOMS, tmp_path / "run").folder.history()
    assert history
    assert all(0 < record["depth_surface"] < 10 for record in history), history

"""Options, gradients and values by hand; golden/test_files.py compares with the released code."""

import numpy as np
import pytest
import torch
from losses.judging import CAMERAS, GOLDEN, PREDICTED, TRUTH, judged
from tables import assert_near, must_refuse
from torch.testing import assert_close
from training_runs import run, tiny
from walk import along_x, pinhole

from qgs.contracts import ViewsConfig
from qgs.data.samples import make_sample, stack_views
from qgs.losses import Mask, Photometric, view_visibility
from qgs.losses.depth import DepthSurface
from qgs.metrics.images import ssim
from qgs.types import Views

POINTS = GOLDEN["points"]


VIEWS = Views(TRUTH, CAMERAS)


def photometric(rgb=PREDICTED, **options):
    return judged(Photometric(Photometric.Config(**options)), VIEWS, rgb=rgb)


def test_valid_ssim_is_the_metric_of_large_enough_images():
    rgb = PREDICTED.clamp(0, 1)
    found = photometric(rgb, ssim_weight=0.3, padding="valid")["ssim"]
    assert_close(found, 0.3 * (1 - ssim(rgb, TRUTH).mean()) / 2)


def test_terms_have_weights_and_those_of_weight_zero_are_left_out():
    assert photometric(ssim_weight=0.0).keys() == {"mse"}
    terms = photometric(mse_weight=0.0, l1_weight=0.8)
    assert terms.keys() == {"l1", "ssim"}
    assert_close(terms["l1"], 0.8 * (PREDICTED - TRUTH).abs().mean())


def test_mask_without_masks_is_refused():
    must_refuse("qgs/mask needs views with masks", judged, Mask(Mask.Config()), VIEWS)


def test_gradients_of_visibility_are_finite_everywhere():
    nearly_zero = torch.tensor([[0.3, 0.1, 1e-30], [1e-30, 0.0, 1e-30], [0.0, 0.2, -1e-12]])
    points = torch.cat([POINTS, nearly_zero.expand(2, 3, 3)], 1).requires_grad_()
    for options in ({}, {"behind": 0.025}, {"clamp": None}, {"z_guard": 1e-3}):
        value = view_visibility(points, CAMERAS[:, :1], **options).sum()
        (gradient,) = torch.autograd.grad(value, points)
        assert value.isfinite(), options
        assert gradient.isfinite().all(), options
        assert gradient.any(), options


def test_points_behind_a_camera_are_invisible_on_demand():
    published, corrected = (
        view_visibility(POINTS, CAMERAS[:, :1], behind=behind)[0] for behind in (None, 0.025)
    )
    in_front = POINTS[0, :, 2] > 0.025
    assert (published[[0, 5]] == 0).all()
    assert (corrected[[0, 5]] == 1).all()
    assert_close(corrected[in_front], published[in_front])


ROOMS = tiny("tokengs", "losses.depth={type: qgs/depth_surface, weight: 1.0}")
POSE = torch.tensor([[0, 0, 1.0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
DEPTHS = torch.zeros(1, 1, 1, 4, 6)
DEPTHS[..., 1, 2] = 2
FROM = pinhole(POSE[None], (2.0, 2.0, 3.0, 2.0), (4, 6))[None]
WALL = Views(torch.zeros(1, 1, 3, 4, 6), FROM, depths=DEPTHS)
"""A turned camera of 4 x 6 pixels, one of which sees something."""
SEEN_FROM_IT = torch.tensor([
    [-0.5, -0.5, 2.5],  # half a unit behind the wall: 0.5 - beta / 2
    [-0.5, -0.5, 1.9],  # 0.1 before it, within beta: 0.1^2 / (2 beta)
    [0.5, -0.5, 1.0],  # where the depth is unknown
    [-3.0, 0.0, 1.0],  # left of the image
    [-0.02, -0.02, -2.0],  # behind the camera
    [-0.004, -0.004, 0.05]  # too near
])  # fmt: skip
OF_DEPTH = SEEN_FROM_IT[None] @ POSE[:3, :3].T


def term(means, views, **options):
    config = DepthSurface.Config(beta=0.2, near=0.1, **options)
    return judged(DepthSurface(config), views, means)["depth_surface"]


def differentiated(means, views, **options):
    """The term, and its gradient."""
    means = means.clone().requires_grad_()
    value = term(means, views, **options)
    return value, *torch.autograd.grad(value, means)


def test_depth_by_hand():
    """A view that is target and input (`training.judge_inputs`) counts once."""
    for inputs in (False, True):
        loss, slope = differentiated(OF_DEPTH, WALL, inputs=inputs)
        assert loss.item() == pytest.approx((0.4 + 0.025) / 2)
        gradient = slope[0] @ POSE[:3, :3]
        # z alone moves: 1 / 2 beyond beta, (1.9 - 2) / beta / 2 within it
        assert_near(gradient[:, 2], [0.5, -0.25, 0, 0, 0, 0])
        assert not gradient[:, :2].any()


def test_a_batch_without_depth_maps_adds_nothing_and_is_logged_once(caplog):
    for _ in range(2):
        for found in differentiated(OF_DEPTH, WALL.replace(depths=None)):
            assert not found.any()
    assert caplog.text.count("no depth maps") == 1


def test_a_centre_that_is_nan_gives_nan():
    means = OF_DEPTH.clone()
    means[0, 1] = torch.nan
    assert term(means, WALL).isnan()


def test_a_hidden_surface_is_not_drawn_to_what_hides_it():
    """A screen at z = 1 hides the wall at z = 2 from the first camera; the second is behind it."""
    cameras = pinhole(along_x([0.0, 0.0]), [2.0] * 4, (4, 4))[None]
    cameras.c2w[0, 1, 2, 3] = 1.0
    depths = torch.ones(1, 2, 1, 4, 4)
    views = Views(depths.expand(-1, -1, 3, -1, -1), cameras, depths=depths)
    means = torch.tensor([[[0.2, 0.1, 1.0], [0.2, 0.1, 2.0], [-0.3, -0.2, 2.0]]])
    for found in differentiated(means, views):
        assert not found.any()
    assert term(means + torch.tensor([0, 0, 0.1]), views) > 0


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


def test_a_training_has_the_loss_on_depth(here):
    history = run(ROOMS).folder.history()
    assert history
    assert all(0 < record["depth_surface"] < 10 for record in history), history

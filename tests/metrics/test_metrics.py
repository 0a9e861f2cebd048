"""PSNR by its formula, SSIM against scikit-image, baselines, and what is measured on Gaussians."""

from types import SimpleNamespace

import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation
from skimage.metrics import structural_similarity
from tables import assert_equal, assert_near, must_refuse
from torch.testing import assert_close
from walk import along_x, pinhole

from qgs.contracts import Column, MetricInput
from qgs.data.samples import stack_views
from qgs.metrics.baselines import mean_colour, nearest_input, worse_than_nearest
from qgs.metrics.dispersion import Dispersion, token_dispersion
from qgs.metrics.images import psnr, ssim
from qgs.types import Views


def pair(noise, size=(24, 37)):
    truth = torch.nn.functional.interpolate(torch.rand(2, 3, 6, 8), size, mode="bilinear")
    return truth + noise * torch.randn(truth.shape), truth


def test_ssim_equals_scikit_image():
    sizes = ((11, 11), (11, 40), (13, 17), (64, 33))
    options = {"channel_axis": 0, "data_range": 1.0, "gaussian_weights": True, "sigma": 1.5}
    for covariance in ("population", "sample"):
        options["use_sample_covariance"] = covariance == "sample"
        for images, truth in (*map(pair, (0.02, 0.2, 1.0)), *(pair(0.1, size) for size in sizes)):
            expected = [
                structural_similarity(a.clamp(0, 1).double().numpy(), b.double().numpy(), **options)
                for a, b in zip(images, truth, strict=True)
            ]
            found = ssim(images, truth, covariance).double()
            assert_equal(found, torch.tensor(expected), atol=1e-6)
    must_refuse("at least 11 pixels a side, got 10 x 20", ssim, *pair(0.1, (10, 20)))


def test_psnr_is_that_of_clipped_images():
    for noise in (0.02, 1.0):
        images, truth = pair(noise)
        errors = (images.clamp(0, 1) - truth).square().mean((1, 2, 3))
        assert_close(psnr(images, truth), -10 * errors.log10())


def test_identical_images_with_leading_dimensions():
    truth = pair(0.0)[1][:, None].expand(-1, 4, -1, -1, -1)
    assert_close(ssim(truth, truth), torch.ones(2, 4))
    assert_close(psnr(truth, truth), torch.full((2, 4), 100.0))


def cameras(x, turn=(0.0,)):
    """Cameras along the x axis, turned by radians about y."""
    c2w = along_x(x)
    c2w[: len(turn), :3, :3] = torch.tensor(Rotation.from_euler("y", np.c_[turn]).as_matrix())
    return pinhole(c2w, size=(8, 8))[None]


def views(x, turn=(0.0,)):
    return Views(torch.rand(1, len(x), 3, 8, 8), cameras(x, turn))


def test_the_nearest_view_is_copied_whatever_the_scale_of_the_scene():
    for inputs, targets, nearest in (
        (views([0, 1, 3.0]), cameras([2.7, 0.1, 1.4]), [2, 0, 1]),
        (views([0, 0, 0.0], [1.5, -1.5, 0.1]), cameras([0, 0.0], [0, -1.2]), [2, 1]),
        (views([0, 0.01], [0.3, 0]), cameras([0.004]), [1]),
        (views([0, 100.0], [0.3, 0]), cameras([40.0]), [1]),
    ):
        assert torch.equal(nearest_input(inputs, targets), inputs.images[:, nearest]), targets


def test_each_scene_has_its_own_views_and_mean_colour():
    both = stack_views([views([0, 1.0]), views([1.0, 0])])
    targets = both.cameras[[0, 0], :1]
    expected = torch.stack([both.images[0, :1], both.images[1, 1:]])
    assert_equal(nearest_input(both, targets), expected)
    mean = both.images.mean((1, 3, 4))[:, None, :, None, None]
    assert_close(mean_colour(both, targets), mean.expand(2, 1, 3, 8, 8))


FIGURES = """
- [higher, 14.457, 14.463, false]
- [higher, 14.454, 14.463, true]
- [lower, 0.31, 0.30, true]
- [lower, 0.304, 0.301, false]
- [higher, 15.0, null, false]
"""
"""Which is better, the model's figure, the nearest photo's, and whether it is remarked on."""


def test_a_model_is_worse_only_where_the_shown_figures_differ():
    for better, model, nearest, remarked in yaml.safe_load(FIGURES):
        text = worse_than_nearest(Column("score", better, 2), model, nearest, "try this")
        assert ("try this" in text) == bool(text) == remarked, (model, nearest)


def test_distances_to_the_centroid_of_each_token():
    means = torch.randn(2, 5 * 4, 3)
    tokens = [token - token.mean(0) for scene in means for token in scene.split(4)]
    expected = torch.cat([token.norm(dim=1) for token in tokens]).view(2, 20)
    assert_close(token_dispersion(means, 4), expected)
    must_refuse("20 Gaussians", token_dispersion, means, 6)
    for scene, distances in zip(means, expected, strict=True):
        scene = scene[None]
        given = MetricInput(scene, None, SimpleNamespace(means=scene), 4)
        found = Dispersion(Dispersion.Config())(given)
        assert_near(found["mean"].mean(), distances.mean())
        assert_near(found["median"], np.median(distances))

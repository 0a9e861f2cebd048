from itertools import product

import numpy as np
import torch
from numpy.testing import assert_allclose
from qgs_viewer.placement import Placement, Splats, hit, on_photo, splats
from scipy.spatial.transform import Rotation
from small import cloud
from walk import arc, pinhole

from qgs.renderers.reference import TorchRenderer

AHEAD = np.array([0.0, 0.0, 1.0])


def test_covariances_are_those_of_points_that_were_placed_one_by_one():
    gaussians = cloud(5)
    turn = torch.from_numpy(Rotation.from_euler("xyz", [0.3, -0.8, 1.1]).as_matrix())
    place = Placement(turn, torch.tensor([1.0, -2.0, 0.5]).double(), 1.7)
    found = splats(gaussians, place)
    for g, turn in enumerate(Rotation.from_quat(gaussians.quats[0], scalar_first=True).as_matrix()):
        axes = turn * gaussians.scales[0, g].numpy()  # one standard deviation along each
        ends = place.points(gaussians.means[0, g] + torch.from_numpy(axes.T)).numpy()
        arms = ends - found.centers[g]
        assert_allclose(arms.T @ arms, found.covariances[g], rtol=1e-4, atol=1e-6)


def test_a_click_hits_what_the_renderer_shows_there():
    """Where one Gaussian stands out: two approximations of a splat may order similar ones."""
    view = pinhole(arc([0], 4), (60.0, 55.0, 30.0, 35.0))
    scene = cloud(60).to(torch.float64)
    scene.colors.requires_grad_()
    picture = TorchRenderer(TorchRenderer.Config())(scene, view[None], torch.zeros(3).double())
    found = splats(cloud(60), Placement.identity())
    eye = view.c2w[0, :3, 3].numpy()
    checked = 0
    for v, u in product(range(8, 60, 6), repeat=2):
        pixel = picture.rgb[0, 0, :, v, u].sum()
        (weights,) = torch.autograd.grad(pixel, scene.colors, retain_graph=True)
        (first, second), numbers = weights[0, :, 0].topk(2)
        if first > 0.05 and second < 0.6 * first:
            way = on_photo(view, torch.tensor([[u + 0.5, v + 0.5]]), 1.0)[0, 0].numpy() - eye
            assert hit(found, eye, way / np.linalg.norm(way)) == numbers[0]
            checked += 1
    assert checked > 20
    assert hit(found, np.array([9.0, 0, 0]), AHEAD) is None


def test_small_gaussians_beside_large_ones_survive_half_precision():
    sizes = np.array([2.0, 2e-4])
    covariances = sizes[:, None, None] ** 2 * np.eye(3)
    factor = Splats(None, covariances, None, None).magnification
    sent = (covariances * factor**2).astype(np.float16).astype(np.float64)
    assert_allclose(np.sqrt(sent[:, 0, 0]) / factor, sizes, rtol=1e-3)

from itertools import product

import numpy as np
import torch
from numpy.testing import assert_allclose
from qgs_viewer import queries
from qgs_viewer.look import CATEGORICAL
from qgs_viewer.placement import hit, on_photo, splats
from renderers.scenes import make_scene
from scipy.spatial.transform import Rotation
from tables import assert_equal, assert_near
from walk import arc, cloud, pinhole

from qgs.drawing.images import NOTHING, finer
from qgs.geometry.transforms import moved, to_camera, to_pixels
from qgs.renderers.reference import TorchRenderer
from qgs.types import SpatialSupport


def test_an_outline_touches_the_outermost_of_the_projected_surface_points(cameras):
    camera = cameras[:, 1:]
    centers = torch.rand(1, 5, 3) + torch.tensor([-0.5, -0.5, 1.0])
    support = SpatialSupport(centers, 0.15 * torch.randn(1, 5, 3, 3))
    angles = torch.linspace(0, 2 * torch.pi, 64)
    directions = torch.stack([angles.cos(), angles.sin()])
    for query in range(5):
        ball = torch.nn.functional.normalize(torch.randn(20000, 3), dim=-1)
        surface = centers[0, query] + ball @ support.axes[0, query].mT
        pixels = to_pixels(to_camera(surface[None], camera)[0, 0], camera.intrinsics[0, 0])
        reach = (queries.outline(support, query, camera) @ directions).amax(0)
        size = reach + reach.roll(32)
        assert_equal((pixels @ directions).amax(0), reach, atol=0.02 * size.max())


def test_a_centre_is_drawn_where_it_lies_though_its_support_reaches_behind_the_camera(cameras):
    photo = np.full((128, 128, 3), 255, np.uint8)  # of 32 pixels, focal length 32
    support = SpatialSupport(torch.tensor([[[0.1, 0.0, 0.5]]]), torch.eye(3)[None, None])
    drawn = queries.support_picture(photo, support, cameras[:, :1], {0: CATEGORICAL[0]})
    places = np.argwhere(drawn[..., 0] != drawn[0, 0, 0])
    assert_allclose(places.mean(0), (63.5, 89.1), 0, 1)


def test_notable_queries_are_heavy_well_inside_the_picture_apart_and_small(model, cameras):
    """Query 5 is heavy at the border; 6 covers the view from behind, so it comes last."""
    u = torch.tensor([0.2, 0.21, 0.8, 0.2, 0.8, 0.1, 0.5])
    v = torch.tensor([0.2, 0.2, 0.2, 0.8, 0.8, 0.5, 0.5])
    depths = torch.tensor([1.5] * 6 + [2.5])
    sizes = torch.tensor([0.05] * 5 + [0.2, 2.0]).repeat_interleave(4)
    centers = torch.stack([(u - 0.5) * depths, (v - 0.5) * depths, depths], 1)
    means = centers.repeat_interleave(4, 0) + 0.01 * torch.randn(28, 3)
    scales = sizes[None, :, None].expand(1, 28, 3)
    scene = cloud(28).replace(means=means[None], scales=scales, opacities=torch.full((1, 28), 0.8))
    weights = queries.rendered_weights(model, scene, cameras).view(7, 4).sum(1)
    assert weights[5:].min() > weights[:5].max()
    drawn = queries.notable_queries(model, scene, cameras, 5)
    first, *others = (query.index for query in drawn)
    assert first == weights[:5].argmax()
    assert {first, *others} - {0, 1} == {2, 3, 4, 6}
    assert others[3] == 6
    own = means.view(7, 4, 3)[others[0]]
    assert_near(drawn[1].dispersion, (own - own.mean(0)).norm(dim=-1).mean())
    assert len(queries.notable_queries(model, scene, cameras, 7)) == 7


def test_a_query_picture_is_grey_but_for_its_queries(model, cameras):
    gaussians, _ = make_scene(count=48)
    camera = finer(cameras[:, :1], 64)
    drawn, none = (
        np.ptp(queries.query_picture(model, gaussians, some, camera).astype(int), axis=-1)
        for some in (queries.notable_queries(model, gaussians, camera, 1), [])
    )
    assert drawn.shape == (64, 64)
    assert 0 < (drawn > 60).mean() < 0.6
    assert not none.any()


def test_attention_maps_share_one_scale_and_show_what_a_mask_hides_as_nothing():
    first_head = [0.0, 1, 0, -torch.inf, 0, 3, -torch.inf, 0]
    scores = torch.tensor([first_head, [0, 1, 0, -torch.inf, 0, 1, 2, 0]])
    maps = queries.patch_maps(scores, (2, 2, 2))
    np.testing.assert_array_equal(maps, [[[0, 1], [0, np.nan]], [[0, 2], [2, 0]]])
    white = [np.full((16, 16, 3), 255, np.uint8)] * 2
    assert queries.washed(white[0] // 2).mean() > 128
    with np.errstate(all="raise"):
        pictures = np.stack(queries.attention_pictures(white, maps))
        nothing = np.stack(queries.attention_pictures(white, np.full_like(maps, np.nan)))
    assert (pictures[0, 8:, 8:] == NOTHING).all()
    assert (nothing == NOTHING).all()
    colors = np.ptp(pictures.astype(int), axis=-1)[:, ::8, ::8].ravel()
    assert colors[[5, 6]].min() > 100 > colors[1] > 0
    assert not colors[[0, 2, 4, 7]].any()


def test_covariances_are_those_of_points_that_were_placed_one_by_one():
    gaussians = cloud(5)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.8, 1.1]).as_matrix()
    pose[:3, 3] = [1.0, -2.0, 0.5]
    found = splats(moved(gaussians, torch.from_numpy(pose), 1.7))
    for g, turn in enumerate(Rotation.from_quat(gaussians.quats[0], scalar_first=True).as_matrix()):
        axes = turn * gaussians.scales[0, g].numpy()  # one standard deviation along each
        ends = gaussians.means[0, g].numpy() + axes.T
        ends = 1.7 * ends @ pose[:3, :3].T + pose[:3, 3]
        arms = ends - found.centers[g]
        assert_allclose(arms.T @ arms, found.covariances[g], rtol=1e-4, atol=1e-6)


def test_a_click_hits_what_the_renderer_shows_there():
    """Where one Gaussian stands out: two approximations of a splat may order similar ones."""
    view = pinhole(arc([0], 4), (120.0, 110.0, 30.0, 35.0))
    scene = cloud(60).to(torch.float64)
    scene.colors.requires_grad_()
    picture = TorchRenderer(TorchRenderer.Config())(scene, view[None], torch.zeros(3).double())
    found = splats(cloud(60))
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
    assert hit(found, np.array([9.0, 0, 0]), np.array([0.0, 0, 1])) is None

from dataclasses import replace

import numpy as np
import pytest
import torch
from qgs_viewer.curves import Curves, curves_figure
from qgs_viewer.queries import (
    attention_pictures,
    notable_queries,
    patch_maps,
    project_support,
    query_picture,
    rendered_weights,
    support_picture,
    washed,
)

from qgs.drawing.figures import CATEGORICAL
from qgs.drawing.images import NOTHING, depth_picture, depth_range, enlarged, finer, rgb_picture
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.types import SpatialSupport


def ellipsoids(count: int = 5) -> SpatialSupport:
    generator = torch.Generator().manual_seed(3)
    centers = torch.rand(1, count, 3, generator=generator) - 0.5
    axes = torch.linalg.qr(torch.randn(1, count, 3, 3, generator=generator)).Q
    lengths = 0.05 + 0.3 * torch.rand(1, count, 1, 3, generator=generator)
    return SpatialSupport(centers + torch.tensor([0.0, 0.0, 1.5]), axes * lengths)


def test_outlines_hold_every_projected_surface_point_and_touch_the_outermost(cameras):
    support = ellipsoids()
    camera = cameras[:, 1:]
    ellipses = project_support(support, camera)
    assert ellipses.whole.all()
    sphere = torch.nn.functional.normalize(torch.randn(20000, 3), dim=-1)
    for index in range(5):
        surface = support.centers[0, index] + sphere @ support.axes[0, index].T
        in_camera = to_camera(surface[None], camera)[0, 0]
        pixels = to_pixels(in_camera, camera.intrinsics[0, 0])
        local = torch.linalg.solve(ellipses.axes[index], (pixels - ellipses.centers[index]).T).norm(
            dim=0
        )
        assert local.max() < 1 + 1e-3
        assert local.max() > 0.99


def test_supports_around_or_behind_the_camera_have_no_outline(cameras):
    centers = torch.tensor([[[0.0, 0.0, 0.1], [0.0, 0.0, -2.0], [0.0, 0.0, 2.0]]])
    axes = (torch.eye(3) * 0.5).expand(1, 3, 3, 3)
    ellipses = project_support(SpatialSupport(centers, axes), cameras[:, :1])
    assert ellipses.whole.tolist() == [False, False, True]
    assert ellipses.axes.isfinite().all()
    assert ellipses.points.isfinite().all()


def test_a_centre_is_drawn_where_it_lies_though_its_support_reaches_behind_the_camera(cameras):
    photo = np.full((128, 128, 3), 255, np.uint8)
    lens, camera = cameras.intrinsics[0, 0], cameras[:, :1]
    center = camera.c2w[0, 0, :3, :3] @ torch.tensor([0.1, 0.0, 0.5]) + camera.c2w[0, 0, :3, 3]
    support = SpatialSupport(center[None, None], torch.eye(3)[None, None])
    drawn = support_picture(photo, support, camera, {0: CATEGORICAL[0]})
    rows, columns = np.nonzero((drawn.astype(int) - drawn[0, 0] != 0).any(-1))
    scale = 128 / camera.size[1]
    assert abs(columns.mean() + 0.5 - scale * (lens[0] * 0.2 + lens[2]).item()) < 1
    assert abs(rows.mean() + 0.5 - scale * lens[3].item()) < 1


def test_rendered_weights_add_up_to_the_coverage(model, gaussians, cameras):
    weights = rendered_weights(model, gaussians, cameras)
    alpha = model.render(gaussians, cameras).alpha
    assert weights.shape == (1, gaussians.count)
    torch.testing.assert_close(weights.sum(), alpha.sum(), rtol=1e-4, atol=1e-3)


def test_notable_queries_are_heavy_well_inside_the_picture_and_apart(model, gaussians, cameras):
    queries = model.queries.count
    places = torch.zeros(queries, 2)
    inside = [[0.2, 0.2], [0.21, 0.2], [0.8, 0.2], [0.2, 0.8], [0.8, 0.8]]
    places[:6] = torch.tensor([*inside, [0.1, 0.5]])  # the last one is the heaviest
    sizes, faint = torch.ones(queries), torch.ones(queries)
    sizes[5], faint[6:] = 4.0, 0.01
    means = torch.cat([(places - 0.5) * 1.5, torch.full((queries, 1), 1.5)], -1)
    placed = replace(
        gaussians,
        means=(means.repeat_interleave(4, 0) + 0.01 * torch.randn(queries * 4, 3))[None],
        scales=gaussians.scales * sizes.repeat_interleave(4)[None, :, None],
        opacities=gaussians.opacities * faint.repeat_interleave(4),
    )
    drawn = notable_queries(model, placed, cameras, 4)
    weights = rendered_weights(model, placed, cameras).view(queries, -1).sum(1)
    assert int(weights.argmax()) == 5
    indices = [query.index for query in drawn]
    assert sorted(indices)[1:] == [2, 3, 4]
    assert min(indices) in (0, 1)
    assert indices[0] == int(weights[:5].argmax())
    means = placed.means.view(queries, -1, 3)[indices[1]]
    assert drawn[1].dispersion == pytest.approx(float((means - means.mean(0)).norm(dim=-1).mean()))
    assert len({query.index for query in notable_queries(model, placed, cameras, 12)}) == 12


def test_queries_that_cover_the_view_come_last(model, gaussians, cameras):
    queries = model.queries.count
    places = torch.full((queries, 2), 3.0)
    places[:4] = torch.tensor([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.5, 0.5]])
    means = torch.cat([(places - 0.5) * 1.5, torch.full((queries, 1), 1.5)], -1)
    scales = torch.full((1, queries * 4, 3), 0.02)
    scales[:, 12:16] = 1.0  # query 3 covers the view
    placed = replace(gaussians, means=means.repeat_interleave(4, 0)[None], scales=scales)
    weights = rendered_weights(model, placed, cameras[:, :1]).view(queries, -1).sum(1)
    assert int(weights.argmax()) == 3
    drawn = [query.index for query in notable_queries(model, placed, cameras[:, :1], 4)]
    assert (sorted(drawn[:3]), drawn[3]) == ([0, 1, 2], 3)


def test_a_query_picture_is_grey_but_for_its_queries(model, gaussians, cameras):
    camera = finer(cameras[:, :1], 64)
    chosen = notable_queries(model, gaussians, camera, 1)
    picture = query_picture(model, gaussians, chosen, camera).astype(int)
    colored = np.ptp(picture, axis=-1) > 60
    assert picture.shape == (64, 64, 3)
    assert 0 < colored.mean() < 0.6
    none = query_picture(model, gaussians, [], camera)
    assert np.ptp(none.astype(int), axis=-1).max() == 0


def test_depth_pictures_share_a_scale_and_show_where_nothing_is():
    depth = torch.tensor([[[0.0, 1.0], [2.0, 3.0]]])
    assert depth_range(depth)[0] == pytest.approx(1.0, abs=0.1)
    picture = depth_picture(depth, 1.0, 3.0)
    assert tuple(picture[0, 0]) == NOTHING
    brightness = picture.sum(-1)
    assert brightness[0, 1] > brightness[1, 0] > brightness[1, 1]
    assert depth_range(torch.zeros(1, 2, 2)) == (0.0, 1.0)


def test_pictures_keep_their_pixels():
    image = torch.rand(3, 4, 6)
    picture = rgb_picture(image)
    np.testing.assert_allclose(picture / 255, image.permute(1, 2, 0), atol=0.51 / 255)
    assert enlarged(picture, 24).shape == (16, 24, 3)
    flat = np.full((4, 6, 3), 90, np.uint8)
    assert (enlarged(flat, 24) == 90).all()
    assert washed(picture).mean() > picture.mean()


def test_attention_maps_share_one_scale_over_the_views():
    scores = torch.zeros(8)
    scores[5] = 1.0
    maps = patch_maps(scores[None], (2, 2, 2))
    assert maps[1, 0, 1] == 1
    white = [np.full((16, 16, 3), 255, np.uint8)] * 2
    first, second = attention_pictures(white, maps)
    assert np.ptp(first.reshape(-1, 3), axis=0).max() == 0
    color = np.ptp(second.astype(int), axis=-1)
    assert color[:8, 8:].min() > 100
    assert color[8:].max() == color[:8, :8].max() == 0


def test_what_a_mask_hides_has_the_colour_of_nothing_and_no_part_in_the_scale():
    scores = torch.tensor([[0.0, 1.0, -torch.inf, -torch.inf], [0.0, 3.0, 2.0, -torch.inf]])
    maps = patch_maps(scores, (1, 2, 2))
    np.testing.assert_array_equal(maps[0], [[0, 2], [2, np.nan]])
    black = [np.zeros((4, 4, 3), np.uint8)]
    with np.errstate(all="raise"):
        (picture,) = attention_pictures(black, maps)
        (plain,) = attention_pictures(black, np.nan_to_num(maps))
        (none,) = attention_pictures(black, np.full_like(maps, np.nan))
    assert (picture[:, :2] == plain[:, :2]).all()
    assert (picture[2:, 2:] == NOTHING).all()
    assert (none == picture[3, 3]).all()


def test_curves_of_hours_which_may_hold_pauses_are_drawn_by_steps():
    run = Curves([0.0, 1.0, 7000.0], [1.0, 0.5, 0.4], [8.0, 12.0, 13.0], [100, 200, 300])
    paused = replace(run, seconds=[0.0, 1.0, 9000.0])
    for curves, place, unit in (
        ({"a": run}, run.seconds, "seconds"),
        ({"a": run, "b": paused}, run.steps, "steps"),
    ):
        for axis in curves_figure(curves).axes:
            assert axis.get_xlabel() == unit
            assert all(list(line.get_xdata()) == list(place) for line in axis.lines)

"""What rooms and worlds have in common, as both are drawn from a seed."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from qgs_viewer.curves import curves_of
from qgs_worlds.caster.intervals import clearances
from qgs_worlds.rooms.source import RoomScene, RoomsSource
from qgs_worlds.worlds.source import WorldsSource
from tables import assert_equal
from walk import assert_rigid

from qgs.checkpoint.models import checkpoint_path
from qgs.geometry.rays import pixel_directions
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.types import Views

SIZE = 16, 24


@pytest.fixture(params=[RoomsSource, WorldsSource])
def source(request):
    """Makes one with these options."""
    kind = request.param
    return lambda **options: kind(kind.Config(**{"image_size": SIZE, **options}))


def test_a_scene_is_a_function_of_seed_split_and_index(source):
    first = source().scenes("train")[7]
    again = source(scenes=9, cache_mb=0).scenes("train")[7]
    assert_equal(first.images([3, 1]), again.images([3, 1]))
    assert_equal(first.images([1]), first.images([3, 1])[1:])
    for other in (source().scenes("test")[7], source(seed=1).scenes("train")[7]):
        assert not torch.equal(first.images([1]), other.images([1]))


def test_cameras_are_rigid_and_keep_clear_of_every_surface(source):
    for scene in source().scenes("train")[:50]:
        if isinstance(scene, RoomScene):
            shapes = scene.tables.shapes[1:]
            c2w = scene.cameras.c2w.double().numpy()
            assert (np.array(scene.size[:2]) / 2 - abs(c2w[:, :2, 3])).min() > 0.2
        else:
            shapes = scene.drawn.world.shapes
            c2w = scene.drawn.rig.c2w
        assert_rigid(c2w)
        assert clearances(shapes, c2w[:, :3, 3]).min() > 0.15
        assert c2w[:, 2, 1].max() < 0, "the image's y axis points down"


@pytest.mark.parametrize("size", [(17, 33), (130, 5)])
def test_images_have_any_size_and_do_not_depend_on_threads(source, size, monkeypatch):
    def drawn(threads):
        monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
        scene = source(image_size=size).scenes("test")[0]
        return scene.images([0, 5]), scene.depths([0, 5])

    images, depths = drawn(1)
    assert images.shape == (2, 3, *size)
    assert depths.shape == (2, 1, *size)
    assert 0 <= depths.min() < depths.max() < torch.inf
    assert 0 <= images.min() < images.max() <= 1
    assert_equal(drawn(3), (images, depths))


def test_more_samples_change_edges_only(source):
    coarse, fine = (source(samples=n).scenes("train")[0].images([0]) for n in (1, 4))
    assert 0 < (coarse - fine).abs().mean() < 0.08


def test_slices_and_range(source):
    scenes = source(scenes=5).scenes("train")
    assert [scene.name for scene in scenes[3:]] == ["train/000003", "train/000004"]
    with pytest.raises(IndexError):
        scenes[5]


def test_colours_reproject_through_depth():
    """Where depth says that two cameras see one point."""
    size = (96, 96)
    scene = RoomsSource(RoomsSource.Config(image_size=size)).scenes("train")[1]
    frames = [2, 4]
    views = Views(scene.images(frames)[None], scene.cameras[frames][None])
    depths = scene.depths(frames)
    assert depths.min() > 0  # a room is closed
    first, second = views.images[0]
    one, other = views.cameras[0].intrinsics
    points = (pixel_directions(one, size) * depths[0, 0, ..., None]).flatten(0, 1)
    c2w = views.cameras.c2w[0, 0]
    local = to_camera((points @ c2w[:3, :3].T + c2w[:3, 3])[None], views.cameras)[0, 1]
    grid = (to_pixels(local, other) / 48 - 1).view(1, *size, 2)
    *seen, depth = F.grid_sample(torch.cat([second, depths[1]])[None], grid, align_corners=False)[0]
    z = local[:, 2].view(size)
    agrees = (grid[0].abs() < 0.95).all(-1) & (z > 0) & ((depth - z).abs() < 0.02)
    assert agrees.float().mean() > 0.3
    aligned, unaligned = (
        (colours - first).abs().mean(0)[agrees].mean() for colours in (torch.stack(seen), second)
    )
    assert aligned < 0.05
    assert aligned < 0.5 * unaligned


def test_models_come_with_their_training_curves():
    for name in ("locus-64", "tokengs-64"):
        curves = curves_of(checkpoint_path(f"rooms/{name}"))
        assert [record["step"] for record in curves] == list(range(100, 40_001, 100))
        assert curves[0]["psnr"] + 5 < curves[-1]["psnr"]

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from pydantic import ValidationError
from qgs_rooms.source import RoomsSource
from qgs_viewer.curves import curves_of

from qgs.data.samples import mirrored_views
from qgs.geometry.rays import pixel_directions
from qgs.io.models import checkpoint_path
from qgs.types import Cameras, Views


def source(**options) -> RoomsSource:
    return RoomsSource(RoomsSource.Config(**{"image_size": (32, 48), **options}))


def warped(views: Views, depths: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """View 1's colours seen at view 0's pixels, and where depth says that both see one point."""
    cameras = views.cameras[0]
    height, width = cameras.size
    points = pixel_directions(cameras.intrinsics[0], cameras.size) * depths[0, 0, ..., None]
    world = points @ cameras.c2w[0, :3, :3].T + cameras.c2w[0, :3, 3]
    local = world @ cameras.w2c[1, :3, :3].T + cameras.w2c[1, :3, 3]
    fx, fy, cx, cy = cameras.intrinsics[1]
    u = (fx * local[..., 0] / local[..., 2] + cx) / width * 2 - 1
    v = (fy * local[..., 1] / local[..., 2] + cy) / height * 2 - 1
    grid = torch.stack([u, v], -1)[None]
    stack = torch.cat([views.images[0, 1], depths[1]])[None]
    seen = F.grid_sample(stack, grid, align_corners=False)[0]
    inside = (grid[0].abs() < 0.95).all(-1) & (local[..., 2] > 0)
    return seen[:3], inside & ((seen[3] - local[..., 2]).abs() < 0.02)


def pair(scene, frames=(2, 4)) -> tuple[Views, torch.Tensor]:
    cameras = scene.cameras[list(frames)]
    views = Views(
        scene.images(frames)[None],
        Cameras(cameras.c2w[None], cameras.intrinsics[None], cameras.size),
    )
    return views, scene.depths(frames)


@pytest.mark.parametrize("mirror", [False, True])
def test_colours_reproject_through_depth(mirror):
    scene = source(image_size=(96, 96)).scenes("train")[1]
    views, depths = pair(scene)
    if mirror:
        views, depths = mirrored_views(views), depths.flip(-1)
    seen, agrees = warped(views, depths)
    assert agrees.float().mean() > 0.3
    aligned = (seen - views.images[0, 0]).abs().mean(0)[agrees].mean()
    unaligned = (views.images[0, 1] - views.images[0, 0]).abs().mean(0)[agrees].mean()
    assert aligned < 0.05
    assert aligned < 0.5 * unaligned


def test_a_room_is_a_function_of_seed_split_and_index():
    first, again = source().scenes("train")[7], source(scenes=9, cache_mb=0).scenes("train")[7]
    assert torch.equal(first.images([3, 1]), again.images([3, 1]))
    assert torch.equal(first.images([3, 1]), first.images([3, 1]))
    for other in (source().scenes("test")[7], source(seed=1).scenes("train")[7]):
        assert not torch.equal(first.images([1]), other.images([1]))


@pytest.mark.parametrize("size", [(17, 33), (130, 5)])
def test_any_size(size):
    scene = source(image_size=size).scenes("test")[0]
    images, depths = scene.images([0, 5]), scene.depths([0, 5])
    assert images.shape == (2, 3, *size)
    assert depths.shape == (2, 1, *size)
    assert depths.min() > 0
    assert 0 <= images.min() < images.max() <= 1


def test_poses_are_rigid_and_level_and_inside_the_room():
    for index in range(20):
        scene = source().scenes("train")[index]
        rotation = scene.cameras.c2w[:, :3, :3]
        identity = torch.eye(3).expand_as(rotation)
        torch.testing.assert_close(rotation @ rotation.mT, identity, atol=1e-5, rtol=0)
        assert torch.linalg.det(rotation).min() > 0.99
        assert rotation[:, 2, 1].max() < 0, "the image's y axis points down"
        reach = torch.tensor(scene.size[:2]) / 2 - scene.cameras.c2w[:, :2, 3].abs()
        assert reach.min() > 0.2


def distances(shapes: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    """Metres (F, S) from points to the boxes around shapes, 0 inside."""
    offset = eyes[:, None] - shapes[None, :, 1:4]
    cos, sin = shapes[:, 7], shapes[:, 8]
    along = cos * offset[..., 0] + sin * offset[..., 1]
    across = cos * offset[..., 1] - sin * offset[..., 0]
    local = np.stack([along, across, offset[..., 2]], -1)
    return np.linalg.norm(np.maximum(np.abs(local) - shapes[:, 4:7], 0), axis=-1)


def test_cameras_keep_clear_of_every_surface():
    for index in range(60):
        scene = source().scenes("train")[index]
        assert distances(scene.room.shapes, scene.cameras.c2w[:, :3, 3].numpy()).min() > 0.2


def test_more_samples_change_edges_only():
    coarse = source(samples=1).scenes("train")[0].images([0])
    fine = source(samples=4).scenes("train")[0].images([0])
    assert 0 < (coarse - fine).abs().mean() < 0.08


@pytest.mark.parametrize("wrong", [{"fov": (80.0, 60.0)}, {"scenes": 0}, {"rooms": 3}])
def test_wrong_options_are_refused(wrong):
    with pytest.raises(ValidationError):
        source(**wrong)


def test_slices_and_range():
    scenes = source(scenes=5).scenes("train")
    assert [scene.name for scene in scenes[3:]] == ["train/000003", "train/000004"]
    with pytest.raises(IndexError):
        scenes[5]


@pytest.mark.parametrize("name", ["locus-64", "tokengs-64"])
def test_models_come_with_their_training_curves(name):
    file = checkpoint_path(f"rooms/{name}")
    curves = curves_of(file)
    assert curves is not None
    assert list(curves.steps) == list(range(100, 40_001, 100))
    assert curves.psnr[0] + 5 < curves.psnr[-1]
    assert file.with_suffix(".history.jsonl").stat().st_size < 60_000

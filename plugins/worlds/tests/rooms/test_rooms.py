import pytest
import torch
import torch.nn.functional as F
from qgs_viewer.curves import curves_of
from qgs_worlds.rooms.source import RoomsSource

from qgs.checkpoint.models import checkpoint_path
from qgs.data.samples import mirrored_views
from qgs.geometry.rays import pixel_directions
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.types import Views


def scenes(size=(16, 24)):
    return RoomsSource(RoomsSource.Config(image_size=size)).scenes("train")


@pytest.mark.parametrize("mirror", [False, True])
def test_colours_reproject_through_depth(mirror):
    """Where depth says that two cameras see one point."""
    scene = scenes((96, 96))[1]
    frames = [2, 4]
    size = (96, 96)
    views = Views(scene.images(frames)[None], scene.cameras[frames][None])
    depths = scene.depths(frames)
    assert depths.min() > 0  # a room is closed
    if mirror:
        views = mirrored_views(views)
        depths = depths.flip(-1)
    (first, second) = views.images[0]
    (one, other) = views.cameras[0].intrinsics
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


@pytest.mark.parametrize("name", ["locus-64", "tokengs-64"])
def test_models_come_with_their_training_curves(name):
    curves = curves_of(checkpoint_path(f"rooms/{name}"))
    assert [record["step"] for record in curves] == list(range(100, 40_001, 100))
    assert curves[0]["psnr"] + 5 < curves[-1]["psnr"]

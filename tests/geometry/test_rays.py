import torch
from renderers.scenes import make_scene
from torch.testing import assert_close

from qgs.geometry.rays import camera_centers, patch_rays, plucker_rays


def test_the_rays_of_a_memory_meet_at_the_centres_of_its_cameras():
    _, cameras = make_scene(2, 3, 5, dtype=torch.float64)
    height, width = cameras.size
    rays = patch_rays(plucker_rays(cameras), 4)
    centers = camera_centers(rays, (3, height // 4, width // 4))
    assert_close(centers, cameras.c2w[..., :3, 3])

import numpy as np
import torch
from qgs_viewer.placement import (
    Placement,
    Splats,
    hit,
    near_ray,
    on_photo,
    splats,
)
from scipy.spatial.transform import Rotation

from qgs.geometry.transforms import to_camera, to_pixels
from qgs.renderers.reference import TorchRenderer
from qgs.types import Cameras, Gaussians

AHEAD = np.array([0.0, 0.0, 1.0])


def cloud(count: int, size: float = 0.08) -> Gaussians:
    make = torch.manual_seed(3)
    means = torch.rand(1, count, 3, generator=make) * 2 - 1 + torch.tensor([0.0, 0.0, 4.0])
    quats = torch.nn.functional.normalize(torch.randn(1, count, 4, generator=make), dim=-1)
    scales = size * (0.5 + torch.rand(1, count, 3, generator=make))
    others = torch.rand(1, count, generator=make) * 0.7 + 0.2, torch.rand(1, count, 3)
    return Gaussians(means, scales, quats, *others)


def a_placement() -> Placement:
    turn = torch.from_numpy(Rotation.from_euler("xyz", [0.3, -0.8, 1.1]).as_matrix())
    return Placement(turn, torch.tensor([1.0, -2.0, 0.5]).double(), 1.7)


def camera() -> Cameras:
    lens = torch.tensor([60.0, 55.0, 30.0, 35.0]).double()
    return Cameras(torch.eye(4).double()[None], lens[None], (64, 64))


def test_covariances_are_those_of_points_that_were_placed_one_by_one() -> None:
    gaussians, place = cloud(5), a_placement()
    found = splats(gaussians, place)
    turns = Rotation.from_quat(gaussians.quats[0].numpy()[:, [1, 2, 3, 0]]).as_matrix()
    for g in range(5):
        axes = turns[g] * gaussians.scales[0, g].numpy()  # one standard deviation along each
        ends = place.points(gaussians.means[0, g] + torch.from_numpy(axes.T)).numpy()
        arms = ends - found.centers[g]
        np.testing.assert_allclose(arms.T @ arms, found.covariances[g], rtol=1e-4, atol=1e-6)


def test_two_worlds_of_one_scene_place_a_point_alike() -> None:
    poses = [torch.eye(4).double(), torch.eye(4).double()]
    for pose, angle in zip(poses, (0.2, 0.9), strict=True):
        pose[:3, :3] = torch.from_numpy(Rotation.from_euler("y", angle).as_matrix())
        pose[:3, 3] = torch.tensor([angle, 1.0, 2 * angle])
    worlds = [(pose, torch.tensor(scale)) for pose, scale in zip(poses, (0.4, 0.7), strict=True)]
    point = torch.tensor([0.3, -0.5, 2.0]).double()
    inside = [scale * (torch.linalg.inv(pose) @ torch.cat([point, torch.ones(1).double()]))[:3]
              for pose, scale in worlds]  # fmt: skip
    placed = Placement.between(worlds[0], worlds[1]).points(inside[0])
    torch.testing.assert_close(placed, inside[1])


def test_a_click_hits_what_the_renderer_shows_there() -> None:
    gaussians, view = cloud(60), camera()
    colors = gaussians.colors.double().requires_grad_()
    doubles = gaussians.to(torch.float64)
    scene = Gaussians(doubles.means, doubles.scales, doubles.quats, doubles.opacities, colors)
    picture = TorchRenderer(TorchRenderer.Config())(scene, view[None], torch.zeros(3).double())
    found, checked = splats(gaussians, Placement.identity()), 0
    for v, u in [(v, u) for v in range(8, 60, 6) for u in range(8, 60, 6)]:
        pixel = picture.rgb[0, 0, :, v, u].sum()
        (weights,) = torch.autograd.grad(pixel, colors, retain_graph=True)
        first, second = weights[0, :, 0].topk(2).values.tolist()
        if first < 0.05 or second > 0.6 * first:
            continue  # the two approximations of one splat may order these two otherwise
        point = on_photo(view, torch.tensor([[u + 0.5, v + 0.5]]).double(), 1.0)[0, 0].numpy()
        assert hit(found, np.zeros(3), point / np.linalg.norm(point)) == int(
            weights[0, :, 0].argmax()
        )
        checked += 1
    assert checked > 20


def two(opacity: float, depth: float = 2.0) -> Splats:
    centers = np.array([[0, 0, depth], [0, 0, 4]], np.float32)
    covariances = np.tile(0.01 * np.eye(3, dtype=np.float32), (2, 1, 1))
    opacities = np.array([[opacity], [0.9]], np.float32)
    return Splats(centers, covariances, opacities, np.ones((2, 3), np.float32))


def test_a_ray_past_everything_hits_nothing() -> None:
    assert hit(two(0.9), np.array([3.0, 0, 0]), AHEAD) is None
    assert near_ray(two(0.9).centers, np.array([3.0, 0, 0]), AHEAD, 0.1) is None


def test_the_nearest_point_within_reach_is_taken() -> None:
    points = np.array([[0.05, 0, 5], [0.05, 0, 2], [0, 0, -1], [0.5, 0, 1]])
    assert near_ray(points, np.zeros(3), AHEAD, 0.1) == 1


def test_a_point_on_a_photo_is_seen_at_its_pixel() -> None:
    cameras, pixels = camera(), torch.tensor([[3.0, 60.0], [40.5, 12.0]]).double()
    points = on_photo(cameras, pixels, 0.7)
    seen = to_camera(points, cameras[None])
    torch.testing.assert_close(to_pixels(seen[0], cameras.intrinsics), pixels[None])
    torch.testing.assert_close(seen[0, 0, :, 2], torch.full((2,), 0.7).double())


def test_small_gaussians_beside_large_ones_survive_half_precision() -> None:
    sizes = np.array([2.0, 2e-4], np.float32)
    covariances = sizes[:, None, None] ** 2 * np.eye(3, dtype=np.float32)
    found = Splats(np.zeros((2, 3), np.float32), covariances, np.ones((2, 1)), np.ones((2, 3)))
    sent = (covariances * found.magnification**2).astype(np.float16).astype(np.float64)
    kept = np.sqrt(sent[:, 0, 0]) / found.magnification
    np.testing.assert_allclose(kept, sizes, rtol=1e-3)
    lost = np.sqrt(covariances.astype(np.float16)[:, 0, 0].astype(np.float64))
    assert abs(lost[1] / sizes[1] - 1) > 0.01  # without it

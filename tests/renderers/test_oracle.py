"""The oracle itself, against formulas written out independently."""

import math

import pytest
import torch

from qgs.contracts import RendererConfig
from qgs.renderers import TorchRenderer
from qgs.renderers.reference import project
from qgs.types import Cameras, Gaussians


def test_projection_passes_gradcheck(make_scene):
    gaussians, cameras = make_scene(views=2, count=5)
    gaussians, cameras = gaussians.to(torch.float64), cameras.to(torch.float64)

    def splats(means, scales, quats, c2w, intrinsics):
        scene = Gaussians(means, scales, quats, gaussians.opacities, gaussians.colors)
        seen = project(scene, Cameras(c2w, intrinsics, cameras.size), 0.025, 125.0, 0.3)
        return seen.means, seen.conics, seen.depths

    leaves = (
        gaussians.means, gaussians.scales, gaussians.quats, cameras.c2w, cameras.intrinsics,
    )  # fmt: skip
    assert torch.autograd.gradcheck(splats, [leaf.clone().requires_grad_() for leaf in leaves])


def test_projected_covariance_is_the_jacobian_sandwich(make_scene):
    """conic^-1 = J W S W^T J^T + 0.3 I, with J by autograd of the pinhole projection."""
    gaussians, cameras = make_scene(count=8, size=(400, 400))
    gaussians, cameras = gaussians.to(torch.float64), cameras.to(torch.float64)
    splats = project(gaussians, cameras, 0.025, 125.0, 0.3)
    w2c = cameras.w2c[0, 0]
    fx, fy, cx, cy = cameras.intrinsics[0, 0]

    def pixel(point):
        x, y, z = w2c[:3, :3] @ point + w2c[:3, 3]
        return torch.stack([fx * x / z + cx, fy * y / z + cy])

    for g in range(gaussians.count):
        w, x, y, z = (gaussians.quats[0, g] / gaussians.quats[0, g].norm()).tolist()
        skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
        axes = torch.eye(3, dtype=torch.float64) + 2 * w * skew + 2 * skew @ skew
        covariance = axes @ torch.diag(gaussians.scales[0, g] ** 2) @ axes.T
        mean = gaussians.means[0, g]
        jacobian = torch.autograd.functional.jacobian(pixel, mean)
        expected = jacobian @ covariance @ jacobian.T + 0.3 * torch.eye(2)
        xx, xy, yy = splats.conics[0, 0, g]
        found = torch.linalg.inv(torch.stack([xx, xy, xy, yy]).reshape(2, 2))
        torch.testing.assert_close(found, expected)
        torch.testing.assert_close(splats.means[0, 0, g], pixel(mean))


def test_beyond_the_border_the_jacobian_is_held():
    """Past 15 % of the image outside, the splat's shape no longer depends on how far."""

    def conics(x: float) -> torch.Tensor:
        gaussian = Gaussians(
            torch.tensor([[[x, 0.0, 1.0]]]), torch.full((1, 1, 3), 0.1),
            torch.tensor([[[1.0, 0.0, 0.0, 0.0]]]), torch.ones(1, 1), torch.ones(1, 1, 3),
        )  # fmt: skip
        intrinsics = torch.tensor([[[100.0, 100.0, 50.0, 50.0]]])
        cameras = Cameras(torch.eye(4)[None, None], intrinsics, (100, 100))
        return project(gaussian, cameras, 0.025, 125.0, 0.3).conics

    assert torch.equal(conics(0.66), conics(3.0))
    assert torch.equal(conics(-0.66), conics(-3.0))
    assert not torch.equal(conics(0.60), conics(0.64))


@pytest.mark.parametrize("options", [{}, {"transmittance_min": 0.2, "alpha_cap": 0.6}])
def test_compositing_follows_the_pixel_loop(make_scene, options):
    """One pixel at a time, one Gaussian at a time."""
    gaussians, cameras = make_scene(count=30, size=(6, 7), scale=0.3)
    gaussians, cameras = gaussians.to(torch.float64), cameras.to(torch.float64)
    config = RendererConfig(**options)
    rendering = TorchRenderer(config)(gaussians, cameras)
    splats = project(gaussians, cameras, config.near, config.far, config.dilation)
    for row in range(6):
        for column in range(7):
            transmittance, rgb, depth = 1.0, torch.zeros(3, dtype=torch.float64), 0.0
            for g in splats.depths[0, 0].argsort().tolist():
                u, v = splats.means[0, 0, g].tolist()
                xx, xy, yy = splats.conics[0, 0, g].tolist()
                dx, dy = column + 0.5 - u, row + 0.5 - v
                distance = xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy
                alpha = gaussians.opacities[0, g].item() * math.exp(-0.5 * distance)
                if alpha < config.alpha_min:
                    continue
                alpha = min(alpha, config.alpha_cap)
                if transmittance * (1 - alpha) <= config.transmittance_min:
                    break
                rgb = rgb + transmittance * alpha * gaussians.colors[0, g]
                depth += transmittance * alpha * splats.depths[0, 0, g].item()
                transmittance *= 1 - alpha
            hit = 1 - transmittance
            torch.testing.assert_close(rendering.rgb[0, 0, :, row, column], rgb + 0.5 * (1 - hit))
            assert rendering.alpha[0, 0, 0, row, column].item() == pytest.approx(hit)
            expected = depth / hit if hit else 0.0
            assert rendering.depth[0, 0, 0, row, column].item() == pytest.approx(expected)

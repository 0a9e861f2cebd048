"""The oracle itself, against formulas written out independently."""

from itertools import product

import torch
from renderers.scenes import make_scene
from torch.testing import assert_close

from qgs.contracts import RendererConfig
from qgs.geometry.harmonics import seen_colors
from qgs.renderers import TorchRenderer


def splat(scene, g, w2c, lens, size):
    """Pixel, inverse of J W S W^T J^T + 0.3, depth; J by autograd, held 15 % past the border."""
    focal = lens[:2]
    centre = lens[2:]

    def pixel(point):
        return focal * point[:2] / point[2] + centre

    seen = w2c[:3, :3] @ scene.means[g] + w2c[:3, 3]
    border = 0.15 * size
    slope = (seen[:2] / seen[2]).clamp((-border - centre) / focal, (size + border - centre) / focal)
    held = torch.cat([slope * seen[2], seen[2:]])
    w, x, y, z = (scene.quats[g] / scene.quats[g].norm()).tolist()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    turn = torch.eye(3, dtype=torch.float64) + 2 * w * skew + 2 * skew @ skew
    jacobian = torch.autograd.functional.jacobian(pixel, held)
    axes = jacobian @ w2c[:3, :3] @ turn * scene.scales[g]
    return pixel(seen), torch.linalg.inv(axes @ axes.T + 0.3 * torch.eye(2)), seen[2]


def test_images_follow_the_formulas():
    """Of every scene and view, one pixel at a time, one Gaussian at a time."""
    gaussians, cameras = make_scene(
        2, 2, count=15, size=(4, 5), scale=0.3, harmonics=15, features=2, dtype=torch.float64
    )
    config = RendererConfig(transmittance_min=0.2, alpha_cap=0.6, background=(0.1, 0.2, 0.3))
    rendering = TorchRenderer(config)(gaussians, cameras)
    colors = seen_colors(gaussians, cameras)
    background = torch.tensor(config.background, dtype=torch.float64)
    for b, v in product(range(2), range(2)):
        scene = gaussians[b]
        lens = cameras.intrinsics[b, v]
        splats = [splat(scene, g, cameras.w2c[b, v], lens, torch.tensor([5, 4])) for g in range(15)]
        order = sorted(range(15), key=lambda g: splats[g][2])
        for row, column in product(range(4), range(5)):
            transmittance = 1.0
            sums = torch.zeros(6, dtype=torch.float64)
            for g in order:
                place, conic, depth = splats[g]
                off = torch.tensor([column + 0.5, row + 0.5]) - place
                alpha = float(scene.opacities[g] * (-0.5 * off @ conic @ off).exp())
                if alpha < config.alpha_min:
                    continue
                alpha = min(alpha, config.alpha_cap)
                if transmittance * (1 - alpha) <= config.transmittance_min:
                    break
                blended = torch.cat([colors[b, v, g], scene.features[g], depth[None]])
                sums += transmittance * alpha * blended
                transmittance *= 1 - alpha
            hit = torch.tensor([1 - transmittance], dtype=torch.float64)
            sums[:3] += transmittance * background
            sums[5:] /= hit if hit else 1
            images = (rendering.rgb, rendering.features, rendering.depth, rendering.alpha)
            found = torch.cat([image[b, v, :, row, column] for image in images])
            assert_close(found, torch.cat([sums, hit]))

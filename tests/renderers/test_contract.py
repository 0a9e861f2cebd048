"""What every renderer owes, against float64 autograd of the oracle; the oracle against formulas."""

from importlib.util import find_spec
from itertools import product

import pytest
import torch
from renderers.scenes import differentiate, make_scene
from scipy.spatial.transform import Rotation
from tables import assert_equal, must_refuse
from torch.testing import assert_close
from walk import along_x, pinhole

from qgs.containers import concatenated, named_tensors
from qgs.contracts import RendererConfig
from qgs.geometry.harmonics import seen_colors
from qgs.renderers import CpuRenderer, GsplatRenderer, TorchRenderer

HAS_GSPLAT = torch.cuda.is_available() and find_spec("gsplat")


@pytest.fixture(params=[TorchRenderer, CpuRenderer, GsplatRenderer])
def build(request):
    """`build(**options)`: the renderer under test, on tensors where the test makes them."""
    if request.param is GsplatRenderer and not HAS_GSPLAT:
        pytest.skip("needs a CUDA GPU and gsplat")

    class Moved(request.param):
        """Renders on the device it needs and brings the images back."""

        def forward(self, gaussians, cameras, background=None):
            device = "cuda" if self.name == "gsplat" else "cpu"
            return super().forward(gaussians.to(device), cameras.to(device), background).to("cpu")

    return lambda **options: Moved(RendererConfig(**options))


def compared(renderer, scene, of_images=2e-5, of_gradients=2e-5, **options):
    """What `renderer` makes of a scene, images and gradients, found to be what the oracle makes."""
    rendering, gradients = differentiate(renderer, *scene)
    oracle = TorchRenderer(RendererConfig(**options))
    images, slopes = differentiate(oracle, *(part.to(torch.float64) for part in scene))
    found = rendering.to(torch.float64)
    assert_close(vars(found), vars(images), atol=of_images, rtol=of_images)
    if renderer.name == "gsplat":
        of_gradients = max(of_gradients, 4e-4)  # they are within 2e-4 on an H100
    for name, found in gradients.items():
        pair = (found - slopes[name], slopes[name])
        error, largest = (x.abs().flatten(1).amax(1) for x in pair)  # of each scene
        assert (error <= of_gradients * largest + 1e-9).all(), (name, error / largest)
    return rendering, gradients


def fixed_cameras(batch):
    return pinhole(along_x([0.0] * batch), size=(24, 40))[:, None]


def test_images_and_gradients_match_the_oracle(build):
    scale = torch.tensor([0.02, 0.1, 1.0])[:, None, None]
    for size, harmonics, features in (
        ((16, 16), 3, 0),
        ((24, 40), 8, 1),
        ((33, 17), 15, 0),
        ((5, 64), 0, 5),
        ((1, 1), 0, 0),
    ):
        scene = make_scene(3, 2, 40, size, scale, harmonics, features)
        rendering, gradients = compared(build(), scene)
        assert (rendering.alpha.amax((1, 2, 3, 4)) > 0.05).all()
        assert (rendering.features is None) is (features == 0)
        assert all(gradients[name].any() for name in gradients.keys() & {"sh", "features"})


def extremes(gaussians):
    """A scene changed until drawing it is hard, or nothing of it can be seen."""

    def times(name, *factor):
        return gaussians.replace(**{name: getattr(gaussians, name) * torch.tensor(factor)})

    def at(means):
        return gaussians.replace(means=means)

    means = gaussians.means
    depths = torch.logspace(-1.5, 2, 12)[torch.randperm(12)][:, None]
    flat = means * torch.tensor([0.01, 0.01, 0.0])
    return [
        times("means", 1.0, 1.0, -1.0),  # behind
        times("means", 0.0),  # at the eye
        at(means + torch.tensor([500.0, 0.0, 0.0])),  # off screen
        times("opacities", 1e-9),  # transparent
        times("opacities", 0.0),  # invisible
        times("scales", 1e-12),  # tiny
        times("scales", 10.0, 10.0, 1e-8),  # discs
        gaussians.replace(opacities=torch.ones_like(gaussians.opacities)),
        at(means / means[..., 2:] * depths),  # of any depth
        at(means[:, :1].expand_as(means)),  # coincident
        times("scales", 1e4),  # huge
        times("scales", 1e12),  # overflowing
        times("scales", 1e36),  # of overflowing minors
        times("scales", 10.0, 1e-6, 1e-6),  # needles
        at(flat + torch.tensor([0, 0, 0.025])),  # on the near plane
    ]


def test_extreme_gaussians_are_finite_and_exact_or_unseen(build):
    scenes = extremes(make_scene(count=12, harmonics=15, features=2)[0])
    together = concatenated(scenes, 0)
    rendering, gradients = differentiate(build(), together, fixed_cameras(len(scenes)))
    for _, part in (*named_tensors(rendering), *gradients.items()):
        finite = part.isfinite().flatten(1).all(1)
        assert finite.all(), finite
    for part in (rendering.alpha, *gradients.values()):
        assert not part[:5].any()
    compared(build(), (together[5:11], fixed_cameras(6)), 1e-4, 1e-3)


def test_gaussians_beyond_float64_have_no_gradient():
    for scale in (1e100, 1e160, 1e300):
        scene = make_scene(scale=scale, dtype=torch.float64)
        _, gradients = differentiate(TorchRenderer(RendererConfig()), *scene)
        assert not any(gradient.any() for gradient in gradients.values()), scale


def test_near_and_far_are_inclusive(build):
    z = torch.tensor([0.5, 0.4999, 4.0, 4.001])
    gaussians = make_scene(4, count=1)[0].replace(means=z[:, None, None] * torch.eye(3)[2])
    alpha = build(near=0.5, far=4.0)(gaussians, fixed_cameras(4)).alpha
    assert alpha.flatten(1).any(1).tolist() == [True, False, True, False]


OPTIONS = {"near": 2.0, "far": 2.5, "dilation": 2.0, "background": (0.0, 1.0, 0.0)}
FIXED_BY_GSPLAT = {"alpha_min": 0.2, "alpha_cap": 0.5, "transmittance_min": 0.3}


def test_every_option_has_its_effect(build):
    scene = make_scene(scale=0.2)
    plain = build()
    fixed = {} if plain.name == "gsplat" else FIXED_BY_GSPLAT
    for option, value in (OPTIONS | fixed).items():
        one = {option: value}
        rendering, _ = compared(build(**one), scene, **one)
        assert (rendering.rgb - plain(*scene).rgb).abs().max() > 1e-2, option


def test_opaque_layers_stop_the_ray(build):
    gaussians, cameras = make_scene(count=200, scale=0.6)
    gaussians = gaussians.replace(opacities=gaussians.opacities * 0.5 + 0.5)
    rendering, gradients = compared(build(), (gaussians, cameras), 1e-4, 1e-3)
    assert rendering.alpha.min() > 0.99
    assert rendering.alpha.max() < 1 - 1e-4 + 1e-6
    assert not gradients["colors"][0, gaussians.means[0, :, 2].argmax()].any()
    gaussians, cameras = make_scene(count=1, scale=50.0)
    capped = build()(gaussians.replace(opacities=torch.ones(1, 1)), cameras).alpha
    assert_close(capped.max(), torch.tensor(0.999))


def test_half_precision_is_rendered_in_float32(build):
    """Harmonics included, under autocast too."""
    gaussians, cameras = make_scene(harmonics=8)
    render = build()
    expected = render(gaussians, cameras).rgb
    with torch.autocast("cpu", torch.bfloat16):
        assert_close(render(gaussians, cameras).rgb, expected)
    assert_equal(render(gaussians.to(torch.bfloat16), cameras).rgb, expected, atol=1e-2)


def test_mismatches_are_named(build):
    gaussians, cameras = make_scene(batch=2, views=2)
    render = build()
    must_refuse("2 scenes cannot be rendered from cameras of 1", render, gaussians, cameras[:1])
    must_refuse(r"means must have shape \(B, G, 3\)", render, gaussians[0], cameras)
    must_refuse(r"c2w must have shape \(B, V, 4, 4\)", render, gaussians, cameras[0])
    must_refuse(r"shape \(3,\)", render, gaussians, cameras, torch.zeros(1, 3))


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
    turn = torch.tensor(Rotation.from_quat(scene.quats[g], scalar_first=True).as_matrix())
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
    found = torch.cat([rendering.rgb, rendering.features, rendering.depth, rendering.alpha], 2)
    colors = seen_colors(gaussians, cameras)
    background = found.new_tensor(config.background)
    for b, v in product(range(2), range(2)):
        scene = gaussians[b]
        lens = cameras.intrinsics[b, v]
        splats = [splat(scene, g, cameras.w2c[b, v], lens, torch.tensor([5, 4])) for g in range(15)]
        order = sorted(range(15), key=lambda g: splats[g][2])
        for row, column in product(range(4), range(5)):
            transmittance = 1.0
            sums = found.new_zeros(7)
            for g in order:
                place, conic, depth = splats[g]
                off = torch.tensor([column + 0.5, row + 0.5]) - place
                alpha = float(scene.opacities[g] * (-0.5 * off @ conic @ off).exp())
                if alpha < config.alpha_min:
                    continue
                alpha = min(alpha, config.alpha_cap)
                if transmittance * (1 - alpha) <= config.transmittance_min:
                    break
                blended = [colors[b, v, g], scene.features[g], depth[None], torch.ones(1)]
                sums += transmittance * alpha * torch.cat(blended)
                transmittance *= 1 - alpha
            sums[:3] += transmittance * background
            sums[5] /= sums[6] if sums[6] else 1
            assert_close(found[b, v, :, row, column], sums)

"""What every renderer owes, checked against float64 autograd of the dense oracle."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from qgs.contracts import RendererConfig
from qgs.geometry.harmonics import seen_colors
from qgs.geometry.transforms import moved, quat_to_matrix
from qgs.renderers import TorchRenderer
from qgs.types import Cameras, Gaussians, Rendering, named_tensors

IMAGES = ("rgb", "alpha", "depth")


def oracle(**options: object) -> TorchRenderer:
    return TorchRenderer(RendererConfig(**options))


def assert_images_match(found: Rendering, expected: Rendering, tolerance: float) -> None:
    for name, image in named_tensors(found):
        torch.testing.assert_close(
            image.double(), getattr(expected, name), atol=tolerance, rtol=tolerance
        )


def assert_gradients_match(found: dict, expected: dict, tolerance: float) -> None:
    for name, grad in found.items():
        scale = expected[name].abs().max().item()
        torch.testing.assert_close(
            grad.double(),
            expected[name],
            atol=tolerance * scale + 1e-9,
            rtol=0,
            msg=lambda m, name=name: f"{name}: {m}",
        )


def compared(differentiate, renderer, scene, tolerances=(2e-5, 2e-5), **options) -> tuple:
    """What `renderer` and then the oracle make of a scene, their images and gradients alike."""
    found = differentiate(renderer, *scene)
    expected = differentiate(oracle(**options), *(part.to(torch.float64) for part in scene))
    assert_images_match(found[0], expected[0], tolerances[0])
    least = 4e-4 if renderer.kind == "gsplat" else 0.0  # its gradients are within 2e-4 on an H100
    assert_gradients_match(found[1], expected[1], max(tolerances[1], least))
    return found, expected


def assert_finite(rendering: Rendering, gradients: dict) -> None:
    for name, image in named_tensors(rendering):
        assert torch.isfinite(image).all(), name
    for name, grad in gradients.items():
        assert torch.isfinite(grad).all(), name


def identity_camera(size: tuple[int, int] = (24, 40)) -> Cameras:
    height, width = size
    intrinsics = torch.tensor([40.0, 40.0, width / 2, height / 2])
    return Cameras(torch.eye(4)[None, None], intrinsics[None, None], size)


def one_gaussian(z: float = 2.0, scale: float = 0.1, opacity: float = 0.7) -> Gaussians:
    return Gaussians(
        means=torch.tensor([[[0.0, 0.0, z]]]),
        scales=torch.full((1, 1, 3), scale),
        quats=torch.tensor([[[1.0, 0.0, 0.0, 0.0]]]),
        opacities=torch.tensor([[opacity]]),
        colors=torch.tensor([[[0.9, 0.2, 0.1]]]),
    )


@pytest.mark.parametrize("size", [(16, 16), (24, 40), (33, 17), (5, 64), (1, 1)])
@pytest.mark.parametrize("scale", [0.02, 0.1, 1.0])
def test_images_and_gradients_match_the_oracle(build, make_scene, differentiate, size, scale):
    _, (rendering, _) = compared(differentiate, build(), make_scene(2, 2, size=size, scale=scale))
    assert rendering.alpha.max() > 0.05


@pytest.mark.parametrize(
    "more", [{"harmonics": 3}, {"harmonics": 8, "features": 1}, {"harmonics": 15}, {"features": 5}]
)
def test_harmonics_and_features_match_the_oracle(build, make_scene, differentiate, more):
    scene = make_scene(batch=2, views=2, **more)
    (found, gradients), _ = compared(differentiate, build(), scene)
    assert (found.features is None) is ("features" not in more)
    assert all(gradients[name].abs().max() > 0 for name in gradients.keys() & {"sh", "features"})


def test_harmonics_are_the_colours_of_every_view(build, make_scene):
    gaussians, cameras = make_scene(views=3, harmonics=15)
    together = build()(gaussians, cameras)
    colors = seen_colors(gaussians, cameras)
    for v in range(3):
        plain = replace(gaussians, colors=colors[:, v], sh=None)
        alone = build()(plain, cameras[:, v : v + 1])
        torch.testing.assert_close(together.rgb[:, v], alone.rgb[:, 0], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(together.depth[:, v], alone.depth[:, 0], rtol=1e-5, atol=1e-6)
    assert (together.rgb - build()(replace(gaussians, sh=None), cameras).rgb).abs().max() > 0.02


def test_harmonics_of_zero_are_none(build, make_scene):
    gaussians, cameras = make_scene(views=2)
    none = replace(gaussians, sh=torch.zeros(1, 40, 15, 3))
    given, plain = (build()(scene, cameras) for scene in (none, gaussians))
    for name in IMAGES:
        assert torch.equal(getattr(given, name), getattr(plain, name)), name


def test_features_are_blended_as_colours_over_nothing(build, make_scene):
    gaussians, cameras = make_scene(batch=2, views=2, features=3)
    rendering = build()(gaussians, cameras)
    painted = replace(gaussians, colors=gaussians.features, features=None)
    expected = build()(painted, cameras, torch.zeros(3))
    torch.testing.assert_close(rendering.features, expected.rgb, rtol=1e-5, atol=1e-6)
    assert expected.features is None
    for width in (0, 1, 7):
        shown = gaussians.features.repeat(1, 1, 3)[..., :width]
        found = build()(replace(gaussians, features=shown), cameras).features
        torch.testing.assert_close(found, rendering.features.repeat(1, 1, 3, 1, 1)[:, :, :width])


def test_without_harmonics_and_features_nothing_more_is_computed(build, make_scene, monkeypatch):
    gaussians, cameras = make_scene(views=2)
    given = "qgs.contracts.renderer.seen_colors"
    monkeypatch.setattr(given, lambda *_: pytest.fail("there are no harmonics"))
    assert build()(gaussians, cameras).features is None


@pytest.mark.parametrize("more", [{}, {"harmonics": 15, "features": 2}])
def test_scenes_and_views_do_not_mix(build, make_scene, more):
    gaussians, cameras = make_scene(batch=2, views=3, **more)
    together = build()(gaussians, cameras)
    for b in range(2):
        for v in range(3):
            alone = build()(gaussians[b : b + 1], cameras[b : b + 1, v : v + 1])
            for name, image in named_tensors(together):
                torch.testing.assert_close(
                    image[b, v], getattr(alone, name)[0, 0], rtol=1e-5, atol=1e-6
                )


def test_zero_gaussians_show_the_background(build, make_scene, differentiate):
    gaussians, cameras = make_scene(count=4, batch=2, views=2, harmonics=3, features=4)
    rendering, gradients = differentiate(
        build(background=(0.1, 0.2, 0.3)), gaussians[:, :0], cameras
    )
    expected = torch.tensor([0.1, 0.2, 0.3])[:, None, None].expand_as(rendering.rgb)
    torch.testing.assert_close(rendering.rgb, expected)
    assert rendering.alpha.eq(0).all()
    assert rendering.depth.eq(0).all()
    assert_finite(rendering, gradients)


FACTORS: dict[str, dict[str, tuple[float, ...]]] = {
    "behind": {"means": (1.0, 1.0, -1.0)},
    "at_the_eye": {"means": (0.0,)},
    "huge": {"scales": (1e4,)},
    "overflowing": {"scales": (1e12,)},
    "tiny": {"scales": (1e-12,)},
    "needles": {"scales": (10.0, 1e-6, 1e-6)},
    "discs": {"scales": (10.0, 10.0, 1e-8)},
    "transparent": {"opacities": (1e-9,)},
    "invisible": {"opacities": (0.0,)},
}
OTHERS: dict[str, Callable[[Gaussians], Gaussians]] = {
    "on_the_near_plane": lambda g: replace(
        g, means=g.means * torch.tensor([0.01, 0.01, 0.0]) + torch.tensor([0, 0, 0.025])
    ),
    "off_screen": lambda g: replace(g, means=g.means + torch.tensor([500.0, 0.0, 0.0])),
    "opaque": lambda g: replace(g, opacities=torch.ones_like(g.opacities)),
    "coincident": lambda g: replace(g, means=g.means[:, :1].expand_as(g.means).clone()),
}


def extreme(gaussians: Gaussians, change: str) -> Gaussians:
    if change in OTHERS:
        return OTHERS[change](gaussians)
    ((name, factor),) = FACTORS[change].items()
    return replace(gaussians, **{name: getattr(gaussians, name) * torch.tensor(factor)})


@pytest.mark.parametrize("change", [*FACTORS, *OTHERS])
def test_extreme_gaussians_stay_finite(build, make_scene, differentiate, change):
    gaussians, _ = make_scene(batch=2, harmonics=15, features=2)
    camera = identity_camera()
    cameras = Cameras(camera.c2w.repeat(2, 1, 1, 1), camera.intrinsics.repeat(2, 1, 1), camera.size)
    rendering, gradients = differentiate(build(), extreme(gaussians, change), cameras)
    assert_finite(rendering, gradients)


@pytest.mark.parametrize(
    "change", ["behind", "at_the_eye", "off_screen", "transparent", "invisible"]
)
def test_what_cannot_be_seen_leaves_the_background(build, make_scene, differentiate, change):
    gaussians, _ = make_scene()
    rendering, gradients = differentiate(build(), extreme(gaussians, change), identity_camera())
    assert rendering.alpha.eq(0).all()
    assert all(grad.eq(0).all() for grad in gradients.values())


@pytest.mark.parametrize("change", ["tiny", "discs", "opaque", "coincident", "huge"])
def test_extreme_gaussians_match_the_oracle(build, make_scene, differentiate, change):
    gaussians, _ = make_scene(count=12)
    scene = extreme(gaussians, change), identity_camera()
    compared(differentiate, build(), scene, (1e-4, 1e-3))


def test_near_and_far_are_inclusive(build):
    renderer = build(near=0.5, far=4.0)
    for z, seen in ((0.5, True), (0.4999, False), (4.0, True), (4.001, False)):
        alpha = renderer(one_gaussian(z), identity_camera()).alpha
        assert bool(alpha.max() > 0) is seen, z


def test_one_gaussian_gives_its_color_and_depth(build):
    rendering = build()(one_gaussian(), identity_camera((25, 41)))
    peak = rendering.alpha[0, 0, 0, 12, 20]
    torch.testing.assert_close(peak, torch.tensor(0.7), rtol=1e-5, atol=0)
    torch.testing.assert_close(rendering.depth[0, 0, 0, 12, 20], torch.tensor(2.0))
    expected = peak * torch.tensor([0.9, 0.2, 0.1]) + (1 - peak) * 0.5
    torch.testing.assert_close(rendering.rgb[0, 0, :, 12, 20], expected)


def test_background_can_be_overridden(build, make_scene):
    gaussians, cameras = make_scene()
    renderer = build(background=(0.1, 0.2, 0.3))
    configured, black = renderer(gaussians, cameras), renderer(gaussians, cameras, torch.zeros(3))
    shown = (1 - configured.alpha) * torch.tensor([0.1, 0.2, 0.3])[:, None, None]
    torch.testing.assert_close(configured.rgb, black.rgb + shown, rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match=r"shape \(3,\)"):
        renderer(gaussians, cameras, torch.zeros(1, 3))


def test_rigid_motion_of_everything_changes_nothing(build, make_scene):
    gaussians, cameras = make_scene(views=2, harmonics=15)
    quat = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8, 0.2]), dim=0)
    motion = torch.eye(4)
    motion[:3, :3], motion[:3, 3] = quat_to_matrix(quat), torch.tensor([0.4, -1.0, 0.7])
    before = build()(gaussians, cameras)
    after = build()(moved(gaussians, motion, 1.0), replace(cameras, c2w=motion @ cameras.c2w))
    for name in IMAGES:
        torch.testing.assert_close(
            getattr(after, name), getattr(before, name), rtol=1e-3, atol=1e-4
        )


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("near", 2.0),
        ("far", 2.5),
        ("dilation", 2.0),
        ("alpha_min", 0.2),
        ("alpha_cap", 0.5),
        ("transmittance_min", 0.3),
        ("background", (0.0, 1.0, 0.0)),
    ],
)
def test_every_option_has_its_effect(build, make_scene, differentiate, option, value):
    scene = make_scene(scale=0.2)
    try:
        renderer = build(**{option: value})
    except ValueError:
        pytest.skip(f"this renderer refuses {option}")
    (rendering, _), _ = compared(differentiate, renderer, scene, **{option: value})
    assert (rendering.rgb - build()(*scene).rgb).abs().max() > 1e-2


def test_alpha_is_capped(build):
    rendering = build()(one_gaussian(scale=5.0, opacity=1.0), identity_camera())
    torch.testing.assert_close(rendering.alpha.max(), torch.tensor(0.999))


def test_opaque_layers_stop_the_ray(build, make_scene, differentiate):
    gaussians, cameras = make_scene(count=200, scale=0.6)
    gaussians = replace(gaussians, opacities=gaussians.opacities * 0.5 + 0.5)
    found, _ = compared(differentiate, build(), (gaussians, cameras), (1e-4, 1e-3))
    assert found[0].alpha.min() > 0.99
    assert found[0].alpha.max() < 1 - 1e-4 + 1e-6
    last = gaussians.means[0, :, 2].argmax()
    assert found[1]["colors"][0, last].eq(0).all()


def test_the_same_bits_every_time(build, make_scene, differentiate):
    gaussians, cameras = make_scene(batch=2, views=2, count=300, size=(48, 48), scale=0.2)
    renderer = build()
    if renderer.kind == "gsplat":
        pytest.skip("gsplat adds gradients with atomics")
    first = differentiate(renderer, gaussians, cameras)
    second = differentiate(renderer, gaussians, cameras)
    for name in IMAGES:
        assert torch.equal(getattr(first[0], name), getattr(second[0], name))
    for name, grad in first[1].items():
        assert torch.equal(grad, second[1][name]), name


def test_autocast_and_half_precision_render_in_float32(build, make_scene):
    gaussians, cameras = make_scene()
    expected = build()(gaussians, cameras)
    with torch.autocast("cpu", torch.bfloat16):
        rendering = build()(gaussians, cameras)
    torch.testing.assert_close(rendering.rgb, expected.rgb)
    half = replace(gaussians, colors=gaussians.colors.bfloat16())
    rendering = build()(half, cameras)
    assert rendering.rgb.dtype == torch.float32
    torch.testing.assert_close(rendering.rgb, expected.rgb, rtol=0, atol=1e-2)


def test_mismatches_are_named(build, make_scene):
    gaussians, cameras = make_scene(batch=2, views=2)
    renderer = build()
    with pytest.raises(ValueError, match="2 scenes cannot be rendered from cameras of 1"):
        renderer(gaussians, cameras[:1])
    with pytest.raises(ValueError, match=r"means \(B, G, 3\)"):
        renderer(gaussians[0], cameras)
    with pytest.raises(ValueError, match=r"cameras of shape \(B, V\)"):
        renderer(gaussians, cameras[0])


def test_devices_must_agree(make_scene):
    gaussians, cameras = make_scene()
    with pytest.raises(ValueError, match="Gaussians are on meta, cameras on cpu"):
        oracle()(gaussians.to("meta"), cameras)

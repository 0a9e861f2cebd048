"""The call into gsplat against the gsplat that is installed, as far as it runs on a CPU.

Its wheel is pure Python that compiles CUDA when first needed, so it imports without a GPU (`pip
install --no-deps gsplat==1.5.3 jaxtyping wadler-lindig`). Compared are the signature, its reference
projection and its spherical harmonics. Not its blending: the reference of that,
`_rasterize_to_pixels`, asks a CUDA kernel which Gaussians a pixel meets; tests/renderers/
test_contract.py has it on a GPU.
"""

import inspect

import pytest
import torch

import qgs.renderers.gsplat as gsplat_module
from qgs.contracts import RendererConfig
from qgs.geometry.harmonics import seen_colors
from qgs.renderers import GsplatRenderer
from qgs.renderers.reference import project

gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed")
reference = pytest.importorskip("gsplat.cuda._torch_impl")

CONFIG = RendererConfig(near=0.1, far=3.5, dilation=0.4)


@pytest.fixture
def bound(monkeypatch):
    """`bound(gaussians, cameras)`: what gsplat's own signature makes of the call, by name."""
    signature = inspect.signature(gsplat.rasterization)
    found = []

    def rasterization(*given, **named):
        call = signature.bind(*given, **named)
        call.apply_defaults()
        found.append(call.arguments)
        images = (*call.arguments["viewmats"].shape[:2], named["height"], named["width"])
        channels = call.arguments["colors"].shape[-1] + 1
        return torch.zeros(*images, channels), torch.zeros(*images, 1), {}

    monkeypatch.setattr(gsplat, "rasterization", rasterization)
    monkeypatch.setattr(gsplat_module, "_check_supported", lambda *_: None)

    def call(gaussians, cameras):
        GsplatRenderer(CONFIG)(gaussians, cameras)
        return found[-1]

    return call


def test_the_call_fits_the_signature_and_leaves_the_rest_at_what_it_means(bound, make_scene):
    found = bound(*make_scene(batch=2, views=3, count=7, harmonics=8, features=2))
    assert found["packed"] is False
    assert found["sh_degree"] is None, "colours are given, not coefficients"
    assert (found["rasterize_mode"], found["camera_model"]) == ("classic", "pinhole")
    assert not any(found[name] for name in ("with_ut", "with_eval3d", "segmented"))
    assert found["covars"] is None
    assert found["radius_clip"] == 0
    assert found["colors"].shape[-1] + 1 <= found["channel_chunk"], "one pass"
    assert found["backgrounds"].shape == (2, 3, 5)


@pytest.mark.parametrize("views", [1, 3])
def test_its_projection_is_ours(bound, make_scene, views):
    gaussians, cameras = make_scene(batch=2, views=views, count=60, size=(24, 40))
    found = bound(gaussians, cameras)
    covars, _ = reference._quat_scale_to_covar_preci(found["quats"], found["scales"], True, False)
    radii, means, depths, conics, _ = reference._fully_fused_projection(
        found["means"], covars, found["viewmats"], found["Ks"], found["width"], found["height"],
        found["eps2d"], found["near_plane"], found["far_plane"],
    )  # fmt: skip
    ours = project(gaussians, cameras, CONFIG.near, CONFIG.far, CONFIG.dilation)
    theirs = (radii > 0).all(-1)
    assert theirs.any()
    assert not theirs.all(), "some are beyond far"
    assert (ours.visible | ~theirs).all(), "what it draws, we draw"
    torch.testing.assert_close(ours.means[theirs], means[theirs], rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(ours.depths[theirs], depths[theirs])
    torch.testing.assert_close(ours.conics[theirs], conics[theirs], rtol=1e-3, atol=1e-5)
    far = ours.visible & (depths > CONFIG.far)
    assert not far.any()


@pytest.mark.parametrize(("count", "degree"), [(3, 1), (8, 2), (15, 3)])
def test_its_harmonics_are_ours(make_scene, count, degree):
    gaussians, cameras = make_scene(batch=1, views=2, count=50, harmonics=count)
    constant = (gaussians.colors - 0.5) / 0.28209479177387814
    coefficients = torch.cat([constant[..., None, :], gaussians.sh], -2)[:, None]
    directions = gaussians.means[:, None] - cameras.c2w[..., None, :3, 3]
    coefficients = coefficients.expand(*directions.shape[:-1], -1, -1)
    theirs = reference._spherical_harmonics(degree, directions, coefficients) + 0.5
    ours = seen_colors(gaussians, cameras)
    torch.testing.assert_close(ours, theirs.clamp_min(0), rtol=1e-4, atol=1e-5)

"""`qgs/gsplat` and `qgs/auto` as far as a machine without a GPU can tell."""

import sys
from types import SimpleNamespace
from unittest.mock import Mock

import torch
from renderers.scenes import make_scene
from tables import assert_equal, must_refuse
from torch.testing import assert_close

from qgs.containers import concatenated
from qgs.contracts import RendererConfig
from qgs.renderers import AutoRenderer, CpuRenderer, GsplatRenderer, TorchRenderer
from qgs.renderers.gsplat import _check_supported
from qgs.types import Cameras, Gaussians


def rasterization(
    *, colors, viewmats, Ks, width, height, near_plane, far_plane, eps2d, backgrounds, **given
):
    """What gsplat's function of this name gives, by our renderer; colors: (B, V, G, C)."""
    assert given.pop("packed") is False
    assert given.pop("render_mode") == "RGB+ED"
    assert Ks[0, 0, 2].tolist() == [0, 0, 1]
    assert colors.shape[2], "kernels divide by the number of Gaussians"
    renderer = TorchRenderer(RendererConfig(near=near_plane, far=far_plane, dilation=eps2d))
    cameras = Cameras(torch.linalg.inv(viewmats), Ks.flatten(2)[..., [0, 4, 2, 5]], (height, width))
    parts = []
    for view in range(len(colors[0])):
        seen = Gaussians(**given, colors=colors[:, view, :, :3], features=colors[:, view])
        parts.append(renderer(seen, cameras[:, [view]]))
    found = concatenated(parts, 1)
    channels = found.features + (1 - found.alpha) * backgrounds[..., None, None]
    images = torch.cat([channels, found.depth], 2)
    return images.movedim(2, -1), found.alpha.movedim(2, -1), {}


def test_images_are_those_of_the_function_that_gsplat_documents(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    monkeypatch.setattr("qgs.renderers.gsplat._check_supported", lambda *_: None)
    config = RendererConfig(near=2.0, far=3.5, dilation=2.0, background=(0.1, 0.2, 0.3))
    for more in ({"harmonics": 8, "features": 2}, {}, {"count": 0}):
        scene = make_scene(2, 3, size=(12, 20), scale=0.2, **more)
        found, expected = (kind(config)(*scene) for kind in (GsplatRenderer, TorchRenderer))
        assert_close(vars(found), vars(expected))


def test_options_that_the_kernels_fix_are_refused():
    """Each of them in a recipe: tests/recipe/cases/mistakes.txt."""
    must_refuse("alpha_cap", GsplatRenderer, RendererConfig(alpha_cap=0.99))


ON_CUDA = SimpleNamespace(means=SimpleNamespace(is_cuda=True, dtype=torch.float32))
"""The parts of Gaussians there that the checks look at."""


def test_tensors_elsewhere_and_intrinsics_that_want_a_gradient_are_refused():
    gaussians, cameras = make_scene()
    render = GsplatRenderer(RendererConfig())
    must_refuse("CUDA tensors, got Gaussians on cpu", render, gaussians, cameras)
    cameras.intrinsics.requires_grad_()
    must_refuse("no gradient for intrinsics", _check_supported, ON_CUDA, cameras)


def test_auto_goes_by_where_the_gaussians_are(monkeypatch):
    scene = make_scene()
    auto = AutoRenderer(RendererConfig())
    assert_equal(auto(*scene).rgb, CpuRenderer(RendererConfig())(*scene).rgb)
    gsplat = Mock()
    monkeypatch.setattr("qgs.renderers.GsplatRenderer", gsplat)
    assert auto.draw(ON_CUDA, scene[1], None, None) is gsplat.return_value.draw.return_value

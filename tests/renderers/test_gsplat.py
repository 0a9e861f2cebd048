"""`qgs/gsplat` and `qgs/auto` as far as a machine without a GPU can tell."""

import sys
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from renderers.scenes import make_scene
from tables import assert_equal, must_refuse
from torch.testing import assert_close

from qgs.contracts import RendererConfig
from qgs.geometry.harmonics import seen_colors
from qgs.renderers import AutoRenderer, CpuRenderer, GsplatRenderer
from qgs.renderers.gsplat import _check_supported


@pytest.fixture
def calls(monkeypatch):
    """Stand in for gsplat; return the list of keyword arguments it was called with."""

    def rasterization(**arguments):
        images = (*arguments["viewmats"].shape[:2], arguments["height"], arguments["width"])
        channels = arguments["colors"].shape[-1] + 1  # and depth
        rgbd = torch.arange(float(channels)).expand(*images, channels)
        return rgbd, torch.full((*images, 1), 0.25), {}

    kernels = Mock(wraps=rasterization)
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=kernels))
    monkeypatch.setattr("qgs.renderers.gsplat._check_supported", lambda *_: None)
    return kernels.call_args_list


def test_arguments_are_what_gsplat_expects(calls):
    config = RendererConfig(near=0.1, far=50.0, dilation=0.5, background=(0.1, 0.2, 0.3))
    render = GsplatRenderer(config)
    gaussians, cameras = make_scene(2, 3, 7, size=(12, 20), harmonics=8, features=2)
    rendering = render(gaussians, cameras)
    bare = render(gaussians.replace(sh=None, features=None), cameras)
    found, of_bare = (call.kwargs for call in calls)
    fx, fy, cx, cy = cameras.intrinsics[1, 2]
    assert_equal(found.pop("Ks")[1, 2], torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    assert found.pop("render_mode") == "RGB+ED"
    features = gaussians.features[:, None].expand(2, 3, 7, 2)
    backdrop = torch.tensor([0.1, 0.2, 0.3, 0, 0]).expand(2, 3, 5)
    expected = {
        **{name: getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities")},
        "colors": torch.cat([seen_colors(gaussians, cameras), features], -1),
        "viewmats": torch.linalg.inv(cameras.c2w),
        "width": 20,
        "height": 12,
        "near_plane": 0.1,
        "far_plane": 50.0,
        "eps2d": 0.5,
        "packed": False,
        "backgrounds": backdrop,
    }
    assert_close(found, expected)
    assert_equal(of_bare["colors"], gaussians.colors[:, None].expand(2, 3, 7, 3))
    assert_equal(of_bare["backgrounds"], backdrop[..., :3])
    channels = torch.tensor([0, 1, 2, 3, 4, 5, 0.25, 3])[:, None, None].expand(2, 3, 8, 12, 20)
    images = [rendering.rgb, rendering.features, rendering.depth, rendering.alpha, bare.depth]
    assert_equal(torch.cat(images, 2), channels)
    render(gaussians[:, :0], cameras)
    assert len(calls) == 2, "kernels divide by the number of Gaussians"


def test_options_that_the_kernels_fix_are_refused():
    """A recipe with them too: tests/recipe/cases/mistakes.txt."""
    for option, value in {"alpha_cap": 0.99, "alpha_min": 0.01, "transmittance_min": 1e-3}.items():
        must_refuse(option, GsplatRenderer, RendererConfig(**{option: value}))


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
    assert AutoRenderer(RendererConfig())(ON_CUDA, scene[1]) is gsplat.return_value.return_value

"""`qgs/gsplat` and `qgs/auto` as far as a machine without a GPU can tell."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

import qgs.renderers as auto_module
import qgs.renderers.gsplat as gsplat_module
from qgs.contracts import ModelDims, RecipeContext, RendererConfig
from qgs.geometry.harmonics import seen_colors
from qgs.renderers import AutoRenderer, CpuRenderer, GsplatRenderer
from qgs.types import Rendering

CONTEXT = RecipeContext(ModelDims(16, 2, 1))


@pytest.fixture
def calls(monkeypatch):
    """Stand in for gsplat; return the list of keyword arguments it was called with."""
    seen = []

    def rasterization(**arguments):
        seen.append(arguments)
        images = (*arguments["viewmats"].shape[:2], arguments["height"], arguments["width"])
        channels = arguments["colors"].shape[-1] + 1  # and depth
        rgbd = torch.arange(float(channels)).expand(*images, channels)
        return rgbd, torch.full((*images, 1), 0.25), {}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    monkeypatch.setattr(gsplat_module, "_check_supported", lambda *_: None)
    return seen


def test_arguments_are_what_gsplat_expects(calls, make_scene):
    gaussians, cameras = make_scene(batch=2, views=3, count=7, size=(12, 20))
    config = RendererConfig(near=0.1, far=50.0, dilation=0.5, background=(0.1, 0.2, 0.3))
    rendering = GsplatRenderer(config)(gaussians, cameras)
    (found,) = calls
    assert (found["width"], found["height"]) == (20, 12)
    assert (found["near_plane"], found["far_plane"], found["eps2d"]) == (0.1, 50.0, 0.5)
    assert found["packed"] is False
    assert found["render_mode"] == "RGB+ED"
    for name in ("means", "scales", "quats", "opacities", "colors"):
        assert torch.equal(found[name], getattr(gaussians, name))
    torch.testing.assert_close(found["viewmats"] @ cameras.c2w, torch.eye(4).expand(2, 3, 4, 4))
    fx, fy, cx, cy = cameras.intrinsics[1, 2]
    expected = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    assert torch.equal(found["Ks"][1, 2], expected)
    assert torch.equal(found["backgrounds"], torch.tensor([0.1, 0.2, 0.3]).expand(2, 3, 3))
    assert rendering.rgb.shape == (2, 3, 3, 12, 20)
    assert rendering.rgb[0, 0, :, 0, 0].tolist() == [0, 1, 2]
    assert rendering.depth.shape == (2, 3, 1, 12, 20)
    assert rendering.depth.eq(3).all()
    assert rendering.alpha.shape == (2, 3, 1, 12, 20)
    GsplatRenderer(config)(gaussians[:, :0], cameras)
    assert len(calls) == 1, "kernels divide by the number of Gaussians"


def test_harmonics_and_features_reach_gsplat(calls, make_scene):
    gaussians, cameras = make_scene(batch=2, views=3, count=7, harmonics=8, features=2)
    rendering = GsplatRenderer(RendererConfig())(gaussians, cameras)
    GsplatRenderer(RendererConfig())(replace(gaussians, sh=None), cameras)
    seen, plain = (found["colors"] for found in calls)
    assert torch.equal(seen[..., :3], seen_colors(gaussians, cameras))
    assert torch.equal(seen[..., 3:], gaussians.features[:, None].expand(2, 3, 7, 2))
    assert torch.equal(plain, torch.cat([gaussians.colors, gaussians.features], -1))
    assert calls[0]["backgrounds"][1, 2].tolist() == [0.5, 0.5, 0.5, 0, 0]
    assert rendering.rgb[0, 0, :, 0, 0].tolist() == [0, 1, 2]
    assert rendering.features[0, 0, :, 0, 0].tolist() == [3, 4]
    assert rendering.depth.eq(5).all()


@pytest.mark.parametrize(
    "changed", [{"alpha_cap": 0.99}, {"alpha_min": 0.01}, {"transmittance_min": 1e-3}]
)
@pytest.mark.parametrize("cls", [GsplatRenderer, AutoRenderer])
def test_options_that_the_kernels_fix_are_refused(cls, changed):
    (problem,) = cls.problems(RendererConfig(**changed), CONTEXT)
    assert problem.option == next(iter(changed))
    assert "qgs/cpu" in problem.fix
    assert list(cls.problems(RendererConfig(near=1.0, dilation=1.0), CONTEXT)) == []
    with pytest.raises(ValueError, match=next(iter(changed))):
        GsplatRenderer(RendererConfig(**changed))


def test_cpu_tensors_are_refused(make_scene):
    with pytest.raises(ValueError, match="CUDA tensors, got Gaussians on cpu"):
        GsplatRenderer(RendererConfig())(*make_scene())


class _OnCuda:
    """The parts of a CUDA tensor that the checks look at."""

    is_cuda = True
    dtype = torch.float32


def test_intrinsics_that_want_a_gradient_are_refused(make_scene):
    _, cameras = make_scene()
    cameras.intrinsics.requires_grad_()
    with pytest.raises(ValueError, match="no gradient for intrinsics"):
        gsplat_module._check_supported(SimpleNamespace(means=_OnCuda()), cameras)


def test_auto_goes_by_where_the_gaussians_are(make_scene, monkeypatch):
    gaussians, cameras = make_scene()
    built = []
    monkeypatch.setattr(
        auto_module, "CpuRenderer", lambda config: built.append(CpuRenderer(config)) or built[-1]
    )
    auto = AutoRenderer(RendererConfig())
    found = [auto(gaussians, cameras) for _ in range(2)][-1]
    assert torch.equal(found.rgb, CpuRenderer(RendererConfig())(gaussians, cameras).rgb)
    assert len(built) == 1, "built once, not at every call"

    flat = torch.zeros(1, 1, 1, 2, 2)
    answer = Rendering(flat.expand(-1, -1, 3, -1, -1), flat, flat)
    monkeypatch.setattr(
        auto_module, "GsplatRenderer", lambda config: lambda *inputs: (answer, inputs)
    )
    scene = SimpleNamespace(means=_OnCuda())
    assert AutoRenderer(RendererConfig())(scene, cameras)[0] is answer

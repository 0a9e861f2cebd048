"""What is particular to `qgs/cpu`."""

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import qgs.renderers
import qgs.renderers.cpu
from qgs.contracts import RendererConfig
from qgs.renderers import COMPONENTS, CpuRenderer
from qgs.types import concatenated, named_tensors


@pytest.fixture
def threads():
    """Restore torch's number of threads."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("views", [1, 3])
def test_the_number_of_threads_changes_no_bit(make_scene, differentiate, threads, views):
    gaussians, cameras = make_scene(views=views, count=300, size=(80, 48), scale=0.2)
    results = []
    for count in (1, 2, 5):
        threads(count)
        results.append(differentiate(CpuRenderer(RendererConfig()), gaussians, cameras))
    for rendering, gradients in results[1:]:
        assert torch.equal(rendering.rgb, results[0][0].rgb)
        assert torch.equal(rendering.depth, results[0][0].depth)
        for name, grad in gradients.items():
            assert torch.equal(grad, results[0][1][name]), name


@pytest.mark.parametrize(
    ("factors", "tolerance"),
    [
        ({"means": torch.tensor([3.0, 3.0, 1.0]), "scales": 3}, 2e-5),  # beyond the borders
        ({"quats": torch.linspace(0.1, 5, 40)[:, None]}, 2e-5),
        ({"scales": torch.tensor([6.0, 0.1, 0.1])}, 1e-4),  # the oracle in float32 is 2e-5 off
    ],
    ids=["wide", "not normalised", "thin"],
)
def test_the_projection_has_the_gradients_of_autograd(
    make_scene, differentiate, factors, tolerance
):
    gaussians, cameras = make_scene(batch=2, views=3)
    changed = {name: getattr(gaussians, name) * factor for name, factor in factors.items()}
    gaussians = replace(gaussians, **changed)
    _, found = differentiate(CpuRenderer(RendererConfig()), gaussians, cameras)
    exact = gaussians.to(torch.float64), cameras.to(torch.float64)
    _, expected = differentiate(qgs.renderers.TorchRenderer(RendererConfig()), *exact)
    for name, grad in found.items():
        error = (grad - expected[name]).abs().max() / expected[name].abs().max()
        assert error < tolerance, name


@pytest.mark.parametrize("more", [{}, {"harmonics": 3, "features": 4}])
def test_more_gaussians_than_a_unit_of_work_takes(make_scene, differentiate, more):
    """Repeating a scene with opacity 0 changes neither its images nor its gradients."""
    gaussians, cameras = make_scene(batch=2, views=2, count=300, **more)
    fillers = replace(gaussians, opacities=gaussians.opacities * 0)
    padded = concatenated([fillers, gaussians], 1)
    renderer = CpuRenderer(RendererConfig())
    rendering, gradients = differentiate(renderer, gaussians, cameras)
    padded_rendering, padded_gradients = differentiate(renderer, padded, cameras)
    assert torch.equal(padded_rendering.rgb, rendering.rgb)
    for name, _ in named_tensors(gaussians):
        assert torch.equal(padded_gradients[name][:, 300:], gradients[name]), name
        assert padded_gradients[name][:, :300].eq(0).all(), name
    for name in ("c2w", "intrinsics"):
        torch.testing.assert_close(padded_gradients[name], gradients[name])


def test_gaussians_have_the_same_gradients_without_those_of_the_cameras(make_scene, differentiate):
    gaussians, cameras = make_scene(views=2)
    renderer = CpuRenderer(RendererConfig())
    means = gaussians.means.clone().requires_grad_()
    (alone,) = torch.autograd.grad(
        renderer(replace(gaussians, means=means), cameras).rgb.sum(), [means]
    )
    poses = cameras.c2w.clone().requires_grad_()
    together = torch.autograd.grad(
        renderer(replace(gaussians, means=means), replace(cameras, c2w=poses)).rgb.sum(),
        [means, poses],
    )
    assert torch.equal(alone, together[0])
    assert together[1].abs().max() > 0


def test_float64_comes_back_as_float64(make_scene):
    gaussians, cameras = make_scene()
    single = CpuRenderer(RendererConfig())(gaussians, cameras)
    gaussians = gaussians.to(torch.float64)
    double = CpuRenderer(RendererConfig())(gaussians, cameras.to(torch.float64))
    assert double.rgb.dtype == double.alpha.dtype == double.depth.dtype == torch.float64
    torch.testing.assert_close(double.rgb.float(), single.rgb, rtol=1e-4, atol=1e-5)


def test_depths_sort_by_value_over_many_magnitudes(make_scene, differentiate):
    gaussians, cameras = make_scene(count=64, scale=0.02)
    depth = torch.logspace(-1.5, 2, 64)[torch.randperm(64)][None, :, None]
    means = gaussians.means / gaussians.means[..., 2:] * depth
    scaled = replace(gaussians, means=means, scales=gaussians.scales * depth)
    found = CpuRenderer(RendererConfig())(scaled, cameras)
    expected = qgs.renderers.TorchRenderer(RendererConfig())(scaled, cameras)
    torch.testing.assert_close(found.rgb, expected.rgb, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.depth, expected.depth, rtol=1e-3, atol=1e-3)


def test_missing_numba_says_what_to_do(monkeypatch):
    monkeypatch.setattr(qgs.renderers.cpu, "can_compile", lambda: False)
    message = r'pip install "query-gaussians\[cpu\]".*qgs/torch'
    with pytest.raises(RuntimeError, match=message):
        CpuRenderer(RendererConfig())


def test_tensors_elsewhere_are_refused(make_scene):
    gaussians, cameras = make_scene()
    with pytest.raises(ValueError, match="renders CPU tensors, got Gaussians on meta"):
        CpuRenderer(RendererConfig())(gaussians.to("meta"), cameras.to("meta"))


def test_importing_the_renderers_imports_neither_numba_nor_gsplat():
    code = "import sys, qgs.renderers; print({'numba', 'gsplat'} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "set()"
    assert {cls.name for cls in COMPONENTS} == {"torch", "cpu", "gsplat", "auto"}


def test_a_forked_process_can_render_after_its_parent_has(make_scene):
    code = (
        "import os, torch\n"
        "from qgs.contracts import RendererConfig\n"
        "from qgs.renderers import CpuRenderer\n"
        "from qgs.types import Cameras, Gaussians\n"
        "g = Gaussians(torch.ones(1, 4, 3), torch.ones(1, 4, 3), torch.eye(4)[None],\n"
        "              torch.ones(1, 4), torch.ones(1, 4, 3))\n"
        "c = Cameras(torch.eye(4)[None, None], torch.full((1, 1, 4), 20.0), (40, 40))\n"
        "torch.set_num_threads(2)\n"
        "render = CpuRenderer(RendererConfig())\n"
        "parent = render(g, c).rgb\n"
        "pid = os.fork()\n"
        "if pid == 0:\n"
        "    os._exit(0 if torch.equal(render(g, c).rgb, parent) else 3)\n"
        "print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))\n"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    assert found.stdout.strip() == "0"


_RENDER_ONE = (
    "import qgs, torch; from qgs.renderers import CpuRenderer as R; "
    "from qgs.contracts import RendererConfig as C; from qgs.types import *; "
    "g = Gaussians(torch.ones(1, 1, 3), torch.ones(1, 1, 3), torch.ones(1, 1, 4) / 2, "
    "torch.ones(1, 1), torch.ones(1, 1, 3)); "
    "c = Cameras(torch.eye(4)[None, None], torch.ones(1, 1, 4), (8, 8)); "
    "print(qgs.__file__, R(C())(g, c).alpha.max().item() > 0)"
)


@pytest.mark.slow
@pytest.mark.parametrize("home", ["home", "file"])
def test_an_installation_that_cannot_be_written_renders(tmp_path: Path, home: str):
    """The cache goes to the user's directory; where that cannot be written either, to none."""
    package = tmp_path / "site" / "qgs"
    source = Path(qgs.renderers.__file__).parents[1]
    shutil.copytree(source, package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "kernels" / "__pycache__").touch()  # stops even root from writing there
    (tmp_path / "file").touch()
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site"), "HOME": str(tmp_path / home)}
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    found = subprocess.run(
        [sys.executable, "-c", _RENDER_ONE],
        capture_output=True, text=True, env=environment, cwd=tmp_path,
    )  # fmt: skip
    assert found.stdout.split() == [str(package / "__init__.py"), "True"], found.stderr
    assert bool(list(tmp_path.rglob("*.nbi"))) is (home == "home")

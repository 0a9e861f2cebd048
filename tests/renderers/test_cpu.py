"""What is particular to `qgs/cpu`."""

import os
import signal
from unittest.mock import Mock

import torch
from renderers.scenes import differentiate, make_scene
from tables import assert_equal, must_refuse
from torch.testing import assert_close

from qgs.containers import concatenated, named_tensors
from qgs.contracts import RendererConfig
from qgs.kernels import kernel
from qgs.renderers import CpuRenderer, TorchRenderer

RENDER = CpuRenderer(RendererConfig())


def test_the_number_of_threads_changes_no_bit():
    for views in (1, 3):
        scene = make_scene(views=views, count=300, size=(80, 48), scale=0.2)
        results = []
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            rendering, gradients = differentiate(RENDER, *scene)
            results.append(dict(named_tensors(rendering)) | gradients)
        for found in results[1:]:
            assert_equal(found, results[0])


def test_more_gaussians_than_a_unit_of_work_takes():
    """Repeating a scene with opacity 0 changes neither its images nor its gradients."""
    for more in ({}, {"harmonics": 3, "features": 4}):
        gaussians, cameras = make_scene(batch=2, views=2, count=300, **more)
        fillers = gaussians.replace(opacities=gaussians.opacities * 0)
        rendering, gradients = differentiate(RENDER, gaussians, cameras)
        padded, found = differentiate(RENDER, concatenated([fillers, gaussians], 1), cameras)
        assert_equal(padded.rgb, rendering.rgb)
        for name, _ in named_tensors(gaussians):
            of_fillers, found[name] = found[name].split(300, 1)
            assert not of_fillers.any(), name
            assert torch.equal(found[name], gradients[name]), name
        assert_close(found, gradients)


def test_tensors_elsewhere_are_refused():
    gaussians, cameras = make_scene()
    away = gaussians.to("meta")
    must_refuse("renders CPU tensors, got Gaussians on meta", RENDER, away, cameras.to("meta"))
    must_refuse("Gaussians are on meta, cameras on cpu", RENDER, away, cameras)


def test_a_forked_process_can_render_after_its_parent_has():
    # Enough work for all threads to start, tensors too small for those of torch.
    scene = make_scene(count=300, size=(96, 48))
    torch.set_num_threads(3)
    parent = RENDER(*scene).rgb
    child = os.fork()
    if not child:
        signal.alarm(20)  # ends the child should it wait for threads that it does not have
        os._exit(0 if torch.equal(RENDER(*scene).rgb, parent) else 3)
    assert os.waitpid(child, 0)[1] == 0


def test_kernels_are_compiled_where_they_cannot_be_kept(monkeypatch):
    def njit(cache=False, **options):
        if cache:
            raise RuntimeError("no locator available")
        return Mock()

    monkeypatch.setattr("numba.njit", njit)
    assert isinstance(kernel(abs), Mock)


def test_needles_lose_no_row_of_the_tiles_that_they_cross():
    given = make_scene(count=150, size=(70, 90), scale=torch.tensor([0.6, 0.002, 0.002]))
    assert_equal(RENDER(*given).rgb, TorchRenderer(RendererConfig())(*given).rgb, atol=2e-4)

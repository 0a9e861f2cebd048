"""MVSplat and DepthSplat against tensors that the released code computed."""

from importlib.util import find_spec, module_from_spec
from pathlib import Path

import parity
import pytest
import torch
from published.files import read_golden
from published.splats import model_of, views_of
from qgs_zoo.mvsplat import sweep
from qgs_zoo.mvsplat.sweep import nearest_neighbours
from torch import nn
from torch.testing import assert_close
from walk import covariances

import qgs
from qgs.geometry.harmonics import SH_C0, harmonics

FILES = """
mvsplat_a mvsplat_views3_a mvsplat_cases_a depthsplat_a depthsplat_base_a depthsplat_base_eighth_a
depthsplat_small_eighth_views4_a depthsplat_cases_a
"""


def read(name):
    return read_golden(Path(__file__).parent / f"golden/{name}.safetensors")


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    """Weights that those of a file replace are not drawn: that would take most of the time."""
    for draw in ("trunc_normal_", "normal_", "uniform_", "kaiming_normal_", "kaiming_uniform_"):
        monkeypatch.setattr(nn.init, draw, lambda x, *_, **__: x)


def test_every_tensor():
    """But of the release's data loader: it crops to whole pixels, sources of photos here do not."""
    for golden in map(read, FILES.split()):
        rows = parity.compared(golden)
        assert not [row for row in rows if row.problem]
        assert {row.name for row in rows} == {*golden.promised()}


@pytest.mark.parametrize("name", ["mvsplat_views3_a", "depthsplat_base_eighth_a"])
def test_a_published_file_gives_the_released_gaussians(name, monkeypatch):
    """Of the recipe that fits, in worlds in which no camera stands at the origin."""
    golden = read(name)
    views = views_of(golden)
    model = model_of(golden)
    # near and far of the files differ from view to view
    near = golden.input("near")
    far = golden.input("far")
    own = model.encoder.predict
    monkeypatch.setattr(model.encoder, "predict", lambda given, *_: own(given, near, far))
    done = qgs.reconstruct(model, views, overrides=["views.scale=constant"])
    assert torch.equal(done.sample.inputs.cameras.c2w, views.cameras.c2w)
    ours = done.gaussians
    theirs = golden.tensors
    # Colours in 50 directions in place of harmonics: the family's rasteriser reads directions as
    # z, x, y, and never degree 4.
    seen = nn.functional.normalize(torch.randn(50, 3), dim=-1)
    sh = theirs["harmonics"][..., :16]
    turned = harmonics(seen[:, [2, 0, 1]], sh.shape[-1] - 1) @ sh[..., 1:].mT
    colours = ours.colors[..., None, :] + harmonics(seen, ours.sh.shape[-2]) @ ours.sh
    found = [ours.means, covariances(ours), ours.opacities, colours]
    wanted = [theirs[name] for name in ("means", "covariances", "opacities")]
    wanted.append(0.5 + SH_C0 * sh[..., None, :, 0] + turned)
    assert_close(found, wanted, rtol=parity.RTOL, atol=parity.ATOL)


def test_both_ways_to_correlate_agree(monkeypatch):
    """Few pixels for each candidate: all pairs at once; many: warped features, in chunks."""
    golden = read("depthsplat_a")
    cameras = views_of(golden).cameras
    features = golden.tensors["features_mv.0"]
    neighbours = nearest_neighbours(cameras.c2w, 2)
    inverse = golden.tensors["inverse_depth_candidates.0"].flatten(0, 1)[..., None, None]
    given = sweep.Sweep(cameras, neighbours, golden.input("near"), golden.input("far"))

    gradients = []
    for pairs, samples in ((sweep.PAIRS, sweep.MAX_SAMPLES), (0, 1 << 15), (40, 1 << 10)):
        monkeypatch.setattr(sweep, "PAIRS", pairs)
        monkeypatch.setattr(sweep, "MAX_SAMPLES", samples)
        learned = features.clone().requires_grad_()
        volume = sweep.cost_volume(learned, inverse, given)
        gradients += torch.autograd.grad(volume.square().sum(), learned)
        # Sums cancel: twice the rounding of the released code's own.
        assert_close(volume, golden.tensors["cost_volume.0"], rtol=1e-4, atol=1.5e-4)
        assert_close(gradients[-1], gradients[0], rtol=1e-4, atol=1.5e-4 * gradients[0].abs().max())


def test_a_module_that_is_imported_in_inference_can_train():
    spec = find_spec("qgs_zoo.mvsplat.adapter")
    with torch.inference_mode():
        fresh = module_from_spec(spec)
        spec.loader.exec_module(fresh)
    rotation = torch.eye(3, requires_grad=True)
    fresh.world_harmonics(rotation, 2).sum().backward()
    assert rotation.grad.any()

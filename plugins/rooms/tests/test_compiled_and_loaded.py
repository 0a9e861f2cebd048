"""Kernels draw the same bits when they are compiled as when they come from numba's cache."""

import subprocess
import sys

import pytest

DRAW = """
import hashlib, sys
from qgs_rooms.source import RoomsSource

source = RoomsSource(RoomsSource.Config(image_size=(64, 64)))
for scene in source.scenes("train")[:20]:
    for kind in sys.argv[1:]:
        for frame in range(len(scene)):
            drawn = getattr(scene, kind)([frame]).numpy()
            print(scene.name, kind, frame, hashlib.sha256(drawn.tobytes()).hexdigest()[:12])
"""
RENDER = """
import hashlib, sys, torch
from qgs.contracts import RendererConfig
from qgs.renderers import CpuRenderer
from qgs.types import Cameras, Gaussians

for count, size in ((40, (24, 40)), (2000, (64, 64)), (5000, (128, 128))):
    random = torch.Generator().manual_seed(count)
    draw = lambda *shape: torch.rand(shape, generator=random)
    means = (draw(2, count, 3) - 0.5) * torch.tensor([3.0, 2.0, 1.0])
    means = means + torch.tensor([0.0, 0.0, 3.0])
    c2w = torch.eye(4).repeat(2, 3, 1, 1)
    c2w[..., :3, 3] = 0.3 * draw(2, 3, 3)
    lens = torch.tensor([0.8 * size[1], 0.8 * size[1], size[1] / 2, size[0] / 2]).repeat(2, 3, 1)
    shape = (2, count)
    inputs = [means, 0.1 * draw(*shape, 3), draw(*shape, 4), draw(*shape), draw(*shape, 3)]
    inputs += [c2w, lens]
    for tensor in inputs:
        tensor.requires_grad_()
    out = CpuRenderer(RendererConfig())(Gaussians(*inputs[:5]), Cameras(c2w, lens, size))
    results = [out.rgb, out.alpha, out.depth]
    if "backward" in sys.argv:
        (out.rgb * draw(*out.rgb.shape)).sum().add(out.depth.sum()).backward()
        results += [tensor.grad for tensor in inputs]
    for place, tensor in enumerate(results):
        print(size, place, hashlib.sha256(tensor.detach().numpy().tobytes()).hexdigest()[:12])
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "first", "everything"),
    [(DRAW, ["depths"], ["images", "depths"]), (RENDER, ["forward"], ["backward"])],
    ids=["rooms", "renderer"],
)
def test_bits_do_not_depend_on_the_cache(tmp_path, monkeypatch, code, first, everything):
    """Compiled at once; some of them loaded and the others compiled; all of them loaded."""

    def drawn(cache, kinds):
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / cache))
        command = [sys.executable, "-c", code, *kinds]
        return set(
            subprocess.run(command, check=True, capture_output=True, text=True).stdout.split("\n")
        )

    compiled = drawn("empty", everything)
    assert len(compiled) > 9
    assert drawn("empty", everything) == compiled
    assert drawn("partly filled", first) <= compiled
    assert drawn("partly filled", everything) == compiled

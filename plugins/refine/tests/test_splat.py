"""The bytes of .splat files."""

from pathlib import Path

import numpy as np
import torch
from commands import run_qgs
from qgs_refine.splat import SPLAT
from torch import Tensor

import qgs
from qgs.types import Gaussians

PARTS = ("means", "scales", "quats", "opacities", "colors")


def random_gaussians(count: int) -> Gaussians:
    def draw(*trailing: int) -> Tensor:
        return torch.rand(1, count, *trailing)

    quats = torch.nn.functional.normalize(draw(4) - 0.5, dim=-1)
    return Gaussians(draw(3) * 10 - 5, draw(3) * 0.5 + 1e-3, quats, draw() * 0.98 + 0.01, draw(3))


def test_the_bytes_of_a_splat_file(tmp_path: Path) -> None:
    given = random_gaussians(300)
    qgs.save_ply(given, tmp_path / "scene.ply")
    run_qgs("convert", tmp_path / "scene.ply", tmp_path / "scene.splat")
    read = np.frombuffer((tmp_path / "scene.splat").read_bytes(), SPLAT)
    assert SPLAT.itemsize == 32
    order = (given.scales[0].prod(-1) * given.opacities[0]).argsort(descending=True)
    means, scales, quats, opacities, colors = (getattr(given, n)[0][order].numpy() for n in PARTS)
    np.testing.assert_array_equal(read["mean"], means)
    np.testing.assert_allclose(read["scale"], scales, rtol=1e-6)
    np.testing.assert_allclose(read["rgba"][:, :3] / 255, colors, atol=0.002)
    np.testing.assert_allclose(read["rgba"][:, 3] / 255, opacities, atol=0.002)
    np.testing.assert_allclose((read["quat"].astype(float) - 128) / 128, quats, atol=0.008)

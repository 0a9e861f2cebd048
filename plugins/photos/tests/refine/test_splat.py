"""The bytes of .splat files."""

import numpy as np
import torch
from commands import run_qgs
from numpy.testing import assert_allclose
from qgs_photos.refine.splat import SPLAT
from test_refining import cloud

import qgs


def test_the_bytes_of_a_splat_file(tmp_path):
    given = cloud(300)
    qgs.save_ply(given, tmp_path / "scene.ply")
    run_qgs("convert", tmp_path / "scene.ply", tmp_path / "scene.splat")
    read = np.frombuffer((tmp_path / "scene.splat").read_bytes(), SPLAT)
    assert SPLAT.itemsize == 32
    given = given[0][(given.scales.prod(-1) * given.opacities)[0].argsort(descending=True)]
    np.testing.assert_array_equal(read["mean"], given.means)
    assert_allclose(read["scale"], given.scales, rtol=1e-6)
    rgba = torch.cat([given.colors, given.opacities[:, None]], 1)
    assert_allclose(read["rgba"] / 255, rgba, atol=0.002)
    assert_allclose((read["quat"].astype(float) - 128) / 128, given.quats, atol=0.008)

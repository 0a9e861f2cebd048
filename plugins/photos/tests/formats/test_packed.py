"""Compressed files: gsply writes and reads them, others read ours."""

import pytest
import torch
from torch.testing import assert_close
from walk import cloud

import qgs
from qgs.geometry.transforms import quat_to_matrix
from qgs.reconstruction.scene_formats import save_gaussians


def covariances(gaussians):
    axes = quat_to_matrix(gaussians.quats) * gaussians.scales[..., None, :]
    return axes @ axes.mT


def assert_close_enough(found, given):
    found = found[0][torch.cdist(given.means[0], found.means[0]).argmin(1)]
    for part in ("means", "opacities", "colors"):
        assert_close(getattr(found, part), getattr(given, part)[0], atol=0.01, rtol=0)
    assert_close(covariances(found), covariances(given)[0], atol=4e-3, rtol=0)
    assert_close(found.sh, given.sh[0], atol=0.04, rtol=0)


@pytest.mark.parametrize("suffix", ["spz", "compressed.ply"])
def test_the_round_trip(tmp_path, suffix):
    sizes = []
    for count in (3, 8, 15):
        sh = torch.rand(1, 300, count, 3) - 0.5
        given = cloud(300).replace(sh=sh)
        save_gaussians(given, tmp_path / f"a.{suffix}")
        assert_close_enough(qgs.load_ply(tmp_path / f"a.{suffix}"), given)
        sizes.append((tmp_path / f"a.{suffix}").stat().st_size)
    # degrees that the scene lacks take no space
    assert sizes[0] < sizes[1] < sizes[2]


def test_positions_in_spz_are_as_fine_as_the_farthest_allows(tmp_path):
    given = cloud(300)
    for factor in (1e-3, 1.0, 1e4):
        far = given.replace(means=factor * given.means)
        save_gaussians(far, tmp_path / "a.spz")
        found = qgs.load_ply(tmp_path / "a.spz")
        step = factor * float(given.means.abs().max()) / 2**22
        assert_close(found.means, far.means, atol=max(step, 2**-24), rtol=0)

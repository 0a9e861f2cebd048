"""Compressed files: gsply writes and reads them, others read ours."""

import json
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from qgs_photos.formats.gltf import save_glb
from tables import assert_equal
from walk import arc, assert_alike, cloud, pinhole

import qgs
from qgs.geometry.transforms import moved
from qgs.reconstruction.scene_formats import save_gaussians


def assert_close_enough(found, given, sh=0.04):
    assert_equal(assert_alike(found, given).sh, given.sh[0], atol=sh)


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
        assert_equal(found.means, far.means, atol=max(step, 2**-24))


def node(*words, folder):
    return subprocess.run(words, cwd=folder, check=True, capture_output=True, text=True).stdout


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("npm") is None, reason="there is no npm: apt install npm")
def test_splat_transform_and_three_read_our_files(tmp_path):
    node("npm", "install", "three@0.187", "@playcanvas/splat-transform@2.7", folder=tmp_path)
    given = cloud(300).replace(sh=torch.rand(1, 300, 15, 3) - 0.5)
    for name in ("a.spz", "a.compressed.ply"):
        save_gaussians(given, tmp_path / name)
        node("npx", "splat-transform", "-w", name, "back.ply", folder=tmp_path)
        assert_close_enough(qgs.load_ply(tmp_path / "back.ply"), given)
    qgs.save_ply(given, tmp_path / "a.ply")
    names = ["back.spz", "back.compressed.ply", "back.glb"]
    if find_spec("imagecodecs"):
        names.append("back.sog")
    for name in names:
        node("npx", "splat-transform", "-g", "cpu", "-w", "a.ply", name, folder=tmp_path)
        found = qgs.load_ply(tmp_path / name)
        if name == "back.glb":
            # it turns about another axis
            found = moved(found, torch.tensor([-1.0, 1, -1, 1]).diag(), 1.0)
        # .spz gives harmonics of degree 2 four bits, .sog has a table of few
        assert_close_enough(found, given, 0.7 if name == "back.sog" else 0.07)

    cameras = pinhole(arc([-20.0, 0, 20], 3).float())[None]
    save_glb(given, tmp_path / "a.glb", {name: cameras[:, [i]] for i, name in enumerate("abc")})
    read = Path(__file__).with_name("read_glb.mjs").read_text()
    (tmp_path / "read.mjs").write_text(read)
    seen = json.loads(node("node", "read.mjs", "a.glb", folder=tmp_path))
    assert seen["counts"] == [300]
    assert [camera["name"] for camera in seen["cameras"]] == [*"abc", "flight"]
    turn = np.diag([1.0, -1, -1, 1])
    lifted = turn.copy()
    lifted[1, 3] = -np.quantile(-given.means[0, :, 1], 0.02)
    for camera, c2w in zip(seen["cameras"], cameras.c2w[0].numpy(), strict=False):
        world = np.reshape(camera["world"], (4, 4)).T
        np.testing.assert_allclose(world, lifted @ c2w @ turn, atol=1e-5)
    assert seen["clips"] == [["flight", 2, ["flight.position", "flight.quaternion"]]]

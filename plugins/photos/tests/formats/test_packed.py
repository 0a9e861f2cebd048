"""Compressed files: gsply writes and reads them, others read ours."""

import shutil
import subprocess
from base64 import b64encode
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from browser import CHROMIUM, chromium
from qgs_photos.formats.gltf import save_glb
from qgs_photos.viewing import VIEWER
from tables import assert_equal
from walk import arc, assert_alike, cloud, pinhole

import qgs
from qgs.geometry.harmonics import seen_colors
from qgs.geometry.transforms import moved
from qgs.reconstruction.scene_formats import save_gaussians

AROUND = pinhole(arc(torch.linspace(0, 700, 50), 3, 0.1).float())[None]
"""Fifty cameras on a spiral around the origin."""
NEEDS_NPM = pytest.mark.skipif(
    shutil.which("npm") is None, reason="there is no npm: apt install npm"
)


def assert_close_enough(found, given, sh=0.04):
    """Also the colours that 50 cameras around see."""
    found = assert_alike(found, given)
    assert_equal(found.sh, given.sh[0], atol=sh)
    seen, expected = (seen_colors(scene, AROUND) for scene in (found[None], given))
    assert (seen - expected).abs().mean() < 0.04


@pytest.mark.parametrize("suffix", ["spz", "compressed.ply"])
def test_the_round_trip(tmp_path, suffix):
    sizes = []
    for count in (3, 8, 15):
        given = cloud(300).replace(sh=torch.rand(1, 300, count, 3) - 0.5)
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
    subprocess.run(words, cwd=folder, check=True, capture_output=True)


@pytest.mark.slow
@NEEDS_NPM
def test_splat_transform_reads_our_files_and_we_its(tmp_path):
    node("npm", "install", "@playcanvas/splat-transform@2.7", folder=tmp_path)
    given = cloud(300).replace(sh=torch.rand(1, 300, 15, 3) - 0.5)
    for name in ("a.spz", "a.compressed.ply"):
        save_gaussians(given, tmp_path / name)
        node("npx", "splat-transform", "-w", name, "back.ply", folder=tmp_path)
        assert_close_enough(qgs.load_ply(tmp_path / "back.ply"), given)
    save_gaussians(given.replace(sh=None), tmp_path / "a.splat")
    node("npx", "splat-transform", "-w", "a.splat", "back.ply", folder=tmp_path)
    assert_alike(qgs.load_ply(tmp_path / "back.ply"), given)
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


@pytest.mark.slow
@NEEDS_NPM
@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium: apt install chromium")
def test_three_draws_our_scene_from_50_cameras_of_the_file(tmp_path):
    node("npm", "install", "three@0.187", folder=tmp_path)
    given = cloud(300).replace(sh=torch.rand(1, 300, 15, 3) - 0.5, opacities=torch.ones(1, 300))
    cameras = {f"camera_{place}": AROUND[:, [place]] for place in range(50)}
    save_glb(given, tmp_path / "a.glb", cameras)
    html = Path(__file__).with_name("read_glb.html").read_text()
    data = b64encode((tmp_path / "a.glb").read_bytes()).decode()
    (tmp_path / "a.html").write_text(html.replace("a.glb", f"data:;base64,{data}"))
    with chromium(tmp_path / "profile", "--allow-file-access-from-files") as page:
        page.open((tmp_path / "a.html").as_uri())
        page.until("the pictures", "!!window.seen")
        seen = page.evaluate("seen")
    assert seen["counts"] == [300]
    assert seen["clips"] == [["flight", 49, ["flight.position", "flight.quaternion"]]]
    assert [view["name"] for view in seen["views"]] == [*cameras, "flight"]
    views = seen["views"][:-1]
    poses = AROUND.c2w[0] @ torch.tensor([1.0, -1, -1, 1]).diag()
    worlds = torch.tensor([view["world"] for view in views]).view(50, 4, 4).mT
    assert_equal(worlds[0].inverse() @ worlds, poses[0].inverse() @ poses, atol=1e-4)
    render = VIEWER(given, AROUND)
    pixels = torch.tensor([view["pixels"] for view in views]).view(50, 64, 64, 4)[..., :3]
    errors = (pixels / 255 - render.rgb[0].movedim(1, -1).clamp(0, 1)).abs().mean(-1)
    for error, alpha in zip(errors, render.alpha[0, :, 0], strict=True):
        # it blends edges in another way
        assert error[alpha > 0.9].mean() < 0.06

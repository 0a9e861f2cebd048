from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from qgs.data.scenes import warn_once
from qgs.io.ply import OPACITY_EPS, PROPERTIES, SH_C0, load_ply, save_ply
from qgs.types import Gaussians


def random_gaussians(*batch: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def draw(*trailing: int) -> torch.Tensor:
        return torch.rand(*batch, *trailing, generator=generator)

    return Gaussians(
        means=draw(3) * 10 - 5,
        scales=draw(3) * 0.5 + 1e-3,
        quats=torch.nn.functional.normalize(draw(4) - 0.5, dim=-1),
        opacities=draw() * 0.98 + 0.01,
        colors=draw(3),
    )


def test_round_trip(tmp_path):
    gaussians = random_gaussians(1, 200)
    save_ply(gaussians, tmp_path / "scene.ply")
    again = load_ply(tmp_path / "scene.ply")
    for name in ("means", "scales", "quats", "opacities", "colors"):
        torch.testing.assert_close(getattr(again, name), getattr(gaussians, name))


def test_file_follows_the_3dgs_conventions(tmp_path):
    gaussians = random_gaussians(50)
    save_ply(gaussians, tmp_path / "scene.ply")
    ply = PlyData.read(str(tmp_path / "scene.ply"))
    assert not ply.text
    assert ply.byte_order == "<"
    assert ply["vertex"].data.dtype == np.dtype([(name, "<f4") for name in PROPERTIES])
    vertex = ply["vertex"]
    np.testing.assert_array_equal(vertex["y"], gaussians.means[:, 1])
    np.testing.assert_allclose(0.5 + SH_C0 * vertex["f_dc_2"], gaussians.colors[:, 2], rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-vertex["opacity"])), gaussians.opacities, rtol=1e-5)
    np.testing.assert_allclose(np.exp(vertex["scale_1"]), gaussians.scales[:, 1], rtol=1e-5)
    np.testing.assert_array_equal(vertex["rot_0"], gaussians.quats[:, 0])


def test_certain_opacities_stay_finite(tmp_path):
    gaussians = random_gaussians(2)
    gaussians.opacities.copy_(torch.tensor([0.0, 1.0]))
    save_ply(gaussians, tmp_path / "scene.ply")
    opacities = load_ply(tmp_path / "scene.ply").opacities[0]
    torch.testing.assert_close(opacities, torch.tensor([OPACITY_EPS, 1 - OPACITY_EPS]))


def test_no_gaussians_at_all(tmp_path):
    save_ply(random_gaussians(1, 0), tmp_path / "empty.ply")
    assert load_ply(tmp_path / "empty.ply").count == 0


def test_several_scenes_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"one scene.*\(2,\)"):
        save_ply(random_gaussians(2, 5), tmp_path / "two.ply")
    assert not list(tmp_path.iterdir())


def test_numbers_that_are_not_finite_are_refused_and_nothing_is_left(tmp_path):
    gaussians = random_gaussians(4)
    gaussians.means[2, 0] = float("nan")
    with pytest.raises(ValueError, match="1 of 4 Gaussians"):
        save_ply(gaussians, tmp_path / "nan.ply")
    assert not list(tmp_path.iterdir())


def test_the_layout_is_that_of_the_3dgs_release(tmp_path):
    save_ply(random_gaussians(3), tmp_path / "scene.ply")
    vertex = PlyData.read(tmp_path / "scene.ply")["vertex"].data
    assert vertex.dtype.names is not None
    assert len(vertex.dtype.names) == 62
    assert vertex.dtype.names[8:10] == ("f_dc_2", "f_rest_0")
    assert vertex.dtype.names[53:56] == ("f_rest_44", "opacity", "scale_0")
    assert not any(vertex[f"f_rest_{index}"].any() for index in range(45))


def test_a_parser_of_others_reads_the_same_numbers(tmp_path):
    gsply = pytest.importorskip("gsply", reason="gsply, a reader of splat files, is not installed")
    gaussians = random_gaussians(1, 200)
    save_ply(gaussians, tmp_path / "scene.ply")
    read = gsply.plyread(str(tmp_path / "scene.ply"))
    for name, values in {
        "means": read.means,
        "scales": np.exp(read.scales),
        "quats": read.quats,
        "opacities": 1 / (1 + np.exp(-read.opacities)),
        "colors": 0.5 + SH_C0 * read.sh0,
    }.items():
        np.testing.assert_allclose(
            values.reshape(getattr(gaussians, name)[0].shape),
            getattr(gaussians, name)[0],
            rtol=1e-5,
            atol=1e-6,
            err_msg=name,
        )


def test_files_of_others_are_read(tmp_path, caplog):
    gaussians = random_gaussians(5)
    save_ply(gaussians, tmp_path / "scene.ply")
    vertices = PlyData.read(tmp_path / "scene.ply")["vertex"].data
    few = [name for name in PROPERTIES if not name.startswith(("f_rest", "n"))]
    smaller = np.empty(5, dtype=[(name, ">f8") for name in reversed(few)])
    for name in few:
        smaller[name] = vertices[name] * (2 if name.startswith("rot") else 1)
    PlyData([PlyElement.describe(smaller, "vertex")], text=True).write(tmp_path / "other.ply")
    torch.testing.assert_close(load_ply(tmp_path / "other.ply").quats[0], gaussians.quats)
    assert caplog.text == ""


@pytest.mark.parametrize("count", [3, 8, 15])
def test_harmonics_make_the_round_trip(tmp_path, count):
    gaussians = replace(random_gaussians(1, 20), sh=torch.randn(1, 20, count, 3))
    save_ply(gaussians, tmp_path / "scene.ply")
    again = load_ply(tmp_path / "scene.ply")
    assert torch.equal(again.sh, gaussians.sh)
    torch.testing.assert_close(again.colors, gaussians.colors)


def test_harmonics_lie_channel_by_channel(tmp_path):
    """f_rest_0 to 14 are red, 15 to 29 green, 30 to 44 blue, as in the 3DGS release."""
    gaussians = replace(random_gaussians(5), sh=torch.randn(5, 8, 3))
    save_ply(gaussians, tmp_path / "scene.ply")
    vertices = PlyData.read(tmp_path / "scene.ply")["vertex"].data
    for channel, coefficient in ((0, 0), (1, 7), (2, 3)):
        column = vertices[f"f_rest_{15 * channel + coefficient}"]
        np.testing.assert_array_equal(column, gaussians.sh[:, coefficient, channel])
    assert not any(vertices[f"f_rest_{15 * channel + 8}"].any() for channel in range(3))


def test_a_parser_of_others_reads_the_same_harmonics(tmp_path):
    gsply = pytest.importorskip("gsply", reason="gsply, a reader of splat files, is not installed")
    gaussians = replace(random_gaussians(1, 20), sh=torch.randn(1, 20, 15, 3))
    save_ply(gaussians, tmp_path / "scene.ply")
    read = gsply.plyread(str(tmp_path / "scene.ply")).shN
    np.testing.assert_array_equal(read.reshape(20, 15, 3), gaussians.sh[0])


def test_files_of_fewer_degrees_are_read(tmp_path):
    gaussians = replace(random_gaussians(4), sh=torch.randn(4, 3, 3))
    save_ply(gaussians, tmp_path / "scene.ply")
    vertices = PlyData.read(tmp_path / "scene.ply")["vertex"].data

    def written(name: str, rest: int) -> Path:
        kept = [n for n in PROPERTIES if not n.startswith("f_rest_")]
        fewer = np.zeros(4, [(n, "<f4") for n in (*kept, *(f"f_rest_{i}" for i in range(rest)))])
        for n in kept:
            fewer[n] = vertices[n]
        for channel in range(3 if rest == 9 else 0):
            for i in range(3):
                fewer[f"f_rest_{3 * channel + i}"] = vertices[f"f_rest_{15 * channel + i}"]
        PlyData([PlyElement.describe(fewer, "vertex")]).write(tmp_path / name)
        return tmp_path / name

    assert torch.equal(load_ply(written("first.ply", 9)).sh[0], gaussians.sh)
    assert load_ply(written("zeros.ply", 24)).sh is None
    with pytest.raises(ValueError, match=r"odd.ply has 10 properties f_rest_\*; .* f_rest_8, "):
        load_ply(written("odd.ply", 10))


def test_features_are_left_out_with_a_word(tmp_path, caplog):
    gaussians = replace(random_gaussians(1, 4), features=torch.ones(1, 4, 2))
    warn_once.cache_clear()
    save_ply(gaussians, tmp_path / "scene.ply")
    assert "no place for `features`: they are left out" in caplog.text
    assert load_ply(tmp_path / "scene.ply").features is None


def test_harmonics_that_are_not_finite_are_refused(tmp_path):
    gaussians = replace(random_gaussians(4), sh=torch.zeros(4, 3, 3))
    gaussians.sh[1:3, 2, 0] = torch.inf
    with pytest.raises(ValueError, match="2 of 4 Gaussians"):
        save_ply(gaussians, tmp_path / "inf.ply")


def test_what_is_no_ply_of_gaussians_is_refused(tmp_path):
    points = np.zeros(3, dtype=[(name, "<f4") for name in ("x", "y", "z")])
    chunks = np.zeros(1, dtype=[("min_x", "<f4")])
    elements = [PlyElement.describe(points, "vertex"), PlyElement.describe(chunks, "chunk")]
    PlyData(elements[:1]).write(tmp_path / "points.ply")
    PlyData(elements).write(tmp_path / "compressed.ply")
    save_ply(random_gaussians(3), tmp_path / "whole.ply")
    (tmp_path / "cut.ply").write_bytes((tmp_path / "whole.ply").read_bytes()[:-5])
    (tmp_path / "noise.ply").write_bytes(b"\x89PNG\r\n\xff")
    for name, told in {
        "points": "is no PLY of Gaussians: it lacks f_dc_0",
        "compressed": "is a compressed PLY: it lacks",
        "cut": "is no whole PLY file",
        "noise": "is no whole PLY file",
    }.items():
        with pytest.raises(ValueError, match=f"{name}.ply {told}"):
            load_ply(tmp_path / f"{name}.ply")
    with pytest.raises(FileNotFoundError):
        load_ply(tmp_path / "none.ply")

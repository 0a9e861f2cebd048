import numpy as np
import pytest
import torch
from plyfile import PlyData

from qgs.io.ply import OPACITY_EPS, PROPERTIES, SH_C0, write_ply
from qgs.types import Gaussians


def read_ply(path) -> Gaussians:
    vertices = PlyData.read(str(path))["vertex"].data

    def columns(*names: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([vertices[name] for name in names], -1, dtype=np.float32))

    return Gaussians(
        means=columns("x", "y", "z"),
        scales=columns("scale_0", "scale_1", "scale_2").exp(),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        opacities=columns("opacity")[:, 0].sigmoid(),
        colors=columns("f_dc_0", "f_dc_1", "f_dc_2") * SH_C0 + 0.5,
    )[None]


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
    write_ply(gaussians, tmp_path / "scene.ply")
    again = read_ply(tmp_path / "scene.ply")
    for name in ("means", "scales", "quats", "opacities", "colors"):
        torch.testing.assert_close(getattr(again, name), getattr(gaussians, name))


def test_file_follows_the_3dgs_conventions(tmp_path):
    gaussians = random_gaussians(50)
    write_ply(gaussians, tmp_path / "scene.ply")
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
    write_ply(gaussians, tmp_path / "scene.ply")
    opacities = read_ply(tmp_path / "scene.ply").opacities[0]
    torch.testing.assert_close(opacities, torch.tensor([OPACITY_EPS, 1 - OPACITY_EPS]))


def test_no_gaussians_at_all(tmp_path):
    write_ply(random_gaussians(1, 0), tmp_path / "empty.ply")
    assert read_ply(tmp_path / "empty.ply").count == 0


def test_several_scenes_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"one scene.*\(2,\)"):
        write_ply(random_gaussians(2, 5), tmp_path / "two.ply")
    assert not list(tmp_path.iterdir())


def test_numbers_that_are_not_finite_are_refused_and_nothing_is_left(tmp_path):
    gaussians = random_gaussians(4)
    gaussians.means[2, 0] = float("nan")
    with pytest.raises(ValueError, match="1 of 4 Gaussians"):
        write_ply(gaussians, tmp_path / "nan.ply")
    assert not list(tmp_path.iterdir())

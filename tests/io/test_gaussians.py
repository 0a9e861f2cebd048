"""Files of Gaussians: PLY as other programs write and read it, .splat, a format of a plug-in."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import run_qgs
from plyfile import PlyData, PlyElement
from torch import Tensor

import qgs
from qgs.extensions import ExtensionError
from qgs.io.gaussians import (
    OPACITY_EPS,
    PROPERTIES,
    SH_C0,
    load_ply,
    save_gaussians,
    save_ply,
)
from qgs.types import Gaussians, map_tensors

PARTS = ("means", "scales", "quats", "opacities", "colors")


def random_gaussians(*batch: int) -> Gaussians:
    def draw(*trailing: int) -> Tensor:
        return torch.rand(*batch, *trailing)

    quats = torch.nn.functional.normalize(draw(4) - 0.5, dim=-1)
    return Gaussians(draw(3) * 10 - 5, draw(3) * 0.5 + 1e-3, quats, draw() * 0.98 + 0.01, draw(3))


def with_harmonics(gaussians: Gaussians, count: int) -> tuple[Gaussians, Tensor]:
    sh = torch.randn(*gaussians.means.shape[:-1], count, 3)
    return replace(gaussians, sh=sh), sh


def vertices_of(path: Path) -> np.ndarray:
    return PlyData.read(str(path))["vertex"].data


def test_the_file_is_that_of_the_3dgs_release(tmp_path: Path) -> None:
    gaussians = random_gaussians(50)
    save_ply(gaussians, tmp_path / "scene.ply")
    ply = PlyData.read(str(tmp_path / "scene.ply"))
    assert (ply.text, ply.byte_order) == (False, "<")
    vertex = ply["vertex"].data
    names = vertex.dtype.names or ()
    assert len(names) == 62
    assert names[8:10] == ("f_dc_2", "f_rest_0")
    assert names[53:56] == ("f_rest_44", "opacity", "scale_0")
    assert vertex.dtype == np.dtype([(name, "<f4") for name in PROPERTIES])
    assert not any(vertex[f"f_rest_{index}"].any() for index in range(45))
    np.testing.assert_array_equal(vertex["y"], gaussians.means[:, 1])
    np.testing.assert_allclose(0.5 + SH_C0 * vertex["f_dc_2"], gaussians.colors[:, 2], rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-vertex["opacity"])), gaussians.opacities, rtol=1e-5)
    np.testing.assert_allclose(np.exp(vertex["scale_1"]), gaussians.scales[:, 1], rtol=1e-5)
    np.testing.assert_array_equal(vertex["rot_0"], gaussians.quats[:, 0])


@pytest.mark.parametrize("harmonics", [0, 3, 8, 15])
def test_the_round_trip(tmp_path: Path, harmonics: int) -> None:
    given = random_gaussians(1, 200)
    if harmonics:
        given, _ = with_harmonics(given, harmonics)
    save_ply(given, tmp_path / "scene.ply")
    again = load_ply(tmp_path / "scene.ply")
    for name in PARTS:
        torch.testing.assert_close(getattr(again, name), getattr(given, name))
    assert (again.sh is None) == (given.sh is None)
    if given.sh is not None and again.sh is not None:
        assert torch.equal(again.sh, given.sh)


def test_certain_opacities_stay_finite(tmp_path: Path) -> None:
    gaussians = random_gaussians(2)
    gaussians.opacities.copy_(torch.tensor([0.0, 1.0]))
    save_ply(gaussians, tmp_path / "scene.ply")
    opacities = load_ply(tmp_path / "scene.ply").opacities[0]
    torch.testing.assert_close(opacities, torch.tensor([OPACITY_EPS, 1 - OPACITY_EPS]))


def test_several_scenes_and_numbers_that_are_not_finite_leave_no_file(tmp_path: Path) -> None:
    broken, (harmonic, sh) = random_gaussians(4), with_harmonics(random_gaussians(4), 3)
    broken.means[2, 0] = torch.nan
    sh[1:3, 2, 0] = torch.inf
    for gaussians, words in (
        (random_gaussians(2, 5), "one scene"),
        (broken, "1 of 4"),
        (harmonic, "2 of 4"),
    ):
        with pytest.raises(ValueError, match=words):
            save_ply(gaussians, tmp_path / "a.ply")
    assert not list(tmp_path.iterdir())


def test_another_parser_reads_the_same_numbers(tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply", reason="gsply, a reader of splat files, is not installed")
    gaussians, sh = with_harmonics(random_gaussians(1, 200), 15)
    save_ply(gaussians, tmp_path / "scene.ply")
    read = gsply.plyread(str(tmp_path / "scene.ply"))
    values = (
        *(read.means, np.exp(read.scales), read.quats, 1 / (1 + np.exp(-read.opacities))),
        0.5 + SH_C0 * read.sh0,
    )
    for name, found in zip(PARTS, values, strict=True):
        wanted = getattr(gaussians, name)[0]
        np.testing.assert_allclose(found.reshape(wanted.shape), wanted, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(read.shN.reshape(200, 15, 3), sh[0])


def test_harmonics_lie_channel_by_channel(tmp_path: Path) -> None:
    """f_rest_0 to 14 are red, 15 to 29 green, 30 to 44 blue, as in the 3DGS release."""
    gaussians, sh = with_harmonics(random_gaussians(5), 8)
    save_ply(gaussians, tmp_path / "scene.ply")
    vertices = vertices_of(tmp_path / "scene.ply")
    for channel, coefficient in ((0, 0), (1, 7), (2, 3)):
        column = vertices[f"f_rest_{15 * channel + coefficient}"]
        np.testing.assert_array_equal(column, sh[:, coefficient, channel])
    assert not any(vertices[f"f_rest_{15 * channel + 8}"].any() for channel in range(3))


def test_files_of_others_are_read(tmp_path: Path) -> None:
    """Text, float64, big-endian, properties in another order, quaternions that are not unit."""
    gaussians = random_gaussians(5)
    save_ply(gaussians, tmp_path / "scene.ply")
    vertices = vertices_of(tmp_path / "scene.ply")
    few = [name for name in PROPERTIES if not name.startswith(("f_rest", "n"))]
    smaller = np.empty(5, dtype=[(name, ">f8") for name in reversed(few)])
    for name in few:
        smaller[name] = vertices[name] * (2 if name.startswith("rot") else 1)
    PlyData([PlyElement.describe(smaller, "vertex")], text=True).write(tmp_path / "other.ply")
    torch.testing.assert_close(load_ply(tmp_path / "other.ply").quats[0], gaussians.quats)


def test_files_of_fewer_degrees_are_read(tmp_path: Path) -> None:
    gaussians, sh = with_harmonics(random_gaussians(4), 3)
    save_ply(gaussians, tmp_path / "scene.ply")
    vertices = vertices_of(tmp_path / "scene.ply")

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

    found = load_ply(written("first.ply", 9)).sh
    assert found is not None
    assert torch.equal(found[0], sh)
    assert load_ply(written("zeros.ply", 24)).sh is None
    with pytest.raises(ValueError, match="10 properties"):
        load_ply(written("other.ply", 10))


def test_other_files_are_refused_by_name(tmp_path: Path) -> None:
    points = np.zeros(3, dtype=[(name, "<f4") for name in ("x", "y", "z")])
    chunks = np.zeros(1, dtype=[("min_x", "<f4")])
    elements = [PlyElement.describe(points, "vertex"), PlyElement.describe(chunks, "chunk")]
    PlyData(elements[:1]).write(tmp_path / "points.ply")
    PlyData(elements).write(tmp_path / "compressed.ply")
    save_ply(random_gaussians(3), tmp_path / "whole.ply")
    (tmp_path / "cut.ply").write_bytes((tmp_path / "whole.ply").read_bytes()[:-5])
    whole = (tmp_path / "whole.ply").read_bytes()
    (tmp_path / "noise.ply").write_bytes(b"\x89PNG\r\n\xff")
    (tmp_path / "empty.ply").touch()
    (tmp_path / "negative.ply").write_bytes(whole.replace(b"vertex 3", b"vertex -3"))
    (tmp_path / "promise.ply").write_bytes(whole.replace(b"vertex 3", b"vertex 3000000000"))
    text = whole.replace(b"binary_little_endian", b"ascii").replace(b" 3", b" " + b"9" * 19)
    (tmp_path / "text.ply").write_bytes(text)
    (tmp_path / "twice.ply").write_bytes(whole.replace(b"float nx", b"float x"))
    comments = whole.replace(b"element", b"comment x\n" * 10_000 + b"element")
    (tmp_path / "long.ply").write_bytes(comments)
    faces = b"element face 100000000\nproperty list uint float v\nend_header"
    (tmp_path / "faces.ply").write_bytes(whole.replace(b"end_header", faces))
    zeros = random_gaussians(3)
    save_ply(replace(zeros, quats=zeros.quats * 0), tmp_path / "no_rotation.ply")
    save_ply(random_gaussians(0), tmp_path / "nothing.ply")
    large = bytearray(whole)
    large[-28:-24] = np.float32(88).tobytes()  # the square of its exponential overflows
    (tmp_path / "large.ply").write_bytes(large)
    names = ("points", "compressed", "cut", "noise", "empty", "negative", "promise", "text")
    for name in (*names, "twice", "long", "faces", "no_rotation", "large", "nothing"):
        with pytest.raises(ValueError, match=rf"{name}\.ply"):
            load_ply(tmp_path / f"{name}.ply")
    os.mkfifo(tmp_path / "pipe.ply")  # reading it would wait for a writer
    for name in ("none", "pipe"):
        with pytest.raises(FileNotFoundError, match=rf"{name}\.ply"):
            load_ply(tmp_path / f"{name}.ply")


def test_convert_keeps_the_most_opaque(tmp_path: Path) -> None:
    given, sh = with_harmonics(random_gaussians(1, 50), 8)
    qgs.save_ply(given, tmp_path / "all.ply")
    done = run_qgs("convert", tmp_path / "all.ply", tmp_path / "few.ply", "--count", 7)
    assert "7 of 50 Gaussians" in done.output
    few = load_ply(tmp_path / "few.ply")
    best = given.opacities[0].topk(7).indices.sort().values  # in the order of the file
    torch.testing.assert_close(few.means[0], given.means[0, best])
    assert few.sh is not None
    assert torch.equal(few.sh[0], sh[0, best])
    assert run_qgs("convert", tmp_path / "all.ply", tmp_path / "same.PLY").exception is None
    assert torch.equal(load_ply(tmp_path / "same.PLY").means, given.means)
    assert given.most_opaque(99).count == 50
    plain = replace(given, sh=None)
    halves = map_tensors(lambda x: torch.cat([x, x.flip(1)]), plain).most_opaque(5)
    torch.testing.assert_close(halves.colors[0], halves.colors[1].flip(0))
    assert run_qgs("convert", tmp_path / "few.ply", tmp_path / "few.splat").exception is None
    assert (tmp_path / "few.splat").stat().st_size == 7 * 32


def test_other_suffixes_and_files_that_exist_are_refused(tmp_path: Path) -> None:
    qgs.save_ply(random_gaussians(2), tmp_path / "a.ply")
    before = (tmp_path / "a.ply").read_bytes()
    error = run_qgs("convert", tmp_path / "a.ply", tmp_path / "a.spz").exception
    assert isinstance(error, ValueError)
    assert ".splat" in str(error)
    error = run_qgs("convert", tmp_path / "a.ply", tmp_path / "a.ply").exception
    assert isinstance(error, FileExistsError)
    assert (tmp_path / "a.ply").read_bytes() == before


def test_an_installed_distribution_adds_a_format(install, tmp_path: Path) -> None:
    source = """
        def plugin(gaussians, path):
            path.write_text(str(gaussians.count))
        """
    install("qgs-xyz", "xyz", source, group="qgs.scene_writers")
    qgs.save_ply(random_gaussians(5), tmp_path / "a.ply")
    assert run_qgs("convert", tmp_path / "a.ply", tmp_path / "a.XYZ").exception is None
    assert (tmp_path / "a.XYZ").read_text() == "5"
    with pytest.raises(ValueError, match=r"\.xyz"):
        save_gaussians(random_gaussians(5), tmp_path / "a.abc")


def test_a_format_that_cannot_be_imported_is_refused_before_the_work(
    install, tmp_path: Path
) -> None:
    install("qgs-xyz", "xyz", "import no_such_package", group="qgs.scene_writers")
    with pytest.raises(ExtensionError, match=r"qgs-xyz 1\.2"):
        save_gaussians(random_gaussians(5), tmp_path / "a.xyz")
    missing = tmp_path / "missing.safetensors"  # not even read
    error = run_qgs("reconstruct", missing, tmp_path, "--out", tmp_path / "a.xyz").exception
    assert isinstance(error, ExtensionError)

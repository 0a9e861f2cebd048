"""Files of Gaussians: PLY as other programs write and read it, .splat, a format of a plug-in."""

import os
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import done
from numpy.lib.recfunctions import repack_fields
from numpy.testing import assert_allclose, assert_array_equal
from plyfile import PlyData, PlyElement
from tables import assert_equal, must_not_find, must_refuse
from torch.testing import assert_close
from walk import assert_alike, cloud

import qgs
from qgs.containers import concatenated
from qgs.extensions import ExtensionError
from qgs.reconstruction.scene_formats import PROPERTIES, load_ply, save_gaussians, save_ply

pytestmark = pytest.mark.usefixtures("here")
FIRST = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2"
REST = [f"f_rest_{index}" for index in range(45)]
LAST = "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"


def harmonic(number, harmonics):
    return cloud(number).replace(sh=torch.randn(1, number, harmonics, 3))


def saved(name, gaussians):
    save_ply(gaussians, name)
    return Path(name)


def vertices_of(path):
    return PlyData.read(str(path))["vertex"].data


def ply(**elements):
    described = [PlyElement.describe(data, name) for name, data in elements.items()]
    file = BytesIO()
    PlyData(described).write(file)
    return file.getvalue()


def test_the_file_is_that_of_the_3dgs_release():
    """f_rest_0 to 14 are red, 15 to 29 green, 30 to 44 blue."""
    names = [*FIRST.split(), *REST, *LAST.split()]
    given = harmonic(50, 8)[0]
    for gaussians in (given, given.replace(sh=None)):
        rest = torch.zeros(50, 3, 15)
        if gaussians.sh is not None:
            rest[..., :8] = gaussians.sh.mT
        columns = [
            given.means,
            torch.zeros(50, 3),
            (given.colors - 0.5) / 0.28209479177387814,
            rest.flatten(1),
            given.opacities.logit()[:, None],
            given.scales.log(),
            given.quats,
        ]
        whole = PlyData.read(str(saved("scene.ply", gaussians)))
        assert whole.text is False
        assert whole.byte_order == "<"
        vertex = whole["vertex"].data
        assert vertex.dtype == np.dtype([(name, "<f4") for name in names])
        assert_close(torch.tensor(vertex.tolist()), torch.cat(columns, 1))


def test_the_round_trip():
    """Of opacities and scales too whose logits and logarithms are infinite."""
    for given in (cloud(200), *(harmonic(200, count) for count in (3, 8, 15))):
        given.opacities[0, :2] = torch.tensor([0.0, 1.0])
        given.scales[0, 0] = 0
        path = saved("scene.ply", given)
        assert all(np.isfinite(vertices_of(path)[name]).all() for name in PROPERTIES)
        assert_close(vars(load_ply(path)), vars(given))


def test_several_scenes_and_numbers_that_are_not_finite_leave_no_file():
    broken = cloud(4)
    more = harmonic(4, 3)
    broken.means[0, 2, 0] = torch.nan
    more.sh[0, 1:3, 2, 0] = torch.inf
    for gaussians, words in (
        (concatenated([cloud(5)] * 2, 0), "one scene"),
        (broken, "1 of 4"),
        (more, "2 of 4"),
    ):
        must_refuse(words, save_ply, gaussians, "a.ply")
    assert not os.listdir()


def test_files_of_others_are_understood(caplog):
    """Text, float64, big-endian, properties in another order, quaternions that are not unit.

    Numbers that are not finite, filters of Mip-Splatting, coordinates of maps.
    """
    given = cloud(9)[0]
    path = saved("a.ply", given)
    few = [name for name in PROPERTIES if not name.startswith(("f_rest", "n"))]
    vertices = np.zeros(9, [(name, ">f8") for name in ("filter_3D", *reversed(few))])
    for name in few:
        vertices[name] = vertices_of(path)[name] * (2 if name.startswith("rot") else 1)

    def read(name, values):
        other = vertices.copy()
        other[name] += values
        PlyData([PlyElement.describe(other, "vertex")], text=True).write(path)
        return load_ply(path)

    # the square of the last one's exponential overflows
    assert_close(read("scale_1", [np.nan, np.inf, 88, *[0] * 6]).quats[0], given.quats[3:])
    assert "left out 3 of 9" in caplog.text
    filtered = read("filter_3D", 0.3)[0]
    wide = (given.scales**2 + 0.3**2).sqrt()
    assert_close(filtered.scales, wide)
    assert_close(filtered.opacities, given.opacities * (given.scales / wide).prod(-1))
    far = read("y", 5_412_250.125)
    save_gaussians(far, "far.splat")
    assert caplog.text.count(" 5412250.0 ") == 1
    place = torch.tensor([0, 5_412_250.125, 0], dtype=torch.float64)
    for gaussians in (far, load_ply(saved(path, far))):
        assert_close(gaussians.means[0] - place, given.means.double(), atol=1e-6, rtol=1e-5)
    assert np.abs(vertices_of(path)["y"]).max() < 20


def test_packed_files_of_other_programs_are_read():
    """PlayCanvas' splat-transform wrote the same Gaussians, each time in another order."""
    folder = Path(__file__).parent / "packed"
    expected = load_ply(folder / "scene.splat")
    found = (load_ply(folder / name) for name in ("scene.spz", "scene.compressed.ply"))
    assert_equal(*(assert_alike(each, expected).sh for each in found), atol=0.02)


def test_files_of_fewer_degrees_are_read():
    given = harmonic(4, 3)
    vertices = vertices_of(saved("scene.ply", given))
    kept = [name for name in PROPERTIES if name not in REST]

    def written(rest):
        fewer = repack_fields(vertices[[*kept, *rest]])
        fewer.dtype.names = [*kept, *REST[: len(rest)]]
        path = Path("fewer.ply")
        path.write_bytes(ply(vertex=fewer))
        return path

    first = REST[0:3] + REST[15:18] + REST[30:33]
    zeros = REST[3:15] + REST[18:30]
    assert_equal(load_ply(written(first)).sh, given.sh)
    assert load_ply(written(zeros)).sh is None
    must_refuse("10 properties", load_ply, written(zeros[:10]))


def test_other_files_are_refused_by_name():
    points = np.zeros(3, [(name, "<f4") for name in "xyz"])
    chunks = np.zeros(1, [("min_x", "<f4")])
    some = cloud(3)
    whole = saved("whole.ply", some).read_bytes()
    still = saved("still.ply", some.replace(quats=some.quats * 0)).read_bytes()
    faces = b"element face 100000000\nproperty list uint float v\nend_header"
    for name, content in {
        "compressed.ply": ply(vertex=points, chunk=chunks),
        "cut.ply": whole[:-5],
        "noise.ply": b"\x89PNG\r\n\xff",
        "promise.ply": whole.replace(b"vertex 3", b"vertex 3000000000"),
        "long.ply": whole.replace(b"element", b"comment x\n" * 10_000 + b"element"),
        "faces.ply": whole.replace(b"end_header", faces),
        "without rotation.ply": still,
        "without any.ply": saved("none.ply", cloud(0)).read_bytes(),
        "4.spz": b"NGSP\4\0\0\0\5\0\0\0",
    }.items():
        path = Path(name)
        path.write_bytes(content)
        must_refuse(f"{name}.*(splat-transform|holds no Gaussians)", load_ply, path)
    os.mkfifo("pipe.ply")  # reading it would wait for a writer
    for name in ("missing.ply", "pipe.ply"):
        must_not_find(name, load_ply, name)


def test_convert_keeps_the_most_opaque():
    given = harmonic(50, 8)
    qgs.save_ply(given, "all.ply")
    assert "7 of 50 Gaussians" in done("convert all.ply few.ply --count 7").output
    few = load_ply("few.ply")
    best = given.opacities[0].topk(7).indices.sort().values  # in the order of the file
    assert_close(few.means[0], given.means[0, best])
    assert_equal(few.sh[0], given.sh[0, best])
    done("convert all.ply same.PLY")
    assert_equal(load_ply("same.PLY").means, given.means)
    assert given.most_opaque(99).count == 50


def test_other_suffixes_and_files_that_exist_are_refused():
    before = saved("a.ply", cloud(2)).read_bytes()
    must_refuse(r"\.splat", done, "convert a.ply a.abc")
    must_refuse(r"a\.ply", done, "convert a.ply a.ply", kind=FileExistsError)
    assert Path("a.ply").read_bytes() == before


def test_an_installed_distribution_adds_a_format(install):
    """The longest suffix decides."""
    source = """
        def plugin(gaussians, path, cameras):
            path.write_text(f"{gaussians.count} {[*cameras]}")
        """
    install("qgs-xyz", "xyz.ply", source, group="qgs.scene_writers")
    file = Path("a.XYZ.ply")
    save_gaussians(cloud(5), file, {"photo": None})
    assert file.read_text() == "5 ['photo']"
    must_refuse(r"\.xyz", save_gaussians, cloud(5), "a.abc")
    reader = "from walk import cloud\nplugin = lambda path: cloud(int(path.read_text()[0]))[0]"
    install("qgs-abc", "xyz.ply", reader, group="qgs.scene_readers")
    assert load_ply(file).count == 5


def test_a_format_that_cannot_be_imported_is_refused_before_the_work(install):
    install("qgs-xyz", "xyz", "import no_such_package", group="qgs.scene_writers")
    # the model, which does not exist, is not even read
    line = "reconstruct missing.safetensors . --out a.xyz"
    must_refuse(r"qgs-xyz 1\.2", done, line, kind=ExtensionError)


def test_the_bytes_of_a_splat_file():
    given = cloud(300)
    qgs.save_ply(given, "scene.ply")
    done("convert scene.ply scene.splat")
    read = np.frombuffer(Path("scene.splat").read_bytes(), "3f4,3f4,4u1,4u1")
    given = given[0][(given.scales.prod(-1) * given.opacities)[0].argsort(descending=True)]
    assert_array_equal(read["f0"], given.means)
    assert_allclose(read["f1"], given.scales, rtol=1e-6)
    rgba = torch.cat([given.colors, given.opacities[:, None]], 1)
    assert_allclose(read["f2"] / 255, rgba, atol=0.002)
    assert_allclose((read["f3"].astype(float) - 128) / 128, given.quats, atol=0.008)
    assert_equal(load_ply("scene.splat").quats[0], given.quats, atol=0.02)
    Path("cut.splat").write_bytes(bytes(33))
    must_refuse("cut.splat", load_ply, "cut.splat")

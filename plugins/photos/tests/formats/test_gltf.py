""".glb files: what they store of Gaussians and cameras, and what others may write."""

import json
import struct

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from qgs_photos.formats.gltf import save_glb
from scipy.spatial.transform import Rotation
from tables import assert_equal, assert_near, must_refuse
from torch.testing import assert_close
from walk import arc, cloud, pinhole

import qgs
from qgs.geometry.transforms import moved, quat_to_matrix, to_camera
from qgs.reconstruction.scene_formats import save_gaussians


def opened(path):
    """The JSON and the numbers of a .glb file."""
    data = path.read_bytes()
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert length % 4 == 0
    size, kind = struct.unpack_from("<I4s", data, 20 + length)
    numbers = data[28 + length :]
    assert kind == b"BIN\0"
    assert size == len(numbers)
    return json.loads(data[20 : 20 + length]), numbers


def write(path, content, numbers):
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(numbers), b"BIN\0") + numbers
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def assert_same(found, expected):
    for part in ("means", "scales", "opacities", "colors", "sh", "features"):
        assert_close(getattr(found, part), getattr(expected, part), atol=2e-6, rtol=1e-5)
    turns = quat_to_matrix(found.quats), quat_to_matrix(expected.quats)
    assert_equal(*turns, atol=1e-5)


@pytest.mark.parametrize("count", [0, 3, 8, 15])
def test_the_round_trip(tmp_path, count):
    given = cloud(50)
    if count:
        given = given.replace(sh=torch.randn(1, 50, count, 3), features=torch.randn(1, 50, 2))
    save_gaussians(given, tmp_path / "a.glb")
    assert_same(qgs.load_ply(tmp_path / "a.glb"), given)


def test_cameras_see_what_ours_see(tmp_path):
    """In glTF, -Z is forward and +Y is up: that of the cameras, from the ground at 0."""
    cameras = pinhole(arc([-20, 0, 20], 3, 0.2).float(), (60.0, 50.0, 32.0, 24.0), (48, 64))[None]
    given = cloud(20)
    named = {f"photo {view}": cameras[:, [view]] for view in range(3)}
    save_glb(given, tmp_path / "a.glb", named)
    assert_same(qgs.load_ply(tmp_path / "a.glb"), given)
    content, numbers = opened(tmp_path / "a.glb")
    _, *nodes = content["nodes"]
    assert [node["name"] for node in nodes] == [*named, "flight"]
    places = np.array([node["translation"] for node in nodes])
    turns = Rotation.from_quat([node["rotation"] for node in nodes]).as_matrix()
    means = np.frombuffer(numbers, "<f4", 60).reshape(20, 3)
    assert abs(np.quantile(means[:, 1], 0.02)) <= 1e-5
    seen = (means - places[:3, None]) @ turns[:3] * [1, -1, -1]
    assert_allclose(seen, to_camera(given.means, cameras)[0], atol=1e-5)
    up = turns[:3, :, 1].mean(0)
    assert_allclose(up / np.linalg.norm(up), [0, 1, 0], atol=1e-4)
    for camera in content["cameras"]:
        perspective = camera["perspective"]
        assert_near(perspective["yfov"], 2 * np.arctan(24 / 50))
        assert_near(perspective["aspectRatio"], 64 / 60 / (48 / 50))

    (flight,) = content["animations"]
    ends = [content["accessors"][sampler["output"]]["max"] for sampler in flight["samplers"]]
    assert_allclose(ends[0], places.max(0), atol=1e-6)
    assert {channel["target"]["node"] for channel in flight["channels"]} == {4}


def test_cameras_in_a_ring_and_maps_keep_the_scene(tmp_path):
    """Cameras that look everywhere have no mean direction; coordinates of maps are too large."""
    place = torch.tensor([4_512_345.25, 5e5, 3e6], dtype=torch.float64)
    c2w = arc([0, 90, 180, 270], 3)
    c2w[:, :3, 3] += place
    far = cloud(20).replace(means=cloud(20).means.double() + place)
    save_glb(far, tmp_path / "a.glb", {f"{i}": pinhole(c2w[[i]])[None] for i in range(4)})
    assert_equal(qgs.load_ply(tmp_path / "a.glb").means - place, far.means - place, atol=1e-5)
    content, _ = opened(tmp_path / "a.glb")
    assert np.linalg.norm(content["nodes"][1]["translation"]) < 9


def test_files_of_others_are_read(tmp_path):
    """Nodes in nodes, integers as fractions, with gaps, another primitive."""
    given = cloud(6)
    save_gaussians(given, tmp_path / "a.glb")
    content, numbers = opened(tmp_path / "a.glb")
    primitives = content["meshes"][0]["primitives"]
    primitives.append({"attributes": {"POSITION": 0}})
    content["nodes"] = [
        {"children": [1], "rotation": [0, 0, 2**-0.5, 2**-0.5], "scale": [2, 2, 2]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]},
    ]
    spread = np.full((6, 4), 77, np.uint16)
    spread[:, 0] = 2**16 * given.opacities[0]
    content["bufferViews"].append({"buffer": 0, "byteOffset": len(numbers), "byteStride": 8})
    place = primitives[0]["attributes"]["KHR_gaussian_splatting:OPACITY"]
    view = len(content["bufferViews"]) - 1
    content["accessors"][place] |= {"bufferView": view, "componentType": 5123}
    write(tmp_path / "b.glb", content, numbers + spread.tobytes())

    turn = torch.tensor([1.0, -1, -1, 1]).diag()
    outer = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    inner = turn.clone()
    inner[0, 3] = 5
    found = qgs.load_ply(tmp_path / "b.glb")
    assert_equal(found.opacities, given.opacities, atol=1e-4)
    expected = moved(moved(given, inner, 1.0), turn @ outer, 2.0)
    assert_same(found.replace(opacities=given.opacities), expected)


def test_what_cannot_be_read_is_refused(tmp_path):
    save_gaussians(cloud(3), tmp_path / "a.glb")
    wrong = tmp_path / "wrong.glb"
    extension = {"KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "linear"}}
    for part, change, words in (
        (lambda c: c["accessors"][0], {"count": 10**9}, "strides"),
        (lambda c: c["meshes"][0]["primitives"][0], {"extensions": extension}, "linear"),
        (lambda c: c["meshes"][0]["primitives"][0], {"extensions": {}}, "no primitives"),
        (lambda c: c, {"extensionsRequired": ["EXT_meshopt"]}, "other extensions"),
        (lambda c: c["nodes"][0], {"scale": [1, 2, 1]}, "different factors"),
        (lambda c: c["scenes"][0], {"nodes": [0, 0]}, "0"),
    ):
        content, numbers = opened(tmp_path / "a.glb")
        part(content).update(change)
        write(wrong, content, numbers)
        must_refuse(f"wrong.glb cannot be read.*{words}", qgs.load_ply, wrong)
    wrong.write_bytes(b"solid cube of another program")
    must_refuse("no binary glTF", qgs.load_ply, wrong)

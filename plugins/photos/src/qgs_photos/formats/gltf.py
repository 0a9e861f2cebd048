"""Binary glTF files (.glb) of Gaussians, with cameras of the photos and a flight along them.

Source: glTF 2.0 and its extension KHR_gaussian_splatting. In glTF, +Y is up and cameras look along
-Z.
"""

import json
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from kornia.geometry.conversions import (
    quaternion_to_rotation_matrix,
    rotation_matrix_to_quaternion,
)
from torch import Tensor

from qgs.containers import concatenated
from qgs.files import replacing
from qgs.geometry.harmonics import SH_C0
from qgs.geometry.poses import look_at
from qgs.geometry.transforms import moved
from qgs.reconstruction.scene_formats import one_scene
from qgs.types import Cameras, Gaussians
from qgs_photos.formats import TURN

EXTENSION = "KHR_gaussian_splatting"
COLORS = "srgb_rec709_display"
UPRIGHT = "upright"
"""Extra of the asset: the pose (4, 4) from the world of the Gaussians to that of the file."""
FLIGHT = "flight"
"""Name of the camera that moves, and of its animation."""
FEATURE = "_QGS_FEATURE_"
"""Name of an attribute for a channel of features, before the channel's index."""
NEAREST = 0.01
"""Distance of the near plane, as a fraction of the cameras' distance from the scene's middle."""
HARMONICS = [
    f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{place}"
    for degree in (1, 2, 3)
    for place in range(2 * degree + 1)
]
"""Names of coefficients of spherical harmonics from degree 1, in the order of `Gaussians.sh`."""
# The ground is found among Gaussians up to this many times as far as half of them are. A small part
# of them is below it.
_AROUND = 2.0
_LOWEST = 0.02
# Formats of numbers; integers are fractions of their largest value.
_FLOAT = 5126
_NUMBERS = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, _FLOAT: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_KINDS = {width: kind for kind, width in _WIDTHS.items()}


def save_glb(gaussians: Gaussians, path: str | Path, cameras: Mapping[str, Cameras]) -> None:
    """Write one scene, (G, ...) or (1, G, ...), as KHR_gaussian_splatting.

    cameras: cameras (1, 1) by name, in the world of the Gaussians. The file gets them, and one more
    that an animation moves from each to the next. Their mean up direction becomes +Y, and the
    ground gets height 0; without cameras, -y becomes +Y. Warns and raises errors as `save_ply`
    does.
    """
    upright = TURN.clone()
    if cameras:
        c2w = torch.cat([camera.c2w[0].double().cpu() for camera in cameras.values()])
        upright = _upright(c2w)
        upright[1, 3] = -_ground(gaussians.means, c2w, upright[1, :3])
    scene, origin = one_scene(moved(gaussians, upright, 1.0), ".glb")
    if origin:
        upright[:3, 3] -= torch.tensor([*map(float, origin.split())], dtype=torch.float64)
    arrays = _Arrays()
    attributes = {name: arrays.add(values) for name, values in _attributes(scene)}
    splats = {
        "mode": 0,
        "attributes": attributes,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": COLORS}},
    }
    content = {
        "asset": {"version": "2.0", "generator": "qgs", "extras": {UPRIGHT: upright.tolist()}},
        "extensionsUsed": [EXTENSION],
        "meshes": [{"primitives": [splats]}],
        "nodes": [{"name": "scene", "mesh": 0}],
    }
    if cameras:
        filmed = [*cameras.items(), (FLIGHT, next(iter(cameras.values())))]
        content |= _filmed(filmed, upright, scene.means.median(0).values, arrays)
    content |= {
        "scene": 0,
        "scenes": [{"nodes": [*range(len(content["nodes"]))]}],
        "accessors": arrays.accessors,
        "bufferViews": arrays.views,
        "buffers": [{"byteLength": len(arrays.data)}],
    }
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(arrays.data), b"BIN\0") + arrays.data
    with replacing(path) as temporary:
        temporary.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


class _Arrays:
    """Arrays of a file, one after the other in its binary chunk."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views = list[dict[str, Any]]()
        self.accessors = list[dict[str, Any]]()

    def add(self, values: Tensor) -> int:
        """Add `values` (N, C) as float32; return the index of their accessor."""
        array = values.float().numpy()
        start = len(self.data)
        self.data += array.tobytes()
        self.views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes})
        index = len(self.accessors)
        self.accessors.append(
            {
                "bufferView": index,
                "componentType": _FLOAT,
                "count": len(array),
                "type": _KINDS[array.shape[1]],
                "min": array.min(0).tolist(),
                "max": array.max(0).tolist(),
            }
        )
        return index


def _attributes(scene: Gaussians) -> Iterator[tuple[str, Tensor]]:
    """Yield names and values (G, C) of what the extension stores of Gaussians (G,)."""
    yield "POSITION", scene.means
    yield f"{EXTENSION}:ROTATION", F.normalize(scene.quats, dim=-1).roll(-1, -1)
    yield f"{EXTENSION}:SCALE", scene.scales
    yield f"{EXTENSION}:OPACITY", scene.opacities[:, None]
    yield f"{EXTENSION}:SH_DEGREE_0_COEF_0", (scene.colors - 0.5) / SH_C0
    if scene.sh is not None:
        yield from zip(HARMONICS, scene.sh.unbind(1), strict=False)
    if scene.features is not None:
        for place, feature in enumerate(scene.features.split(1, -1)):
            yield f"{FEATURE}{place}", feature
    # for viewers that do not know the extension
    yield "COLOR_0", torch.cat([scene.colors.clamp(0, 1), scene.opacities[:, None]], 1)


def _upright(c2w: Tensor) -> Tensor:
    """Return the rotation (4, 4) that turns the mean up direction of cameras (V, 4, 4) to +Y."""
    # The first counts a little more: cameras that are turned over would have no mean.
    down = c2w[:, :3, 1].sum(0) + 1e-3 * c2w[0, :3, 1]
    # z if it may be, else x or y; rounded, so that noise does not choose
    aside = torch.eye(3).double()[2 - down.flip(0).abs().round(decimals=2).argmin()]
    left, back, down = look_at(torch.zeros_like(down), down, aside)[:3, :3].unbind(-1)
    pose = torch.eye(4).double()
    pose[:3, :3] = -torch.stack([left, down, back])
    return pose


def _ground(means: Tensor, c2w: Tensor, up: Tensor) -> float:
    """Return the height of the lowest means that are not far behind what cameras look at.

    means: (..., G, 3). c2w: poses of the cameras (V, 4, 4). up: direction (3,).
    """
    points = means.flatten(0, -2).double().cpu()
    away = (points - c2w[:, :3, 3].mean(0)).norm(dim=-1)
    heights = points[away < _AROUND * away.median()] @ up
    return float(np.quantile(heights, _LOWEST))


def _lens(camera: Cameras, near: float) -> dict[str, Any]:
    """Return the glTF camera of a camera (1, 1), with its centre in the middle of the image."""
    fx, fy, _, _ = camera.intrinsics[0, 0].tolist()
    height, width = camera.size
    angle = 2 * math.atan(height / (2 * fy))
    ratio = width / fx * fy / height
    return {
        "type": "perspective",
        "perspective": {"yfov": angle, "aspectRatio": ratio, "znear": near},
    }


def _filmed(
    cameras: Sequence[tuple[str, Cameras]], upright: Tensor, middle: Tensor, arrays: _Arrays
) -> dict[str, Any]:
    """Return cameras with their nodes, after the scene's, and the animation of the last of them.

    upright: pose (4, 4) from their world to the file's. middle: middle of the scene, (3,).
    """
    c2w = torch.cat([camera.c2w[0].double().cpu() for _, camera in cameras])
    c2w = upright @ c2w @ TURN
    places = c2w[:, :3, 3]
    quats = rotation_matrix_to_quaternion(c2w[:, :3, :3].contiguous()).roll(-1, -1)
    near = NEAREST * float((places - middle).norm(dim=-1).median())
    nodes = [{"name": "scene", "mesh": 0}]
    for index, (name, _) in enumerate(cameras):
        place = {"translation": places[index].tolist(), "rotation": quats[index].tolist()}
        nodes.append({"name": name, "camera": index, **place})
    # from each of the others to the next in a second
    times = arrays.add(torch.arange(len(cameras) - 1)[:, None])
    outputs = {"translation": arrays.add(places[:-1]), "rotation": arrays.add(quats[:-1])}
    channels = [
        {"sampler": index, "target": {"node": len(cameras), "path": path}}
        for index, path in enumerate(outputs)
    ]
    samplers = [{"input": times, "output": output} for output in outputs.values()]
    return {
        "cameras": [{"name": name, **_lens(camera, near)} for name, camera in cameras],
        "nodes": nodes,
        "animations": [{"name": FLIGHT, "channels": channels, "samplers": samplers}],
    }


def load_glb(path: Path) -> Gaussians:
    """Return the Gaussians (G,) of all primitives with KHR_gaussian_splatting in a .glb file.

    The world of a file by `save_glb` is turned back; of others, +Y becomes -y. Raises ValueError
    for another kind of file, for none of these primitives, and for other colours than sRGB;
    IndexError, KeyError or struct.error for a damaged file.
    """
    data = path.read_bytes()
    magic, _, _, length, _ = struct.unpack_from("<4sIIII", data)
    if magic != b"glTF":
        raise ValueError("it is no binary glTF")
    content = json.loads(data[20 : 20 + length])
    numbers = data[28 + length :]
    parts = list[Gaussians]()
    buffer, *others = content["buffers"]
    if others or "uri" in buffer or content.get("extensionsRequired", [EXTENSION]) != [EXTENSION]:
        raise ValueError("it needs other files or other extensions")
    upright = content["asset"].get("extras", {}).get(UPRIGHT, TURN.tolist())
    back = torch.linalg.inv(torch.tensor(upright, dtype=torch.float64))
    for pose, mesh in _meshes(content):
        factor = float(pose[:3, 0].norm())
        rigid = back @ pose
        rigid[:3, :3] /= factor
        if not torch.allclose(rigid[:3, :3].inverse(), rigid[:3, :3].T, atol=1e-4):
            raise ValueError("it has a node that scales axes by different factors")
        for primitive in mesh["primitives"]:
            if EXTENSION in primitive.get("extensions", ()):
                parts.append(moved(_splats(content, primitive, numbers), rigid, factor))
        if sum(part.count for part in parts) > len(data):
            raise ValueError("it repeats its Gaussians")
    if not parts:
        raise ValueError(f"it has no primitives with {EXTENSION}")
    return concatenated(parts, 0)


def _meshes(content: Mapping[str, Any]) -> Iterator[tuple[Tensor, Mapping[str, Any]]]:
    """Yield the transform to the world (4, 4), and the mesh, of each node that has a mesh."""
    unseen = dict(enumerate(content["nodes"]))
    roots = content["scenes"][content.get("scene", 0)]["nodes"]
    left = [(root, torch.eye(4).double()) for root in roots]
    while left:
        index, outer = left.pop(0)
        # each comes once, so that a small file cannot stand for a large one
        node = unseen.pop(index)
        pose = outer @ _transform(node)
        if "mesh" in node:
            yield pose, content["meshes"][node["mesh"]]
        left[:0] = [(child, pose) for child in node.get("children", ())]


def _transform(node: Mapping[str, Any]) -> Tensor:
    """Return the transform (4, 4) of a node to its parent."""
    if "matrix" in node:
        # column by column
        return torch.tensor(node["matrix"], dtype=torch.float64).view(4, 4).T
    pose = torch.eye(4).double()
    quat = torch.tensor(node.get("rotation", [0.0, 0, 0, 1])).double().roll(1)
    pose[:3, :3] = quaternion_to_rotation_matrix(quat) * torch.tensor(node.get("scale", 1.0))
    pose[:3, 3] = torch.tensor(node.get("translation", 0.0), dtype=torch.float64)
    return pose


def _splats(content: Mapping[str, Any], primitive: Mapping[str, Any], numbers: bytes) -> Gaussians:
    """Return the Gaussians (G,) of a primitive, in its own frame."""
    if (colors := primitive["extensions"][EXTENSION]["colorSpace"]) != COLORS:
        raise ValueError(f"its colours are {colors}, not {COLORS}")
    attributes = primitive["attributes"]
    values = {name: _values(content, index, numbers) for name, index in attributes.items()}
    harmonics = [values[name] for name in HARMONICS if name in values]
    count = sum(name.startswith(FEATURE) for name in values)
    features = [values[f"{FEATURE}{place}"] for place in range(count)]
    return Gaussians(
        values["POSITION"],
        values[f"{EXTENSION}:SCALE"],
        values[f"{EXTENSION}:ROTATION"].roll(1, -1),
        values[f"{EXTENSION}:OPACITY"][:, 0],
        values[f"{EXTENSION}:SH_DEGREE_0_COEF_0"] * SH_C0 + 0.5,
        torch.stack(harmonics, 1) if harmonics else None,
        torch.cat(features, 1) if features else None,
    )


def _values(content: Mapping[str, Any], index: int, numbers: bytes) -> Tensor:
    """Return the values (N, C) of an accessor, integers as fractions of their largest value."""
    accessor = content["accessors"][index]
    view = content["bufferViews"][accessor["bufferView"]]
    kind = np.dtype(_NUMBERS[accessor["componentType"]])
    shape = (accessor["count"], _WIDTHS[accessor["type"]])
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    least = shape[1] * kind.itemsize
    strides = (max(view.get("byteStride", 0), least), kind.itemsize)
    array = np.ndarray(shape, kind, numbers, start, strides)
    found = torch.from_numpy(array.astype(np.float32))
    return found if kind.kind == "f" else (found / np.iinfo(kind).max).clamp_min(-1)

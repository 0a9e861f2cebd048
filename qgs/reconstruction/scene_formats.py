"""Gaussians as files: PLY of the 3DGS release, .splat, and formats that distributions add."""

import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from plyfile import PlyData, PlyElement, PlyElementParseError, PlyHeaderParseError
from torch import Tensor

from qgs.containers import map_tensors, named_tensors
from qgs.extensions import imported, installed
from qgs.files import replacing
from qgs.geometry.harmonics import SH_C0
from qgs.types import SH_COUNTS, Gaussians
from qgs.wording import listed, warn_once

WRITER_GROUP = "qgs.scene_writers"
"""Entry points of functions (gaussians, path): the name is the suffix that they write, undotted."""

OPACITY_EPS = 1e-6
"""Least distance of a stored opacity from 0 and 1, where the logit is infinite."""
SCALE_MIN = 1e-12
"""Smallest scale stored, world units: the logarithm of 0 is infinite."""

_MEANS = ("x", "y", "z")
_COLORS = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
NEEDED = (*_MEANS, *_COLORS, "opacity", *_SCALES, *_QUATS)
REST = tuple(f"f_rest_{index}" for index in range(3 * SH_COUNTS[-1]))
"""Spherical harmonics of degrees 1 to 3, all of red first, then green, then blue; always written,
as zeros too: the viewer of the 3DGS release and plugins of game engines need all of them."""
PROPERTIES = (*_MEANS, "nx", "ny", "nz", *_COLORS, *REST, "opacity", *_SCALES, *_QUATS)

SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
"""A Gaussian of a .splat file, 32 bytes. Source: github.com/antimatter15/splat, convert.py."""

# Bytes of a header, at most: that of the 3DGS release has 1,500.
_HEADER = 2**16


def save_gaussians(gaussians: Gaussians, path: str | Path) -> None:
    """Write one scene, (G, ...) or (1, G, ...), in the format of the suffix of `path`.

    Raises ValueError for a suffix without a writer (see `scene_writers`), for several scenes, and
    for numbers that are not finite.
    """
    writers = scene_writers()
    suffix = Path(path).suffix.lower()
    if suffix not in writers:
        raise ValueError(
            f"{path} must end in {listed(writers, between=' or ')}; for .spz, .sog and others give "
            "a PLY to PlayCanvas' converter: `npx @playcanvas/splat-transform IN.ply OUT.sog`"
        )
    writers[suffix]()(gaussians, path)


def scene_writers() -> Mapping[str, Callable[[], Callable[[Gaussians, str | Path], None]]]:
    """Return by suffix a function that finds the writer of such files.

    Finding one of WRITER_GROUP raises ExtensionError where its distribution cannot be imported.
    """
    added = {
        f".{entry.name.lower()}": partial(imported, entry) for entry in installed(WRITER_GROUP)
    }
    return {**added, ".ply": lambda: save_ply, ".splat": lambda: save_splat}


def save_ply(gaussians: Gaussians, path: str | Path) -> None:
    """Write one scene, (G, ...) or (1, G, ...), as binary little-endian float32.

    Colours become f_dc, spherical harmonics f_rest, opacities logits, scales logarithms;
    quaternions stay w x y z; normals are zero. Warns that `features` are left out.
    Raises ValueError for several scenes or for numbers that are not finite.
    """
    scene = one_scene(gaussians, "PLY", "features")
    sh = scene.means.new_zeros(scene.count, SH_COUNTS[-1], 3) if scene.sh is None else scene.sh
    rest = F.pad(sh, (0, 0, 0, SH_COUNTS[-1] - sh.shape[1]))
    columns = {
        _MEANS: scene.means,
        _COLORS: (scene.colors - 0.5) / SH_C0,
        ("opacity",): scene.opacities.clamp(OPACITY_EPS, 1 - OPACITY_EPS).logit()[:, None],
        _SCALES: scene.scales.clamp_min(SCALE_MIN).log(),
        _QUATS: scene.quats,
        # Channel by channel.
        REST: rest.mT.flatten(1),
    }
    vertices = np.zeros(scene.count, dtype=[(name, "<f4") for name in PROPERTIES])
    for names, values in columns.items():
        for name, column in zip(names, values.unbind(-1), strict=True):
            vertices[name] = column
    with replacing(path) as temporary, temporary.open("wb") as file:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(file)


def save_splat(gaussians: Gaussians, path: str | Path) -> None:
    """Write one scene, (G, ...) or (1, G, ...), the largest and most opaque Gaussians first.

    Colours, opacities and quaternions, w x y z, get 8 bits. Warns that spherical harmonics and
    `features` are left out. Raises as `save_ply`.
    """
    scene = one_scene(gaussians, ".splat", "sh", "features")
    # Viewers draw a file while it loads, so what covers most comes first.
    covering = scene.scales.prod(-1) * scene.opacities
    scene = scene[covering.argsort(descending=True, stable=True)]

    def as_bytes(values: Tensor) -> Tensor:
        return values.round().clamp(0, 255).byte()

    records = np.empty(scene.count, SPLAT)
    records["mean"] = scene.means
    records["scale"] = scene.scales
    records["rgba"] = as_bytes(torch.cat([scene.colors, scene.opacities[:, None]], -1) * 255)
    records["quat"] = as_bytes(F.normalize(scene.quats, dim=-1) * 128 + 128)
    with replacing(path) as temporary:
        temporary.write_bytes(records.tobytes())


def load_ply(path: str | Path) -> Gaussians:
    """Return the Gaussians (1, G) of a PLY file in the layout of the 3DGS release.

    `sh` ends with the last degree of f_rest that is not all zeros, None without one. Raises
    FileNotFoundError, and ValueError for another kind of file or of PLY, such as a compressed one,
    and for numbers that are not finite.
    """
    vertices, names = _vertices(Path(path))
    count = sum(name.startswith("f_rest_") for name in names)
    rest = REST[:count]
    if count not in (0, *(3 * n for n in SH_COUNTS)) or not names.issuperset(rest):
        raise ValueError(
            f"{path} has {count} properties f_rest_*; spherical harmonics of degrees 1, 2 or 3 "
            "are f_rest_0 to f_rest_8, f_rest_23 or f_rest_44: write the file anew, or without them"
        )

    def columns(*names: str) -> Tensor:
        return torch.from_numpy(np.stack([vertices[name] for name in names], -1, dtype=np.float32))

    # In float64 norms are finite; a quaternion of 0 becomes NaN, which is refused below.
    quats = columns(*_QUATS).double()
    scene = Gaussians(
        means=columns(*_MEANS),
        scales=columns(*_SCALES).exp(),
        quats=(quats / quats.norm(dim=-1, keepdim=True)).float(),
        opacities=columns("opacity")[:, 0].sigmoid(),
        colors=columns(*_COLORS) * SH_C0 + 0.5,
        sh=_used_degrees(columns(*rest).unflatten(-1, (3, -1)).mT) if rest else None,
    )
    try:
        return one_scene(scene, "PLY")[None]
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _vertices(path: Path) -> tuple[np.ndarray, set[str]]:
    """Return the vertices of a PLY file of Gaussians, and the names of their numbers."""
    if not path.is_file():
        raise FileNotFoundError(f"no file at {path}")
    try:
        with path.open("rb") as start:
            header, end, _ = start.read(_HEADER).partition(b"end_header")
        counts = map(int, re.findall(rb"element\s+\S+\s+(\d{1,99})", header))
        # plyfile takes the memory that a header promises.
        if not end or max(counts, default=0) > path.stat().st_size:
            raise ValueError(f"its header is not whole in {_HEADER:,} bytes, or promises too much")
        elements = {element.name: element.data for element in PlyData.read(str(path)).elements}
    except (PlyHeaderParseError, PlyElementParseError, ValueError, MemoryError) as error:
        raise ValueError(f"{path} is no whole PLY file ({error}): copy it again") from error
    vertices = elements.get("vertex", np.empty(0))
    kinds = vertices.dtype.fields or {}
    # Lists are objects to NumPy.
    names = {name for name, kind in kinds.items() if not kind[0].hasobject}
    if missing := [name for name in NEEDED if name not in names]:
        kind = "a compressed PLY" if "chunk" in elements else "no PLY of Gaussians"
        raise ValueError(
            f"{path} is {kind}: it lacks {listed(missing)}; give one with the properties of the "
            "3DGS release, as SuperSplat's uncompressed export writes it"
        )
    if not len(vertices):
        raise ValueError(f"{path} holds no Gaussians")
    return vertices, names


def one_scene(gaussians: Gaussians, kind: str, *lost: str) -> Gaussians:
    """Return the Gaussians (G, ...) of (G, ...) or (1, G, ...), float32 on the CPU, for a file.

    Warns about the parts in `lost`. Raises ValueError for several scenes or for numbers whose
    squares are not finite. kind: of the file.
    """
    batch = gaussians.means.shape[:-2]
    if batch not in ((), (1,)):
        raise ValueError(
            f"a {kind} file holds one scene, got Gaussians of batch shape {tuple(batch)}; "
            "write them one by one, as gaussians[i]"
        )
    if names := [f"`{name}`" for name in lost if getattr(gaussians, name) is not None]:
        warn_once(f"{kind} files have no place for {listed(names)}: left out")
    scene = gaussians[0] if batch else gaussians
    scene = map_tensors(Tensor.detach, scene).to("cpu", torch.float32)
    squares = [part.square()[..., None].flatten(1) for _, part in named_tensors(scene)]
    if broken := int((~torch.cat(squares, -1).isfinite().all(-1)).sum()):
        raise ValueError(f"{broken} of {scene.count} Gaussians are not finite, or too large")
    return scene


def _used_degrees(sh: Tensor) -> Tensor | None:
    """Return the coefficients (G, C, 3) without degrees that are zeros; None without any."""
    used = sh.any(0).any(-1).nonzero().flatten().tolist()
    count = next(count for count in (0, *SH_COUNTS) if count > max(used, default=-1))
    return sh[:, :count] if count else None

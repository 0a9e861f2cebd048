"""Gaussians as files: PLY of the 3DGS release, .splat, and formats that other packages add.

Files hold float32. Gaussians too far from zero for float32 are written relative to a local origin,
which a PLY file names in a comment. Reading such a PLY adds the origin and gives means in float64.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.lib.recfunctions import structured_to_unstructured, unstructured_to_structured
from plyfile import PlyData, PlyElement
from torch import Tensor

from qgs.containers import map_tensors, named_tensors
from qgs.extensions import imported, installed
from qgs.files import replacing
from qgs.geometry.harmonics import SH_C0
from qgs.geometry.transforms import narrowed
from qgs.types import SH_COUNTS, Cameras, Gaussians
from qgs.wording import listed, one_line, warn_once

if TYPE_CHECKING:
    from gsply import GSData

WRITER_GROUP = "qgs.scene_writers"
"""Group of entry points of writers (see `SceneWriter`). An entry point has the suffix of its files
as its name, without the first dot."""
READER_GROUP = "qgs.scene_readers"
"""Group of entry points of readers, which are functions: path -> Gaussians (G,). Their numbers need
not be finite, and quaternions not be unit. Entry points are named as those of writers."""
SceneWriter = Callable[[Gaussians, str | Path, Mapping[str, Cameras]], None]
"""Function (gaussians, path, cameras) that writes one scene. Cameras (1, 1), in the world of the
Gaussians, have names; formats that hold no cameras leave them out."""

T = TypeVar("T")

OPACITY_EPS = 1e-6
"""Least distance of a stored opacity from 0 and 1, where the logit is infinite."""
SCALE_MIN = 1e-12
"""Smallest scale stored, world units: the logarithm of 0 is infinite."""

_MEANS = ["x", "y", "z"]
_COLORS = ["f_dc_0", "f_dc_1", "f_dc_2"]
_OTHERS = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
REST = [f"f_rest_{index}" for index in range(3 * SH_COUNTS[-1])]
"""Properties for spherical harmonics of degrees 1 to 3: all of red first, then green, then blue.

All are written even if they are 0, because the viewer of the 3DGS release and plugins of game
engines need them."""
PROPERTIES = (*_MEANS, "nx", "ny", "nz", *_COLORS, *REST, *_OTHERS)

# Bytes of a header, at most: that of the 3DGS release has 1,500.
_HEADER = 2**16


def save_gaussians(
    gaussians: Gaussians, path: str | Path, cameras: Mapping[str, Cameras] | None = None
) -> None:
    """Write one scene, (G, ...) or (1, G, ...), in the format that the suffix of `path` names.

    cameras: see `SceneWriter`. Raises ValueError for a suffix without a writer, for several scenes,
    and for numbers that are not finite.
    """
    writer = writer_of(path)
    if writer is None:
        raise _unwritable(path)
    writer(gaussians, path, cameras or {})


def writer_of(path: str | Path) -> SceneWriter | None:
    """Return the writer of files such as `path`; None if there is none, as for a folder.

    Raises ExtensionError if the package of a writer (entry points WRITER_GROUP) cannot be imported,
    and ValueError for files that can only be read.
    """
    find = _of_suffix(path, _writers())
    if find is None and _of_suffix(path, _added(READER_GROUP)):
        raise _unwritable(path)
    return find and find()


def _unwritable(path: str | Path) -> ValueError:
    return ValueError(
        f"{path} must end in {listed(_writers(), between=' or ')}; for others give a PLY to "
        "PlayCanvas' converter: `npx @playcanvas/splat-transform IN.ply OUT`"
    )


def _writers() -> dict[str, Callable[[], SceneWriter]]:
    return {
        ".ply": lambda: lambda gaussians, path, _: save_ply(gaussians, path),
        ".splat": lambda: lambda gaussians, path, _: save_splat(gaussians, path),
        **_added(WRITER_GROUP),
    }


def _added(group: str) -> dict[str, Callable]:
    """Return functions that import the entry points of `group`, by suffix."""
    return {f".{entry.name.lower()}": partial(imported, entry) for entry in installed(group)}


def _of_suffix(path: str | Path, known: Mapping[str, T]) -> T | None:
    """Return the value of the longest suffix in `known` with which the name of `path` ends."""
    name = Path(path).name.lower()
    return known.get(max(filter(name.endswith, known), key=len, default=""))


def save_ply(gaussians: Gaussians, path: str | Path) -> None:
    """Write one scene, (G, ...) or (1, G, ...), as binary little-endian float32.

    Colours become f_dc, spherical harmonics f_rest, opacities logits, scales logarithms;
    quaternions stay w x y z; normals are zero. Warns if `features` are left out, and if means are
    written relative to a local origin, which the comment `local origin X Y Z` names. Raises
    ValueError for several scenes or for numbers that are not finite.
    """
    scene, origin = one_scene(gaussians, "PLY", "features")
    sh = scene.means.new_zeros(scene.count, SH_COUNTS[-1], 3) if scene.sh is None else scene.sh
    columns = [
        scene.means,
        torch.zeros_like(scene.means),
        (scene.colors - 0.5) / SH_C0,
        # Channel by channel.
        F.pad(sh, (0, 0, 0, SH_COUNTS[-1] - sh.shape[1])).mT.flatten(1),
        scene.opacities.logit(OPACITY_EPS)[:, None],
        scene.scales.clamp_min(SCALE_MIN).log(),
        scene.quats,
    ]
    vertices = unstructured_to_structured(torch.cat(columns, 1).numpy(), names=PROPERTIES)
    comments = [f"local origin {origin}"] if origin else []
    whole = PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<", comments=comments)
    with replacing(path) as temporary, temporary.open("wb") as file:
        whole.write(file)


def save_splat(gaussians: Gaussians, path: str | Path) -> None:
    """Write one scene, (G, ...) or (1, G, ...), the largest and most opaque Gaussians first.

    Colours, opacities and quaternions, w x y z, get 8 bits. Warns if spherical harmonics or
    `features` are left out, and if means are written relative to a local origin. Raises the errors
    of `save_ply`.
    """
    scene, _ = one_scene(gaussians, ".splat", "sh", "features")
    # Viewers draw a file while it loads, so what covers most comes first.
    covering = scene.scales.prod(-1) * scene.opacities
    scene = scene[covering.argsort(descending=True, stable=True)]

    # Source: github.com/antimatter15/splat, convert.py.
    numbers = torch.cat([scene.means, scene.scales], 1).view(torch.uint8)
    rgba = torch.cat([scene.colors, scene.opacities[:, None]], 1) * 255
    rest = torch.cat([rgba, F.normalize(scene.quats, dim=-1) * 128 + 128], 1)
    rows = torch.cat([numbers, rest.round().clamp(0, 255).byte()], 1)
    with replacing(path) as temporary:
        temporary.write_bytes(rows.numpy().tobytes())


def load_ply(path: str | Path) -> Gaussians:
    """Return the Gaussians (1, G) of a file: a PLY of the 3DGS release or SuperSplat, .splat.

    Other packages add formats (entry points READER_GROUP). The Gaussians are in the world of the
    file. Those that are not finite are left out, with a warning. The 3D filter of Mip-Splatting is
    applied. `sh` has all degrees up to the last that is not all zeros, and is None if all are
    zeros. Means are float64 if float32 would lose digits. Raises FileNotFoundError, and ValueError
    for another kind of file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file at {path}")
    try:
        readers = {".splat": lambda: _of_splat, **_added(READER_GROUP)}
        read = _of_suffix(path, readers) or (lambda: read_ply)
        scene = read()(path)
    # Readers raise anything of a damaged file.
    except Exception as error:
        raise ValueError(
            f"{path} cannot be read as Gaussians ({one_line(error)}): copy it again if it is "
            f"{listed(('PLY', *readers), between=' or ')}; others become PLY by `npx "
            "@playcanvas/splat-transform IN OUT.ply`"
        ) from error
    # In float64 norms are finite; a quaternion of 0 becomes NaN, which is left out.
    quats = scene.quats.double()
    scene = replace(scene, quats=(quats / quats.norm(dim=-1, keepdim=True)).float())
    whole = _finite(scene)
    count = int(whole.sum())
    if not count:
        raise ValueError(f"{path} holds no Gaussians, or none whose numbers are all finite")
    if count < scene.count:
        warn_once(
            f"{path}: left out {scene.count - count} of {scene.count} Gaussians, which are not "
            "finite, or too large"
        )
    return narrowed(scene[whole][None])


def _finite(scene: Gaussians) -> Tensor:
    """Return a mask (G,), True for Gaussians whose numbers all have finite squares in float32."""
    squares = [part.float().square()[..., None].flatten(1) for _, part in named_tensors(scene)]
    return torch.cat(squares, -1).isfinite().all(-1)


def _of_splat(path: Path) -> Gaussians:
    rows = np.frombuffer(path.read_bytes(), "3f4,3f4,4u1,4u1")
    means, scales, rgba, quats = (torch.tensor(rows[f"f{part}"]).float() for part in range(4))
    return Gaussians(means, scales, quats - 128, rgba[:, 3] / 255, rgba[:, :3] / 255)


def of_gsply(content: "GSData") -> Gaussians:
    """Return the Gaussians (G,) of what gsply has read, as they are stored."""
    with TemporaryDirectory() as folder:
        plain = Path(folder, "plain.ply")
        content.save(plain)
        return read_ply(plain)


def read_ply(path: Path) -> Gaussians:
    """Return the Gaussians (G,) of a PLY file as they are stored, see `load_ply`."""
    with path.open("rb") as file:
        header, end, _ = file.read(_HEADER).partition(b"end_header")
    counts = map(int, re.findall(rb"element\s+\S+\s+(\d{1,99})", header))
    # plyfile takes the memory that a header promises.
    if not end or max(counts, default=0) > path.stat().st_size:
        raise ValueError(
            f"its header does not end within the first {_HEADER:,} bytes, or announces more "
            "elements than the file can hold"
        )
    content = PlyData.read(str(path))
    # A compressed PLY of SuperSplat.
    if "chunk" in content:
        from gsply import plyread

        return of_gsply(plyread(path))
    vertices = content["vertex"].data
    names = vertices.dtype.names or ()
    count = sum(name.startswith("f_rest_") for name in names)
    if count not in (0, 9, 24, 45):
        raise ValueError(f"it has {count} properties f_rest_*, not 0, 9, 24 or 45")

    def columns(names: list[str], kind: type = np.float32) -> Tensor:
        return torch.from_numpy(structured_to_unstructured(vertices[names], kind, copy=True))

    numbers = columns([*_COLORS, *_OTHERS, *REST[:count]])
    colors, opacities, scales, quats, rest = numbers.split((3, 1, 3, 4, count), 1)
    means = columns(_MEANS, np.float64)
    if origin := re.search(rb"comment local origin (\S+) (\S+) (\S+)\s", header):
        means += torch.tensor([*map(float, origin.groups())], dtype=torch.float64)
    scales = scales.exp()
    opacities = opacities.sigmoid()
    if "filter_3D" in names:
        # Source: github.com/autonomousvision/mip-splatting, create_fused_ply.
        wide = torch.hypot(scales, columns(["filter_3D"]))
        opacities = opacities * (scales / wide).prod(-1, keepdim=True)
        scales = wide
    sh = rest.unflatten(-1, (3, count // 3)).mT
    used = sh.any(0).any(-1).nonzero().flatten().tolist()
    kept = next(kept for kept in (0, *SH_COUNTS) if kept > max(used, default=-1))
    colors = colors * SH_C0 + 0.5
    return Gaussians(means, scales, quats, opacities[:, 0], colors, sh[:, :kept] if kept else None)


def one_scene(gaussians: Gaussians, kind: str, *lost: str) -> tuple[Gaussians, str]:
    """Prepare Gaussians for a file: return one scene (G, ...), float32 on the CPU, and its origin.

    gaussians: (G, ...) or (1, G, ...). kind: file type for messages. lost: fields that this file
        type cannot hold; if the Gaussians have some of these, a warning says that they are lost.
    The origin is the point "X Y Z" from which means are measured, or "" for (0, 0, 0).
    Raises ValueError for several scenes or for numbers whose squares are not finite.
    """
    batch = gaussians.means.shape[:-2]
    if batch not in ((), (1,)):
        raise ValueError(
            f"a {kind} file holds one scene, got Gaussians of batch shape {tuple(batch)}; "
            "write them one by one, as gaussians[i]"
        )
    if names := [f"`{name}`" for name in lost if getattr(gaussians, name) is not None]:
        warn_once(f"{kind} files cannot hold {listed(names)}, which are left out")
    scene = gaussians[0] if batch else gaussians
    scene = map_tensors(Tensor.detach, scene).to("cpu")
    if broken := int((~_finite(scene)).sum()):
        raise ValueError(
            f"{broken} of {scene.count} Gaussians have NaN, infinity or huge numbers: remove them"
        )
    return about_origin(replace(scene.to(torch.float32), means=scene.means))


def about_origin(gaussians: Gaussians) -> tuple[Gaussians, str]:
    """Return Gaussians (..., G) with float32 means relative to an origin, and this origin.

    The origin is text, "X Y Z", or "" if float32 can hold the means as they are. An origin that is
    not "" causes a warning.
    """
    scene = narrowed(gaussians)
    if scene.means.dtype == scene.scales.dtype:
        return scene, ""
    middle = scene.means.flatten(0, -2).median(0).values.round()
    origin = " ".join(map(str, middle.tolist()))
    warn_once(f"positions too large for float32 are written relative to the local origin {origin}")
    return replace(scene, means=(scene.means - middle).float()), origin

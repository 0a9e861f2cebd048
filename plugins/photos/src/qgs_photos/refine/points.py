"""The sparse points of a COLMAP model beside the photos, as Gaussians to start from."""

import struct

import torch
from torch import Tensor
from upath import UPath

from qgs.data.photos import formats_of
from qgs.data.photos.colmap import Colmap
from qgs.paths import read_file
from qgs.types import Gaussians

_OPACITY = 0.1
_NEIGHBOURS, _COMPARED = 3, 8192  # nearest points, of this many drawn ones, that give a size
_AT_ONCE = 1024  # points, so that memory stays within 0.1 GB
_FIXED = struct.Struct("<Q3d3BdQ")  # number, position, colour, error, length of the track


def sparse_points(folder: UPath) -> tuple[Tensor, Tensor] | None:
    """Positions (N, 3), float64, and colours (N, 3) in [0, 1], in the world of the cameras.

    folder: of a scene's photos. None where COLMAP did not make the cameras, and without points.
    Raises ValueError for points that cannot be read.
    """
    # other formats go first, and have a world of their own
    if formats_of(folder)[:1] != [Colmap.name]:
        return None
    model = Colmap.read(folder, None).file
    readers = {"points3D.bin": _binary, "points3D.txt": _text}
    file = next((model / name for name in readers if (model / name).is_file()), None)
    if file is None:
        return None
    try:
        found = torch.tensor(readers[file.name](read_file(file)), dtype=torch.float64)
    except (ValueError, struct.error) as error:
        raise ValueError(f"{file} cannot be read: {error}; export the model again") from error
    found = found.reshape(-1, 6)
    found = found[found.isfinite().all(1)]
    return (found[:, :3], found[:, 3:] / 255) if len(found) else None


def _text(content: bytes) -> list[list[float]]:
    lines = [line for line in content.decode().splitlines() if line.strip() and line[0] != "#"]
    return [[*map(float, line.split()[1:7])] for line in lines]


def _binary(content: bytes) -> list[list[float]]:
    (count,), at = struct.unpack_from("<Q", content), 8
    rows = list[list[float]]()
    for _ in range(count):
        _, x, y, z, red, green, blue, _, track = _FIXED.unpack_from(content, at)
        rows.append([x, y, z, red, green, blue])
        at += _FIXED.size + 8 * track
    if at > len(content):
        raise ValueError("the file is cut off")
    return rows


@torch.no_grad()
def from_points(
    points: tuple[Tensor, Tensor], world: tuple[Tensor, Tensor], most: int, seed: int = 0
) -> Gaussians:
    """At most `most` Gaussians (1, G) at points, as large as the gaps to their neighbours.

    points: as of `sparse_points`. world: reference pose (4, 4) and scale, as of `own_world`.
    """
    (means, colors), (reference, scale) = points, world
    drawn = torch.randperm(len(means), generator=torch.Generator().manual_seed(seed))[:most]
    pose = torch.linalg.inv(reference.double())
    means = ((means[drawn] @ pose[:3, :3].T + pose[:3, 3]) * scale.double()).float()
    few = means[:_COMPARED]
    nearest = [
        torch.cdist(part, few).topk(min(_NEIGHBOURS + 1, len(few)), largest=False).values
        for part in means.split(_AT_ONCE)
    ]
    # gaps on a surface shrink with the root of the number of points
    gaps = torch.cat(nearest)[:, 1:].mean(1) * (len(few) / len(means)) ** 0.5
    middle = gaps.nanmedian().nan_to_num(1.0)
    gaps = gaps.nan_to_num(float(middle)).clamp(0.1 * middle, 5 * middle).clamp_min(1e-6)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(1, len(means), 4)
    opacities = torch.full((1, len(means)), _OPACITY)
    scales = gaps[None, :, None].expand(-1, -1, 3)
    return Gaussians(means[None], scales, quats, opacities, colors[drawn].float()[None])

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
# Nearest points that give a size, of this many drawn ones.
_NEIGHBOURS, _COMPARED = 3, 8192
# Points at once, so that memory stays within 0.1 GB.
_AT_ONCE = 1024
# Number, position, colour, error, length of the track.
_FIXED = struct.Struct("<Q3d3BdQ")


def sparse_points(folder: UPath) -> tuple[Tensor, Tensor] | None:
    """Return positions (N, 3), float64, and colours (N, 3) in [0, 1], in the cameras' world.

    folder: of a scene's photos. None where COLMAP did not make the cameras, and without points.
    Raises ValueError for points that cannot be read.
    """
    # other formats go first, and have a world of their own
    if formats_of(folder)[:1] != [Colmap.name]:
        return None
    model = Colmap.read(folder, None).file
    readers = {model / "points3D.bin": _binary, model / "points3D.txt": _text}
    file = next((file for file in readers if file.is_file()), None)
    if file is None:
        return None
    try:
        found = torch.tensor(readers[file](read_file(file)), dtype=torch.float64)
    except (ValueError, struct.error) as error:
        raise ValueError(f"{file} cannot be read: {error}; export the model again") from error
    found = found.reshape(-1, 6)
    found = found[found.isfinite().all(1)]
    return (found[:, :3], found[:, 3:] / 255) if len(found) else None


def _text(content: bytes) -> list[list[float]]:
    lines = [line for line in content.decode().splitlines() if line.strip() and line[0] != "#"]
    return [[float(word) for word in line.split()[1:7]] for line in lines]


def _binary(content: bytes) -> list[list[float]]:
    (count,) = struct.unpack_from("<Q", content)
    start = 8
    rows = list[list[float]]()
    for _ in range(count):
        _, *row, _, track = _FIXED.unpack_from(content, start)
        rows.append(row)
        # a track is a list of pairs of 4 bytes
        start += _FIXED.size + 8 * track
    if start > len(content):
        raise ValueError("the file is cut off")
    return rows


@torch.no_grad()
def from_points(
    points: tuple[Tensor, Tensor], world: tuple[Tensor, Tensor], most: int, seed: int = 0
) -> Gaussians:
    """Return at most `most` Gaussians (1, G) at points, as large as the gaps to their neighbours.

    points: see `sparse_points`. world: reference pose (4, 4) and scale, as of `own_world`.
    """
    means, colors = points
    reference, scale = world
    drawn = torch.randperm(len(means), generator=torch.Generator().manual_seed(seed))[:most]
    w2c = torch.linalg.inv(reference.double())
    means = ((means[drawn] @ w2c[:3, :3].T + w2c[:3, 3]) * scale.double()).float()
    few = means[:_COMPARED]
    nearest = [
        torch.cdist(part, few).topk(min(_NEIGHBOURS + 1, len(few)), largest=False).values
        for part in means.split(_AT_ONCE)
    ]
    # the nearest is the point itself; gaps on a surface shrink with the root of the number
    gaps = torch.cat(nearest)[:, 1:].mean(1) * (len(few) / len(means)) ** 0.5
    # a point that stands alone, or on others, is as large as the usual one
    middle = gaps.nanmedian().nan_to_num(1.0)
    gaps = gaps.nan_to_num(float(middle)).clamp(0.1 * middle, 5 * middle).clamp_min(1e-6)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(1, len(means), 4)
    opacities = torch.full((1, len(means)), _OPACITY)
    scales = gaps[None, :, None].expand(-1, -1, 3)
    return Gaussians(means[None], scales, quats, opacities, colors[drawn].float()[None])

"""Compressed files of Gaussians, by gsply: .spz, compressed PLY, and .sog, which is only read."""

import math
from pathlib import Path
from tempfile import TemporaryDirectory

import gsply

from qgs.files import replacing
from qgs.geometry.transforms import moved
from qgs.reconstruction.scene_formats import of_gsply, save_ply
from qgs.types import Gaussians
from qgs_photos.formats import TURN

# Bits of a coordinate in .spz, without its sign.
_BITS = 23


def save_compressed(gaussians: Gaussians, path: str | Path, _: object) -> None:
    """Write one scene, (G, ...) or (1, G, ...), as compressed PLY of SuperSplat.

    Warns and raises errors as `save_ply` does.
    """
    content = gsply.compress_to_bytes(_stored(gaussians))
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def save_spz(gaussians: Gaussians, path: str | Path, _: object) -> None:
    """Write one scene, (G, ...) or (1, G, ...), as .spz of version 3.

    Positions get as many bits after the point as the farthest allows. Warns and raises errors as
    `save_ply` does.
    """
    content = _stored(moved(gaussians, TURN, 1.0))
    _, whole = math.frexp(abs(content.means).max())
    with replacing(path) as temporary:
        gsply.write_spz(temporary, content, fractional_bits=min(_BITS - whole, _BITS))


def _stored(gaussians: Gaussians) -> gsply.GSData:
    """Return what a PLY file stores of one scene, without harmonics that the scene lacks."""
    with TemporaryDirectory() as folder:
        plain = Path(folder, "plain.ply")
        save_ply(gaussians, plain)
        stored = gsply.plyread(plain)
    count = 0 if gaussians.sh is None else gaussians.sh.shape[-2]
    stored.shN = stored.shN[:, :count]
    return stored


def load_spz(path: Path) -> Gaussians:
    """Return the Gaussians (G,) of an .spz file. Errors of gsply pass through."""
    return moved(of_gsply(gsply.read_spz(path)), TURN, 1.0)


def load_sog(path: Path) -> Gaussians:
    """Return the Gaussians (G,) of a .sog file. Errors of gsply pass through."""
    from gsply.sog_reader import sogread

    return of_gsply(sogread(path))

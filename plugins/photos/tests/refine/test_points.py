"""Sparse points of a COLMAP model: read in the world of the cameras, as Gaussians to start from."""

import struct

import pytest
import torch
from photo_formats import synthetic, write_colmap
from qgs_photos.refine.initial import from_points, sparse_points
from torch.testing import assert_close
from upath import UPath

POINTS = [(1.0, 2.0, 3.5, 255, 0, 51), (-1.0, 0.25, 4.0, 0, 102, 255), (0.5, 0.5, 5.0, 10, 20, 30)]
TEXT = "# points\n" + "".join(f"7 {' '.join(map(str, row))} 0.5 1 7\n" for row in POINTS)
BINARY = struct.pack("<Q", 3) + b"".join(
    struct.pack("<Q3d3BdQ", n, *row, 0.5, n) + bytes(8 * n) for n, row in enumerate(POINTS)
)
"""Tracks of 0, 1 and 2 images."""


def test_points_of_a_model(tmp_path):
    folder = UPath(tmp_path)
    assert sparse_points(folder) is None
    (tmp_path / "transforms.json").write_text("{}")
    model = write_colmap(tmp_path, synthetic(tmp_path / "files"), "text") / "sparse/0"
    assert sparse_points(folder) is None  # the other format's cameras have another world
    (tmp_path / "transforms.json").unlink()
    (model / "points3D.txt").write_text("# no points\n")
    assert sparse_points(folder) is None
    expected = torch.tensor(POINTS).double()
    for name, content in (("txt", TEXT.encode()), ("bin", BINARY)):
        file = model / f"points3D.{name}"
        file.write_bytes(content)
        points, colors = sparse_points(folder)
        file.unlink()
        assert_close(points, expected[:, :3])
        assert_close(colors, expected[:, 3:] / 255)
    assert sparse_points(folder) is None
    for cut in (4, 40, -3):
        file.write_bytes(BINARY[:cut])
        with pytest.raises(ValueError, match=r"points3D\.bin"):
            sparse_points(folder)


def test_gaussians_are_as_large_as_the_gaps_between_points():
    world = torch.eye(4), torch.tensor(0.5)
    grid = torch.cartesian_prod(*[torch.arange(4.0).double()] * 3)
    found = from_points((grid, grid / 3), world, 64)
    assert torch.allclose(found.scales, torch.tensor(0.5))
    assert torch.allclose(found.colors, found.means / 1.5)
    assert from_points((grid, grid), world, 10).count == 10
    alone = from_points((grid[:1], grid[:1]), world, 10).scales
    assert 0 < alone.min() <= alone.max() < torch.inf

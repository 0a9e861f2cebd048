"""Sparse points of a COLMAP model: read in the world of the cameras, as Gaussians to start from."""

import struct
from pathlib import Path

import pytest
import torch
from qgs_refine.points import from_points, sparse_points
from upath import UPath

from qgs.geometry.poses import look_at

POINTS = [(1.0, 2.0, 3.5, 255, 0, 51), (-1.0, 0.25, 4.0, 0, 102, 255), (0.5, 0.5, 5.0, 10, 20, 30)]


def model(folder: Path) -> Path:
    """A COLMAP model of one camera and one image, without points."""
    place = folder / "sparse/0"
    place.mkdir(parents=True)
    (folder / "images").mkdir()
    (folder / "images/a.png").touch()
    (place / "cameras.txt").write_text("1 PINHOLE 8 8 8 8 4 4\n")
    (place / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    return place


def as_text() -> bytes:
    rows = (" ".join(map(str, row)) for row in POINTS)
    return "\n".join(
        ["# points", *(f"{n} {row} 0.5 1 7" for n, row in enumerate(rows, 1))]
    ).encode()


def as_binary() -> bytes:
    """The second point has a track of two images."""
    records = [
        struct.pack("<Q3d3BdQ", n, *row, 0.5, n % 3) + bytes(8 * (n % 3))
        for n, row in enumerate(POINTS)
    ]
    return struct.pack("<Q", len(POINTS)) + b"".join(records)


@pytest.mark.parametrize(("name", "content"), [("txt", as_text()), ("bin", as_binary())])
def test_points_of_a_model(name: str, content: bytes, tmp_path: Path) -> None:
    (model(tmp_path) / f"points3D.{name}").write_bytes(content)
    found = sparse_points(UPath(tmp_path))
    assert found is not None
    expected = torch.tensor(POINTS, dtype=torch.float64)
    torch.testing.assert_close(found[0], expected[:, :3])
    torch.testing.assert_close(found[1], expected[:, 3:] / 255)


def test_without_points_there_are_none(tmp_path: Path) -> None:
    assert sparse_points(UPath(tmp_path)) is None
    model(tmp_path)
    assert sparse_points(UPath(tmp_path)) is None


def test_cameras_of_another_format_have_another_world(tmp_path: Path) -> None:
    (model(tmp_path) / "points3D.txt").write_bytes(as_text())
    (tmp_path / "transforms.json").write_text("{}")
    assert sparse_points(UPath(tmp_path)) is None


@pytest.mark.parametrize("cut", [4, 40, -3])
def test_points_that_are_cut_off_are_refused(cut: int, tmp_path: Path) -> None:
    file = model(tmp_path) / "points3D.bin"
    file.write_bytes(as_binary()[:cut])
    with pytest.raises(ValueError, match=r"points3D\.bin"):
        sparse_points(UPath(tmp_path))


def test_gaussians_stand_at_the_points_in_the_world_of_a_scene() -> None:
    eye, forward, down = torch.tensor([[1.0, 2, 3], [0, 1, 0], [0, 0, -1]], dtype=torch.float64)
    reference, scale = look_at(eye, forward, down), torch.tensor(0.5)
    grid = torch.cartesian_prod(*[torch.arange(4.0, dtype=torch.float64)] * 3)
    found = from_points((grid, grid / 3), (reference, scale), 64)
    assert found.count == 64
    back = found.means[0].double() / 0.5 @ reference[:3, :3].T + reference[:3, 3]
    assert torch.cdist(back, grid).amin(1).max() < 1e-5
    torch.testing.assert_close(found.colors[0].double(), back / 3, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.scales, torch.full((1, 64, 3), 0.5))
    assert from_points((grid, grid), (reference, scale), 10).count == 10
    alone = from_points((grid[:1], grid[:1]), (reference, scale), 10)
    assert alone.scales.isfinite().all()
    assert alone.scales.min() > 0

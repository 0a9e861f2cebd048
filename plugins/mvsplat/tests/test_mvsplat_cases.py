"""Single Gaussians, a warp and the opacity map against what the released MVSplat computed."""

import pytest
import torch
from qgs_mvsplat.adapter import (
    band_mask,
    camera_quaternions,
    e3nn_harmonics,
    turn_of_harmonics,
    world_harmonics,
)
from qgs_mvsplat.head import RayHead, mapped_opacity
from qgs_mvsplat.pixels import PIXEL, OnRays, PixelQueries, ray_directions
from qgs_mvsplat.sweep import warp_grid, warped
from released import ATOL, RTOL, Released
from torch import Tensor

from qgs.contracts import ModelDims
from qgs.geometry.harmonics import harmonics
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import Cameras, ImageMemory, QueryState, Views

DIMS = ModelDims(86, 1, 0)
CASES = Released("mvsplat_cases_a")
ROTATION = CASES.tensors["adapter.extrinsics"][:, :3, :3]


def lens_of(k: Tensor, size: tuple[int, int]) -> Tensor:
    height, width = size
    lens = [k[..., 0, 0] * width, k[..., 1, 1] * height]
    return torch.stack([*lens, k[..., 0, 2] * width, k[..., 1, 2] * height], -1)


def decoded() -> tuple[QueryState, dict[str, Tensor]]:
    """The state of the file's Gaussians, each a scene of one pixel, and what is made of it."""
    given = {n.removeprefix("adapter."): x for n, x in CASES.tensors.items() if "adapter" in n}
    height, width = CASES.config["image_shape"]
    lens = lens_of(given["intrinsics"], (height, width))
    # The centre of the pixel stands where the file has the Gaussian, and raw places are zero.
    shift = 0.5 - given["coordinates"] * torch.tensor([width, height])
    lens = torch.cat([lens[:, :2], lens[:, 2:] + shift], -1)
    cameras = Cameras(given["extrinsics"][:, None], lens[:, None], (1, 1))
    views = Views(torch.zeros(len(lens), 1, 3, 1, 1), cameras)
    head = [given["depths"].log()[:, None], given["opacities"].logit()[:, None]]
    raw = torch.cat([*head, torch.zeros(len(lens), 2), given["raw"]], -1)
    memory = ImageMemory(raw[:, None], grid=(1, 1, 1))
    state = PixelQueries(PixelQueries.Config(), DIMS)(memory, views)
    out = RayHead(RayHead.Config(), DIMS)(state)
    factors = quat_to_matrix(out.quats) * out.scales[..., None, :]
    turn = turn_of_harmonics(ROTATION, 4) * band_mask(4)
    found = {
        "origins": state[PIXEL][:, :, 0],
        "directions": ray_directions(raw[:, None, None, 2:4], state[PIXEL], unit=True)[:, 0],
        "means": OnRays(OnRays.Config(), DIMS)(out.offsets, state)[:, 0],
        "scales": out.scales[:, 0],
        "covariances": (factors @ factors.mT)[:, 0],
        "rotations": camera_quaternions(given["raw"][:, None, 3:7]),
        "harmonics": torch.einsum("bkl,bxl->bxk", turn, given["raw"][:, 7:].unflatten(1, (3, -1))),
    }
    return state, {n: x if n == "harmonics" else x[:, 0] for n, x in found.items()}


OUTPUTS = [n for n in CASES.config["outputs"] if n.startswith("adapter.")]


@pytest.mark.parametrize("name", OUTPUTS)
def test_single_gaussians(name: str) -> None:
    found = decoded()[1][name.removeprefix("adapter.")]
    torch.testing.assert_close(found, CASES.tensors[name], rtol=RTOL, atol=ATOL)


def test_our_harmonics_show_the_colours_of_the_released_ones() -> None:
    # Their rasteriser evaluates 3DGS's functions at (z, x, y), of degrees up to 3.
    released = CASES.tensors["adapter.harmonics"].double()
    raw = CASES.tensors["adapter.raw"][:, 7:].double().unflatten(1, (3, -1))
    ours = torch.einsum("bkl,bxl->bxk", world_harmonics(ROTATION.double(), 4), raw)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    theirs = harmonics(directions[:, [2, 0, 1]], 15) @ released[..., 1:16].mT
    shown = harmonics(directions, 15) @ ours[..., 1:16].mT
    torch.testing.assert_close(shown, theirs, rtol=1e-4, atol=5e-5)
    torch.testing.assert_close(ours[..., 0], released[..., 0], rtol=1e-5, atol=1e-6)
    assert theirs.std() > 0.01


def test_harmonics_are_orthonormal_and_those_of_3dgs_but_for_signs_and_axes() -> None:
    directions = torch.nn.functional.normalize(torch.randn(40_000, 3, dtype=torch.float64), dim=-1)
    values = e3nn_harmonics(directions, 4)
    gram = values.mT @ values / len(values)
    torch.testing.assert_close(gram, torch.eye(25, dtype=torch.float64), rtol=0, atol=0.06)
    sign = (-1.0) ** torch.arange(1, 16)
    ours = harmonics(directions[:, [2, 0, 1]], 15) * (4 * torch.pi) ** 0.5
    torch.testing.assert_close(ours, sign * values[:, 1:16])
    torch.testing.assert_close(values[:, 1:4], 3**0.5 * directions)


def test_the_warp() -> None:
    given = {n.removeprefix("warp."): x for n, x in CASES.tensors.items() if "warp" in n}
    k = given["intrinsics"]
    lens = torch.stack([k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2]], -1)
    grid = warp_grid(given["depth"], lens, given["pose"])
    near = given["grid"].abs() < 3  # near the other camera's plane digits are lost
    torch.testing.assert_close(grid[near], given["grid"][near], rtol=RTOL, atol=ATOL)
    torch.testing.assert_close(grid, given["grid"], rtol=1e-3, atol=ATOL)
    torch.testing.assert_close(
        warped(given["features"], grid), given["warped"], rtol=RTOL, atol=ATOL
    )


def test_the_opacity_map() -> None:
    schedule, p = CASES.tensors["opacity.schedule"], CASES.tensors["opacity.pdf"]
    for (initial, final, warm_up, step), mapped in zip(
        schedule.tolist(), CASES.tensors["opacity.mapped"], strict=True
    ):
        exponent = initial + min(step / warm_up, 1) * (final - initial)
        torch.testing.assert_close(mapped_opacity(p, exponent), mapped, rtol=RTOL, atol=ATOL)

"""DepthSplat against tensors that the released code computed."""

import pytest
import torch
from qgs_mvsplat import sweep
from qgs_mvsplat.adapter import band_mask, camera_quaternions, turn_of_harmonics
from qgs_mvsplat.depthsplat import nearest_neighbours
from qgs_mvsplat.pixels import PIXEL, in_world, pixel_fields
from qgs_mvsplat.sweep import feature_lenses, relative_poses, warp_grid, warped
from recorded_depthsplat import DEGREE, DIMS, decoded, recorded
from released import Released

from qgs.geometry.harmonics import SH_C0
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import Cameras, QueryState

FILES = ["depthsplat_a", "depthsplat_base_eighth_a", "depthsplat_base_a"]
FILES += ["depthsplat_small_eighth_views4_a"]
SUMS_CANCEL = dict.fromkeys(["cost_volume.0", "cost_volume.1"], (1e-4, 1.5e-4))
KINDER = {**SUMS_CANCEL, "warp_grid.0": (1e-3, 5e-5)}


@pytest.mark.parametrize("name", FILES)
def test_every_tensor(name: str) -> None:
    released = Released(name)
    assert released.problems(recorded(released), KINDER) == {}


@pytest.fixture(scope="module")
def cases() -> Released:
    return Released("depthsplat_cases_a")


def test_single_gaussians(cases: Released) -> None:
    """Each of 20 has a camera of its own; some have rotations and numbers that trouble."""
    given = {name.removeprefix("adapter."): x for name, x in cases.tensors.items()}
    raw, c2w = given["raw"], given["extrinsics"][:, None]
    height, width = cases.config["image_shape"]
    k = given["intrinsics"] * torch.tensor([width, height, 1.0])[:, None]
    lens = torch.stack([k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2]], -1)[:, None]
    fields = pixel_fields(Cameras(c2w, lens, (height, width)), 1, 1)  # one pixel, all of the image
    origin, corner, across, down = fields[PIXEL].unbind(2)
    x, y = given["coordinates"][:, None, :, None].unbind(2)
    point = corner + x * across + y * down
    fields[PIXEL] = torch.stack([origin, point, 0 * across, 0 * down], 2)
    sh = raw[:, 7:].unflatten(1, (3, 9)).clone()
    sh[..., 0] += (given["rgb"] - 0.5) / SH_C0
    numbers = [given["depths"].log()[:, None], given["opacities"].logit()[:, None]]
    numbers += [torch.zeros(20, 2), raw[:, :7], sh.flatten(1)]
    features = in_world(torch.cat(numbers, 1)[:, None], c2w[..., :3, :3])
    out, means = decoded(QueryState(features, fields), DIMS[1])
    factors = quat_to_matrix(out.quats) * out.scales[..., None, :]
    turn = turn_of_harmonics(c2w[:, 0, :3, :3], DEGREE) * band_mask(DEGREE)
    found = {
        "origins": origin[:, 0],
        "directions": point[:, 0],
        "means": means[:, 0],
        "covariances": (factors @ factors.mT)[:, 0, 0],
        "scales": out.scales[:, 0, 0],
        "rotations": camera_quaternions(raw[:, 3:7]),
        "harmonics": torch.einsum("nkl,nxl->nxk", turn, sh),
    }
    for name, x in found.items():
        torch.testing.assert_close(x, given[name], rtol=1e-4, atol=5e-5, msg=name)


def test_warp(cases: Released) -> None:
    given = {name.removeprefix("warp."): x for name, x in cases.tensors.items()}
    k = given["intrinsics"]
    lens = torch.stack([k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2]], -1)
    grid = warp_grid(given["depth"], lens, given["pose"])
    torch.testing.assert_close(grid, given["grid"], rtol=1e-3, atol=5e-5)
    seen = warped(given["features"], given["grid"])
    torch.testing.assert_close(seen, given["warped"], rtol=1e-4, atol=5e-5)


def test_both_ways_to_correlate_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few pixels for each candidate: all pairs at once; many: warped features, in chunks."""
    released = Released("depthsplat_a")
    cameras, features = released.views().cameras, released.tensors["features_mv.0"]
    neighbours = nearest_neighbours(cameras.c2w, 2)
    inverse = released.tensors["inverse_depth_candidates.0"][..., None, None]
    lens = feature_lenses(cameras, features.shape[-2:])
    given = (features, inverse, lens, relative_poses(cameras.c2w, neighbours), neighbours)
    for pairs, samples in ((0, 1 << 15), (40, 1 << 10)):
        monkeypatch.setattr(sweep, "PAIRS", pairs)
        monkeypatch.setattr(sweep, "MAX_SAMPLES", samples)
        found = sweep.cost_volume(*given)
        torch.testing.assert_close(found, released.tensors["cost_volume.0"], rtol=1e-4, atol=1.5e-4)

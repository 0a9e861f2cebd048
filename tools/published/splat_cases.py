"""Single Gaussians, a warp and opacities of MVSplat's and DepthSplat's files of cases."""

import torch
from qgs_zoo.mvsplat.adapter import band_mask, camera_quaternions, turn_of_harmonics
from qgs_zoo.mvsplat.depthsplat_head import WorldHead
from qgs_zoo.mvsplat.head import RayHead, mapped_opacity
from qgs_zoo.mvsplat.pixels import PIXEL, OnRays, in_world, pixel_fields, ray_directions
from qgs_zoo.mvsplat.sweep import warp_grid, warped
from torch import Tensor

from published.files import GoldenFile
from published.splats import lens_of
from qgs.contracts import ModelDims
from qgs.geometry.harmonics import SH_C0
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import Cameras, QueryState


def cases_tensors(golden: GoldenFile) -> dict[str, Tensor]:
    """Every output of a file of cases but those of the release's data loader."""
    lens = lens_of(golden.input("warp.intrinsics"))
    pose = golden.input("warp.pose")
    grid = warp_grid(golden.input("warp.depth"), lens, pose)
    found = {"warp.grid": grid, "warp.warped": warped(golden.input("warp.features"), grid)}
    if "opacity.pdf" in golden.tensors:
        found["opacity.mapped"] = opacities(golden)
    return found | {f"adapter.{name}": x for name, x in single_gaussians(golden).items()}


def opacities(golden: GoldenFile) -> Tensor:
    """Probabilities mapped by each schedule: first and last exponent, length, step."""
    first, last, length, step = golden.input("opacity.schedule").unbind(1)
    exponents = first + (step / length).clamp(max=1) * (last - first)
    pdf = golden.input("opacity.pdf")
    return torch.stack([mapped_opacity(pdf, exponent) for exponent in exponents.tolist()])


def single_gaussians(golden: GoldenFile) -> dict[str, Tensor]:
    """Gaussians each with a camera of its own; some have rotations and numbers that trouble."""
    of_rays = golden.config["kind"] == "mvsplat_cases"
    names = ("depths", "opacities", "raw", "extrinsics")
    depth, opacity, raw, c2w = (golden.input(f"adapter.{name}") for name in names)
    fields = rays(golden)
    sh = raw[:, 7:].unflatten(1, (3, -1)).clone()
    degree = round(sh.shape[-1] ** 0.5) - 1
    if not of_rays:
        sh[..., 0] += (golden.input("adapter.rgb") - 0.5) / SH_C0
    numbers = [depth.log()[:, None], opacity.logit()[:, None], raw.new_zeros(len(raw), 2)]
    numbers = torch.cat([*numbers, raw[:, :7], sh.flatten(1)], 1)[:, None]
    dims = ModelDims(numbers.shape[-1], 1, 0)
    state = QueryState(in_world(numbers, c2w[:, None, :3, :3]), fields)
    head = (RayHead(RayHead.Config(), dims) if of_rays else WorldHead(WorldHead.Config(), dims))(
        state
    )
    centers = OnRays(OnRays.Config(measure="distance" if of_rays else "depth"), dims)
    factors = quat_to_matrix(head.quats) * head.scales[..., None, :]
    turn = turn_of_harmonics(c2w[:, :3, :3], degree) * band_mask(degree, c2w)
    directions = ray_directions(numbers[:, :, None, 2:4], fields[PIXEL], unit=of_rays)
    return {
        "origins": fields[PIXEL][:, 0, 0],
        "directions": directions[:, 0, 0],
        "means": centers(head.offsets, state)[:, 0, 0],
        "covariances": (factors @ factors.mT)[:, 0, 0],
        "scales": head.scales[:, 0, 0],
        "rotations": camera_quaternions(raw[:, 3:7]),
        "harmonics": torch.einsum("nkl,nxl->nxk", turn, sh),
    }


def rays(golden: GoldenFile) -> dict[str, Tensor]:
    """Fields of pixels in whose middles the Gaussians stand, outside of the image too."""
    height, width = golden.config["image_shape"]
    c2w = golden.input("adapter.extrinsics")[:, None]
    lens = lens_of(golden.input("adapter.intrinsics"), (height, width))[:, None]
    # Of the image as one pixel.
    fields = pixel_fields(Cameras(c2w, lens, (height, width)), 1, 1)
    origin, corner, across, down = fields[PIXEL].unbind(2)
    x, y = golden.input("adapter.coordinates")[:, None, :, None].unbind(2)
    own = across / width, down / height
    place = corner + x * across + y * down - (own[0] + own[1]) / 2
    return {**fields, PIXEL: torch.stack([origin, place, *own], 2)}

"""Gaussians at pixels of photos, at the depth that other photos confirm: a plane sweep.

Source: A Space-Sweep Approach to True Multi-Image Matching (Collins 1996), with patches along rays.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.types import Cameras, Gaussians, Views

_DEPTHS, _NEAREST, _FARTHEST = 56, 0.1, 4.0  # number of hypotheses; their range over the size
_OTHERS = 6  # photos that a pixel is compared with; the better half counts, for occlusions
_BASELINE, _TURNED = 0.06, 10.0  # best baseline over the size; weight of 1 - cosine of the axes
_PATCH = 1  # radius in pixels of the compared patch
_MAX_COST = 0.3  # truncation of a difference of colours; half of it outside a photo
_NO_EVIDENCE = 1e-4  # cost per e-fold of depth away from the size: breaks ties only
_AT_ONCE = 1024  # pixels, so that memory stays within 0.3 GB
_OPACITY, _PIXELS = 0.1, 2.0  # opacity of the Gaussians; standard deviation in pixels


@torch.no_grad()
def swept(views: Views, count: int, size: float, generator: torch.Generator) -> Gaussians:
    """Gaussians (1, count) at random pixels of the photos `views` (1, V), with their colours.

    size: approximate distance of the scene from the cameras; also the depth of pixels that no
    other photo shows.
    """
    (height, width), device = views.cameras.size, views.images.device
    of_photo = height * width
    drawn = torch.randint(views.images.shape[1] * of_photo, (count,), generator=generator)
    drawn = drawn.sort().values
    parts = [
        _on_photo(views, photo, pixels.to(device), size)
        for photo, start in enumerate(range(0, views.images.shape[1] * of_photo, of_photo))
        for pixels in (drawn[(drawn >= start) & (drawn < start + of_photo)] - start).split(_AT_ONCE)
    ]
    means, scales, colors = (torch.cat(part)[None] for part in zip(*parts, strict=True))
    quats = torch.tensor([1.0, 0, 0, 0], device=device).expand(1, count, 4)
    return Gaussians(means, scales, quats, torch.full_like(means[..., 0], _OPACITY), colors)


def _on_photo(
    views: Views, photo: int, pixels: Tensor, size: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Means, scales and colors (n, 3) at `pixels` (n,) of one photo, in row-major order."""
    cameras, width = views.cameras, views.cameras.size[1]
    rows, columns = pixels // width, pixels % width
    pose = cameras.c2w[0, photo]
    depths = _depths(views, photo, rows, columns, size)
    rays = _rays(cameras, photo, rows, columns)
    means = pose[:3, 3] + rays * depths[:, None]
    scales = (_PIXELS * depths / cameras.intrinsics[0, photo, 0])[:, None].expand(-1, 3)
    return means, scales, views.images[0, photo][:, rows, columns].T


def _rays(cameras: Cameras, photo: int, rows: Tensor, columns: Tensor) -> Tensor:
    """World directions (..., 3) of pixels (...), scaled to depth 1 in the camera."""
    fx, fy, cx, cy = cameras.intrinsics[0, photo]
    x, y = (columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy
    return torch.stack([x, y, torch.ones_like(x)], -1) @ cameras.c2w[0, photo, :3, :3].T


def _depths(views: Views, photo: int, rows: Tensor, columns: Tensor, size: float) -> Tensor:
    """Depth (n,) of pixels (n,) of one photo, of least cost against the other photos."""
    cameras, (height, width) = views.cameras, views.cameras.size
    logs = torch.linspace(math.log(_NEAREST), math.log(_FARTHEST), _DEPTHS, device=rows.device)
    tried, others = size * logs.exp(), _others(cameras, photo, size)
    steps = torch.arange(-_PATCH, _PATCH + 1, device=rows.device)
    down, right = (x.reshape(-1) for x in torch.meshgrid(steps, steps, indexing="ij"))
    rows = (rows[:, None] + down).clamp(0, height - 1)
    columns = (columns[:, None] + right).clamp(0, width - 1)
    pose, own = cameras.c2w[0, photo], views.images[0, photo][:, rows, columns]
    points = pose[:3, 3] + _rays(cameras, photo, rows, columns)[:, :, None] * tried[:, None]
    costs = []  # (n, depths) of every other photo
    for other in others:
        w2c, (fx, fy, cx, cy) = cameras.w2c[0, other], cameras.intrinsics[0, other]
        x, y, z = (points @ w2c[:3, :3].T + w2c[:3, 3]).unbind(-1)
        ahead = z.clamp_min(1e-3 * size)
        at = torch.stack([fx * x / ahead + cx, fy * y / ahead + cy], -1)
        at = 2 * at / at.new_tensor([width, height]) - 1
        seen = (z >= ahead) & (at.abs() < 1).all(-1)
        flat = at.flatten(0, 1)[None]
        found = F.grid_sample(views.images[:, other], flat, "bilinear", "border", False)
        cost = (found.view(*own.shape, _DEPTHS) - own[..., None]).abs().mean(0)
        costs.append(torch.where(seen, cost.clamp_max(_MAX_COST), _MAX_COST / 2).mean(1))
    best = torch.stack(costs).topk((len(costs) + 1) // 2, 0, largest=False).values.mean(0)
    return tried[(best + _NO_EVIDENCE * logs.abs()).argmin(-1)]


def _others(cameras: Cameras, photo: int, size: float) -> list[int]:
    """Photos with the best baseline and direction for matching `photo`; itself if alone."""
    eyes, axes = cameras.c2w[0, :, :3, 3], cameras.c2w[0, :, :3, 2]
    baseline = (eyes - eyes[photo]).norm(dim=-1) / size
    unlike = (baseline.clamp_min(1e-6) / _BASELINE).log().abs() + _TURNED * (1 - axes @ axes[photo])
    unlike[photo] = math.inf
    return unlike.topk(min(_OTHERS, max(len(eyes) - 1, 1)), largest=False).indices.tolist()

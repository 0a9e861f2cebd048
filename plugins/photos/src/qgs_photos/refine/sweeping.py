"""Place Gaussians at pixels of photos, at the depth on which photos agree best (plane sweep).

Source: A Space-Sweep Approach to True Multi-Image Matching (Collins 1996), with 3 x 3 patches.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.containers import concatenated
from qgs.types import Cameras, Gaussians, Views

# Hypotheses for a depth.
_DEPTHS = 56
# Their range over the size of the scene.
_NEAREST = 0.1
_FARTHEST = 4.0
# Photos that a pixel is compared with; the better half counts, because others may see it hidden.
_OTHERS = 6
# Best baseline over the size of the scene.
_BASELINE = 0.06
# Weight of 1 - cosine of the axes.
_TURNED = 10.0
# Radius of the compared patch, in pixels.
_PATCH = 1
# Truncation of a difference of colours; half of it outside a photo.
_MAX_COST = 0.3
# Cost per e-fold of depth away from the size: breaks ties only.
_NO_EVIDENCE = 1e-4
# Pixels at once, so that memory stays within 0.3 GB.
_AT_ONCE = 1024
# Opacity of the Gaussians.
_OPACITY = 0.1
# Their standard deviation in pixels.
_PIXELS = 2.0


@torch.no_grad()
def swept(views: Views, count: int, size: float, generator: torch.Generator) -> Gaussians:
    """Return Gaussians (1, count) at random pixels of photos (1, V), in the colours of the pixels.

    size: approximate distance of the scene from the cameras, used as the depth of pixels that no
    other photo shows. generator: samples the pixels.
    """
    pixels = math.prod(views.cameras.size)
    drawn = torch.randint(views.images.shape[1] * pixels, (count,), generator=generator)
    drawn = drawn.sort().values
    parts = list[Gaussians]()
    for photo in range(views.images.shape[1]):
        own = drawn[drawn // pixels == photo] % pixels
        parts += [_on_photo(views, photo, few, size) for few in own.split(_AT_ONCE)]
    return concatenated(parts, 1)


def balls(means: Tensor, scales: Tensor, opacity: float, colors: Tensor) -> Gaussians:
    """Return unrotated Gaussians (1, G) of one opacity. means, scales, colors: (G, 3)."""
    quats = colors.new_tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    return Gaussians(means, scales, quats, torch.full_like(colors[:, 0], opacity), colors)[None]


def _on_photo(views: Views, photo: int, pixels: Tensor, size: float) -> Gaussians:
    """Return Gaussians (1, n) at `pixels` (n,) of a photo.

    Pixels are numbered row by row.
    """
    cameras = views.cameras
    pixels = pixels.to(views.images.device)
    rows = pixels // cameras.size[1]
    columns = pixels % cameras.size[1]
    depths = _depths(views, photo, rows, columns, size)
    rays = pixel_rays(cameras, photo, rows, columns)
    means = cameras.c2w[0, photo, :3, 3] + rays * depths[:, None]
    scales = (_PIXELS * depths / cameras.intrinsics[0, photo, 0])[:, None].expand(-1, 3)
    return balls(means, scales, _OPACITY, views.images[0, photo][:, rows, columns].T)


def pixel_rays(cameras: Cameras, photo: int, rows: Tensor, columns: Tensor) -> Tensor:
    """Return the world directions (..., 3) of pixels, scaled to depth 1 in the camera."""
    fx, fy, cx, cy = cameras.intrinsics[0, photo]
    x = (columns + 0.5 - cx) / fx
    y = (rows + 0.5 - cy) / fy
    return torch.stack([x, y, torch.ones_like(x)], -1) @ cameras.c2w[0, photo, :3, :3].T


def _depths(views: Views, photo: int, rows: Tensor, columns: Tensor, size: float) -> Tensor:
    """Return the depths (n,) of pixels of one photo, by comparison with other photos.

    From depths around the distance `size`, each pixel gets the one where colours differ least.
    """
    cameras = views.cameras
    height, width = cameras.size
    logs = torch.linspace(math.log(_NEAREST), math.log(_FARTHEST), _DEPTHS, device=rows.device)
    tried = size * logs.exp()
    steps = torch.arange(-_PATCH, _PATCH + 1, device=rows.device)
    down, right = torch.cartesian_prod(steps, steps).T
    rows = (rows[:, None] + down).clamp(0, height - 1)
    columns = (columns[:, None] + right).clamp(0, width - 1)
    colors = views.images[0, photo][:, rows, columns]
    rays = pixel_rays(cameras, photo, rows, columns)
    points = cameras.c2w[0, photo, :3, 3] + rays[:, :, None] * tried[:, None]
    costs = list[Tensor]()
    for other in _others(cameras, photo, size):
        w2c = cameras.w2c[0, other]
        focal, centre = cameras.intrinsics[0, other].split(2)
        seen_from = points @ w2c[:3, :3].T + w2c[:3, 3]
        depth = seen_from[..., 2:]
        places = (focal * seen_from[..., :2] / depth + centre) / depth.new_tensor([width, height])
        places = 2 * places - 1
        visible = (depth[..., 0] >= 1e-3 * size) & (places.abs() < 1).all(-1)
        flat = places.flatten(0, 1)[None]
        found = F.grid_sample(views.images[:, other], flat, "bilinear", "border", False)
        cost = (found.view(*colors.shape, _DEPTHS) - colors[..., None]).abs().mean(0)
        costs.append(torch.where(visible, cost.clamp_max(_MAX_COST), _MAX_COST / 2).mean(1))
    half = (len(costs) + 1) // 2
    best = torch.stack(costs).topk(half, 0, largest=False).values.mean(0)
    return tried[(best + _NO_EVIDENCE * logs.abs()).argmin(-1)]


def _others(cameras: Cameras, photo: int, size: float) -> list[int]:
    """Return the indices of photos whose baseline and direction are best for matching `photo`.

    A single photo is matched with itself.
    """
    centres = cameras.c2w[0, :, :3, 3]
    axes = cameras.c2w[0, :, :3, 2]
    baseline = (centres - centres[photo]).norm(dim=-1) / size
    turned = 1 - axes @ axes[photo]
    unlike = (baseline.clamp_min(1e-6) / _BASELINE).log().abs() + _TURNED * turned
    unlike[photo] = math.inf
    count = min(_OTHERS, max(len(centres) - 1, 1))
    return unlike.topk(count, largest=False).indices.tolist()

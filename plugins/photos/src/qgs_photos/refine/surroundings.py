"""Surroundings of a scene: its background colour as opaque Gaussians far away."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F

from qgs.types import Cameras, Gaussians
from qgs_photos.refine.sweeping import balls, pixel_rays

# Angle between neighbours, in radians, and their standard deviation.
_GAP = 0.1


@torch.no_grad()
def surroundings(cameras: Cameras, size: float, color: Sequence[float]) -> Gaussians:
    """Return Gaussians (1, G) of one colour on a sphere, in the directions of cameras (1, V).

    A file of Gaussians holds no background colour, and viewers show their own where nothing is.
    size: approximate distance of the scene from the cameras.
    """
    centres = cameras.c2w[0, :, :3, 3]
    middle = centres.mean(0)
    centres = centres - middle
    radius = 10 * size + 4 * centres.norm(dim=-1).max()
    # those beside a photo reach into it
    part = torch.linspace(-0.2, 1.2, 24, device=centres.device)
    rows, columns = torch.cartesian_prod(part * cameras.size[0], part * cameras.size[1]).T
    ways = [pixel_rays(cameras, v, rows, columns) for v in range(len(centres))]
    seen = F.normalize(centres[:, None] + radius * torch.stack(ways), dim=-1).flatten(0, 1)
    # many photos look the same way: one of each cell
    sphere = F.normalize((seen / _GAP).round().unique(dim=0), dim=-1)[None]
    # several overlap everywhere: less than 0.002 of what is behind them shows
    return balls(
        middle + radius * sphere,
        (radius * _GAP).expand_as(sphere),
        0.9,
        sphere.new_tensor(color).expand_as(sphere),
    )

"""Surroundings: the background colour of a scene, as distant Gaussians that every viewer shows."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F

from qgs.containers import map_tensors
from qgs.types import Gaussians, Views
from qgs_photos.refine.refining import distance, joined
from qgs_photos.refine.sweeping import balls, pixel_rays

# Angle between neighbours, in radians; also their standard deviation.
_GAP = 0.1
# Several overlap everywhere: less than 0.002 of what is behind them shows.
_OPACITY = 0.9
# Places along each side of a photo; Gaussians beside a photo reach into it.
_PLACES = torch.linspace(-0.2, 1.2, 24)


def edge_color(views: Views) -> tuple[float, float, float]:
    """Return the median colour at the edges of photos (1, V)."""
    images = views.images[0].transpose(0, 1)
    edges = [images[..., 0, :], images[..., -1, :], images[..., 0], images[..., -1]]
    red, green, blue = torch.cat(edges, -1).flatten(1).median(1).values.tolist()
    return red, green, blue


@torch.no_grad()
def surrounded(gaussians: Gaussians, views: Views, color: Sequence[float]) -> Gaussians:
    """Add Gaussians of one colour behind all others, in every direction in which photos look.

    views: photos (1, V). A file of Gaussians holds no background colour; without these Gaussians,
    viewers show a colour of their own where the scene is empty.
    """
    cameras = views.cameras
    centres = cameras.c2w[0, :, :3, 3]
    middle = centres.mean(0)
    centres = centres - middle
    radius = 10 * distance(gaussians, views) + 4 * float(centres.norm(dim=-1).max())
    places = _PLACES.to(centres.device)
    rows, columns = torch.cartesian_prod(places * cameras.size[0], places * cameras.size[1]).T
    rays = torch.stack([pixel_rays(cameras, v, rows, columns) for v in range(len(centres))])
    directions = F.normalize(centres[:, None] + radius * rays, dim=-1).flatten(0, 1)
    # Many photos look the same way: one Gaussian for each cell.
    sphere = F.normalize((directions / _GAP).round().unique(dim=0), dim=-1)
    means = middle + radius * sphere
    scales = torch.full_like(sphere, radius * _GAP)
    far = balls(means, scales, _OPACITY, sphere.new_tensor(color).expand_as(sphere))
    # First in the file, so that viewers which have not sorted yet draw them behind all others.
    return map_tensors(lambda part: part.roll(far.count, 1), joined(gaussians, far))

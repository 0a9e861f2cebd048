"""Evidence that photos give on the Gaussians of a scene: errors to expect, and floaters."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.data.view_samplers import evenly
from qgs.geometry.harmonics import seen_colors
from qgs.geometry.transforms import to_camera
from qgs.metrics.images import psnr
from qgs.types import Cameras, Gaussians, Views
from qgs_photos.viewing import VIEWER

MOST = 64
"""Largest number of photos that are compared with their renders."""
# Pixels that a Gaussian must fill in a photo, so that the photo shows it.
_SHOWN = 0.5
# The expected error: factor on the error in photos, exponent of the number of photos, exponent
# for each radian between a view and the nearest photo. docs/refine.md says how they were fitted.
_FACTOR = 4.7
_OF_COUNT = -0.5
_OF_ANGLE = 0.5
_LARGEST_ANGLE = 1.0
# Least error in photos, and error where no Gaussian is if photos show no such place.
_LEAST = 0.003
_EMPTY = 0.3
# Floaters: their depth over the median depth of a photo, at most, and photos that show them.
_NEAR = 0.3
_FEW = 2


@dataclass(frozen=True)
class Evidence:
    """Evidence that P photos of a scene give on its G Gaussians.

    gaussians: (1, G). eyes: centres of the photos' cameras (P, 3). shown: which photos show which
    Gaussians (P, G). floating: Gaussians near a camera that few photos show (G,). errors: errors to
    expect in views from the directions of the photos (G,). empty: the error to expect where no
    Gaussian is. scale: factor of these errors that `calibrated` has found.
    """

    gaussians: Gaussians
    eyes: Tensor
    shown: Tensor
    floating: Tensor
    errors: Tensor
    empty: Tensor
    scale: float = 1.0

    def error_map(self, cameras: Cameras) -> Tensor:
        """Return the error to expect in each pixel of the render from a camera (1, 1): (H, W).

        It grows with the angle between the directions of the view and of the nearest photo.
        """
        means = self.gaussians.means[0]
        to_view = F.normalize(cameras.c2w[0, 0, :3, 3] - means, dim=-1)
        # of the vectors to photos, without a tensor of them
        along = self.eyes @ to_view.T - (means * to_view).sum(-1)
        cosines = (along / torch.cdist(self.eyes, means)).where(self.shown, -1.0)
        angles = cosines.amax(0).clamp(math.cos(_LARGEST_ANGLE), 1).acos()
        errors = self.errors * (_OF_ANGLE * angles).exp()
        render = VIEWER(replace(self.gaussians, features=errors[None, :, None]), cameras)
        return (render.features + self.empty * (1 - render.alpha))[0, 0, 0]

    def calibrated(self, judged: Views) -> "Evidence":
        """Return a copy whose errors are scaled to those in photos (1, H) that were left out.

        The fewer photos, the less: the best scale differs between photos of a scene, too.
        """
        expected = found = 0.0
        for view in each_view(judged):
            expected += float(self.error_map(view.cameras).mean())
            rgb = VIEWER(self.gaussians, view.cameras).rgb
            found += float(errors_of(rgb, view.images).mean())
        count = judged.images.shape[1]
        scale = (found / expected) ** (count / (count + 0.5)) if found else 1.0
        return replace(self, errors=scale * self.errors, empty=scale * self.empty, scale=scale)

    def cleaned(self, judged: Views) -> "Evidence":
        """Return a copy without floating Gaussians, unless photos that were left out get worse.

        judged: these photos, (1, H); without any, or if their mean PSNR falls, nothing changes.
        """
        keep = ~self.floating
        # nothing to judge by renders
        if keep.all():
            return self
        kept = replace(
            self,
            gaussians=self.gaussians[:, keep],
            shown=self.shown[:, keep],
            floating=self.floating[keep],
            errors=self.errors[keep],
        )
        # without photos both are NaN
        return kept if quality(kept.gaussians, judged) >= quality(self.gaussians, judged) else self


def quality(gaussians: Gaussians, views: Views) -> float:
    """Return the mean PSNR of renders of Gaussians (1, G) as photos (1, V); NaN without photos."""
    scores = [psnr(VIEWER(gaussians, view.cameras).rgb, view.images) for view in each_view(views)]
    return float(torch.stack(scores).mean()) if scores else math.nan


def errors_of(rgb: Tensor, images: Tensor) -> Tensor:
    """Return the absolute error of renders (..., 3, H, W), a mean over RGB: (..., H, W)."""
    return (rgb.clamp(0, 1) - images).abs().mean(-3)


def evidence(gaussians: Gaussians, views: Views, surroundings: int = 0) -> Evidence:
    """Gather the evidence on Gaussians (1, G) from photos (1, V), at most MOST of them.

    surroundings: number of the first Gaussians, which stand for what is far behind all others; they
    never float.
    """
    photos = views.images.shape[1]
    compared = evenly(range(photos), MOST)
    sums = gaussians.means.new_zeros(2, gaussians.count)
    shown = sums.new_zeros(len(compared), gaussians.count).bool()
    near = sums[0].bool()
    holes = sums.new_zeros(2)
    for place, photo in enumerate(compared):
        view = views.select([photo])
        weights, empty, depth = _weights(gaussians, view)
        shown[place] = weights[0] > _SHOWN
        depths = to_camera(gaussians.means, view.cameras)[0, 0, :, 2]
        near |= shown[place] & (depths < _NEAR * depth)
        sums += weights
        holes += empty
    weights, errors = sums
    # as if one more pixel had the usual error
    errors = (errors + errors.sum() / weights.sum().clamp_min(1)) / (weights + 1)
    count = shown.sum(0) * photos / len(compared)
    near[:surroundings] = False
    # where hardly more photos exist, they say nothing
    floating = near & (count <= _FEW) & (photos > 2 * _FEW)
    errors = _FACTOR * (errors + _LEAST) * (1 + count) ** _OF_COUNT
    eyes = views.cameras.c2w[0, compared, :3, 3]
    holes, missed = holes
    return Evidence(gaussians, eyes, shown, floating, errors, (missed + _EMPTY) / (holes + 1))


def each_view(views: Views) -> Iterator[Views]:
    """Yield the V views (1, 1) of `views` (1, V)."""
    return (views.select([view]) for view in range(views.images.shape[1]))


def _weights(gaussians: Gaussians, view: Views) -> tuple[Tensor, Tensor, Tensor]:
    """Return sums over the pixels of a photo (1, 1), of each of G Gaussians and of empty places.

    The sums are those of the weight, and of the weight times the error of the render: (2, G), (2,).
    The median of rendered depths comes with them.
    """
    with torch.enable_grad():
        colors = seen_colors(gaussians, view.cameras)[:, 0].requires_grad_()
        render = VIEWER(gaussians.replace(colors=colors, sh=None), view.cameras)
        errors = errors_of(render.rgb.detach(), view.images)[0, 0]
        factors = torch.stack([torch.ones_like(errors), errors])
        # the derivatives by red and green are weights
        (weights,) = torch.autograd.grad((render.rgb[0, 0, :2] * factors).sum(), colors)
    empty = (1 - render.alpha.detach())[0, 0]
    depth = render.depth.detach()[render.alpha > 0.5].median()
    return weights[0, :, :2].T, (empty * factors).sum((1, 2)), depth

"""Optimise the pose and the exposure of each photo together with the Gaussians."""

from collections.abc import Collection

import torch
import torch.nn.functional as F
from kornia.geometry.conversions import Rt_to_matrix4x4
from torch import Tensor

from qgs.containers import concatenated
from qgs.geometry.transforms import depths_in_view, quat_to_matrix, to_camera, to_pixels
from qgs.types import Cameras, Gaussians, Views

DIFFER = 0.035
"""Spread of the brightness of photos from which the exposure of each is optimised by default: the
standard deviation of `brightness`. Photos of one exposure have up to 0.03, of +-1/4 stop 0.04."""
# Added to colours, so that dark ones count less.
_DARK = 0.02
# Learning rates of poses: the first, and the last over the first.
_RATE = 3e-4
_LAST = 0.1
# Weight of squared corrections of poses, so that the world stays where it is in the mean.
_HELD = 10.0
# Part of the way to the best exposure that each step goes, and the pull of exposures to 0.
_FOLLOWED = 0.2
_PULL = 1e-3


class Adjustments:
    """Corrections of the poses and colours of photos; each step changes those of one photo.

    A pose has 6 parameters in the frame of its camera, which are optimised: half the rotation
    vector (radians), and the translation divided by `size`. An exposure is an affine map of
    rendered RGB, fitted to the photo by least squares: (4, 3), without the identity. The mean of
    all exposures is 0, so that the Gaussians keep the mean colours of the photos.

    photos: number of photos. adjust: what is corrected, "poses" and "exposure". size: size of the
    scene in world units. like: tensor whose type and device the corrections get.
    """

    def __init__(self, photos: int, adjust: Collection[str], size: float, like: Tensor) -> None:
        self.size = size
        # One tensor a photo: Adam leaves those without a gradient where they are.
        count = photos if "poses" in adjust else 0
        self._poses = [like.new_zeros(6).requires_grad_() for _ in range(count)]
        self._optimizer = torch.optim.Adam(self._poses, eps=1e-15) if count else None
        self._exposures = like.new_zeros(photos, 4, 3) if "exposure" in adjust else None

    def cameras(self, photo: int, cameras: Cameras) -> Cameras:
        """Return the corrected camera (1, 1) of the photo with index `photo`."""
        if not self._poses:
            return cameras
        turn, shift = self._poses[photo].split(3)
        # small turns: half the axis is the quaternion's vector
        quat = F.normalize(torch.cat([turn.new_ones(1), turn]), dim=0)
        move = Rt_to_matrix4x4(quat_to_matrix(quat)[None], self.size * shift[None, :, None])
        return cameras.replace(c2w=cameras.c2w @ move)

    def every_camera(self, cameras: Cameras) -> Cameras:
        """Return the corrected cameras (1, V) of all photos, without gradients."""
        with torch.no_grad():
            each = [self.cameras(v, cameras[:, [v]]) for v in range(cameras.shape[1])]
        return concatenated(each, 1)

    def seen(self, photo: int, rgb: Tensor, image: Tensor) -> Tensor:
        """Correct the exposure of rendered `rgb` (1, 1, 3, H, W) to that of a photo, and fit it.

        photo: index of the photo. image: the photo, of the same shape.
        """
        if self._exposures is None:
            return rgb
        exposure = self._exposures[photo].clone()
        with torch.no_grad():
            best = fitted_exposure(rgb, image)
            self._exposures[photo].lerp_(best, _FOLLOWED)
            self._exposures -= self._exposures.mean(0)
        return exposed(rgb, exposure)

    def cost(self, photo: int) -> Tensor | float:
        """Return the loss term that keeps the pose of the photo with index `photo` where it is."""
        return _HELD * self._poses[photo].square().sum() if self._poses else 0.0

    def step(self, used: float) -> None:
        """Take an optimizer step.

        used: fraction of the optimisation's time already spent; the learning rate falls with it.
        """
        if self._optimizer:
            self._optimizer.param_groups[0]["lr"] = _RATE * _LAST**used
            self._optimizer.step()
            self._optimizer.zero_grad()


def exposed(rgb: Tensor, exposure: Tensor) -> Tensor:
    """Return `rgb` (..., 3, H, W) plus an affine map (4, 3) of it."""
    return rgb + (_colors(rgb) @ exposure).movedim(-1, -3)


def fitted_exposure(rgb: Tensor, image: Tensor) -> Tensor:
    """Return the affine map (4, 3) for `exposed` that makes `rgb` most like `image`.

    rgb, image: (..., 3, H, W). Squares of the map cost a little, so that noise is not followed.
    """
    colors = _colors(rgb).flatten(0, -2)
    missing = (image - rgb).movedim(-3, -1).flatten(0, -2)
    squares = colors.T @ colors / len(colors) + _PULL * torch.eye(4).to(colors)
    return torch.linalg.solve(squares, colors.T @ missing / len(colors))


def _colors(rgb: Tensor) -> Tensor:
    """Return colours (..., H, W, 4) of `rgb` (..., 3, H, W), with a 1 behind each."""
    return F.pad(rgb.movedim(-3, -1), (0, 1), value=1.0)


def brightness(gaussians: Gaussians, views: Views) -> Tensor:
    """Return how much brighter than the Gaussians (1, G) each of V photos is where it shows them.

    gaussians: in the colours of pixels of the photos. views: (1, V). The result (V,) has the median
    of the logarithm of the ratio in each photo.
    """
    means = gaussians.means
    last = means.new_tensor(views.cameras.size) - 1
    found = list[Tensor]()
    for view, image in enumerate(views.images[0]):
        camera = views.cameras[:, [view]]
        seen = depths_in_view(means[0], camera)[0].isfinite()
        pixels = to_pixels(to_camera(means, camera)[0, 0, seen], camera.intrinsics[0, 0])
        rows, columns = pixels.flip(-1).minimum(last).long().T
        shown = image[:, rows, columns].mean(0)
        own = gaussians.colors[0, seen].mean(-1)
        # those of the photo's own pixels say nothing
        ratios = ((shown + _DARK) / (own + _DARK))[shown != own]
        found.append(ratios.log().nanmedian())
    return torch.stack(found)

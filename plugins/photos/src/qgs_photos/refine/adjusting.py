"""Optimise the pose and the exposure of each photo together with the Gaussians."""

from collections.abc import Collection

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.transforms import quat_to_matrix
from qgs.types import Cameras

_SHAPES = {"poses": (6,), "exposure": (3, 4)}
_RATES = {"poses": 3e-4, "exposure": 5e-3}
# Final learning rates over the first.
_LAST = 0.1
# Weights of squares, so that the world and its colours stay where they are in the mean.
_HELD = {"poses": 10.0, "exposure": 0.1}


class Adjustments:
    """Corrections of the poses and colours of photos; each step optimises those of one photo.

    A pose has 6 parameters in the frame of its camera: half the rotation vector (radians), and the
    translation divided by `size`. An exposure has 3 x 4 parameters: the deviation from the identity
    of an affine map of rendered RGB.

    photos: number of photos. adjust: what is optimised, "poses" and "exposure". size: size of the
    scene in world units. like: tensor whose type and device the parameters get.
    """

    def __init__(self, photos: int, adjust: Collection[str], size: float, like: Tensor) -> None:
        self.size = size
        # One tensor a photo: Adam leaves those without a gradient where they are.
        self._parts = {
            name: [like.new_zeros(shape).requires_grad_() for _ in range(photos)]
            for name, shape in _SHAPES.items()
            if name in adjust
        }
        self._optimizers = {
            name: torch.optim.Adam(part, eps=1e-15) for name, part in self._parts.items()
        }

    def cameras(self, photo: int, cameras: Cameras) -> Cameras:
        """Return the corrected camera (1, 1) of the photo with index `photo`."""
        if "poses" not in self._parts:
            return cameras
        turn, shift = self._parts["poses"][photo].split(3)
        # small turns: half the axis is the quaternion's vector
        quat = F.normalize(torch.cat([turn.new_ones(1), turn]), dim=0)
        rows = torch.cat([quat_to_matrix(quat), self.size * shift[:, None]], 1)
        move = torch.cat([rows, rows.new_tensor([[0.0, 0, 0, 1]])])
        return cameras.replace(c2w=cameras.c2w @ move)

    def every_camera(self, cameras: Cameras) -> Cameras:
        """Return the corrected cameras (1, V) of all photos, without gradients."""
        with torch.no_grad():
            each = [self.cameras(v, cameras[:, [v]]).c2w for v in range(cameras.shape[1])]
        return cameras.replace(c2w=torch.cat(each, 1))

    def seen(self, photo: int, rgb: Tensor) -> Tensor:
        """Apply the exposure of the photo with index `photo` to rendered `rgb` (1, 1, 3, H, W)."""
        if "exposure" not in self._parts:
            return rgb
        change = self._parts["exposure"][photo]
        turned = torch.einsum("ij,bvjhw->bvihw", change[:, :3], rgb)
        return rgb + turned + change[:, 3, None, None]

    def cost(self, photo: int) -> Tensor | float:
        """Return the loss term that keeps the corrections of the photo with index `photo` small."""
        return sum(_HELD[k] * part[photo].square().sum() for k, part in self._parts.items())

    def step(self, used: float) -> None:
        """Take an optimizer step.

        used: fraction of the optimisation's time already spent; the learning rate falls with it.
        """
        for name, optimizer in self._optimizers.items():
            optimizer.param_groups[0]["lr"] = _RATES[name] * _LAST**used
            optimizer.step()
            optimizer.zero_grad()

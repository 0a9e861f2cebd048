"""Gaussians as viser takes them; points on photos; the Gaussian on a ray."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.transforms import quat_to_matrix
from qgs.precision import full_precision
from qgs.types import Cameras, Gaussians, Size

# Blending weight on a clicked ray below which a Gaussian is not hit.
LEAST_WEIGHT = 0.02
# A half of the largest number of float16, which viewers get covariances in.
FLOAT16 = 2.0**15


@dataclass(frozen=True)
class Splats:
    """G Gaussians in the form that viser takes, all in float32.

    centers: (G, 3). covariances: (G, 3, 3). opacities: (G, 1). colors: RGB (G, 3) in [0, 1].
    """

    centers: np.ndarray
    covariances: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray

    @property
    def magnification(self) -> float:
        """Factor to multiply lengths by, so that covariances fit into float16.

        The factor brings the largest covariance near the maximum of float16. Standard deviations
        that are 10,000 times smaller than the largest then do not vanish.
        """
        return float(np.sqrt(FLOAT16 / max(np.abs(self.covariances).max(), 1e-30)))


@full_precision
def splats(gaussians: Gaussians) -> Splats:
    """Return the Gaussians (1, G) of one scene.

    Spherical harmonics above degree 0 are left out, see `harmonics_script`.
    """
    turns_G33 = quat_to_matrix(gaussians.quats[0]).cpu().double()
    axes_G33 = turns_G33 * gaussians.scales[0].cpu().double()[:, None, :]
    return Splats(
        centers=_array(gaussians.means[0]),
        covariances=_array(axes_G33 @ axes_G33.mT),
        opacities=_array(gaussians.opacities[0, :, None]),
        colors=_array(gaussians.colors[0].clamp(0, 1)),
    )


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().cpu().numpy()


def hit(found: Splats, origin: np.ndarray, direction: np.ndarray) -> int | None:
    """Return the index of the Gaussian with the largest blending weight on a ray.

    Returns None if all weights are below 0.02. The alpha of a Gaussian is its greatest value along
    the ray; alphas are blended from near to far. origin, direction: start and direction of the ray,
    both (3,).
    """
    offsets = origin - found.centers.astype(np.float64)
    # flat Gaussians have no inverse
    least = 1e-12 * np.eye(3)
    precision = np.linalg.inv(found.covariances.astype(np.float64) + least)
    across = np.einsum("gij,j->gi", precision, direction)
    along = np.maximum(across @ direction, 1e-30)
    depths = -np.einsum("gi,gi->g", across, offsets) / along
    nearest = offsets + depths[:, None] * direction
    distances = np.einsum("gi,gij,gj->g", nearest, precision, nearest)
    alphas = np.where(depths > 0, np.exp(-distances / 2), 0) * found.opacities[:, 0]
    order = np.argsort(depths)
    # light that is left after the Gaussians before
    left = np.cumprod(np.r_[1.0, 1 - alphas[order]])[:-1]
    weights = alphas[order] * left
    best = int(weights.argmax())
    return int(order[best]) if weights[best] >= LEAST_WEIGHT else None


@full_precision
def on_photo(cameras: Cameras, pixels: Tensor, depth: float | Tensor) -> Tensor:
    """Return the world points (V, P, 3) of P pixels in V cameras, at the depth z = `depth`.

    cameras: (V,). pixels: (P, 2), the same pixels in all cameras. depth: one for all, or (V, P, 1).
    """
    focal, principal = cameras.intrinsics[:, None].split(2, -1)
    local = F.pad((pixels.to(focal) - principal) / focal, (0, 1), value=1.0) * depth
    return local @ cameras.c2w[:, :3, :3].to(local).mT + cameras.c2w[:, None, :3, 3].to(local)


def corners(size: Size) -> Tensor:
    """Return the corners (4, 2) of a picture in pixels (x, y), clockwise from (0, 0)."""
    height, width = size
    return torch.tensor([[0, 0], [width, 0], [width, height], [0, height]]).double()


def patch_centers(grid: tuple[int, int, int], size: Size) -> Tensor:
    """Return the centres of all patches of one photo in pixels (x, y): (rows * columns, 2).

    grid: numbers of photos, of patch rows and of patch columns. size: (H, W) of a photo in pixels.
    """
    _, rows, columns = grid
    height, width = size
    places = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).double() + 0.5
    # a grid counts rows first, pixels are (x, y)
    return places.flip(-1) * torch.tensor([width / columns, height / rows])

"""The loss `qgs/visibility`, which moves Gaussians outside of all target views into a view."""

from collections.abc import Iterable, Iterator
from typing import Literal

import torch
from pydantic import PositiveFloat
from torch import Tensor

from qgs.contracts import Loss, Problem, RecipeContext, without_effect
from qgs.geometry.constants import constant
from qgs.losses.photometric import mean_of_gaussians
from qgs.precision import full_precision
from qgs.types import Cameras, LayerPrediction, Rendering, Views

_TINY_Z = 1e-8
"""Value of |z| below which z counts as 0, so that gradients of x / z stay finite."""

INFINITE_PIXEL = 1e6
"""Pixel coordinate used in place of x / 0 with x != 0 (TokenGS release)."""


class VisibilityOptions(Loss.Config):
    """Options of visibility losses.

    With `behind_camera` "invisible", a point behind a camera has no gradient from this camera, like
    every point whose loss is clamped. Views that have the point in front of them still move it.
    """

    clamp: PositiveFloat | None = 1.0
    """Upper bound of a point's loss. The unit is half an image side (TokenGS and LocusGS releases:
    1). null: no bound."""
    near: PositiveFloat = 0.025
    """Camera-frame z, in world units, at or below which a point counts as behind the camera."""
    behind_camera: Literal["published", "invisible"] = "published"
    """Rule for points behind a camera. "published" projects them like other points, mirrored, so
    they may count as visible, as in the TokenGS and LocusGS releases. "invisible" sets the
    loss of such a point in this camera's view to the upper bound, the option `clamp`."""

    @property
    def behind(self) -> float | None:
        """Camera-frame z at or below which points are invisible; None if z does not matter."""
        return self.near if self.behind_camera == "invisible" else None

    def conflicts(self) -> Iterator[Problem]:
        """Yield a problem for each option that contradicts another option or has no effect."""
        if self.behind_camera == "published":
            yield from without_effect(self, ("near",), "`behind_camera` is published")
        elif self.clamp is None:
            yield Problem(
                "clamp",
                "`behind_camera` is invisible and `clamp` is null, so the loss of a point behind "
                "every camera is infinite",
                "set `clamp` to a number, such as 1.0",
            )


class Visibility(Loss):
    """Visibility loss: mean distance of the Gaussians to the image of their nearest target view.

    A Gaussian that a target view shows has distance 0; see `view_visibility` (TokenGS release).
    """

    name = "visibility"
    renderings = "none"

    class Config(VisibilityOptions):
        infinite_pixel: PositiveFloat = INFINITE_PIXEL
        """Pixel coordinate u of a point at depth 0 with camera-frame x > 0. With x < 0, u has the
        opposite sign. The same rule gives v from y. No effect if `clamp` is set."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        yield from config.conflicts()
        if config.clamp is not None:
            yield from without_effect(config, ("infinite_pixel",), "`clamp` bounds every point")

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        per_point = view_visibility(
            prediction.gaussians.means,
            target.cameras,
            clamp=self.config.clamp,
            behind=self.config.behind,
            infinite_pixel=self.config.infinite_pixel,
        )
        return mean_of_gaussians(per_point, prediction)


@full_precision
def view_visibility(
    points: Tensor,
    cameras: Cameras,
    *,
    clamp: float | None = 1.0,
    behind: float | None = None,
    z_guard: float | None = None,
    infinite_pixel: float = INFINITE_PIXEL,
) -> Tensor:
    """Return the distance (B, P) of each point to the nearest view's image; 0 inside an image.

    The distance to a view's image is relu(|u| - 1) + relu(|v| - 1), with the point's pixel u, v
    scaled to [-1, 1] over the image. The result is the minimum over views, at most `clamp`
    (TokenGS, LocusGS releases).

    points: P world points per scene, (B, P, 3). cameras: (B, V).
    clamp: largest result; None sets no limit.
    behind: camera-frame z at or below which a point is infinitely far from a view's image. None:
        points behind the camera are projected like those in front.
    z_guard: a camera-frame z between -z_guard and z_guard is replaced by z_guard (LocusGS anchors).
        None keeps z; then x / 0 becomes `infinite_pixel`, and 0 / 0 counts as visible (TokenGS).

    The gradient uses only the nearest view (the first of equally near views), so that memory does
    not grow with the number of views. Values and gradients are finite, unless `behind` is set
    without `clamp`.
    """
    options = (behind, z_guard, infinite_pixel)
    # Find the nearest view first, so that only its graph is kept.
    with torch.no_grad():
        views = [cameras[:, view, None] for view in range(cameras.shape[1])]
        excess = torch.stack([_image_excess(points, view, *options) for view in views], 1)
        nearest = excess.argmin(1)
    # Only the second pass, for the nearest view, has a graph.
    scene = torch.arange(len(nearest), device=nearest.device)[:, None]
    excess = _image_excess(points, cameras[scene, nearest], *options)
    return excess if clamp is None else excess.clamp_max(clamp)


def _image_excess(
    points: Tensor,
    cameras: Cameras,
    behind: float | None,
    z_guard: float | None,
    infinite_pixel: float,
) -> Tensor:
    """Compute the distance (B, P) of P world points (B, P, 3) to a camera's image.

    `view_visibility` defines the distance. cameras: (B, P), one for each point, or (B, 1), one for
    all points of a scene; both give bitwise equal results.
    """
    # By sums, not a matrix product: one point and many must give the same bits.
    from_camera = points - cameras.c2w[..., :3, 3]
    camera_points = (from_camera[..., None] * cameras.c2w[..., :3, :3]).sum(-2)
    xy = camera_points[..., :2]
    z = camera_points[..., 2:]
    # LocusGS replaces small z of either sign by a positive one: a release's choice.
    if z_guard is not None:
        z = torch.where(z.abs() < z_guard, z_guard, z)
    # Divide by 1 there and insert the value later: where() alone would pass NaN gradients.
    at_zero = z.abs() < _TINY_Z
    focal, principal = cameras.intrinsics.split(2, -1)
    pixels = focal * xy / torch.where(at_zero, 1.0, z) + principal
    pixels = torch.where(at_zero, torch.where(xy == 0, 0.0, infinite_pixel * xy.sign()), pixels)
    height, width = cameras.size
    normalised = 2 * pixels / constant([width, height], pixels) - 1
    excess = (normalised.abs() - 1).relu().sum(-1)
    if behind is None:
        return excess
    return torch.where(camera_points[..., 2] <= behind, torch.inf, excess)

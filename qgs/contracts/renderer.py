"""Contract of the slot `renderer`, which checks and prepares what a renderer draws."""

from abc import abstractmethod
from typing import Annotated, ClassVar

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat
from torch import Tensor

from qgs.containers import check_shapes
from qgs.contracts.component import Component, ComponentConfig, Fields, FieldSpec
from qgs.contracts.settings import Far
from qgs.geometry.constants import constant
from qgs.geometry.harmonics import seen_colors
from qgs.precision import full_precision
from qgs.types import Cameras, Gaussians, Rendering

Channel = Annotated[float, Field(ge=0, le=1)]


class RendererConfig(ComponentConfig):
    """Splatting options of every renderer (defaults: TokenGS, LocusGS and gsplat 1.5.3)."""

    near: PositiveFloat = 0.025
    """Nearest camera-frame z, in world units, at which Gaussians are rendered."""
    far: Far = 125.0
    """Farthest camera-frame z, in world units, at which Gaussians are rendered."""
    dilation: NonNegativeFloat = 0.3
    """Variance in pixel^2 added to the diagonal of each Gaussian's projected covariance. 0 adds
    nothing."""
    alpha_min: float = Field(default=1 / 255, gt=0, lt=1)
    """Least alpha of a Gaussian at a pixel. The Gaussian is skipped at pixels where its alpha is
    lower."""
    alpha_cap: float = Field(default=0.999, gt=0, lt=1)
    """Largest alpha of one Gaussian at a pixel. Larger values are lowered to this."""
    transmittance_min: float = Field(default=1e-4, ge=0, lt=1)
    """Transmittance at which blending ends. A pixel skips the Gaussian that would lower its
    transmittance to this value or below, and all Gaussians behind."""
    background: tuple[Channel, Channel, Channel] = (0.5, 0.5, 0.5)
    """Background colour, RGB in [0, 1]."""


class Renderer(Component, torch.nn.Module):
    """EWA splatting: (Gaussians (B, G), Cameras (B, V), background) -> Rendering (B, V).

    B, G and V are scenes, Gaussians and views. Colours come from `colors` and `sh` of the
    Gaussians, along the direction from the camera's centre to the mean. `Gaussians.features` are
    blended with the same weights as colours, over a background of 0. The rendering is
    differentiable in all Gaussian parameters. Images and gradients are finite, even without
    Gaussians and for Gaussians behind the camera, off screen or huge.

    devices: types of torch devices on which the renderer runs, such as "cpu", "cuda", "mps".
    camera_gradients: the tensors of `Cameras` that get gradients on all these devices: "c2w" (for
        rotations and translations), "intrinsics", both or none. If a tensor not named here requires
        a gradient, `forward` raises ValueError.
    """

    slot = "renderer"
    scheduled = frozenset({"near", "far", "dilation"})
    devices: ClassVar[tuple[str, ...]] = ("cpu", "cuda")
    camera_gradients: ClassVar[tuple[str, ...]] = ("c2w", "intrinsics")

    class Config(RendererConfig):
        """Options of this renderer; by default those of every renderer."""

    config: RendererConfig
    writes: ClassVar[Fields] = {
        "rendering.rgb": FieldSpec((3, "H", "W")),
        "rendering.alpha": FieldSpec((1, "H", "W")),
        "rendering.depth": FieldSpec((1, "H", "W"), frame="camera"),
    }

    # Half precision has no digits for pixels.
    @full_precision
    def forward(
        self,
        gaussians: Gaussians,  # (B, G)
        cameras: Cameras,  # (B, V)
        background: Tensor | None = None,  # (3,) RGB
    ) -> Rendering:
        """Render every scene from each of its cameras.

        background: RGB (3,) in [0, 1]; None uses the option `background`.
        Raises ValueError for Gaussians and cameras of different batch sizes or devices, and for
        cameras that require a gradient not listed in `camera_gradients`.
        """
        gaussians, cameras = _prepared(gaussians, cameras)
        backdrop = self._backdrop(background, gaussians.means)
        return self.draw(gaussians, cameras, _channels_of(gaussians, cameras), backdrop)

    @abstractmethod
    def draw(
        self,
        gaussians: Gaussians,  # (B, G)
        cameras: Cameras,  # (B, V)
        channels: Tensor,  # (B, V, G, 3 + F)
        backdrop: Tensor,  # (3,) RGB
    ) -> Rendering:
        """Render every scene from each of its cameras, in float64 if the means are float64.

        Batch sizes and devices match, numbers are float32 or float64, and autocast is off.
        channels: what is blended: colours of the Gaussians from each camera, then their features;
            (B, 1, G, 3 + F) if colours do not depend on the camera.
        backdrop: background of the colours, on the device of the Gaussians.
        """

    def _backdrop(self, background: Tensor | None, like: Tensor) -> Tensor:
        """Return `background` as RGB (3,) in dtype and device of `like`.

        None stands for the option `background`.
        """
        if background is None:
            # A tensor of Python numbers would make the GPU wait for a copy.
            return constant(self.config.background, like)
        if background.shape != (3,):
            raise ValueError(
                f"background must be one RGB colour of shape (3,), got {tuple(background.shape)}"
            )
        return background.to(like)


def _prepared(gaussians: Gaussians, cameras: Cameras) -> tuple[Gaussians, Cameras]:
    """Return Gaussians and cameras in float64 if the means are float64, else in float32.

    Raises ValueError unless Gaussians (B, G) and cameras (B, V) match in shape and device.
    """
    means = gaussians.means
    check_shapes(gaussians, means="B G 3")
    check_shapes(cameras, c2w="B V 4 4")
    if len(means) != cameras.shape[0]:
        raise ValueError(
            f"Gaussians of {len(means)} scenes cannot be rendered from cameras of "
            f"{cameras.shape[0]} scenes; both need the same batch size"
        )
    # Torch would raise its error deep inside a kernel.
    if means.device != cameras.c2w.device:
        raise ValueError(
            f"Gaussians are on {means.device}, cameras on {cameras.c2w.device}; "
            "move one with .to(device)"
        )
    # Half precision would move the projection of a Gaussian by pixels.
    dtype = torch.promote_types(means.dtype, torch.float32)
    return gaussians.to(dtype), cameras.to(dtype)


def _channels_of(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Return the channels to blend: the colours of Gaussians from each camera, then their features.

    The shape is (B, V, G, 3 + F): scenes, views, Gaussians, RGB and F features; or (B, 1, G, 3 + F)
    if colours do not depend on the camera.
    """
    colors = seen_colors(gaussians, cameras)
    if gaussians.features is None:
        return colors
    features = gaussians.features[:, None].expand(*colors.shape[:-1], -1)
    return torch.cat([colors, features], -1)

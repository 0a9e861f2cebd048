"""Slot `renderer`: Gaussians to images, and how a renderer checks and prepares what it is given."""

from abc import abstractmethod
from typing import Annotated, ClassVar, TypeAlias

import torch
from pydantic import Field, ValidationInfo, field_validator
from torch import Tensor

from qgs.contracts.component import Component, ComponentConfig, Fields, FieldSpec, OptionError
from qgs.geometry.constants import constant
from qgs.geometry.harmonics import seen_colors
from qgs.types import Cameras, Gaussians, Rendering

Channel: TypeAlias = Annotated[float, Field(ge=0, le=1)]


class RendererConfig(ComponentConfig):
    """Splatting settings that every renderer obeys (defaults: both releases, gsplat 1.5.3)."""

    near: float = Field(default=0.025, gt=0)
    """Gaussians nearer than this camera-frame z are dropped, world units."""
    far: float = Field(default=125.0, gt=0, validate_default=True)
    """Gaussians beyond this camera-frame z are dropped, world units."""
    dilation: float = Field(default=0.3, ge=0)
    """Added to the diagonal of the projected covariance, pixel^2."""
    alpha_min: float = Field(default=1 / 255, gt=0, lt=1)
    """Contributions to a pixel below this are skipped."""
    alpha_cap: float = Field(default=0.999, gt=0, lt=1)
    """Upper bound of one Gaussian's contribution to a pixel."""
    transmittance_min: float = Field(default=1e-4, ge=0, lt=1)
    """A pixel takes no more Gaussians once its transmittance would fall to this."""
    background: tuple[Channel, Channel, Channel] = (0.5, 0.5, 0.5)
    """RGB in [0, 1] behind everything."""

    @field_validator("far")
    @classmethod
    def _far_is_behind_near(cls, far: float, info: ValidationInfo) -> float:
        near = info.data.get("near")
        # A `near` that is refused itself is not among the data.
        if near is not None and far <= near:
            raise OptionError(
                f"far must be more than near, got near {near:g} and far {far:g}",
                f"set far above {near:g}, or near below {far:g}",
            )
        return far


class Renderer(Component, torch.nn.Module):
    """EWA splatting: (Gaussians (B, G), Cameras (B, V), background) -> Rendering (B, V).

    Colours are those that `Gaussians.sh` gives along the direction from the camera's centre to the
    mean. `Gaussians.features` are blended with the weights of the colours, over 0.
    Differentiable in all Gaussian parameters. Images and gradients are finite, also for no
    Gaussians and for Gaussians behind the camera, off screen or huge.

    devices: types of torch devices that it renders on, such as "cpu", "cuda", "mps".
    camera_gradients: those of "c2w" and "intrinsics" that have a gradient on all these devices (of
        c2w, along rotations and translations). A ValueError refuses others that require one.
    """

    slot: ClassVar[str] = "renderer"
    scheduled: ClassVar[frozenset[str]] = frozenset({"near", "far", "dilation"})
    devices: ClassVar[tuple[str, ...]] = ("cpu", "cuda")
    camera_gradients: ClassVar[tuple[str, ...]] = ("c2w", "intrinsics")

    class Config(RendererConfig):
        """The settings of every renderer; add your own below."""

    config: RendererConfig
    writes: ClassVar[Fields] = {
        "rendering.rgb": FieldSpec((3, "H", "W")),
        "rendering.alpha": FieldSpec((1, "H", "W")),
        "rendering.depth": FieldSpec((1, "H", "W"), frame="camera"),
    }

    @abstractmethod
    def forward(
        self,
        gaussians: Gaussians,  # (B, G)
        cameras: Cameras,  # (B, V)
        background: Tensor | None = None,  # (3,) RGB
    ) -> Rendering:
        """Render every scene from each of its cameras.

        background: None for the configured one.
        Raises ValueError for Gaussians and cameras of different batch sizes or devices, and for
        cameras that require a gradient which there is not.
        """


def check_inputs(gaussians: Gaussians, cameras: Cameras) -> None:
    """Raise ValueError unless Gaussians (B, G) and cameras (B, V) belong together."""
    means = gaussians.means
    if means.ndim != 3 or len(cameras.shape) != 2:
        raise ValueError(
            f"a renderer takes Gaussians of B scenes, means (B, G, 3), and cameras of shape "
            f"(B, V), got {tuple(means.shape)} and {tuple(cameras.shape)}; add leading dimensions "
            "for a single scene or view"
        )
    if len(means) != cameras.shape[0]:
        raise ValueError(
            f"Gaussians of {len(means)} scenes cannot be rendered from cameras of "
            f"{cameras.shape[0]} scenes; both need the same batch size"
        )
    # Torch would say so somewhere inside of a kernel.
    if means.device != cameras.c2w.device:
        raise ValueError(
            f"Gaussians are on {means.device}, cameras on {cameras.c2w.device}; "
            "move one with .to(device)"
        )


def raise_precision(gaussians: Gaussians, cameras: Cameras) -> tuple[Gaussians, Cameras]:
    """Both as float64 if the means are, as float32 otherwise."""
    # Half precision would move the projection of a Gaussian by pixels.
    dtype = torch.promote_types(gaussians.means.dtype, torch.float32)
    return gaussians.to(dtype), cameras.to(dtype)


def channels_of(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """What is blended: colours as cameras see them, then features.

    (B, V, G, 3 + F); (B, 1, G, 3 + F) where all cameras see the same.
    """
    colors = seen_colors(gaussians, cameras)
    if gaussians.features is None:
        return colors
    features = gaussians.features[:, None].expand(*colors.shape[:-1], -1)
    return torch.cat([colors, features], -1)


def background_of(
    background: Tensor | None, configured: tuple[float, float, float], like: Tensor
) -> Tensor:
    """The background RGB (3,) in the dtype and on the device of `like`."""
    if background is None:
        # A tensor of Python numbers would make the GPU wait for a copy.
        return constant(configured, like)
    if background.shape != (3,):
        raise ValueError(f"background must be one RGB of shape (3,), got {tuple(background.shape)}")
    return background.to(like)

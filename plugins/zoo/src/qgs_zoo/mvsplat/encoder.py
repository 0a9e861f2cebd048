"""What both encoders share: the range of depths, sizes of images, a token for each pixel."""

from abc import abstractmethod
from collections.abc import Iterable

from einops import rearrange
from pydantic import Field, ValidationInfo, field_validator
from torch import Tensor

from qgs.contracts import (
    ComponentConfig,
    Encoder,
    OptionError,
    Problem,
    RecipeContext,
    memory_fields,
)
from qgs.types import ImageMemory, Views
from qgs_zoo.mvsplat.pixels import width_problems


class DepthRange(ComponentConfig):
    """Where a plane sweep looks."""

    near: float = Field(gt=0)
    """Least depth, world units; as published, with poses as they are: 1 for MVSplat, 0.5 for
    DepthSplat."""
    far: float = Field(gt=0)
    """Largest depth, world units; as published 100, for DepthSplat on DL3DV 200."""

    @field_validator("far")
    @classmethod
    def _far_is_beyond_near(cls, far: float, info: ValidationInfo) -> float:
        near = info.data.get("near", 0)
        if far <= near:
            raise OptionError(
                f"far must be beyond near, got near {near:g} and far {far:g}",
                "give the depths at which the scene begins and ends",
            )
        return far


class SweepEncoder(Encoder):
    """Encoder whose memory has a token for each pixel, or square of them, at depths in a range."""

    # Views are matched in their order; with three or more, the mask of shifted windows falls on
    # keys in their order (released code).
    ordered_views = True
    writes = memory_fields("features", "grid")
    Config: type[DepthRange]
    config: DepthRange

    @classmethod
    @abstractmethod
    def multiple(cls, config: DepthRange) -> int:
        """What sides of images are multiples of, in pixels: for windows and levels of U-Nets."""

    @abstractmethod
    def predict(self, views: Views, near_BV: Tensor, far_BV: Tensor) -> Tensor:
        """Numbers of every pixel (B, V, C, H, W), for depths between `near` and `far`."""

    @classmethod
    def problems(cls, config: DepthRange, context: RecipeContext) -> Iterable[Problem]:
        yield from width_problems(context)
        size = context.image_size
        multiple = cls.multiple(config)
        if size and any(side % multiple for side in size):
            nearest = [max(round(side / multiple), 1) * multiple for side in size]
            reason = (
                f"images of {size[0]} x {size[1]} (H x W) are no multiples of {multiple} pixels"
            )
            yield Problem("", reason, f"set data.image_size to {nearest}")

    def forward(self, views: Views) -> ImageMemory:
        """Raises ValueError for images that the U-Nets and windows do not divide."""
        (height, width), multiple = views.cameras.size, self.multiple(self.config)
        if height % multiple or width % multiple:
            raise ValueError(
                f"images of {height} x {width} (H x W) are no multiples of {multiple} pixels; "
                "resize or crop the views"
            )
        # One range for all views: data do not say one.
        ends = (self.config.near, self.config.far)
        near_BV, far_BV = (views.cameras.c2w.new_full(views.cameras.shape, end) for end in ends)
        numbers_BVCHW = self.predict(views, near_BV, far_BV)
        _, count, _, rows, columns = numbers_BVCHW.shape
        features = rearrange(numbers_BVCHW, "b v c h w -> b (v h w) c")
        return ImageMemory(features, grid=(count, rows, columns))

"""Contract of the slot `encoder`, which turns posed photos into an image memory."""

from abc import abstractmethod
from collections.abc import Iterable
from typing import ClassVar

import torch
from pydantic import PositiveInt
from torch import Tensor

from qgs.contracts.component import (
    ComponentConfig,
    Fields,
    FieldSpec,
    ModelComponent,
    Problem,
    RecipeContext,
)
from qgs.types import ImageMemory, Views

MEMORY_FIELDS: Fields = {
    "memory.keys": FieldSpec(("D/h",)),
    "memory.values": FieldSpec(("D/h",)),
    "memory.features": FieldSpec(("D",)),
    "memory.patch_rays": FieldSpec((6,), frame="world"),
    "memory.grid": FieldSpec((3,), torch.int64),  # no tensor: three numbers for all tokens
}


def memory_fields(*names: str) -> Fields:
    """Return the named fields of ImageMemory by full name, such as "memory.keys" for "keys"."""
    return {f"memory.{name}": MEMORY_FIELDS[f"memory.{name}"] for name in names}


class Encoder(ModelComponent):
    """Encoder: Views with images (B, V, 3, H, W) in [0, 1] -> ImageMemory of M tokens per scene.

    The cameras are in the world frame. The encoder runs once per forward pass. A token may depend
    on all views. If the memory has a grid, a token depends most on the patch at its view, row and
    column. Raises ValueError for images that it cannot divide into patches.

    ordered_views: True if the order of the views matters. If False, permuting the views permutes
        the tokens.
    reads_cameras: True if the encoder reads `views.cameras`. If False, it accepts `Photos` too.
    tunable: True if the encoder implements `project`, which test-time tuning needs.
    """

    slot = "encoder"
    ordered_views: ClassVar[bool] = False
    reads_cameras: ClassVar[bool] = True
    tunable: ClassVar[bool] = False
    writes = MEMORY_FIELDS
    """Fields of the ImageMemory that the encoder fills (default: all). The width of
    `memory.features` may differ from the model's width D."""

    @classmethod
    def size_multiple(cls, config: ComponentConfig) -> int | None:
        """Return a number that must divide both sides of an image, or None.

        None means that the model works only at the image size of the training; users' photos are
        then cropped to this size. With a number, users' photos keep their aspect ratio.
        """
        return None

    @abstractmethod
    def forward(self, views: Views) -> ImageMemory:
        """Encode all views of each scene together."""

    def project(self, features: Tensor, memory: ImageMemory) -> ImageMemory:
        """Return `memory` recomputed from new `features` of equal shape, for test-time tuning.

        `project(memory.features, memory)` must give an equal memory. Raises NotImplementedError
        unless the encoder is `tunable`.
        """
        # Recipes that need it are refused, see `tunable`.
        raise NotImplementedError(
            f"{type(self).__name__} cannot recompute an image memory: set evaluation.tuning=queries"
        )


class PatchEncoder(Encoder):
    """An encoder that cuts every photo into square patches and makes one token of each patch."""

    class Config(ComponentConfig):
        patch_size: PositiveInt = 8
        """Side of a patch in pixels. It must divide both sides of the image."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Report a bad `patch_size`: one that does not divide the data's images."""
        size = context.image_size
        patch = config.patch_size
        if size and any(side % patch for side in size):
            # The multiple that crops or enlarges least.
            nearest = [max(round(side / patch), 1) * patch for side in size]
            yield Problem(
                "patch_size",
                f"patches of {patch} pixels do not divide images of {size[0]} x {size[1]} (H x W)",
                f"choose images of {nearest}, or a patch_size that divides both sides",
            )

    @classmethod
    def size_multiple(cls, config: Config) -> int:
        """Return the side of a patch in pixels, which must divide both sides of an image."""
        return config.patch_size

    def grid(self, views: Views) -> tuple[int, int, int]:
        """Return (V, H/P, W/P): the views, and the rows and columns of patches of P pixels in each.

        Raises ValueError if patches do not divide the images.
        """
        patch = self.config.patch_size
        count, _, height, width = views.images.shape[1:]
        if height % patch or width % patch:
            raise ValueError(
                f"images of {height} x {width} cannot be cut into patches of {patch} pixels; "
                "resize the views, or build the model with another patch_size"
            )
        return count, height // patch, width // patch

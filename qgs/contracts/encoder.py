"""Slot `encoder`: posed photos to image memory."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from qgs.contracts.component import ComponentConfig, Fields, FieldSpec, ModelComponent
from qgs.types import ImageMemory, Views

MEMORY_FIELDS: Fields = {
    "memory.keys": FieldSpec(("D/h",)),
    "memory.values": FieldSpec(("D/h",)),
    "memory.features": FieldSpec(("D",)),
    "memory.patch_rays": FieldSpec((6,), frame="world"),
    "memory.grid": FieldSpec((3,), torch.int64),  # no tensor: three numbers for all tokens
}


class Encoder(ModelComponent):
    """Views (B, V, 3, H, W) in [0, 1] with world-frame cameras -> ImageMemory of M tokens.

    Runs once per forward pass. A token may see all views; where the memory has a grid, it depends
    most on its own patch, that of its view, row and column. Raises ValueError for images that it
    cannot divide into patches.

    ordered_views: whether the order of the views matters. Otherwise, permuting the views permutes
    the tokens.
    reads_cameras: whether it reads `views.cameras`. One that does not may be given `Photos`.
    tunable: whether `project` makes a memory of other features, which tuning at test time needs.
    """

    slot: ClassVar[str] = "encoder"
    ordered_views: ClassVar[bool] = False
    reads_cameras: ClassVar[bool] = True
    tunable: ClassVar[bool] = False

    @classmethod
    def provides(cls, config: ComponentConfig) -> Fields:
        """The parts of the ImageMemory that it fills: all, unless it says otherwise.

        One that leaves some out, or whose features have a width of its own, overrides this.
        """
        return MEMORY_FIELDS

    def adapted(self, learned: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """A state dict for this encoder, made of one `learned` with patches of another size.

        Weights that it cannot bring to its own shapes stay as they are, and are then refused.
        """
        return dict(learned)

    @abstractmethod
    def forward(self, views: Views) -> ImageMemory:
        """Encode all views of each scene together."""

    def project(self, features: Tensor, memory: ImageMemory) -> ImageMemory:
        """`memory` made anew from other `features` of its shape: what tuning at test time reads.

        `project(memory.features, memory)` is that memory again. Raises NotImplementedError unless
        the encoder is `tunable`.
        """
        raise NotImplementedError(f"{type(self).__name__} makes no memory of other features")

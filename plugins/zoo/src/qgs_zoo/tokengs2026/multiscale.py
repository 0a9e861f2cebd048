"""`tokengs2026/multiscale_vit`: keys and values from several blocks of a ViT (TokenGS 2026.6)."""

from collections.abc import Iterable

import torch
from pydantic import Field, field_validator
from torch import Tensor, nn

from qgs.contracts import (
    MEMORY_FIELDS,
    ComponentConfig,
    Fields,
    FieldSpec,
    ModelDims,
    OptionError,
    Problem,
    RecipeContext,
)
from qgs.geometry.rays import patch_rays, plucker_rays
from qgs.tokengs.encoder import PatchViT, keys_and_values
from qgs.types import ImageMemory, Views
from qgs_zoo.tokengs2026.times import TimeEmbedding, without_times


class MultiscaleReadout(PatchViT):
    """Features of an image token: the outputs of S chosen blocks, each with a norm of its own.

    Unlike the default encoder it can embed the times of photos.
    """

    class Config(PatchViT.Config):
        blocks: tuple[int, ...] = Field(default=(1, 2, 3), min_length=1)
        """Numbers of the blocks that are read, ascending; 1 is the first, and `depth` the last."""
        time_channels: int = Field(default=0, ge=0, multiple_of=2)
        """Channels that the time of a photo is embedded with; 0 for photos without times."""

        @field_validator("blocks")
        @classmethod
        def _ascending(cls, blocks: tuple[int, ...]) -> tuple[int, ...]:
            if list(blocks) != sorted(set(blocks)) or blocks[0] < 1:
                raise OptionError(
                    f"blocks must ascend from 1 without repeats, got {list(blocks)}",
                    f"write {sorted({max(number, 1) for number in blocks})}",
                )
            return blocks

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.read = frozenset(config.blocks)
        self.norms = nn.ModuleList(nn.LayerNorm(dims.width, config.norm_eps) for _ in config.blocks)
        self.feature_width = len(config.blocks) * dims.width
        if config.time_channels:
            channels = config.time_channels
            patch = config.patch_size
            self.time_embedding = TimeEmbedding(channels, dims.width, patch)

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        yield from super().problems(config, context)
        yield from without_times(config.time_channels, context)
        last = config.blocks[-1]
        # Blocks behind the last one that is read would learn nothing.
        if last != config.depth:
            what = "does not exist" if last > config.depth else "leaves the blocks after it unread"
            yield Problem(
                "blocks",
                f"the last block that is read, {last} of a depth of {config.depth}, {what}",
                f"set depth to {last}, or let blocks end with {config.depth}",
            )

    def embed(self, views: Views, plucker: Tensor) -> Tensor:
        """Embeddings of colours, rays and times, added: (B, M, D).

        Raises ValueError for views without times if these are embedded.
        """
        x_BMD = super().embed(views, plucker)
        if not self.config.time_channels:
            return x_BMD
        if views.times is None:
            raise ValueError(
                "this encoder reads the times of photos and these have none: give each frame "
                "of their transforms file a 'time' and pack chunks again, give the views times "
                "(B, V), or set model.encoder.time_channels to 0"
            )
        times_BVD = self.time_embedding(views.times)
        return x_BMD + times_BVD.repeat_interleave(x_BMD.shape[1] // times_BVD.shape[1], 1)

    def features(self, views: Views, plucker: Tensor) -> Tensor:
        """Views and Plücker maps as in `embed` -> (B, M, S D), the first chosen block first."""
        x_BMD = self.embed(views, plucker)
        outputs = []
        for number, block in enumerate(self.blocks, start=1):
            x_BMD = block(x_BMD)
            if number in self.read:
                # Each depth has a norm of its own: their sizes differ.
                outputs.append(self.norms[len(outputs)](x_BMD))
        return torch.cat(outputs, -1)


class MultiscaleViT(MultiscaleReadout):
    """Keys and values of every image token from several blocks of a ViT."""

    name = "multiscale_vit"

    def __init__(self, config: MultiscaleReadout.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.kv_proj = nn.Linear(self.feature_width, 2 * dims.width)
        self.k_norm = nn.LayerNorm(dims.width // dims.heads, config.norm_eps)

    @classmethod
    def fields_written(cls, config: ComponentConfig) -> Fields:
        assert isinstance(config, MultiscaleReadout.Config)
        scales = len(config.blocks)
        wide = FieldSpec(("D" if scales == 1 else f"{scales}*D",))
        return {**MEMORY_FIELDS, "memory.features": wide}

    def forward(self, views: Views) -> ImageMemory:
        """Features (B, M, S D); raises ValueError when the patch does not divide the images."""
        grid = self.grid(views)
        plucker_BV6HW = plucker_rays(views.cameras)
        x_BMC = self.features(views, plucker_BV6HW)
        keys, values = keys_and_values(x_BMC, self.kv_proj, self.k_norm)
        rays = patch_rays(plucker_BV6HW, self.config.patch_size)
        return ImageMemory(features=x_BMC, keys=keys, values=values, patch_rays=rays, grid=grid)

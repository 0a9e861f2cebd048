"""`landmark/rendered`: feedback of rendering errors to the image tokens, in rounds.

In a round, the model renders the input photos and runs its last decoder layers again.
"""

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from pydantic import PositiveInt
from torch import Tensor, nn

from qgs.contracts import Decode, ModelDims, Problem, RecipeContext, Render, memory_fields
from qgs.tokengs.blocks import split_heads
from qgs.types import Cameras, ImageMemory, QueryState, Views
from qgs_anchors.landmark.rounds import RoundsFeedback

CHANNELS = 7
"""Channels of an error map: photo minus rendering (RGB), rendering (RGB), alpha."""
ERROR_GAIN = 4.0
"""Factor for photo minus rendering, which is a few tenths. The other channels reach 1."""


class RenderedFeedback(RoundsFeedback):
    """Feedback that adds rendering errors to keys and values, and a learned vector to queries.

    In each token's patch, the errors of the rendered photo are averaged into `cells` x `cells`
    numbers per channel. A 3 x 3 convolution over tokens, GELU and a linear layer turn these numbers
    into keys and values, which are added to the keys and values of the encoder. The tokens keep
    their rays, so a query that prefers rays near its anchor reads the errors where its Gaussians
    are rendered.
    """

    name = "rendered"
    reads = memory_fields("keys", "values", "grid")

    learned = "kv_proj."

    class Config(RoundsFeedback.Config):
        shrink: PositiveInt = 2
        """Render the input photos at 1/`shrink` of their size."""
        cells: PositiveInt = 2
        """Number of cells along each side of a token's patch. Each cell stores mean errors."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.embedding = nn.Conv2d(CHANNELS * config.cells**2, dims.width, 3, padding=1)
        self.kv_proj = nn.Linear(dims.width, 2 * dims.width)

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Report the problems of rounds, and image sizes that `shrink` does not divide."""
        yield from super().problems(config, context)
        size = context.image_size
        if size and any(side % config.shrink for side in size):
            reason = f"images of {size[0]} x {size[1]} (H x W) cannot shrink by {config.shrink}"
            yield Problem("shrink", reason, "choose a number that divides both sides")

    def initial(self) -> dict[str, Tensor]:
        """Return weights with which renderings have no effect."""
        own = self.state_dict()
        return own | {k: torch.zeros_like(own[k]) for k in own if k.startswith(self.learned)}

    def shrunk(self, views: Views) -> Views:
        """Return the photos to compare with renderings: averaged to 1/`shrink` of their size."""
        by = self.config.shrink
        cameras = views.cameras
        size = (cameras.size[0] // by, cameras.size[1] // by)
        # Fewer pixels are cheaper to render, and errors are smooth.
        images = F.avg_pool3d(views.images, (1, by, by))
        return Views(images, Cameras(cameras.c2w, cameras.intrinsics / by, size))

    def forward(
        self,
        state: QueryState,
        memory: ImageMemory,
        views: Views,
        decode: Decode,
        render: Render,
    ) -> tuple[QueryState, ImageMemory]:
        photos = self.shrunk(views)
        with torch.no_grad():
            rendering = render(decode(state), photos.cameras)
        assert memory.grid is not None
        _, rows, columns = memory.grid
        # The rendering is an input too: an error means something else where nothing was drawn.
        error = ERROR_GAIN * (photos.images - rendering.rgb)
        maps_BVCHW = torch.cat([error, rendering.rgb, rendering.alpha], 2)
        cells = self.config.cells
        keys = memory["keys"]
        fine = F.adaptive_avg_pool2d(maps_BVCHW.flatten(0, 1), (rows * cells, columns * cells))
        # The cells of a token become its channels.
        x_XDhw = F.gelu(self.embedding(F.pixel_unshuffle(fine, cells)))
        x_BMD = x_XDhw.flatten(2).mT.unflatten(0, photos.images.shape[:2]).flatten(1, 2)
        k_BhMd, v_BhMd = (split_heads(x, keys.shape[1]) for x in self.kv_proj(x_BMD).chunk(2, -1))
        memory = memory.replace(keys=keys + k_BhMd, values=memory["values"] + v_BhMd)
        return state.replace(features=state.features + self.marker), memory

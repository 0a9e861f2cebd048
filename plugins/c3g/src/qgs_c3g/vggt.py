"""`c3g/vggt_features`: image tokens of VGGT, whose code and weights the user brings.

Neither is free, so this distribution holds and downloads none of them. What is relied on:
`vggt.models.aggregator.Aggregator()` takes images (B, V, 3, H, W) and returns a list of tokens
(B, V, P, 2048), one for each of its layers, and the index of the first that belongs to a patch.
"""

from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from einops import rearrange
from pydantic import Field
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from qgs.contracts import (
    MEMORY_FIELDS,
    ComponentConfig,
    Encoder,
    Fields,
    MissingExtraError,
    ModelDims,
    Problem,
    RecipeContext,
)
from qgs.types import ImageMemory, Views

PATCH, WIDTH = 14, 2048
"""Side of a patch in pixels, width of a token of the last layer (VGGT-1B)."""

MODULE = "vggt.models.aggregator"
"""No distribution of PyPI offers it, so no extra of ours can name one."""

PREFIX = "aggregator."
"""Of the weights that are read, in the file of all of VGGT."""

SUFFIXES = {
    ".safetensors": load_file,
    ".pt": lambda path: torch.load(path, map_location="cpu", weights_only=True, mmap=True),
}


class VggtFeatures(Encoder):
    """Tokens of VGGT's last layer, without those of cameras and registers (C3G).

    It reads images alone, no cameras. Where the model's width is not 2048, a linear layer leads to
    it. A checkpoint has all weights, so that only a model that starts needs the file.
    """

    name: ClassVar[str] = "vggt_features"
    ordered_views = True  # VGGT marks the first one
    reads_cameras = False

    class Config(ComponentConfig):
        weights: str = Field(min_length=1)
        """File of VGGT's weights: its model.safetensors, or model.pt."""
        images: Literal["signed", "unit"] = "signed"
        """What VGGT is given: images in [-1, 1] as in the C3G release, or in [0, 1] ("unit"), as
        VGGT was trained."""

    config: Config
    has_weights: Tensor  # of VGGT, from the file or a checkpoint

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        with _MadeOnTheCpu():
            self.aggregator = _aggregator_class()()
        own = dims.width == WIDTH
        self.proj = nn.Identity() if own else nn.Linear(WIDTH, dims.width)
        on_meta = next(self.aggregator.parameters()).is_meta
        self.unready = "" if on_meta else self._load(Path(config.weights).expanduser())
        self.register_buffer("has_weights", torch.tensor(not self.unready))

    @classmethod
    def provides(cls, config: ComponentConfig) -> Fields:
        """Features and their grid: neither keys and values, nor rays."""
        return {name: MEMORY_FIELDS[name] for name in ("memory.features", "memory.grid")}

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        """Images that do not consist of patches."""
        size = context.image_size
        if size and any(side % PATCH for side in size):
            nearest = [max(round(side / PATCH), 1) * PATCH for side in size]
            reason = f"VGGT's patches of {PATCH} do not divide images of {size[0]} x {size[1]}"
            yield Problem("", f"{reason} (H x W)", f"set data.image_size to {nearest}")

    def forward(self, views: Views) -> ImageMemory:
        """Features (B, M, D) of all patches, and their grid.

        Raises MissingExtraError without weights, ValueError for images of other sizes.
        """
        if self.unready and not self.has_weights:
            raise MissingExtraError(f"the encoder c3g/vggt_features cannot be used: {self.unready}")
        count, _, height, width = views.images.shape[1:]
        if height % PATCH or width % PATCH:
            raise ValueError(
                f"images of {height} x {width} cannot be cut into VGGT's patches of {PATCH}; "
                "resize the views to multiples of it"
            )
        images = views.images * 2 - 1 if self.config.images == "signed" else views.images
        outputs, first = self.aggregator(images)
        tokens_BMC = rearrange(outputs[-1][:, :, first:], "b v p c -> b (v p) c")
        grid = (count, height // PATCH, width // PATCH)
        return ImageMemory(self.proj(tokens_BMC), grid=grid)

    def _load(self, file: Path) -> str:
        """Read the weights; why they cannot be read, "" if they were."""
        if file.suffix not in SUFFIXES:
            known = " or ".join(SUFFIXES)
            return f"{file.name} is no file of weights that is read; name one of {known}"
        if not file.is_file():
            return (
                f"there are no weights at {file}: download VGGT-1B's model.safetensors, whose "
                "licence is not ours to give, and name it in the option `weights`"
            )
        try:
            self.aggregator.load_state_dict(_of_aggregator(SUFFIXES[file.suffix](file)))
        except Exception as error:  # whatever torch and safetensors raise about a damaged file
            return f"{file.name} does not hold VGGT's weights ({type(error).__name__}: {error})"
        return ""


def _of_aggregator(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {n.removeprefix(PREFIX): x for n, x in weights.items() if n.startswith(PREFIX)}


def _aggregator_class() -> Any:
    try:
        return import_module(MODULE).Aggregator
    except ImportError as error:
        raise MissingExtraError(
            "the encoder c3g/vggt_features needs VGGT's code, which comes with a licence of its "
            "own: pip install git+https://github.com/facebookresearch/vggt; without it, use "
            "another encoder, such as qgs/multiview_vit"
        ) from error


class _MadeOnTheCpu(TorchFunctionMode):
    """Ranges are made on the CPU: VGGT's constructor reads their numbers, which meta has not."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.linspace:
            kwargs.setdefault("device", "cpu")
        return func(*args, **kwargs)

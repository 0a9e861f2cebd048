"""Inputs for a component of each slot: small, deterministic, in front of the cameras."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.contracts import FieldSpec, Loss, ModelDims, Renderer
from qgs.geometry.rays import patch_rays, plucker_rays
from qgs.types import (
    SH_COUNTS,
    Cameras,
    Gaussians,
    ImageMemory,
    LayerPrediction,
    QueryState,
    Rendering,
    Views,
)
from qgs_dev.case import Case
from qgs_dev.trees import mapped, tracked

Inputs: TypeAlias = dict[str, Any]
"""Arguments of a component's forward pass, by name, in their order."""

PATCH = 8
"""Pixels along a patch of the image memory that decoder components are given."""

ARGUMENTS: Mapping[str, tuple[str, ...]] = {
    "encoder": ("views",),
    "queries": ("memory", "views"),
    "layer": ("state", "memory"),
    "cross_attention": ("state", "memory"),
    "self_attention": ("state",),
    "feed_forward": ("features",),
    "refinement": ("state",),
    "feedback": ("state", "memory", "rendering", "photos"),
    "head": ("state",),
    "centers": ("offsets", "state"),
    "renderer": ("gaussians", "cameras"),
    "losses": ("prediction", "rendering", "target", "inputs"),
}
"""Arguments of the forward pass of each slot's components, in their order: methods of `Maker`."""

QUERY_INPUTS = ("state", "features", "offsets")
"""Arguments whose second dimension counts queries."""


@dataclass(frozen=True)
class Sizes:
    """B, N, V, K, and (H, W), None for that of the case."""

    batch: int = 2
    queries: int = 6
    views: int = 2
    gaussians: int = 2
    image: tuple[int, int] | None = None


def many(case: Case) -> Sizes:
    """More queries, Gaussians and tokens than what works on windows or chunks of 128 covers."""
    image = (64, 96) if case.slot == "cross_attention" else None
    return Sizes(queries=200, views=3, gaussians=1, image=image)


def inputs_of(case: Case, sizes: Sizes = Sizes(), seed: int = 0) -> Inputs:
    """What a component of the slot of `case` is called with, drawn from `seed`."""
    maker = Maker(case, sizes, torch.Generator().manual_seed(seed))
    return {name: getattr(maker, name)() for name in ARGUMENTS[case.slot]}


def tracked_inputs(case: Case, inputs: Inputs) -> Inputs:
    """A copy that requires gradients; of cameras only in the tensors that a renderer declares."""
    copy, component = tracked(inputs), case.component
    if not issubclass(component, Renderer):
        return copy
    kept = {f"cameras.{name}" for name in component.camera_gradients}
    fixed = {"cameras.c2w", "cameras.intrinsics"} - kept
    return mapped(copy, lambda name, x: x.detach() if name in fixed else x)


def required_fields(case: Case) -> dict[str, FieldSpec]:
    """The fields of the state of the queries that the case requires."""
    required = case.component.fields_read(case.config)
    elsewhere = ("memory.", "rendering.", "gaussians.")
    return {n: spec for n, spec in required.items() if not n.startswith(elsewhere)}


def memory_width(case: Case) -> int:
    """Width of the memory's features: what the case requires, else that of its model."""
    spec = case.component.fields_read(case.config).get("memory.features")
    width = spec.shape[0] if spec else "D"
    return width if isinstance(width, int) else case.dims.width


class Maker:
    """Draws inputs of the given sizes from one generator."""

    def __init__(self, case: Case, sizes: Sizes, generator: torch.Generator) -> None:
        self.case = case
        self.sizes = sizes
        self.generator = generator
        self.image = sizes.image or case.size

    def normal(self, *shape: int) -> Tensor:
        """Numbers from N(0, 1)."""
        return torch.randn(shape, generator=self.generator).to(self.case.device)

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """Between `low` and `high`."""
        numbers = torch.rand(shape, generator=self.generator) * (high - low) + low
        return numbers.to(self.case.device)

    def field(self, name: str, spec: FieldSpec) -> Tensor:
        """A state field; points of the world frame stand in front of the cameras."""
        shape = sizes_of(spec, self.case.dims)
        values = self.normal(self.sizes.batch, self.sizes.queries, *shape)
        if is_place(spec):
            values = 0.4 * values + torch.tensor([0.0, 0.0, 1.5]).to(values)
        if name in self.case.fields:
            values = self.case.fields[name](values)
        elif not spec.dtype.is_floating_point:
            values = values > 0
        return values.to(spec.dtype)

    def state(self) -> QueryState:
        """Features, and the fields that the case requires."""
        required = required_fields(self.case)
        fields = {name: self.field(name, spec) for name, spec in required.items()}
        return QueryState(self.features(), fields)

    def features(self) -> Tensor:
        """(B, N, D)."""
        return self.normal(self.sizes.batch, self.sizes.queries, self.case.dims.width)

    def offsets(self) -> Tensor:
        """(B, N, K, 3)."""
        sizes = self.sizes
        return self.normal(sizes.batch, sizes.queries, sizes.gaussians, 3)

    def cameras(self, image: tuple[int, int] | None = None) -> Cameras:
        """Cameras side by side that look along z, a little inwards."""
        height, width = image or self.image
        scene, view = torch.arange(self.sizes.batch)[:, None], torch.arange(self.sizes.views)
        angle = -0.06 * view - 0.02 * scene
        c2w = torch.eye(4).repeat(*angle.shape, 1, 1)
        c2w[..., 0, 0] = c2w[..., 2, 2] = angle.cos()
        c2w[..., 0, 2], c2w[..., 2, 0] = angle.sin(), -angle.sin()
        c2w[..., 0, 3], c2w[..., 1, 3] = 0.2 * view, 0.05 * scene
        focal = 0.9 * max(height, width)
        lens = torch.tensor([focal, focal, width / 2, height / 2]).expand(*c2w.shape[:2], 4)
        return Cameras(c2w, lens.clone(), (height, width)).to(self.case.device)

    def views(self) -> Views:
        """Noise pictures; they have times where the component embeds these."""
        cameras, times = self.cameras(), None
        images = self.uniform(0, 1, *cameras.shape, 3, *cameras.size)
        if getattr(self.case.config, "time_channels", 0):
            times = self.uniform(0, 1, *cameras.shape)
        return Views(images, cameras, None, times, None if times is None else times[:, :1])

    def photos(self) -> Views:
        """What a rendering is compared with."""
        return self.views()

    def memory(self) -> ImageMemory:
        """An image memory with the rays of the cameras, in patches of PATCH pixels."""
        (height, width), views, dims = self.image, self.sizes.views, self.case.dims
        grid = (views, -(-height // PATCH), -(-width // PATCH))
        cameras = self.cameras(image=(grid[1] * PATCH, grid[2] * PATCH))
        batch, tokens = self.sizes.batch, math.prod(grid)
        heads = (batch, dims.heads, tokens, dims.width // dims.heads)
        keys, values = self.normal(*heads), self.normal(*heads)
        return ImageMemory(
            features=self.normal(batch, tokens, memory_width(self.case)),
            keys=keys,
            values=values,
            patch_rays=patch_rays(plucker_rays(cameras), PATCH),
            grid=grid,
        )

    def gaussians(self) -> Gaussians:
        """Gaussians of all shapes in front of the cameras; a renderer's have all that they can."""
        shape = (self.sizes.batch, self.sizes.queries * self.sizes.gaussians)
        means = 0.4 * self.normal(*shape, 3)
        plain = Gaussians(
            means=means + torch.tensor([0.0, 0.0, 1.5]).to(means),
            scales=self.uniform(0.05, 0.3, *shape, 3),
            quats=F.normalize(self.normal(*shape, 4), dim=-1),
            opacities=self.uniform(0.2, 0.9, *shape),
            colors=self.uniform(0, 1, *shape, 3),
        )
        sh = 0.1 * self.normal(*shape, SH_COUNTS[1], 3) if self.gives("sh") else None
        features = self.uniform(0, 1, *shape, 4) if self.gives("features") else None
        return replace(plain, sh=sh, features=features)

    def gives(self, name: str) -> bool:
        """Whether Gaussians have `sh` or `features`: for a renderer, and what requires them."""
        required = self.case.component.fields_read(self.case.config)
        return self.case.slot == "renderer" or f"gaussians.{name}" in required

    def prediction(self) -> LayerPrediction:
        """Gaussians, and the state that stands for their origin."""
        return LayerPrediction(self.gaussians(), self.state())

    def rendering(self, views: int | None = None) -> Rendering:
        """Noise pictures; by default of no views for a loss that needs none."""
        given = self.case.component
        if views is None:
            unseen = issubclass(given, Loss) and given.renderings == "none"
            views = 0 if unseen else self.sizes.views
        shape = (self.sizes.batch, views)
        rgb, alpha = (self.uniform(0, 1, *shape, c, *self.image) for c in (3, 1))
        depth = self.uniform(1, 2, *shape, 1, *self.image)
        features = self.uniform(0, 1, *shape, 4, *self.image) if self.gives("features") else None
        return Rendering(rgb, alpha, depth, features)

    def target(self) -> Views:
        """Noise pictures with masks, and with depth maps for a loss that reads them."""
        views = self.views()
        masks = self.uniform(0, 1, *views.images.shape[:2], 1, *self.image).round()
        if not getattr(self.case.component, "reads_depths", False):
            return replace(views, masks=masks)
        return replace(views, masks=masks, depths=1 + self.uniform(0, 1, *masks.shape))

    def inputs(self) -> Views:
        """What a prediction was made from: other pictures than the target's."""
        return self.target()


def sizes_of(spec: FieldSpec, dims: ModelDims) -> list[int]:
    """The trailing shape of a field in a model of `dims`; 4 for a size of another name.

    "4*D" is four times the width.
    """
    named = {"D": dims.width, "h": dims.heads, "D/h": dims.width // dims.heads}

    def size(of: int | str) -> int:
        factor, times, name = str(of).rpartition("*")
        count = int(factor) if times and factor.isdigit() else 1
        return of if isinstance(of, int) else count * named.get(name, 4)

    return [size(of) for of in spec.shape]


def is_place(spec: FieldSpec) -> bool:
    """Whether a field holds points of the world."""
    return spec.shape == (3,) and spec.frame == "world" and spec.dtype.is_floating_point

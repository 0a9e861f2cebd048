"""A reconstruction as it can be looked at: its queries, their supports, and what they read."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from qgs.contracts import AttentionWeights, RendererConfig
from qgs.model import QueryGaussianModel
from qgs.reconstruction.trace import Trace, trace
from qgs.types import Gaussians, ImageMemory, QueryState, SpatialSupport, Views
from qgs_viewer.placement import Placement, Splats, on_photo, patch_centers, splats

Background = tuple[float, float, float]
NEUTRAL: Background = RendererConfig().background  # of models, unless their recipe changes it


@dataclass(frozen=True)
class Inside:
    """A model's image memory, and its state after each layer, 0 the start."""

    model: QueryGaussianModel
    memory: ImageMemory
    states: Sequence[QueryState]


@dataclass(frozen=True)
class Look:
    """Gaussians (1, G), the input views (1, V) with labels, and the placement in the shown world.

    inside: None without a model; then there are no queries. frames: numbers of the views in their
    scene. background: RGB in [0, 1] behind the Gaussians.
    """

    gaussians: Gaussians
    views: Views | None = None
    labels: Sequence[str] = ()
    frames: Sequence[int] = ()
    placement: Placement = field(default_factory=Placement.identity)
    inside: Inside | None = None
    background: Background = NEUTRAL
    _traces: dict[int, tuple[Trace, int]] = field(default_factory=dict, init=False, repr=False)

    @property
    def queries(self) -> int:
        """How many queries there are to pick; 0 without a model."""
        return self.inside.states[0].features.shape[1] if self.inside else 0

    @property
    def depth(self) -> int:
        """How many decoder layers there are; 0 without a model."""
        return self.inside.model.depth if self.inside else 0

    @cached_property
    def splats(self) -> Splats:
        """All Gaussians in the shown world."""
        return splats(self.gaussians, self.placement)

    def query_of(self, gaussian: int) -> int:
        """The query that a Gaussian belongs to."""
        return gaussian * self.queries // self.gaussians.count

    def members(self, query: int) -> slice:
        """The Gaussians of a query."""
        each = self.gaussians.count // self.queries
        return slice(query * each, (query + 1) * each)

    def support(self, layer: int) -> SpatialSupport | None:
        """Supports (1, N) after a layer, 0 the start, in the shown world; None without anchors."""
        if self.inside is None:
            return None
        found = self.inside.model.queries.support(self.inside.states[layer])
        if found is None:
            return None
        place = self.placement
        return SpatialSupport(place.points(found.centers), place.vectors(found.axes))

    def attention(self, query: int, layer: int) -> AttentionWeights | None:
        """What a query reads in a layer, (1, h, 1, M), patches of `grid`.

        None where it is not explained, in layer 0, and of tokens that are no patches of photos.
        """
        if self.inside is None or self.inside.memory.grid is None:
            return None
        return self._explained("cross_attention", query, layer)

    @property
    def grid(self) -> tuple[int, int, int]:
        """(V, H/P, W/P) of the patches that `attention` is of."""
        assert self.inside is not None
        assert self.inside.memory.grid is not None
        return self.inside.memory.grid

    def self_attention(self, query: int, layer: int) -> AttentionWeights | None:
        """The queries that a query reads in a layer, (1, h, 1, N); None as for `attention`."""
        return self._explained("self_attention", query, layer)

    def _explained(self, part: str, query: int, layer: int) -> AttentionWeights | None:
        if self.inside is None or not layer:
            return None
        self.trace([query])
        record, place = self._traces[query]
        found: AttentionWeights | None = getattr(record.layers[layer], part)
        if found is None:
            return None
        only = slice(place, place + 1)
        geometry = None if found.geometry is None else found.geometry[:, :, only]
        return AttentionWeights(found.content[:, :, only], geometry, found.weights[:, :, only])

    def trace(self, queries: Sequence[int]) -> None:
        """Have the attention of `queries` at hand, by one pass through the decoder for all."""
        missing = [query for query in dict.fromkeys(queries) if query not in self._traces]
        if missing and self.inside is not None and self.views is not None:
            model, memory = self.inside.model, self.inside.memory
            state = self.inside.states[0]
            with torch.no_grad(), trace(model, queries=missing) as record:
                model.predict(self.views, memory, state)
            self._traces.update({query: (record, at) for at, query in enumerate(missing)})

    def hub(self, query: int, layer: int) -> Tensor:
        """Where lines of a query start, (3,): its support's centre, or its Gaussians' mean."""
        found = self.support(layer)
        if found is not None:
            return found.centers[0, query]
        return self.placement.points(self.gaussians.means[0, self.members(query)]).mean(0)

    def strongest(self, query: int, layer: int, count: int, depth: float) -> "Reading | None":
        """The `count` patches that a query attends to most, on photos `depth` from their cameras.

        Mean over heads; None as for `attention`.
        """
        weights = self.attention(query, layer)
        if weights is None or self.views is None:
            return None
        grid, cameras = self.grid, self.views.cameras[0]
        pixels = patch_centers(grid, cameras.size)
        points = on_photo(cameras, pixels, depth / self.placement.scale).flatten(0, 1)
        shares = weights.weights[0, :, 0].float().mean(0).cpu()
        strongest = shares.topk(min(count, len(shares)))
        side = depth * cameras.size[1] / grid[2] / float(cameras.intrinsics[0, 0])
        read = self.placement.points(points.cpu()[strongest.indices])
        return Reading(read, strongest.values, side)


@dataclass(frozen=True)
class Reading:
    """Patches: points (k, 3) and width `side` in the shown world, shares (k,) of attention."""

    points: Tensor
    shares: Tensor
    side: float


@torch.no_grad()
def look_inside(
    model: QueryGaussianModel,
    views: Views,
    labels: Sequence[str] = (),
    frames: Sequence[int] = (),
    placement: Placement | None = None,
) -> Look:
    """What `model` makes of views (1, V), with all that can be asked of it."""
    memory = model.encoder(views)
    start = model.queries(memory, views)
    prediction = model.predict(views, memory, start, range(1, model.depth + 1))
    states = [start, *(layer.state for layer in prediction.layers.values())]
    inside = Inside(model, memory, states)
    placement = placement or Placement.identity()
    labels = labels or [f"view {view}" for view in range(views.images.shape[1])]
    background = model.renderer.config.background
    return Look(prediction.gaussians, views, labels, frames, placement, inside, background)

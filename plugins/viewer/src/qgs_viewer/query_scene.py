"""A reconstructed scene with its queries: their supports and their attention."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from qgs.contracts import AttentionWeights, RendererConfig
from qgs.geometry.transforms import moved
from qgs.model import QueryGaussianModel
from qgs.reconstruction.trace import Trace, trace
from qgs.types import Cameras, Gaussians, ImageMemory, QueryState, SpatialSupport, Views
from qgs_viewer.placement import Splats, on_photo, patch_centers, splats

Background = tuple[float, float, float]
NEUTRAL = RendererConfig().background
"""Default background of renderers, RGB in [0, 1]."""
Placement = tuple[Tensor, float]
"""Transform into the viewer's world: pose (4, 4), float64, and factor, as for `moved`."""


@dataclass(frozen=True)
class Inside:
    """The model that made a scene, with its intermediate results in the world of the model.

    views: the input views (1, V). memory: tokens of their photos. states: states of the queries
    before the first decoder layer and after each layer. placement: transform from that world into
    the viewer's. traces: records of passes in which one query's attention was asked for, by index
    of the query.
    """

    model: QueryGaussianModel
    views: Views
    memory: ImageMemory
    states: Sequence[QueryState]
    placement: Placement
    traces: dict[int, Trace] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class QueryScene:
    """A reconstruction: Gaussians (1, G), the input views (1, V), and the model's queries.

    All are in the viewer's world. frames: indices of the input views in their scene. inside: the
    model and its intermediate results; None if only the Gaussians are known, and then there are no
    queries. background: RGB in [0, 1] behind the Gaussians.
    """

    gaussians: Gaussians
    views: Views | None = None
    frames: Sequence[int] = ()
    inside: Inside | None = None
    background: Background = NEUTRAL

    @property
    def queries(self) -> int:
        """Number of queries of the model; 0 if the model is not known."""
        return self.inside.states[0].features.shape[1] if self.inside else 0

    @property
    def depth(self) -> int:
        """Number of decoder layers of the model; 0 if the model is not known."""
        return self.inside.model.depth if self.inside else 0

    def refuse_missing(self, query: int | None) -> None:
        """Raise ValueError if the scene has no query with the index `query`. None is accepted."""
        if query is not None and query >= self.queries:
            last = self.queries - 1
            there = f"choose one from 0 to {last}" if self.queries else "this source has no queries"
            raise ValueError(f"--query {query} cannot be picked: {there}")

    @cached_property
    def splats(self) -> Splats:
        """All Gaussians as viser takes them."""
        return splats(self.gaussians)

    def query_of(self, gaussian: int) -> int:
        """Return the index of the query that made the Gaussian with the index `gaussian`."""
        # Gaussians lie query by query, as many of each
        return gaussian * self.queries // self.gaussians.count

    def members(self, query: int) -> slice:
        """Return the indices of the Gaussians that the query with the index `query` made."""
        each = self.gaussians.count // self.queries
        return slice(query * each, (query + 1) * each)

    @torch.no_grad()
    def support(self, layer: int) -> SpatialSupport | None:
        """Return the support ellipsoids of all N queries in the viewer's world, (1, N), float64.

        layer: number of the decoder layer after which the supports are taken; 0 means before the
        first layer. Returns None if the queries have no anchors, or if the model is not known.
        """
        if self.inside is None:
            return None
        found = self.inside.model.queries.support(self.inside.states[layer])
        if found is None:
            return None
        pose, factor = self.inside.placement
        rotation = factor * pose[:3, :3]
        found = found.to("cpu", torch.float64)
        return SpatialSupport(found.centers @ rotation.T + pose[:3, 3], rotation @ found.axes)

    def attention(self, query: int, layer: int) -> AttentionWeights | None:
        """Return the cross-attention of a query in a layer to all patches of `grid`: (1, h, 1, M).

        The h heads attend to M patches. Returns None if the model is not known, in layer 0 (before
        the first layer), if tokens are not patches of photos, or if the decoder does not report
        attention.
        """
        inside = self.inside
        if inside is None or inside.memory.grid is None or not layer:
            return None
        if query not in inside.traces:
            # all layers at once: users walk through them, and one pass costs as much as any
            with torch.no_grad(), trace(inside.model, queries=[query]) as record:
                inside.model.predict(inside.views, inside.memory, inside.states[0])
            inside.traces[query] = record
        return inside.traces[query].layers[layer].cross_attention

    @property
    def grid(self) -> tuple[int, int, int]:
        """Numbers of input photos, of patch rows and of patch columns in each photo."""
        assert self.inside is not None
        assert self.inside.memory.grid is not None
        return self.inside.memory.grid

    def hub(self, query: int, layer: int) -> Tensor:
        """Return the point (3,) at which lines from a query start, in the viewer's world.

        The point is the query's anchor after `layer`; for a query without anchor, it is the mean
        position of the query's Gaussians.
        """
        found = self.support(layer)
        if found is not None:
            return found.centers[0, query]
        return self.gaussians.means[0, self.members(query)].cpu().double().mean(0)

    def strongest(
        self, query: int, layer: int, count: int, depth: float
    ) -> tuple[Tensor, Tensor, float] | None:
        """Return the k = `count` photo patches that a query attends to most, averaged over heads.

        Returns their centres (k, 3), the query's attention to each (k,), and the width of a patch,
        all in the viewer's world; None if `attention` gives None for the query and layer. depth:
        distance from a camera at which its photo is drawn, in the viewer's world.
        """
        weights = self.attention(query, layer)
        if weights is None or self.views is None:
            return None
        cameras = self.views.cameras[0].to("cpu", torch.float64)
        pixels = patch_centers(self.grid, cameras.size)
        points = on_photo(cameras, pixels, depth).flatten(0, 1)
        shares = weights.weights[0, :, 0].float().mean(0).cpu()
        # heads differ, the mean is what figures of papers show
        strongest = shares.topk(min(count, len(shares)))
        side = depth * cameras.size[1] / self.grid[2] / float(cameras.intrinsics[0, 0])
        return points[strongest.indices], strongest.values, side


@torch.no_grad()
def explained(
    model: QueryGaussianModel,
    views: Views,
    frames: Sequence[int],
    placement: Placement | None = None,
    cameras: Cameras | None = None,
) -> QueryScene:
    """Reconstruct a scene from V views (1, V) by `model`, with its queries after each layer.

    frames: indices of the views in their scene. placement: transform from the model's world into
    the viewer's world. cameras: those of the views in the viewer's world. By default both worlds
    are equal.
    """
    memory = model.encoder(views)
    start = model.queries(memory, views)
    prediction = model.predict(views, memory, start, range(1, model.depth + 1))
    # supports are asked for layer by layer, and the start counts as a layer
    states = [start, *(layer.state for layer in prediction.layers.values())]
    gaussians = prediction.gaussians
    return QueryScene(
        moved(gaussians.to("cpu"), *placement) if placement else gaussians,
        views.replace(cameras=cameras or views.cameras),
        frames,
        inside=Inside(model, views, memory, states, placement or (torch.eye(4).double(), 1.0)),
        background=model.renderer.config.background,
    )

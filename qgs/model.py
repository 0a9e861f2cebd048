"""The model: views to image memory, queries through the decoder layers, states to Gaussians."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from qgs.containers import map_tensors
from qgs.contracts import (
    Centers,
    DecoderLayer,
    Encoder,
    Feedback,
    Head,
    Queries,
    Refinement,
    Renderer,
    Supervision,
)
from qgs.domain import Domain
from qgs.model_text import model_text
from qgs.types import (
    Cameras,
    Gaussians,
    ImageMemory,
    LayerPrediction,
    Photos,
    Prediction,
    QueryState,
    Rendering,
    Views,
)


class QueryGaussianModel(nn.Module):
    """From photos to the Gaussians of its queries, in one forward pass.

    refinements: one per decoder layer, at `refinement_of`; layers may share a module.
    recipe: the resolved recipe this model was composed from, None for one built by hand.
    releases: plugins of that recipe, as `Recipe.releases`; those that were imported, whatever is
        installed when the model is saved.
    trained_on: statistics of the training views, as its checkpoint records them, or None.
    loaded_from: its checkpoint as `qgs.load` takes it, an absolute path; "" if it was not loaded.
    """

    def __init__(
        self,
        *,
        encoder: Encoder,
        queries: Queries,
        decoder: Sequence[DecoderLayer],
        refinements: Sequence[Refinement],
        feedback: Feedback,
        head: Head,
        centers: Centers,
        supervision: Supervision,
        renderer: Renderer,
        recipe: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.queries = queries
        self.decoder = nn.ModuleList(decoder)
        self.refinements = nn.ModuleList(dict.fromkeys(refinements))
        # One module may refine after several layers: its weights count once.
        shared = {id(module): index for index, module in enumerate(self.refinements)}
        self.refinement_of = [shared[id(module)] for module in refinements]
        self.feedback = feedback
        self.head = head
        self.centers = centers
        self.supervision = supervision
        self.renderer = renderer
        self.recipe = recipe
        self.releases: Mapping[str, tuple[str, str]] = {}
        self.trained_on: Domain | None = None
        self.loaded_from = ""

    def __repr__(self) -> str:
        return model_text(self)

    @property
    def depth(self) -> int:
        """Number of decoder layers that an evaluation runs, those of rounds of feedback too."""
        return len(self.decoder) + self.feedback.rounds * self.feedback.layers

    def forward(
        self,
        views: Views | Photos,
        layers: Collection[int] | None = None,
        state: QueryState | None = None,
    ) -> Prediction:
        """Reconstruct every scene of `views`, whose cameras are in the model's world.

        layers: see `predict`. state: the initial state; None for that of the queries.
        Raises ValueError for photos without cameras where the encoder or the queries read them.
        """
        # NumPy's cameras are float64, the weights hardly ever.
        views = views.to(torch.promote_types(next(self.parameters()).dtype, torch.float32))
        if isinstance(views, Photos):
            views = self._without_cameras(views)
        memory = self.encoder(views)
        # Tuning at test time brings its own state.
        initial = self.queries(memory, views) if state is None else state
        return self.predict(views, memory, initial, layers)

    def _without_cameras(self, photos: Photos) -> Views:
        """`photos` for parts that read no cameras; ValueError if one does."""
        parts = (self.encoder, self.queries, self.feedback)
        readers = [type(part).__name__ for part in parts if part.reads_cameras]
        if readers:
            raise ValueError(
                f"{' and '.join(readers)} of this model read cameras, and these photos have none; "
                "give Views with cameras, or take an encoder that does without (reads_cameras)"
            )
        # It has the same images and masks.
        return cast(Views, photos)

    def predict(
        self,
        views: Views,
        memory: ImageMemory,
        state: QueryState,
        layers: Collection[int] | None = None,
    ) -> Prediction:
        """Run all decoder layers and decode Gaussians after the chosen ones.

        views, memory: the encoder's input and output. state: the queries before the first layer, of
            as many scenes.
        layers: numbers of the layers to decode, beside the last and that of each round (1 is the
            first, rounds count on; 0 is the start, of a decoder of depth 0); None for the
            supervised ones in training, and for no others in evaluation.
        Raises ValueError for a layer that does not exist and for another number of scenes.
        """
        if layers is None:
            layers = self.supervision.weights().keys() if self.training else ()
        last = len(self.decoder)
        again = last - self.feedback.layers
        rounds = self.feedback.drawn() if self.training else self.feedback.rounds
        order = [*range(last)]
        # Every round of feedback repeats the last layers.
        order += rounds * [*range(again, last)]
        known = range(min(1, last), len(order) + 1)
        unknown = sorted(n for n in layers if n not in known)
        if unknown:
            raise ValueError(
                f"layers {unknown} do not exist; this model has layers {known[0]}..{len(order)}"
            )
        scenes = memory.features.shape[0]
        given = state.features.shape[0]
        if scenes != given:
            raise ValueError(f"the memory is of {scenes} scenes, the initial state of {given}")
        decoded = {} if last else {0: LayerPrediction(self.decode(state), state)}
        first = memory
        for number, index in enumerate(order, start=1):
            if index == again and number > last:
                state, memory = self._corrected(decoded[number - 1], first, views)
            elif index == again:
                first = memory
            refine = self.refinements[self.refinement_of[index]]
            state, memory = self.decoder[index](state, memory)
            state = refine(state)
            if number in layers or index == last - 1:
                decoded[number] = LayerPrediction(self.decode(state), state)
        return Prediction(decoded[len(order)].gaussians, state, decoded)

    def _corrected(
        self, before: LayerPrediction, memory: ImageMemory, views: Views
    ) -> tuple[QueryState, ImageMemory]:
        """What a round starts with."""
        photos = self.feedback.compared(views)
        # What looks wrong is an input of the round, no loss.
        with torch.no_grad():
            rendering = self.render(before.gaussians, photos.cameras)
        return self.feedback(before.state, memory, rendering, photos)

    def decode(self, state: QueryState) -> Gaussians:
        """The Gaussians of a state, ordered query by query."""
        attributes = self.head(state)
        parts = attributes.replace(offsets=self.centers(attributes.offsets, state))
        # Places without a query decode Gaussians that nobody sees.
        if state.mask is not None:
            parts = parts.replace(opacities=parts.opacities * state.mask[..., None])
        # N, K -> G; attributes and Gaussians have their fields in one order.
        return Gaussians(*vars(map_tensors(lambda x: x.flatten(1, 2), parts)).values())

    def render(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        """Render (B, G) Gaussians from (B, V) cameras, see `qgs.contracts.Renderer`."""
        return self.renderer(gaussians, cameras, background)

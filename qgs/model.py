"""The model: an encoder of photos, decoder layers that update queries, and a head for Gaussians."""

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
    """A model that turns photos into the Gaussians of its queries, in one forward pass.

    refinements: the distinct refinement modules; layers may share a module. `refinement_of` has the
        index of the refinement for each decoder layer.
    recipe: the complete recipe of this model; None for a model built by hand.
    releases: distribution and version of each plugin of the recipe when the model was built.
    trained_on: range of the training's cameras, from the checkpoint; empty if it is unknown.
    loaded_from: absolute path of the checkpoint that `qgs.load` read; "" for other models.
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
        shared = {module: index for index, module in enumerate(self.refinements)}
        self.refinement_of = [shared[module] for module in refinements]
        self.feedback = feedback
        self.head = head
        self.centers = centers
        self.supervision = supervision
        self.renderer = renderer
        self.recipe = recipe
        self.releases: Mapping[str, tuple[str, str]] = {}
        self.trained_on = Domain()
        self.loaded_from = ""

    def __repr__(self) -> str:
        return model_text(self)

    @property
    def device(self) -> torch.device:
        """Device of the model's parameters."""
        return next(self.parameters()).device

    @property
    def depth(self) -> int:
        """Number of decoder layers that an evaluation runs, including repetitions by feedback."""
        return len(self.decoder) + self.feedback.rounds * self.feedback.layers

    def compile(self, *args: Any, **kwargs: Any) -> None:
        """Compile the model in place; the arguments are those of torch.compile.

        On CUDA, without arguments, calls replay a CUDA graph (mode "reduce-overhead"): for
        inference, with results that are valid until the next call.
        """
        if self.device.type == "cuda" and not args and not kwargs:
            kwargs["mode"] = "reduce-overhead"
        super().compile(*args, **kwargs)

    def forward(self, views: Views | Photos, layers: Collection[int] | None = None) -> Prediction:
        """Reconstruct every scene of `views`, whose cameras are in the model's frame.

        layers: numbers of layers after which Gaussians are decoded, in addition to the last layer;
            `predict` explains numbers and default. Raises ValueError for `Photos` if encoder,
            queries or feedback read cameras.
        """
        # NumPy's cameras are float64, the weights hardly ever.
        views = views.to(torch.promote_types(next(self.parameters()).dtype, torch.float32))
        if isinstance(views, Photos):
            readers = [
                type(part).__name__
                for part in (self.encoder, self.queries, self.feedback)
                if part.reads_cameras
            ]
            if readers:
                raise ValueError(
                    f"{' and '.join(readers)} of this model need cameras, but these photos have "
                    "none; give Views with cameras, or use components with `reads_cameras = False`"
                )
            # Photos have all other fields that are read.
            views = cast(Views, views)
        memory = self.encoder(views)
        return self.predict(views, memory, self.queries(memory, views), layers)

    def predict(
        self,
        views: Views,
        memory: ImageMemory,
        state: QueryState,
        layers: Collection[int] | None = None,
    ) -> Prediction:
        """Run all decoder layers, and decode Gaussians after the last layer and after `layers`.

        views, memory: the encoder's input and output.
        state: the queries before the first layer, for the same scenes.
        layers: numbers of layers to decode, in addition to the last layer of the decoder and of
            each feedback round. The first layer has number 1; layers that feedback repeats get the
            numbers after the decoder's. 0 is the initial state, only in a decoder of depth 0. None
            stands for the supervised layers in training, and for no additional layers in
            evaluation.
        Raises ValueError for a layer that does not exist, and if `memory` and `state` have
        different numbers of scenes.
        """
        if layers is None:
            layers = self.supervision.weights().keys() if self.training else ()
        last = len(self.decoder)
        again = last - self.feedback.layers
        rounds = self.feedback.drawn() if self.training else self.feedback.rounds
        # Every round of feedback repeats the last layers.
        order = [*range(last), *rounds * [*range(again, last)]]
        known = range(min(1, last), len(order) + 1)
        unknown = sorted(n for n in layers if n not in known)
        if unknown:
            raise ValueError(
                f"layers {unknown} do not exist; this model has layers {known[0]}..{len(order)}"
            )
        scenes = len(memory.features)
        given = len(state.features)
        if scenes != given:
            raise ValueError(
                f"the memory has {scenes} scenes, but the initial state has {given}; both need the "
                "same scenes"
            )
        decoded = {} if last else {0: LayerPrediction(self.decode(state), state)}
        first = memory
        for number, index in enumerate(order, start=1):
            if index == again and number > last:
                state, memory = self.feedback(state, first, views, self.decode, self.render)
            elif index == again:
                first = memory
            state, memory = self.decoder[index](state, memory)
            state = self.refinements[self.refinement_of[index]](state)
            if number in layers or index == last - 1:
                decoded[number] = LayerPrediction(self.decode(state), state)
        return Prediction(decoded[len(order)].gaussians, state, decoded)

    def decode(self, state: QueryState) -> Gaussians:
        """Decode a query state into its Gaussians, ordered query by query."""
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
        """Render Gaussians (B, G) from cameras (B, V), as `qgs.contracts.Renderer.forward` does."""
        return self.renderer(gaussians, cameras, background)

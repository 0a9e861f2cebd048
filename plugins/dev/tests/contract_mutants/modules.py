"""Components that are built, kept, saved or differentiated wrongly, whatever their slot."""

import torch
from contract_mutants.mutant import mutant
from contract_mutants.slots import ChangedSquares
from contract_mutants.sound import ChangedEncoder
from contract_mutants.spatial import AtPlaces, BiasedAttention, Extended, PlacesByALayer
from pydantic import BaseModel, ConfigDict, Field, field_serializer
from small_parts import made
from torch import nn

from qgs.checkpoint.tensors import shapes_of
from qgs.contracts import ModelDims
from qgs.losses import Opacity
from qgs.tokengs import (
    ContentCrossAttention,
    ContentSelfAttention,
    CrossAttentionCore,
    FreeCenters,
    MlpFeedForward,
)


class ExtendedMlp(Extended, MlpFeedForward): ...


class AddsToItsOutput(ExtendedMlp):
    """An MLP with a summand that mutants make."""

    def forward(self, features):
        return super().forward(features) + self.summand


@mutant("builds", "RuntimeError: no kernel for width 32")
class RaisesWhenBuilt(ExtendedMlp):
    def add(self, dims):
        raise RuntimeError(f"no kernel for width {dims.width}")


@mutant("sizes_vary", "`output` has shape")
class FixedNumberOfQueries(AddsToItsOutput):
    def add(self, dims):
        self.summand = nn.Parameter(torch.zeros(6, dims.width))


@mutant("sizes_vary", "in a model of width 48 with 3 heads, RuntimeError")
class FixedNumberOfHeads(Extended, ContentCrossAttention):
    def add(self, dims):
        self.core = CrossAttentionCore(dims.width, 2, self.config.norm_eps)


@mutant("unmet_reads_fail_at_compose", "view size is not")
@mutant("strides_make_no_difference", "view size is not")
class ViewsAField(PlacesByALayer):
    """Takes a field for contiguous; queries expand theirs to all scenes."""

    def forward(self, state):
        center = state["place.center"]
        place = self.place(center.view(-1, 3)).view(*center.shape[:2], -1)
        return self.attention(self.norm(state.features + place), state.mask)


@mutant("construction", "is read back as", z_offset=0.3)
class RoundsAnOption(FreeCenters):
    class Config(FreeCenters.Config):
        @field_serializer("z_offset")
        def _rounded(self, z_offset: float) -> float:
            return float(round(z_offset))


@mutant("construction", "the unknown option `z_offset_x` is accepted")
class IgnoresUnknownOptions(FreeCenters):
    class Config(FreeCenters.Config):
        model_config = ConfigDict(extra="ignore")


class Inner(BaseModel):
    depth: float = 1.0


@mutant("construction", "Inner accepts any option")
class IgnoresUnknownInnerOptions(MlpFeedForward):
    class Config(MlpFeedForward.Config):
        inners: tuple[Inner, ...] | None = None


@mutant("construction", "building changes the options from")
class AppendsToAnOption(ExtendedMlp):
    class Config(MlpFeedForward.Config):
        sizes: list[int] = Field(default=[1])

    def add(self, dims):
        self.config.sizes.append(2)


@mutant("scheduled_options_are_read_anew", "`weight: 0.05` set later gives other results")
class ReadsItsWeightOnce(Opacity):
    def __init__(self, config):
        super().__init__(config)
        self.weight = config.weight

    def term(self, prediction, rendering, target, inputs):
        return self.weight * -(prediction.gaussians.opacities + self.config.eps).log().mean()


PINNED = shapes_of(made(MlpFeedForward, ModelDims(32, 4, 1)).state_dict())
"""What saved weights of `qgs/mlp` hold in a model of width 32."""


@mutant("construction", "summand: allocated")
class AllocatesOnCpu(AddsToItsOutput):
    def add(self, dims):
        self.summand = nn.Parameter(torch.ones(dims.width, device="cpu"))


@mutant("construction", "keeps layers outside")
class KeepsLayersInAList(ExtendedMlp):
    def add(self, dims):
        self.layers = [nn.Linear(dims.width, dims.width)]


@mutant("construction", "building sets the seed of torch's generator")
class SeedsWhenBuilt(MlpFeedForward):
    def __init__(self, config, dims):
        torch.manual_seed(0)
        super().__init__(config, dims)


@mutant("construction", "differ, mlp.fc1.weight")
class DrawsFromItsOwnGenerator(ExtendedMlp):
    def add(self, dims):
        generator = torch.Generator()
        generator.seed()
        with torch.no_grad():
            self.mlp.fc1.weight.normal_(generator=generator)


@mutant("construction", "with the same state dict differ, output")
class KeepsARandomBufferUnsaved(AddsToItsOutput):
    def add(self, dims):
        self.register_buffer("summand", torch.randn(dims.width), persistent=False)


@mutant("state_dict_keys", "'norm.bias'", state_dict=PINNED)
class RenamesItsNorm(ExtendedMlp):
    def add(self, dims):
        self.layer_norm = self.norm
        del self.norm

    def forward(self, features):
        return self.mlp(self.layer_norm(features))


@mutant("parameters_learn", "unused.weight: no gradient reaches it")
class HasAnUnusedLayer(ExtendedMlp):
    def add(self, dims):
        self.unused = nn.Linear(dims.width, dims.width)


@mutant("parameters_learn", "shift: no gradient reaches it")
class ShiftsAllLogits(Extended, BiasedAttention):
    """What is added to all logits alike changes no weight: its gradient is a rounding error."""

    def add(self, dims):
        self.shift = nn.Parameter(torch.zeros(1, 1, 1))

    def bias(self, state, memory):
        return self.shift.float().expand(1, 1, memory.keys.shape[2])


@mutant("inputs_are_not_changed", "changes inputs, offsets")
class ClampsItsInputInPlace(FreeCenters):
    def forward(self, offsets, state):
        return super().forward(offsets.data.clamp_(-0.1, 0.1), state)


@mutant("forward_keeps_no_state", "_cache: changed by")
class CachesByShape(ExtendedMlp):
    def add(self, dims):
        self._cache = {}

    def forward(self, features):
        zeros = self._cache.setdefault(tuple(features.shape), torch.zeros_like(features))
        return super().forward(features) + zeros


@mutant("forward_keeps_no_state", "differs from a first one")
class ScalesByItsFirstInput(ExtendedMlp):
    """Keeps a number in a closure, which no attribute shows."""

    def add(self, dims):
        kept = []

        def first(x):
            if not kept and x.device.type != "meta":
                kept.append(x.detach().mean().item())
            return kept[0] if kept else 0.0

        self.first = first

    def forward(self, features):
        return super().forward(features) + self.first(features)


@mutant("training_draws_from_torch", "sets the seed of torch's generator")
class SeedsInTraining(MlpFeedForward):
    def forward(self, features):
        if self.training:
            torch.manual_seed(0)
        return super().forward(features)


@mutant("gradients_reach_inputs", "memory.keys, memory.values")
class DetachesTheImages(ContentCrossAttention):
    def forward(self, state, memory):
        return self.core(state.features, memory.keys.detach(), memory.values.detach())


@mutant("terms_have_gradients", "no gradient comes from this term")
class DetachedLoss(ChangedSquares):
    def mean(self, error):
        return error.detach().mean()


@mutant("coincident_queries_stay_finite", "with coincident queries")
class DividesBySpread(ContentSelfAttention):
    def forward(self, state):
        features = state.features
        spread = (features - features[:, :1]).norm(dim=(1, 2), keepdim=True)
        return super().forward(state.replace(features=features / spread))


@mutant("points_behind_cameras_stay_finite", "in the centre of a camera")
class DividesByDepth(AtPlaces, ContentSelfAttention):
    def forward(self, state):
        place = state["place.center"]
        return super().forward(state) + place[..., :1] / place[..., 2:]


@mutant("duplicated_view_stays_finite", "with a duplicated view")
class DividesByBaseline(ChangedEncoder):
    def given(self, views):
        eyes = views.cameras.c2w[..., :3, 3]
        baseline = (eyes - eyes[:, :1]).norm(dim=-1).sum(1)
        return views.replace(images=views.images / baseline[:, None, None, None, None])

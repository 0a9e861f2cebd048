"""Components that cannot be built or called, or only with certain sizes or strides."""

import torch
from contract_mutants.fields import PlacesByALayer
from contract_mutants.mutant import mutant
from torch import Tensor, nn

from qgs.components import (
    ContentCrossAttention,
    CrossAttentionCore,
    MlpFeedForward,
)
from qgs.contracts import Loss, Problem


@mutant("builds", "RuntimeError: no kernel for width 32", also=None)
class RaisesWhenBuilt(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        raise RuntimeError(f"no kernel for width {dims.width}")


@mutant("builds", "`hidden`: it fits no width", also="unmet_requirement_fails_at_compose")
class RefusesItsDefaults(MlpFeedForward):
    @classmethod
    def problems(cls, config, context):
        yield Problem("hidden", "it fits no width", "write another")


@mutant("runs", "mat1 and mat2 shapes cannot be multiplied", also=None)
class RaisesWhenCalled(MlpFeedForward):
    def forward(self, features):
        return super().forward(features @ torch.ones(3, 3))


@mutant(
    "runs",
    "it gives a NoneType, not a Tensor",
    also="unmet_requirement_fails_at_compose parameters_learn sizes_vary",
)
class ForgetsToReturn(MlpFeedForward):
    def forward(self, features):
        super().forward(features)


@mutant("runs", "error is no tensor", also="terms_have_gradients renderings_as_declared")
class GivesNumbersAsTerms(Loss):
    renderings = "each"

    def term(self, prediction, rendering, target, inputs):
        return {"error": (rendering.rgb - target.images).square().mean().item()}


@mutant(
    "sizes_vary",
    "`output` is of shape",
    # It is called with three and with 200 queries there, and its parameters have an order.
    also="query_permutation gradients_match_differences batch_independence",
)
class FixedNumberOfQueries(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.place = nn.Parameter(torch.zeros(6, dims.width))

    def forward(self, features):
        return super().forward(features + self.place)


@mutant("sizes_vary", "in a model of width 48 with 3 heads, RuntimeError")
class FixedNumberOfHeads(ContentCrossAttention):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.core = CrossAttentionCore(dims.width, 2, config.norm_eps)


@mutant("sizes_vary", "(2, 6, 32), not (2, 6, 48)")
class FixedWidth(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.out = nn.Linear(dims.width, 32)

    def forward(self, features):
        return self.out(super().forward(features))


@mutant("unmet_requirement_fails_at_compose", "view size is not")
@mutant("strides_make_no_difference", "view size is not")
class ViewsAField(PlacesByALayer):
    """Takes a field for contiguous; queries expand theirs to all scenes."""

    def forward(self, state):
        center = state["place.center"]
        place = self.place(center.view(-1, 3)).view(*center.shape[:2], -1)
        return self.attention(self.norm(state.features + place), state.mask)


@mutant("compiles", "3 more graphs are compiled")
class LoopsOverQueries(MlpFeedForward):
    def forward(self, features):
        updates = [self.mlp(self.norm(features[:, i])) for i in range(features.shape[1])]
        return torch.stack(updates, 1)


@mutant("compiles", "3 more graphs are compiled")
class LoopsOverTokens(ContentCrossAttention):
    def forward(self, state, memory):
        values = memory.values.split(4, 2)
        return self.core(state.features, memory.keys, torch.cat([1.0 * x for x in values], 2))


@mutant("compiles", "features has a gradient")
class DetachesWhenCompiled(MlpFeedForward):
    def forward(self, features: Tensor) -> Tensor:
        if torch.compiler.is_compiling():
            features = features.detach()
        return super().forward(features)

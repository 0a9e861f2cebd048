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


@mutant("builds", "RuntimeError: no kernel for width 32")
class RaisesWhenBuilt(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        raise RuntimeError(f"no kernel for width {dims.width}")


@mutant("runs", "it gives a NoneType, not a Tensor")
class ForgetsToReturn(MlpFeedForward):
    def forward(self, features):
        super().forward(features)


@mutant("sizes_vary", "`output` is of shape")
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


@mutant("compiles", "features has a gradient")
class DetachesWhenCompiled(MlpFeedForward):
    def forward(self, features: Tensor) -> Tensor:
        if torch.compiler.is_compiling():
            features = features.detach()
        return super().forward(features)

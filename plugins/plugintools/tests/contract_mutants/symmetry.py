"""Components that mix scenes, or that know the order of queries or views or the world frame."""

from dataclasses import replace

import torch
from contract_mutants.mutant import mutant
from contract_mutants.renderers import ChangedRenderer
from torch import nn

from qgs.components import ContentCrossAttention, ContentSelfAttention, MlpFeedForward


@mutant("batch_independence", "scene 0 has a gradient")
class CentresOnTheBatch(MlpFeedForward):
    def forward(self, features):
        return super().forward(features - features.mean(0, keepdim=True))


@mutant("forward_keeps_no_state", "in training changes the state")
@mutant("batch_independence", "in training, scene 0 has a gradient")
class BatchNormed(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.statistics = nn.BatchNorm1d(dims.width)

    def forward(self, features):
        return self.statistics(super().forward(features).transpose(1, 2)).transpose(1, 2)


@mutant("query_permutation", "permuted queries")
class NumbersQueries(ContentSelfAttention):
    def forward(self, state):
        number = torch.arange(state.features.shape[1]).to(state.features)
        return super().forward(state) + number[:, None]


@mutant("query_permutation", "with 200 permuted queries")
class AttendsWithinWindows(ContentSelfAttention):
    """Of 16 consecutive queries."""

    def forward(self, state):
        return torch.cat([self.attention(x) for x in self.norm(state.features).split(16, 1)], 1)


@mutant("view_permutation", "permuted views")
class NumbersTokens(ContentCrossAttention):
    def forward(self, state, memory):
        number = torch.arange(memory.keys.shape[2]).to(memory.keys)
        return self.core(state.features, memory.keys + number[:, None], memory.values)


@mutant("view_permutation", "`ordered_views` is declared")
class DeclaresAnOrder(ContentCrossAttention):
    ordered_views = True


@mutant("world_frame_makes_no_difference", "in a moved world, rgb")
class DarkensByHeight(ChangedRenderer):
    """Above the first camera, along the world's y axis: no shift of the world changes it."""

    def given(self, gaussians, cameras):
        height = gaussians.means[..., 1:2] - cameras.c2w[:, :1, 1, 3:]
        return replace(gaussians, colors=gaussians.colors * height.sigmoid()), cameras

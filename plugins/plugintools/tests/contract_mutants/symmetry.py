"""Components that mix scenes, or that know the order of queries or views or the world frame."""

from dataclasses import replace

import torch
from contract_mutants.mutant import mutant
from contract_mutants.renderers import ChangedRenderer
from contract_mutants.slots import ChangedEncoder, OneTerm
from torch import nn

from qgs.components import ContentCrossAttention, ContentSelfAttention, MlpFeedForward
from qgs.contracts import Loss

PAINT = "colours_depend_on_the_direction features_are_blended_as_colours"
"""Checks that fail too where colours are not what they are given as."""


@mutant("batch_independence", "scene 0 has a gradient")
class CentresOnTheBatch(MlpFeedForward):
    def forward(self, features):
        return super().forward(features - features.mean(0, keepdim=True))


@mutant(
    "batch_independence",
    "in training, beside another scene",
    also="gradients_match_differences",  # the mean that it detaches moves
)
class CentresOnADetachedMeanInTraining(MlpFeedForward):
    def forward(self, features):
        update = super().forward(features)
        return update - update.detach().mean(0) if self.training else update


@mutant("batch_independence", "alone, output")
class DividesByTheNumberOfScenes(MlpFeedForward):
    def forward(self, features):
        return super().forward(features) / features.shape[0]


@mutant("forward_keeps_no_state", "in training changes the state", also="sizes_vary")
@mutant("batch_independence", "in training, scene 0 has a gradient", also="sizes_vary")
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


@mutant("query_permutation", "with 200 permuted queries", also="masked_queries_are_not_read")
class AttendsWithinWindows(ContentSelfAttention):
    """Of 16 consecutive queries."""

    def forward(self, state):
        return torch.cat([self.attention(x) for x in self.norm(state.features).split(16, 1)], 1)


@mutant("query_permutation", "with 200 permuted queries")
class RendersTheFirstGaussians(ChangedRenderer):
    def given(self, gaussians, cameras):
        return gaussians[:, :128], cameras


@mutant("query_permutation", "permuted queries, rgb", also="depth_is_expected")
class FadesLaterGaussians(ChangedRenderer):
    def given(self, gaussians, cameras):
        number = torch.arange(gaussians.means.shape[1]).to(gaussians.means)
        return replace(gaussians, opacities=gaussians.opacities / (1 + number / 100)), cameras


@mutant("query_permutation", "permuted queries")
class MeasuresTheFirstGaussian(OneTerm):
    renderings = "none"

    def term(self, prediction, rendering, target, inputs):
        return prediction.gaussians.scales[:, :1].mean()


@mutant("view_permutation", "permuted views")
class NumbersTokens(ContentCrossAttention):
    def forward(self, state, memory):
        number = torch.arange(memory.keys.shape[2]).to(memory.keys)
        return self.core(state.features, memory.keys + number[:, None], memory.values)


@mutant("view_permutation", "permuted views, output")
class ReadsTheFirstTokens(ContentCrossAttention):
    def forward(self, state, memory):
        return self.core(state.features, memory.keys[:, :, :128], memory.values[:, :, :128])


@mutant("view_permutation", "`ordered_views` is declared")
class DeclaresAnOrder(ContentCrossAttention):
    ordered_views = True


@mutant("view_permutation", "permuted views")
class DimsLaterPhotos(ChangedEncoder):
    def given(self, views):
        number = torch.arange(1.0, views.images.shape[1] + 1).to(views.images)
        return replace(views, images=views.images / number[:, None, None, None])


@mutant("view_permutation", "permuted views, depth", also="depth_is_expected")
class ScalesDepthByView(ChangedRenderer):
    def result(self, out):
        number = torch.arange(1.0, out.depth.shape[1] + 1).to(out.depth)
        return replace(out, depth=out.depth / number[:, None, None, None])


@mutant("view_permutation", "permuted views")
class WeighsTheFirstViewMost(OneTerm):
    renderings = "all"

    def term(self, prediction, rendering, target, inputs):
        error = (rendering.rgb - target.images).square().mean((0, 2, 3, 4))
        return (error / torch.arange(1.0, len(error) + 1).to(error)).sum()


@mutant("view_permutation", "permuted views")
class ComparesWithTheFirstInput(Loss):
    renderings = "all"

    def term(self, prediction, rendering, target, inputs):
        return {"term": (rendering.rgb - inputs.images[:, :1]).square().mean()}


@mutant("world_frame_makes_no_difference", "in a moved world, rgb", also=PAINT)
class DarkensByDistanceFromTheOrigin(ChangedRenderer):
    def given(self, gaussians, cameras):
        colors = gaussians.colors * gaussians.means[..., 2:].sigmoid()
        return replace(gaussians, colors=colors), cameras


@mutant("world_frame_makes_no_difference", "in a moved world, rgb", also=PAINT)
class DarkensByHeight(ChangedRenderer):
    """Above the first camera, along the world's y axis: no shift of the world changes it."""

    def given(self, gaussians, cameras):
        height = gaussians.means[..., 1:2] - cameras.c2w[:, :1, 1, 3:]
        return replace(gaussians, colors=gaussians.colors * height.sigmoid()), cameras


@mutant(
    "world_frame_makes_no_difference",
    "in a moved world",
    also="masked_queries_are_not_judged",
)
class MeasuresFromTheOrigin(OneTerm):
    renderings = "none"

    def term(self, prediction, rendering, target, inputs):
        return prediction.gaussians.means.square().mean()


@mutant(
    "world_frame_makes_no_difference",
    "in a moved world",
    also="masked_queries_are_not_judged",
)
class MeasuresHeight(OneTerm):
    """Its spread: no shift of the world changes it, nor a turn about the y axis."""

    renderings = "none"

    def term(self, prediction, rendering, target, inputs):
        height = prediction.gaussians.means[..., 1]
        return (height - height.mean(1, keepdim=True)).square().mean()

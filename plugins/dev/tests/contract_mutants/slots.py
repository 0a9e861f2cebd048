"""Encoders, heads, queries, losses, data, objectives ... that break the contract of their slot."""

from dataclasses import replace

import torch
from contract_mutants.mutant import mutant
from contract_mutants.renderers import ChangedResult
from contract_mutants.sound import ChangedEncoder, StridedConvolutions
from contract_mutants.spatial import Extended
from qgs_zoo.tokengs2026.multiscale import LatentBottleneck
from torch import nn
from walk import Walk

from qgs.contracts import AttentionWeights, Column, CrossAttention, Loss, SceneSource, memory_fields
from qgs.metrics.images import Psnr
from qgs.tokengs import (
    ContentCrossAttention,
    ContentSelfAttention,
    GaussianHead,
    LatentQueries,
    LayerSupervision,
    MultiViewViT,
    NoFeedback,
    OneCycleAdamW,
    OnePass,
)
from qgs.tokengs.blocks import CrossAttentionCore, split_heads


@mutant("head_gives_gaussians", "quaternions are 2")
class GivesLongQuaternions(GaussianHead):
    def activate(self, raw):
        good = super().activate(raw)
        return replace(good, quats=2 * good.quats)


@mutant("queries_are_shared_by_scenes", "scene 1 of 3", count=6)
class NumbersScenes(LatentQueries):
    def start(self, batch_size):
        state = super().start(batch_size)
        scene = torch.arange(batch_size).to(state.features)[:, None, None]
        return state.replace(features=state.features + scene)


@mutant("queries_resize", "cannot be loaded", count=6)
class NeverResizes(LatentQueries):
    def resized(self, learned, generator):
        return dict(learned)


@mutant("supervision_weights", "weights sum to 2", layers=(1, 2))
class WeighsTwice(LayerSupervision):
    def weights(self, rounds=()):
        factor = 1 if rounds else 2
        return {layer: factor * weight for layer, weight in super().weights(rounds).items()}


@mutant("supervision_weights", "and rounds that end at [3, 4]", layers=(1, 2))
class IgnoresRounds(LayerSupervision):
    def weights(self, rounds=()):
        return super().weights()


@mutant("feedback_repeats_layers", "repeats 3 layers of a decoder with 2")
class RepeatsTooMuch(NoFeedback):
    rounds = 1
    layers = 3


@mutant("feedback_repeats_layers", "in `torch.inference_mode`, 0.features: values differ")
class NeedsGradients(NoFeedback):
    def forward(self, state, memory, *compared):
        return state.replace(features=state.features + torch.is_grad_enabled()), memory


class NoiseScene(Walk):
    """Another noise each time."""

    def images(self, frames):
        return torch.rand_like(super().images(frames))


@mutant("scenes_repeat", "opened a second time, scene 0 differs, 1: values differ")
class DrawsItsImages(SceneSource):
    def scenes(self, split):
        return [NoiseScene()]


@mutant("scenes_are_as_listed", "has 6 frames and holds out [6]")
class HoldsOutTooMuch(DrawsItsImages):
    def scenes(self, split):
        (scene,) = super().scenes(split)
        scene.held_out = (1, 6)
        return [scene]


class ChangedSquares(Loss):
    """A squared error (B, V, 3, H, W), of which mutants take a wrong mean."""

    renderings = "each"

    def term(self, prediction, rendering, target, inputs):
        return self.mean((rendering.rgb - target.images).square())


@mutant("loss_is_a_mean_over_scenes", "compared with the mean over scenes")
class SumsOverScenes(ChangedSquares):
    def mean(self, error):
        return error.mean((1, 2, 3, 4)).sum()


@mutant("renderings_as_declared", "compared with the mean over views")
class TakesTheWorstView(ChangedSquares):
    def mean(self, error):
        return error.mean((2, 3, 4)).amax(1).mean()


@mutant("metric_gives_its_columns", "its values are ['', 'lost'], its columns are ['']")
class GivesAValueWithoutColumn(Psnr):
    def forward(self, given):
        return {"": super().forward(given), "lost": given.images.mean()}


@mutant("truth_scores_best", "lower is better, but PSNR is 100 for the truth")
class ReversesItsDirection(Psnr):
    column = Column("PSNR", "lower")


@mutant("optimizer_steps", "the groups do not hold exactly the given parameters")
class OptimizesDecayingGroups(OneCycleAdamW):
    def build(self, groups):
        return super().build([group for group in groups if group["decays"]])


@mutant("optimizer_continues", "a checkpoint and three more")
class CountsItsOwnSteps(OneCycleAdamW):
    calls = 0

    def learning_rate(self, step, seconds):
        self.calls += 1
        return 0.1 / self.calls


@mutant("patch_rays_are_those_of_the_grid", "of patches of 8 pixels")
class RoundsItsRays(ChangedEncoder):
    def result(self, memory):
        return replace(memory, patch_rays=memory.patch_rays.bfloat16().to(memory.patch_rays))


@mutant("tokens_are_those_of_the_grid", "for `keys`: 8% of what changes a token comes from its own")
class OrdersTokensByColumn(ChangedEncoder):
    def result(self, memory):
        def turned(x, tokens):
            x = x.unflatten(tokens, memory.grid).transpose(tokens + 1, tokens + 2)
            return x.flatten(tokens, tokens + 2)

        keys = turned(memory.keys, 2)
        values = turned(memory.values, 2)
        return replace(memory, keys=keys, values=values, features=turned(memory.features, 1))


@mutant("tokens_are_those_of_the_grid", "of what changes a token comes from its own patch")
class ConvolvesAndRollsRows(StridedConvolutions):
    """Up, against the half patch that these convolutions are off."""

    def ordered(self, x_BVDHW):
        return x_BVDHW.roll(-1, -2)


@mutant("tokens_are_those_of_the_grid", "hardly more than from others")
class PoolsEachView(StridedConvolutions):
    def ordered(self, x_BVDHW):
        return x_BVDHW.mean((-1, -2), keepdim=True).expand_as(x_BVDHW)


@mutant("tokens_are_those_of_the_grid", "`values` does not change")
class IgnoresImages(ChangedEncoder):
    def given(self, views):
        return replace(views, images=0 * views.images)


LATENTS = {"depth": 1, "blocks": (1,), "latents": 5, "latent_depth": 1}


@mutant("project_makes_the_memory_again", "`project` of the memory's own features", **LATENTS)
class ProjectsDoubles(LatentBottleneck):
    def project(self, features, memory):
        return super().project(2 * features, memory)


@mutant("project_makes_the_memory_again", "does not declare `tunable`", **LATENTS)
class ProjectsInSecret(LatentBottleneck):
    tunable = False


@mutant("memo_is_of_the_memory_alone", "depends on a weight")
class SharesItsProjection(Extended, CrossAttention):
    """Keys and values by the weights of whichever layer comes first."""

    def add(self, dims):
        self.core = CrossAttentionCore(dims.width, dims.heads)
        self.kv = nn.Linear(dims.width, 2 * dims.width)

    reads = memory_fields("features")

    def forward(self, state, memory):
        both = memory.once("mutants.kv", lambda: self.kv(memory.features))
        keys, values = (split_heads(x, self.dims.heads) for x in both.chunk(2, -1))
        return self.core(state.features, keys, values)


class ChangedExplanation:
    """Attention whose explanation mutants change."""

    def explain(self, *given):
        return self.told(super().explain(*given).content)


@mutant("explanation_is_a_softmax", "off the softmax")
class ExplainsBySigmoid(ChangedExplanation, ContentSelfAttention):
    def told(self, content):
        return AttentionWeights(content, None, torch.sigmoid(content))


@mutant("updates_are_explained", "of them is unexplained")
class ExplainsTooSharply(ChangedExplanation, ContentCrossAttention):
    def told(self, content):
        return AttentionWeights(content, None, (2 * content).softmax(-1))


@mutant("explanation_is_a_softmax", "content is not finite; put masks into geometry")
class MasksItsContent(ChangedExplanation, ContentSelfAttention):
    def told(self, content):
        content = content.masked_fill(content < content.mean(), -torch.inf)
        return AttentionWeights(content, None, content.softmax(-1))


@mutant("masked_queries_are_not_read", "other queries change")
class IgnoresTheMask(ContentSelfAttention):
    def forward(self, state):
        return self.attention(self.norm(state.features))


@mutant("masked_queries_are_not_judged", "when masked queries and their Gaussians change")
class JudgesWhatIsMasked(Loss):
    renderings = "none"

    def term(self, prediction, rendering, target, inputs):
        return prediction.gaussians.scales.mean()


@mutant("head_gives_gaussians", "gives {'features'}, not None")
class GivesFeaturesUntold(GaussianHead):
    def activate(self, raw):
        return replace(super().activate(raw), features=1 * raw[..., :2])


@mutant("unread_cameras_make_no_difference", "has no attribute 'cameras'")
class ReadsCamerasUntold(MultiViewViT):
    reads_cameras = False


class Changed(ChangedResult, OnePass): ...


@mutant("objective_gives_an_outcome", "has no gradient in the model's parameters")
class DetachesTheTotal(Changed):
    def result(self, outcome):
        return replace(outcome, total=outcome.total.detach())


@mutant("objective_gives_an_outcome", "compared with the sum of terms")
class HidesATerm(Changed):
    def result(self, outcome):
        return replace(outcome, total=2 * outcome.total)


@mutant("objective_repeats", "a second call differs")
class CountsItsJudgements(Changed):
    calls = 0

    def result(self, outcome):
        self.calls += 1
        factor = 1 + 1 / self.calls
        terms = {name: factor * x for name, x in outcome.terms.items()}
        return replace(outcome, total=factor * outcome.total, terms=terms)

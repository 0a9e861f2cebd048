"""Components whose gradients stop or are wrong, or that are not finite for extreme inputs."""

from dataclasses import replace

import torch
from contract_mutants.fields import AtPlaces
from contract_mutants.mutant import mutant
from contract_mutants.slots import ChangedEncoder, OneTerm

from qgs.components import (
    ContentCrossAttention,
    ContentSelfAttention,
    FreeCenters,
    MlpFeedForward,
)
from qgs.contracts import Loss


@mutant("gradients_reach_inputs", "memory.keys, memory.values", also="gradients_match_differences")
class DetachesTheImages(ContentCrossAttention):
    def forward(self, state, memory):
        return self.core(state.features, memory.keys.detach(), memory.values.detach())


@mutant("gradients_reach_inputs", "state.fields.place.center", also="requires_are_read")
class MultipliesAFieldByZero(AtPlaces, ContentSelfAttention):
    def forward(self, state):
        return super().forward(state) + 0 * state["place.center"].sum(-1, keepdim=True)


@mutant("gradients_match_differences", "Jacobian")
class DetachesLaterGaussians(FreeCenters):
    def forward(self, offsets, state):
        first, later = offsets[:, :, :1], offsets[:, :, 1:]
        return super().forward(torch.cat([first, later.detach()], 2), state)


@mutant("terms_have_gradients", "no gradient comes from the term")
class DetachedLoss(OneTerm):
    renderings = "each"

    def term(self, prediction, rendering, target, inputs):
        return (rendering.rgb.detach() - target.images.detach()).square().mean()


@mutant("terms_have_gradients", "from the term contrast")
class HasATermOfTheTargetAlone(Loss):
    renderings = "each"

    def term(self, prediction, rendering, target, inputs):
        error = (rendering.rgb - target.images).square().mean()
        return {"error": error, "contrast": target.images.square().mean()}


@mutant("terms_have_gradients", "from the term brightness")
class HasATermOfTheInputsAlone(Loss):
    renderings = "each"

    def term(self, prediction, rendering, target, inputs):
        error = (rendering.rgb - target.images).square().mean()
        return {"error": error, "brightness": inputs.images.mean()}


@mutant("gradients_match_differences", "in evaluation: Jacobian")
class DetachesASummand(MlpFeedForward):
    def forward(self, features):
        return super().forward(features) + features.square().detach()


@mutant("gradients_match_differences", "in training: Jacobian")
class DetachesASummandInTraining(MlpFeedForward):
    """The same numbers in both modes."""

    def forward(self, features):
        update, squares = super().forward(features), features.square()
        return update + squares.detach() - squares if self.training else update


@mutant(
    "unmet_requirement_fails_at_compose",
    "gradients are not",
    also="batch_independence gradients_match_differences zeros_stay_finite "
    "large_numbers_stay_finite coincident_queries_stay_finite",
)
class TakesARootOfZeroInTraining(MlpFeedForward):
    """Its outputs are finite, its gradients are not."""

    def forward(self, features):
        update = super().forward(features)
        return update + (0 * features).sqrt() if self.training else update


@mutant("zeros_stay_finite", "with zeros, output")
class DividesByLength(MlpFeedForward):
    def forward(self, features):
        return super().forward(features / features.norm(dim=-1, keepdim=True))


@mutant("large_numbers_stay_finite", "with inputs times 1e4, output")
class Exponentiates(MlpFeedForward):
    def forward(self, features):
        return super().forward(features.exp())


@mutant(
    "coincident_queries_stay_finite",
    "with coincident queries",
    # The spread is that around the first query, and zeros coincide.
    also="zeros_stay_finite query_permutation masked_queries_are_not_read",
)
class DividesBySpread(ContentSelfAttention):
    def forward(self, state):
        features = state.features
        spread = (features - features[:, :1]).norm(dim=(1, 2), keepdim=True)
        return super().forward(state.replace(features / spread))


@mutant("points_behind_cameras_stay_finite", "in the centre of a camera", also="zeros_stay_finite")
class DividesByDepth(AtPlaces, ContentSelfAttention):
    def forward(self, state):
        place = state["place.center"]
        return super().forward(state) + place[..., :1] / place[..., 2:]


@mutant(
    "duplicated_view_stays_finite",
    "with a duplicated view",
    also="view_permutation",  # baselines are measured from the first view
)
class DividesByBaseline(ChangedEncoder):
    def given(self, views):
        eyes = views.cameras.c2w[..., :3, 3]
        baseline = (eyes - eyes[:, :1]).norm(dim=-1).sum(1)
        return replace(views, images=views.images / baseline[:, None, None, None, None])

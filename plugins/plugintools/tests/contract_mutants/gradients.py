"""Components whose gradients stop or are wrong, or that are not finite for extreme inputs."""

from dataclasses import replace

from contract_mutants.fields import AtPlaces
from contract_mutants.mutant import mutant
from contract_mutants.slots import ChangedEncoder, OneTerm

from qgs.components import (
    ContentCrossAttention,
    ContentSelfAttention,
    MlpFeedForward,
)


@mutant("gradients_reach_inputs", "memory.keys, memory.values")
class DetachesTheImages(ContentCrossAttention):
    def forward(self, state, memory):
        return self.core(state.features, memory.keys.detach(), memory.values.detach())


@mutant("terms_have_gradients", "no gradient comes from the term")
class DetachedLoss(OneTerm):
    renderings = "each"

    def term(self, prediction, rendering, target, inputs):
        return (rendering.rgb.detach() - target.images.detach()).square().mean()


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


@mutant("zeros_stay_finite", "with zeros, output")
class DividesByLength(MlpFeedForward):
    def forward(self, features):
        return super().forward(features / features.norm(dim=-1, keepdim=True))


@mutant("large_numbers_stay_finite", "with inputs times 1e4, output")
class Exponentiates(MlpFeedForward):
    def forward(self, features):
        return super().forward(features.exp())


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
        return replace(views, images=views.images / baseline[:, None, None, None, None])

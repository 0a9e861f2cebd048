"""`locus/anchor_visibility`: loss that pulls anchors into view if no target view shows them."""

from collections.abc import Iterable

from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor

from qgs.contracts import Loss, Problem, RecipeContext
from qgs.losses import VisibilityOptions, mean_of_gaussians, view_visibility
from qgs.types import LayerPrediction, Rendering, Views
from qgs_locus.fields import CENTER, CENTER_FIELD


class AnchorVisibility(Loss):
    """Mean distance of anchor centres to the image of the nearest target view.

    The distance is relu(|u| - 1) + relu(|v| - 1), at most `clamp`, with the centre's pixel u, v
    scaled to [-1, 1] over the image. A centre inside an image has distance 0. This is equation (8)
    of the plugin's README, computed by `qgs.losses.view_visibility`.
    """

    name = "anchor_visibility"
    reads = CENTER_FIELD
    renderings = "none"

    class Config(VisibilityOptions):
        weight: NonNegativeFloat = 0.1
        """Weight of this loss in the objective."""
        z_guard: PositiveFloat = 1e-3
        """A camera-frame z between -z_guard and z_guard, world units, counts as z_guard in the
        perspective division."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Report options that contradict each other or have no effect."""
        return config.conflicts()

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        # Centres only: an anchor outside of all targets gets no gradient from any image.
        per_anchor = view_visibility(
            prediction.state[CENTER],
            target.cameras,
            clamp=self.config.clamp,
            behind=self.config.behind,
            z_guard=self.config.z_guard,
        )
        return mean_of_gaussians(per_anchor, prediction)

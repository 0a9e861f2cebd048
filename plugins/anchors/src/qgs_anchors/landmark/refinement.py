"""`landmark/refine`: LocusGS's refinement, with steps in radii along the axes of the photo."""

from qgs_locus.fields import RAW_RADIUS, radius_field, support_radius
from qgs_locus.refinement import AnchorRefinement
from torch import Tensor

from qgs.contracts import Fields
from qgs.types import QueryState
from qgs_anchors.landmark.fields import FRAME, FRAME_FIELD, in_world


class FramedRefinement(AnchorRefinement):
    """mu += r step(MLP_mu(x)) in the frame of the anchor's photo, rho += MLP_rho(x).

    An anchor that starts at what a photo sees is off by some radii, mostly in depth, which is the
    same direction for all anchors in their photo's frame.
    """

    name = "refine"

    class Config(AnchorRefinement.Config):
        """See `locus/refine`."""

    config: Config

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        """Frames and radii too where centres are refined."""
        framed = {**FRAME_FIELD, **radius_field(config)} if config.center else {}
        return {**super().fields_read(config), **framed}

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        """Whatever is refined."""
        return super().fields_read(config)

    def center_step(self, state: QueryState) -> Tensor:
        """(B, N, 3), world frame."""
        # Steps in radii: what is far away may move further.
        r_BN1 = support_radius(state[RAW_RADIUS], self.config)
        return in_world(r_BN1 * super().center_step(state), state[FRAME])

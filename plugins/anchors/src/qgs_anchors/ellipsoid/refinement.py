"""`ellipsoid/refine`: update of anchor centres, rotations and radii after each decoder layer."""

from qgs_locus.refinement import AnchorRefinement

from qgs.contracts import Fields, ModelDims
from qgs.types import QueryState
from qgs_anchors.ellipsoid.fields import ROTATION, ROTATION_FIELD, radii_field, turned


class EllipsoidRefinement(AnchorRefinement):
    """Update of anchors as in `locus/refine`, but with three radii, and with a rotation.

    An MLP of the query's features gives the vector by which `turned` rotates the anchor.
    """

    name = "refine"
    parts = ("`center`", "`rotation`", "`radius`")

    class Config(AnchorRefinement.Config):
        rotation: bool = True
        """Update anchor rotations after each decoder layer. With false, they stay unchanged."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        if config.rotation:
            self.rotation_mlp = self._head(3)

    @classmethod
    def radius_field(cls, config: Config) -> Fields:
        """Return the state field of the three raw radii (B, N, 3)."""
        return radii_field(config)

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        return {**super().fields_read(config), **(ROTATION_FIELD if config.rotation else {})}

    def forward(self, state: QueryState) -> QueryState:
        """Return the state with updated centres, rotations and raw radii."""
        refined = super().forward(state)
        if self.config.rotation:
            # The turn is multiplied from the left, so it is about world axes.
            rotation_BN4 = turned(state[ROTATION], self.rotation_mlp(state.features))
            refined = refined.replace(fields={ROTATION: rotation_BN4})
        return refined

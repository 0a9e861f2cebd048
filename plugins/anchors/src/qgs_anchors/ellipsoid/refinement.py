"""`ellipsoid/refine`: updates centres, rotations and radii of anchors after each decoder layer."""

from qgs_locus.refinement import AnchorRefinement

from qgs.contracts import Fields, ModelDims
from qgs.types import QueryState
from qgs_anchors.ellipsoid.fields import ROTATION, ROTATION_FIELD, radii_field, turned


class EllipsoidRefinement(AnchorRefinement):
    """`locus/refine` with three radii (rho += MLP(x)), and R = turn(MLP(x)) R."""

    name = "refine"
    parts = ("`center`", "`rotation`", "`radius`")

    class Config(AnchorRefinement.Config):
        rotation: bool = True
        """Whether rotations are refined."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        if config.rotation:
            self.rotation_mlp = self._head(3)

    @classmethod
    def radius_field(cls, config: Config) -> Fields:
        """The three raw radii."""
        return radii_field(config)

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        """Whatever is refined."""
        return {**super().fields_read(config), **(ROTATION_FIELD if config.rotation else {})}

    def forward(self, state: QueryState) -> QueryState:
        """A state with moved centres, turned rotations and changed raw radii."""
        refined = super().forward(state)
        if self.config.rotation:
            # A small turn multiplied to the left: its axes are those of the world.
            rotation_BN4 = turned(state[ROTATION], self.rotation_mlp(state.features))
            refined = refined.replace(fields={ROTATION: rotation_BN4})
        return refined

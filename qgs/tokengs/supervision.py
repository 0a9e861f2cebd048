"""Supervision of chosen decoder layers (`qgs/layers`), and an objective (`qgs/one_pass`)."""

from collections.abc import Iterable, Mapping, Sequence

from pydantic import Field, field_validator

from qgs.contracts import (
    ComponentConfig,
    Objective,
    Outcome,
    Passes,
    Problem,
    RecipeContext,
    Supervision,
)
from qgs.contracts.settings import rising
from qgs.types import Views


class LayerSupervision(Supervision):
    """Supervision of chosen decoder layers and of the last layer of each feedback round.

    The m-th of all S supervised layers has the weight m / (1 + ... + S) (LocusGS release).
    """

    name = "layers"

    class Config(ComponentConfig):
        layers: tuple[int, ...] = Field(default=(12,), min_length=1)
        """Numbers of the supervised decoder layers, ascending. 1 is the first layer. 0 is the
        initial state of the queries, which is valid only in a decoder of depth 0."""

        @field_validator("layers")
        @classmethod
        def _ascending(cls, layers: tuple[int, ...]) -> tuple[int, ...]:
            return layers if layers == (0,) else rising(layers)

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        depth = context.dims.depth
        missing = [n for n in config.layers if n > depth or (n == 0 and depth)]
        if missing:
            reason = f"layers {missing} do not exist in a decoder of depth {depth}"
            fix = f"choose layers from 1 to {depth}, or raise model.decoder.depth"
            yield Problem("layers", reason, fix if depth else "write [0], the initial queries")

    def weights(self, rounds: Sequence[int] = ()) -> Mapping[int, float]:
        layers = (*self.config.layers, *rounds)
        # They sum to 1, so that the learning rate does not depend on how many there are.
        total = len(layers) * (len(layers) + 1) / 2
        return {number: rank / total for rank, number in enumerate(layers, start=1)}


class OnePass(Objective):
    """Objective with one forward pass: the recipe's losses on a prediction from all input views."""

    name = "one_pass"

    def forward(self, inputs: Views, targets: Views, passes: Passes) -> Outcome:
        return passes.judge(passes.predict(inputs), targets, inputs)

"""Options of feedback in rounds, which run the last decoder layers again."""

from collections.abc import Iterable, Mapping
from typing import ClassVar

import torch
from pydantic import Field, PositiveInt
from torch import Tensor, nn

from qgs.contracts import ComponentConfig, Feedback, ModelDims, Problem, RecipeContext


class RoundsFeedback(Feedback):
    """Base of feedback with a random number of rounds in training.

    marker: learned vector (D,), which `forward` adds to the features of all queries. It tells a
        layer that it runs in a round: the weights are those of the first pass.
    learned: beginning of the names of weights without which feedback has no effect.
    """

    learned: ClassVar[str]

    class Config(ComponentConfig):
        rounds: int = Field(default=2, ge=1, le=16)
        """Number of rounds in evaluation, and the largest number of rounds in a training step."""
        least: PositiveInt = 1
        """Smallest number of rounds in a training step. Each step takes a random number of rounds
        from `least` to `rounds`."""
        layers: PositiveInt = 2
        """Number of decoder layers, counted from the last, that each feedback round runs again."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.rounds = config.rounds
        self.layers = config.layers
        self.marker = nn.Parameter(torch.zeros(dims.width))

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Report too large `layers` or `least`."""
        depth = context.dims.depth
        if config.layers > depth:
            reason = f"a round repeats {config.layers} layers of a decoder of depth {depth}"
            yield Problem("layers", reason, f"write at most {depth}, or raise model.decoder.depth")
        if config.least > config.rounds:
            reason = f"`least` is {config.least}, more than `rounds`, which is {config.rounds}"
            yield Problem("least", reason, f"write at most {config.rounds}, or raise `rounds`")

    def adapted(self, learned: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return weights for this feedback, made from the weights `learned` of another model.

        If that model has no feedback or another kind, the returned weights give renderings no
        effect. Otherwise `learned` is returned unchanged.
        """
        if any(name.startswith(self.learned) for name in learned):
            return dict(learned)
        own = self.state_dict()
        return own | {k: torch.zeros_like(own[k]) for k in own if k.startswith(self.learned)}

    def drawn(self) -> int:
        """Return a random number of rounds, uniformly from `least` to `rounds`."""
        return int(torch.randint(self.config.least, self.config.rounds + 1, ()))

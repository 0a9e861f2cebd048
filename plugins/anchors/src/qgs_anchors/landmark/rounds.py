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
    learned: beginning of the names of weights that this kind of feedback alone has.
    """

    learned: ClassVar[str]

    class Config(ComponentConfig):
        rounds: int = Field(default=2, ge=0, le=16)
        """Number of rounds in evaluation, and the largest number of rounds in a training step. 0,
        the first pass alone, is for evaluation."""
        least: PositiveInt = 1
        """Smallest number of rounds in a training step. Each step takes a random number of rounds
        from `least` to `rounds`; if `least` is larger, each takes `rounds`."""
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
        """Report too large `layers`."""
        depth = context.dims.depth
        if config.layers > depth:
            reason = f"a round repeats {config.layers} layers of a decoder of depth {depth}"
            yield Problem("layers", reason, f"write at most {depth}, or raise model.decoder.depth")

    def adapted(self, learned: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the weights `learned` of another model; `initial` if it has no such feedback."""
        known = any(name.startswith(self.learned) for name in learned)
        return dict(learned) if known else self.initial()

    def initial(self) -> dict[str, Tensor]:
        """Return the weights with which a model starts that was trained without such rounds."""
        return self.state_dict()

    def drawn(self) -> int:
        """Return a random number of rounds, uniformly from `least` to `rounds`."""
        most = self.config.rounds
        return int(torch.randint(min(self.config.least, most), most + 1, ()))

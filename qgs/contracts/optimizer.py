"""Slot `optimizer`: how gradients change the weights, and how fast."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, TypedDict

import torch
from pydantic import Field
from torch import nn

from qgs.contracts.component import Component, ComponentConfig
from qgs.contracts.settings import TrainingConfig


class OptimizerConfig(ComponentConfig):
    """The options of every optimiser."""

    parts: dict[str, Annotated[float, Field(ge=0)]] = Field(default={}, max_length=1000)
    """Parts of the model to factors of the learning rate: `{encoder: 0.1}`; 0 freezes a part. A
    part is a path of the recipe, as in `swap`, or a module or parameter of the model; `*`, `?` and
    `[...]` stand for parts of one segment. It holds for everything below it:
    `decoder.layers.*.cross_attention` is all cross-attention. Of several that match, the last
    counts; one that matches nothing is an error."""


class ParameterGroup(TypedDict):
    """Parameters that are treated alike; a group of torch's optimisers.

    decays: whether weight decay applies. factor: of the learning rate, from `parts`.
    """

    params: list[nn.Parameter]
    decays: bool
    factor: float


class Optimizer(Component):
    """An optimiser of torch with its learning rate.

    Training makes one, calls `build` once, and sets the learning rate of every group of torch's
    optimiser to `learning_rate(...)` times the group's factor before each step. What torch's
    optimiser remembers of the parameters is saved and restored by training.
    """

    slot: ClassVar[str] = "optimizer"

    class Config(OptimizerConfig):
        """No options but `parts`."""

    def __init__(self, config: OptimizerConfig, training: TrainingConfig | None = None) -> None:
        """training: says how long training lasts; ValueError is raised where that does not fit."""
        self.config = config
        self.training = training or TrainingConfig()

    @abstractmethod
    def build(self, groups: Sequence[ParameterGroup]) -> torch.optim.Optimizer:
        """Torch's optimiser of `groups`; groups of its own keep the `factor` of what they hold."""

    @abstractmethod
    def learning_rate(self, step: int, seconds: float) -> float:
        """Rate of the `step`-th optimiser step (0 is the first), `seconds` into training.

        Called with ascending steps.
        """

    def state(self) -> Mapping[str, Any]:
        """JSON values that continue `learning_rate` in another process, where it needs any."""
        return {}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from `state`."""

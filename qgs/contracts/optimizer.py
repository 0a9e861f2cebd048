"""Contract of the slot `optimizer`: the update rule of the weights and its learning rate."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import torch
from pydantic import Field, NonNegativeFloat
from torch import nn

from qgs.contracts.component import Component, ComponentConfig
from qgs.contracts.settings import TrainingConfig


class OptimizerConfig(ComponentConfig):
    """Options of every optimiser."""

    learning_rate: NonNegativeFloat = 4e-4
    """The learning rate: a number, or a schedule such as `{schedule: linear, values: [0, 4.0e-4],
    at: [0, 500]}`."""
    parts: dict[str, NonNegativeFloat] = Field(default={}, max_length=1000)
    """Factors of the learning rate for parts of the model, such as `{encoder: 0.1}`. 0 freezes a
    part. A part is the path of a component in the recipe's `model`, or the name of a module or
    parameter. `*`, `?` and `[...]` match within one segment of a path. A part includes everything
    below it: `decoder.layers.*.cross_attention` is all cross-attention. If several parts match a
    parameter, the last match counts. A part that matches nothing is an error."""


class ParameterGroup(TypedDict):
    """Parameters with equal weight decay and learning rate, as a group of torch's optimisers.

    decays: True if weight decay applies to the parameters.
    factor: factor of their learning rate, from the option `parts`.
    """

    params: list[nn.Parameter]
    decays: bool
    factor: float


class Optimizer(Component):
    """An optimiser of torch with its learning rate.

    Training calls `build` once. Before each step, training sets the learning rate of every group of
    torch's optimiser to `learning_rate(...)` times the group's `factor`. Training saves and
    restores the state of torch's optimiser.

    The kinds of schedules that a recipe can use are in `qgs.tokengs.schedules`.
    """

    slot = "optimizer"
    scheduled = frozenset({"learning_rate"})

    class Config(OptimizerConfig):
        """Options of the optimiser. A subclass may add options to those of every optimiser."""

    def __init__(self, config: OptimizerConfig, training: TrainingConfig | None = None) -> None:
        """Store the options, and `training` with the budget of steps and seconds."""
        self.config = config
        # For use without a recipe, as in tests of a component.
        self.training = training or TrainingConfig()

    def check(self) -> None:
        """Raise ValueError if the options do not fit the training's budget of steps and seconds.

        Loading a recipe calls this method after the constructor.
        """
        return

    @abstractmethod
    def build(self, groups: Sequence[ParameterGroup]) -> torch.optim.Optimizer:
        """Return torch's optimiser for `groups`.

        An override that splits a group must copy the group's `factor` to the new groups.
        """

    def learning_rate(self, step: int, seconds: float) -> float:
        """Return the learning rate of optimiser step `step`, `seconds` into training.

        Step 0 is the first. Training calls this method with ascending steps, after setting `config`
        to the option values of the step. The default returns the option `learning_rate`. An
        override should return this option too if `follows_schedule` is true.
        """
        return self.config.learning_rate

    @property
    def follows_schedule(self) -> bool:
        """True if the recipe has a schedule for `learning_rate`."""
        return "learning_rate" in self.schedules

    def state(self) -> Mapping[str, Any]:
        """Return the values, as JSON, that `learning_rate` needs to continue in another process."""
        return {}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore the values that the method `state` returned in another process."""

"""Contract of the slot `optimizer`: the update rule of the weights and its learning rate."""

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

    learning_rate: float = Field(default=4e-4, ge=0)
    """The learning rate: a number, or a schedule such as `{schedule: linear, values: [0, 4.0e-4],
    at: [0, 500]}`."""
    parts: dict[str, Annotated[float, Field(ge=0)]] = Field(default={}, max_length=1000)
    """Factors of the learning rate for parts of the model, such as `{encoder: 0.1}`. 0 freezes a
    part. A part is a path in the recipe, as in `swap`, or a module or parameter of the model. `*`,
    `?` and `[...]` match within one segment of the path. A part includes everything below it:
    `decoder.layers.*.cross_attention` is all cross-attention. If several match, the last one
    counts. A part that matches nothing is an error."""


class ParameterGroup(TypedDict):
    """Parameters with the same decay and factor; a group of torch's optimisers.

    decays: True if weight decay applies. factor: factor of the learning rate, from `parts`.
    """

    params: list[nn.Parameter]
    decays: bool
    factor: float


class Optimizer(Component):
    """An optimiser of torch with its learning rate.

    Training calls `build` once. Before each step it sets the learning rate of every group of
    torch's optimiser to `learning_rate(...)` times the group's factor. Training also saves and
    restores the state of torch's optimiser.

    The kinds of schedules that a recipe can write are in `qgs.tokengs.schedules`.
    """

    slot: ClassVar[str] = "optimizer"
    scheduled: ClassVar[frozenset[str]] = frozenset({"learning_rate"})

    class Config(OptimizerConfig):
        """Options of this optimiser; by default only the common ones."""

    def __init__(self, config: OptimizerConfig, training: TrainingConfig | None = None) -> None:
        """Store the options and `training`, which has the budget of steps and seconds."""
        self.config = config
        # For use without a recipe, as in tests of a component.
        self.training = training or TrainingConfig()

    def check(self) -> None:
        """Raise ValueError if the options do not fit the budget. Called after the constructor."""
        return

    @abstractmethod
    def build(self, groups: Sequence[ParameterGroup]) -> torch.optim.Optimizer:
        """Return torch's optimiser of `groups`. Groups of its own must keep each `factor`."""

    def learning_rate(self, step: int, seconds: float) -> float:
        """Return the rate of optimiser step `step` (0 is the first), `seconds` into training.

        Called with ascending steps; `config` has the values of this step. The default returns the
        option `learning_rate`. Another rule should do the same if `follows_schedule`.
        """
        return self.config.learning_rate

    @property
    def follows_schedule(self) -> bool:
        """True if the recipe has a schedule for `learning_rate`."""
        return "learning_rate" in self.schedules

    def state(self) -> Mapping[str, Any]:
        """Return the JSON values that `learning_rate` needs to continue in another process."""
        return {}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Continue from `state`."""

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

    learning_rate: float = Field(default=4e-4, ge=0)
    """The learning rate: a number, or a schedule such as `{schedule: linear, values: [0, 4.0e-4],
    at: [0, 500]}`."""
    parts: dict[str, Annotated[float, Field(ge=0)]] = Field(default={}, max_length=1000)
    """Parts of the model to factors of the learning rate: `{encoder: 0.1}`; 0 freezes a part. A
    part is a path of the recipe, as in `swap`, or a module or parameter of the model; `*`, `?` and
    `[...]` stand for parts of one segment. It holds for everything below it:
    `decoder.layers.*.cross_attention` is all cross-attention. Of several that match, the last
    counts; one that matches nothing is an error."""


class ParameterGroup(TypedDict):
    """Parameters with the same decay and factor; a group of torch's optimisers.

    decays: whether weight decay applies. factor: of the learning rate, from `parts`.
    """

    params: list[nn.Parameter]
    decays: bool
    factor: float


class Optimizer(Component):
    """An optimiser of torch with its learning rate.

    Training makes one, calls `build` once, and sets the learning rate of every group of torch's
    optimiser to `learning_rate(...)` times the group's factor before each step. Training saves and
    restores the state of torch's optimiser.

    The kinds of schedules that a recipe can write are in `qgs.tokengs.schedules`.
    """

    slot: ClassVar[str] = "optimizer"
    scheduled: ClassVar[frozenset[str]] = frozenset({"learning_rate"})

    class Config(OptimizerConfig):
        """No options but those of every optimiser."""

    def __init__(self, config: OptimizerConfig, training: TrainingConfig | None = None) -> None:
        """training: its budget of steps and seconds."""
        self.config = config
        # Without a recipe, such as in a test of a component.
        self.training = training or TrainingConfig()

    def check(self) -> None:
        """Raise ValueError where the options do not fit the budget; called once it is built."""
        return

    @abstractmethod
    def build(self, groups: Sequence[ParameterGroup]) -> torch.optim.Optimizer:
        """Torch's optimiser of `groups`; groups of its own keep the `factor` of what they hold."""

    def learning_rate(self, step: int, seconds: float) -> float:
        """Rate of the `step`-th optimiser step (0 is the first), `seconds` into training.

        Called with ascending steps, `config` at this step's values. By default the option
        `learning_rate`; another rule should leave it so where `follows_schedule`.
        """
        return self.config.learning_rate

    @property
    def follows_schedule(self) -> bool:
        """Return whether the recipe writes a schedule for `learning_rate`."""
        return "learning_rate" in self.schedules

    def state(self) -> Mapping[str, Any]:
        """JSON values that `learning_rate` needs to continue in another process."""
        return {}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from `state`."""

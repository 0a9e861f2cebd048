"""Components that change their inputs or themselves, or draw random numbers where they must not."""

import random
from typing import Any, ClassVar

import torch
from contract_mutants.fields import PLACE
from contract_mutants.mutant import mutant

from qgs.components import FreeCenters, MlpFeedForward
from qgs.contracts import Refinement


@mutant(
    "inputs_are_not_changed",
    "the inputs differ: offsets",
    # It takes the data out of the graph, and clamps what a second pass is compared with.
    also="gradients_reach_inputs geometry_is_float32_under_autocast",
)
class ClampsItsInputInPlace(FreeCenters):
    def forward(self, offsets, state):
        return super().forward(offsets.data.clamp_(-0.1, 0.1), state)


@mutant(
    "inputs_are_not_changed",
    "forward pass in training",
    also="gradients_match_differences forward_keeps_no_state",
)
class ScalesItsInputInPlaceInTraining(MlpFeedForward):
    def forward(self, features):
        if self.training:
            features.data.mul_(0.5)
        return super().forward(features)


@mutant("outputs_share_no_memory", "in the memory of `features`", also="parameters_learn")
class ReturnsItsInput(MlpFeedForward):
    def forward(self, features):
        return features.view_as(features)


@mutant("outputs_share_no_memory", "in the memory of `home`")
class ReturnsItsBuffer(Refinement):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.register_buffer("home", torch.zeros(1, 1, 3))

    @classmethod
    def fields_written(cls, config):
        return PLACE

    def forward(self, state):
        home = self.get_buffer("home").expand(*state.features.shape[:2], 3)
        return state.replace(fields={"place.center": home})


@mutant("forward_keeps_no_state", "changes calls")
class CountsItsCalls(MlpFeedForward):
    calls = 0

    def forward(self, features):
        self.calls += 1
        return super().forward(features)


@mutant("forward_keeps_no_state", "changes _cache")
class CachesByShape(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        self._cache: dict[tuple[int, ...], torch.Tensor] = {}

    def forward(self, features):
        zeros = self._cache.setdefault(tuple(features.shape), torch.zeros_like(features))
        return super().forward(features) + zeros


@mutant("forward_keeps_no_state", "changes LogsInItsClass._log")
class LogsInItsClass(MlpFeedForward):
    """Its attribute is of the same length each time, but not the same."""

    _log: ClassVar[dict[str, Any]] = {"last": [0.0]}

    def forward(self, features):
        self._log["last"][0] += 1.0
        return super().forward(features)


@mutant("forward_keeps_no_state", "changes the state: seen")
class AveragesItsInputs(MlpFeedForward):
    """A buffer that is not saved follows what was seen."""

    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.register_buffer("seen", torch.zeros(dims.width), persistent=False)

    def forward(self, features):
        with torch.no_grad():
            self.seen += features.mean((0, 1)).to(self.seen)
        return super().forward(features)


@mutant("forward_keeps_no_state", "another one differs")
class ScalesByItsFirstInput(MlpFeedForward):
    """Keeps a number in a closure, which no attribute shows."""

    def __init__(self, config, dims):
        super().__init__(config, dims)
        kept: list[float] = []

        def first(x: torch.Tensor) -> float:
            if not kept and x.device.type != "meta":
                kept.append(x.detach().mean().item())
            return kept[0] if kept else 0.0

        self.first = first

    def forward(self, features):
        return super().forward(features) + self.first(features)


@mutant(
    "eval_repeats_bitwise",
    "the second time output",
    also="query_permutation strides_make_no_difference saved_weights_load",
)
class AddsNoise(MlpFeedForward):
    def forward(self, features):
        return super().forward(features) + 0.01 * torch.randn_like(features)


@mutant("eval_repeats_bitwise", "draws from torch's")
class DrawsInEvaluation(MlpFeedForward):
    def forward(self, features):
        torch.rand(1)
        return super().forward(features)


@mutant("training_draws_from_torch", "torch is in one state")
class SeedsInTraining(MlpFeedForward):
    def forward(self, features):
        if self.training:
            torch.manual_seed(0)
        return super().forward(features)


NO_TWO_AGREE = "batch_independence gradients_match_differences forward_keeps_no_state"
"""Checks that compare two training passes."""


@mutant("training_draws_from_torch", "numpy's or random's", also=NO_TWO_AGREE)
class DropsByPythonsRandom(MlpFeedForward):
    def forward(self, features):
        update = super().forward(features)
        return update * random.random() if self.training else update


@mutant("training_draws_from_torch", "from one seed differ", also=NO_TWO_AGREE)
class DropsByItsOwnGenerator(MlpFeedForward):
    def forward(self, features):
        update = super().forward(features)
        if not self.training:
            return update
        generator = torch.Generator()
        generator.seed()
        return update * torch.rand(update.shape, generator=generator).to(update)

"""Components that change their inputs or themselves, or draw random numbers where they must not."""

import random

import torch
from contract_mutants.mutant import mutant

from qgs.components import FreeCenters, MlpFeedForward


@mutant("inputs_are_not_changed", "the inputs differ: offsets")
class ClampsItsInputInPlace(FreeCenters):
    def forward(self, offsets, state):
        return super().forward(offsets.data.clamp_(-0.1, 0.1), state)


@mutant("outputs_share_no_memory", "in the memory of `features`")
class ReturnsItsInput(MlpFeedForward):
    def forward(self, features):
        return features.view_as(features)


@mutant("forward_keeps_no_state", "changes _cache")
class CachesByShape(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        self._cache: dict[tuple[int, ...], torch.Tensor] = {}

    def forward(self, features):
        zeros = self._cache.setdefault(tuple(features.shape), torch.zeros_like(features))
        return super().forward(features) + zeros


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


@mutant("eval_repeats_bitwise", "the second time output")
class AddsNoise(MlpFeedForward):
    def forward(self, features):
        return super().forward(features) + 0.01 * torch.randn_like(features)


@mutant("training_draws_from_torch", "torch is in one state")
class SeedsInTraining(MlpFeedForward):
    def forward(self, features):
        if self.training:
            torch.manual_seed(0)
        return super().forward(features)


@mutant("training_draws_from_torch", "numpy's or random's")
class DropsByPythonsRandom(MlpFeedForward):
    def forward(self, features):
        update = super().forward(features)
        return update * random.random() if self.training else update

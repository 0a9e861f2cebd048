"""Components that are sound in evaluation, and break one promise as soon as they are trained."""

from __future__ import annotations

import random
from typing import Any, ClassVar

import numpy
import torch
from torch import Tensor, nn

from qgs.components import MlpFeedForward
from qgs.contracts import ModelDims


class BatchNormed(MlpFeedForward):
    """Normalises by statistics of all scenes in training, by those that it has seen later."""

    name: ClassVar[str] = "batch_normed"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.statistics = nn.BatchNorm1d(dims.width)

    def forward(self, features: Tensor) -> Tensor:
        return self.statistics(super().forward(features).transpose(1, 2)).transpose(1, 2)


class CentresOnTheBatch(MlpFeedForward):
    """A mean over scenes that no gradient shows."""

    name: ClassVar[str] = "centres_on_the_batch"

    def forward(self, features: Tensor) -> Tensor:
        update = super().forward(features)
        return update - update.detach().mean(0) if self.training else update


class MutatesInTraining(MlpFeedForward):
    name: ClassVar[str] = "mutates_in_training"

    def forward(self, features: Tensor) -> Tensor:
        if self.training:
            features.data.mul_(0.5)
        return super().forward(features)


class CountsInTraining(MlpFeedForward):
    name: ClassVar[str] = "counts_in_training"
    _steps = 0

    def forward(self, features: Tensor) -> Tensor:
        if self.training:
            self._steps += 1
        return super().forward(features)


class SeedsInTraining(MlpFeedForward):
    name: ClassVar[str] = "seeds_in_training"

    def forward(self, features: Tensor) -> Tensor:
        if self.training:
            torch.manual_seed(0)
        return super().forward(features)


class DropsByNumpy(MlpFeedForward):
    name: ClassVar[str] = "drops_by_numpy"

    def forward(self, features: Tensor) -> Tensor:
        update = super().forward(features)
        return update * numpy.random.rand() if self.training else update


class DropsByPython(MlpFeedForward):
    name: ClassVar[str] = "drops_by_python"

    def forward(self, features: Tensor) -> Tensor:
        update = super().forward(features)
        return update * random.random() if self.training else update


class DropsByItsOwnGenerator(MlpFeedForward):
    """Chance that no seed of a training repeats."""

    name: ClassVar[str] = "drops_by_its_own_generator"

    def forward(self, features: Tensor) -> Tensor:
        update = super().forward(features)
        if not self.training:
            return update
        generator = torch.Generator()
        generator.seed()
        return update * torch.rand(update.shape, generator=generator).to(update)


class KeepsACache(MlpFeedForward):
    name: ClassVar[str] = "keeps_a_cache"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self._cache: dict[tuple[int, ...], Tensor] = {}

    def forward(self, features: Tensor) -> Tensor:
        zeros = self._cache.setdefault(tuple(features.shape), torch.zeros_like(features))
        return super().forward(features) + zeros


class KeepsALog(MlpFeedForward):
    """What its class keeps is of the same length each time, and still not the same."""

    name: ClassVar[str] = "keeps_a_log"
    _log: ClassVar[dict[str, Any]] = {"last": [0.0]}

    def forward(self, features: Tensor) -> Tensor:
        self._log["last"][0] += 1.0
        return super().forward(features)


class SmoothsItsNoise(MlpFeedForward):
    """A buffer that is in no state dict follows what was seen."""

    name: ClassVar[str] = "smooths_its_noise"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.register_buffer("seen", torch.zeros(dims.width), persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        with torch.no_grad():
            self.seen += features.mean((0, 1)).to(self.seen)
        return super().forward(features)

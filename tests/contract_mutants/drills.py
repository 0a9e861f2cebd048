"""Components that keep their promises in evaluation, and break them in training."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from torch import Tensor

from qgs.components import ContentSelfAttention, GaussianHead, MlpFeedForward
from qgs.types import GaussianAttributes, QueryState


class LongQuaternionsInTraining(GaussianHead):
    name: ClassVar[str] = "long_quaternions_in_training"

    def forward(self, state: QueryState) -> GaussianAttributes:
        out = super().forward(state)
        return replace(out, quats=2 * out.quats) if self.training else out


class DividesByLengthInTraining(MlpFeedForward):
    name: ClassVar[str] = "divides_by_length_in_training"

    def forward(self, features: Tensor) -> Tensor:
        if self.training:
            features = features / features.norm(dim=-1, keepdim=True)
        return super().forward(features)


class LosesAQueryInTraining(ContentSelfAttention):
    """Of more than eight."""

    name: ClassVar[str] = "loses_a_query_in_training"

    def forward(self, state: QueryState) -> Tensor:
        update = super().forward(state)
        return update[:, 1:] if self.training and update.shape[1] > 8 else update

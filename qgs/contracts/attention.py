"""What an attention component can tell about itself."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class AttentionWeights:
    """Attention of chosen queries, for looking inside.

    content: (B, h, Q, T) logits of content alone. geometry: (B, 1, Q, T) what geometry adds to
    them, None where nothing is added. weights: (B, h, Q, T) the softmax of their sum.
    """

    content: Tensor
    geometry: Tensor | None
    weights: Tensor

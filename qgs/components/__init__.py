"""The default components: TokenGS, one file per slot."""

from qgs.components.blocks import NORM_EPS, CrossAttentionCore, LayerScale, Mlp, SelfAttentionCore
from qgs.components.centers import FreeCenters, OffsetCenters, posact
from qgs.components.decoder import (
    ContentCrossAttention,
    ContentSelfAttention,
    CrossSelfMlp,
    MlpFeedForward,
    NoFeedback,
    NoRefinement,
)
from qgs.components.encoder import MultiViewViT
from qgs.components.head import GaussianHead
from qgs.components.optimizer import OneCycleAdamW
from qgs.components.queries import LatentQueries
from qgs.components.supervision import LayerSupervision, OnePass
from qgs.contracts import Component

COMPONENTS: tuple[type[Component], ...] = (
    MultiViewViT,
    LatentQueries,
    CrossSelfMlp,
    ContentCrossAttention,
    ContentSelfAttention,
    MlpFeedForward,
    NoRefinement,
    NoFeedback,
    GaussianHead,
    FreeCenters,
    OffsetCenters,
    LayerSupervision,
    OnePass,
    OneCycleAdamW,
)

__all__ = [
    "COMPONENTS",
    "NORM_EPS",
    "ContentCrossAttention",
    "ContentSelfAttention",
    "CrossAttentionCore",
    "CrossSelfMlp",
    "FreeCenters",
    "GaussianHead",
    "LatentQueries",
    "LayerScale",
    "LayerSupervision",
    "Mlp",
    "MlpFeedForward",
    "MultiViewViT",
    "NoFeedback",
    "NoRefinement",
    "OffsetCenters",
    "OneCycleAdamW",
    "OnePass",
    "SelfAttentionCore",
    "posact",
]

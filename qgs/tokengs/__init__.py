"""The default components, which are those of TokenGS, in one file for each slot."""

from qgs.contracts import Component
from qgs.tokengs.blocks import (
    NORM_EPS,
    CrossAttentionCore,
    LayerScale,
    Mlp,
    NormConfig,
    SelfAttentionCore,
)
from qgs.tokengs.decoder import (
    ContentCrossAttention,
    ContentSelfAttention,
    CrossSelfMlp,
    LatentQueries,
    MlpFeedForward,
    NoFeedback,
    NoRefinement,
)
from qgs.tokengs.encoder import MultiViewViT
from qgs.tokengs.head import FreeCenters, GaussianHead, LinearHead, OffsetCenters, posact
from qgs.tokengs.optimizer import OneCycleAdamW
from qgs.tokengs.supervision import LayerSupervision, OnePass

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
    "LinearHead",
    "Mlp",
    "MlpFeedForward",
    "MultiViewViT",
    "NoFeedback",
    "NoRefinement",
    "NormConfig",
    "OffsetCenters",
    "OneCycleAdamW",
    "OnePass",
    "SelfAttentionCore",
    "posact",
]

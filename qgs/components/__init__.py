"""The default components: TokenGS, one file per slot."""

from qgs.components.blocks import NORM_EPS, CrossAttentionCore, LayerScale, Mlp, SelfAttentionCore
from qgs.components.centers import FreeCenters, OffsetCenters, posact
from qgs.components.decoder import (
    ContentCrossAttention,
    ContentSelfAttention,
    CrossSelfMlp,
    MlpFeedForward,
    NoRefinement,
)
from qgs.components.dynamic import BlockCausalSelfAttention, DynamicObjective, DynamicQueries
from qgs.components.encoder import MultiViewViT
from qgs.components.head import GaussianHead
from qgs.components.latents import LatentBottleneck
from qgs.components.multiscale import MultiscaleViT
from qgs.components.objective import OnePass
from qgs.components.optimizer import OneCycleAdamW
from qgs.components.queries import LatentQueries
from qgs.components.supervision import LayerSupervision
from qgs.components.weights import TOKENGS
from qgs.contracts import Component
from qgs.kernels.attention_bias import AttentionBias, Kernel

COMPONENTS: tuple[type[Component], ...] = (
    MultiViewViT,
    MultiscaleViT,
    LatentBottleneck,
    LatentQueries,
    DynamicQueries,
    CrossSelfMlp,
    BlockCausalSelfAttention,
    DynamicObjective,
    ContentCrossAttention,
    ContentSelfAttention,
    MlpFeedForward,
    NoRefinement,
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
    "TOKENGS",
    "AttentionBias",
    "BlockCausalSelfAttention",
    "ContentCrossAttention",
    "ContentSelfAttention",
    "CrossAttentionCore",
    "CrossSelfMlp",
    "DynamicObjective",
    "DynamicQueries",
    "FreeCenters",
    "GaussianHead",
    "Kernel",
    "LatentBottleneck",
    "LatentQueries",
    "LayerScale",
    "LayerSupervision",
    "Mlp",
    "MlpFeedForward",
    "MultiViewViT",
    "MultiscaleViT",
    "NoRefinement",
    "OffsetCenters",
    "OneCycleAdamW",
    "OnePass",
    "SelfAttentionCore",
    "posact",
]

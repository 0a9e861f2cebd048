"""The contracts: one abstract class per slot, and what all components share."""

from qgs.contracts.attention import AttentionWeights
from qgs.contracts.centers import Centers
from qgs.contracts.component import (
    Component,
    ComponentConfig,
    Fields,
    FieldSpec,
    ModelComponent,
    ModelDims,
    OptionError,
    Problem,
    RecipeContext,
    component_of,
    without_effect,
)
from qgs.contracts.cross_attention import CrossAttention
from qgs.contracts.data import Scene, SceneSource, SceneSourceConfig, Split
from qgs.contracts.encoder import MEMORY_FIELDS, Encoder
from qgs.contracts.feed_forward import FeedForward
from qgs.contracts.head import Head
from qgs.contracts.layout import LayoutError, Rename, Unused, WeightLayout
from qgs.contracts.loss import Loss
from qgs.contracts.plugin import (
    CONTRACT_VERSION,
    ENTRY_POINT_GROUP,
    Expected,
    ExpectedError,
    Plugin,
)
from qgs.contracts.queries import Queries
from qgs.contracts.refinement import Refinement
from qgs.contracts.renderer import Renderer, RendererConfig
from qgs.contracts.self_attention import SelfAttention
from qgs.contracts.settings import EvaluationConfig, TrainingConfig, ViewsConfig
from qgs.contracts.supervision import Supervision

__all__ = [
    "CONTRACT_VERSION",
    "ENTRY_POINT_GROUP",
    "MEMORY_FIELDS",
    "AttentionWeights",
    "Centers",
    "Component",
    "ComponentConfig",
    "CrossAttention",
    "Encoder",
    "EvaluationConfig",
    "Expected",
    "ExpectedError",
    "FeedForward",
    "FieldSpec",
    "Fields",
    "Head",
    "LayoutError",
    "Loss",
    "ModelComponent",
    "ModelDims",
    "OptionError",
    "Plugin",
    "Problem",
    "Queries",
    "RecipeContext",
    "Refinement",
    "Rename",
    "Renderer",
    "RendererConfig",
    "Scene",
    "SceneSource",
    "SceneSourceConfig",
    "SelfAttention",
    "Split",
    "Supervision",
    "TrainingConfig",
    "Unused",
    "ViewsConfig",
    "WeightLayout",
    "component_of",
    "without_effect",
]

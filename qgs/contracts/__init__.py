"""Contracts: an abstract class for each slot of a recipe, and the base of all components."""

from qgs.contracts.component import (
    Component,
    ComponentConfig,
    Fields,
    FieldSpec,
    MissingExtraError,
    ModelComponent,
    ModelDims,
    OptionError,
    Problem,
    RecipeContext,
    without_effect,
)
from qgs.contracts.data import (
    Frames,
    Scene,
    SceneSource,
    SceneSourceConfig,
    Split,
    ViewSampler,
    Window,
)
from qgs.contracts.decoder import (
    LAYER_SLOTS,
    SUBLAYER_SLOTS,
    AttentionWeights,
    CrossAttention,
    Decode,
    DecoderLayer,
    Feedback,
    FeedForward,
    LayerParts,
    Refinement,
    Render,
    SelfAttention,
)
from qgs.contracts.encoder import MEMORY_FIELDS, Encoder, PatchEncoder, memory_fields
from qgs.contracts.head import GAUSSIAN_FIELDS, Centers, Head
from qgs.contracts.loss import Loss, Supervision
from qgs.contracts.metric import Column, Metric, MetricInput
from qgs.contracts.objective import Objective, Outcome, Passes
from qgs.contracts.optimizer import Optimizer, OptimizerConfig, ParameterGroup
from qgs.contracts.plugin import CONTRACT_VERSION, Plugin
from qgs.contracts.queries import LearnedQueries, Queries
from qgs.contracts.renderer import Renderer, RendererConfig
from qgs.contracts.settings import Ascending, EvaluationConfig, TrainingConfig, ViewsConfig

__all__ = [
    "CONTRACT_VERSION",
    "GAUSSIAN_FIELDS",
    "LAYER_SLOTS",
    "MEMORY_FIELDS",
    "SUBLAYER_SLOTS",
    "Ascending",
    "AttentionWeights",
    "Centers",
    "Column",
    "Component",
    "ComponentConfig",
    "CrossAttention",
    "Decode",
    "DecoderLayer",
    "Encoder",
    "EvaluationConfig",
    "FeedForward",
    "Feedback",
    "FieldSpec",
    "Fields",
    "Frames",
    "Head",
    "LayerParts",
    "LearnedQueries",
    "Loss",
    "Metric",
    "MetricInput",
    "MissingExtraError",
    "ModelComponent",
    "ModelDims",
    "Objective",
    "Optimizer",
    "OptimizerConfig",
    "OptionError",
    "Outcome",
    "ParameterGroup",
    "Passes",
    "PatchEncoder",
    "Plugin",
    "Problem",
    "Queries",
    "RecipeContext",
    "Refinement",
    "Render",
    "Renderer",
    "RendererConfig",
    "Scene",
    "SceneSource",
    "SceneSourceConfig",
    "SelfAttention",
    "Split",
    "Supervision",
    "TrainingConfig",
    "ViewSampler",
    "ViewsConfig",
    "Window",
    "memory_fields",
    "without_effect",
]

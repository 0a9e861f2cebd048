"""The sections of a recipe: their settings, and what else may stand beside these."""

from collections.abc import Mapping
from typing import Any

from pydantic import Field

from qgs.contracts import (
    LAYER_SLOTS,
    ComponentConfig,
    EvaluationConfig,
    ModelDims,
    TrainingConfig,
    ViewsConfig,
)
from qgs.recipe.decode import decode_config
from qgs.recipe.errors import Problems, did_you_mean
from qgs.recipe.slots import MODEL_SLOTS, SECTIONS
from qgs.recipe.yaml_text import KeyPath, MapNode, kind_of


class ModelSettings(ComponentConfig):
    """The model: sizes that all of its components share."""

    width: int = Field(default=1024, ge=1, le=65_536)
    """Features of a token and of a query (D in the papers)."""
    heads: int = Field(default=16, ge=1)
    """Attention heads (h in the papers), a divisor of the width."""


class DecoderSettings(ComponentConfig):
    """The decoder, but for the components of its layers."""

    depth: int = Field(default=12, ge=0, le=256)
    """Number of layers (L in the papers); 0 decodes the queries as they start."""
    layer_scale: float = Field(default=5e-5, gt=0)
    """Initial LayerScale of every sublayer (TokenGS release)."""


class RecipeSettings(ComponentConfig):
    """Settings at the top of a recipe."""

    recipe: int = Field(ge=1, le=1)
    """Version of the recipe format."""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Of the model's initial parameters and of training."""
    init_from: str | None = None
    """Checkpoint whose weights training starts from, its queries made as many as this recipe has
    (LocusGS release: finetuning); null to start from the initial parameters."""


SETTINGS: dict[KeyPath, type[ComponentConfig]] = {
    (): RecipeSettings,
    ("model",): ModelSettings,
    ("model", "decoder"): DecoderSettings,
    ("views",): ViewsConfig,
    ("training",): TrainingConfig,
    ("evaluation",): EvaluationConfig,
}
_BESIDE: dict[KeyPath, tuple[str, ...]] = {
    (): ("plugins", "swap", "model", *SECTIONS, "views", "training", "evaluation"),
    ("model",): (*MODEL_SLOTS, "decoder"),
    ("model", "decoder"): (*LAYER_SLOTS, "layers"),
}
"""Keys that stand beside the settings of a section."""
_KEYS = {path: {*SETTINGS[path].model_fields, *keys} for path, keys in _BESIDE.items()}
_LAYERS: KeyPath = ("model", "decoder", "layers")
_NAMED = [(name,) for name, section in SECTIONS.items() if section.named]
_MAPPINGS: set[KeyPath] = {("swap",), _LAYERS, *SETTINGS, *_NAMED}


def dims_of(settings: Mapping[KeyPath, Any]) -> ModelDims:
    """Width, heads and depth."""
    model = settings["model",]
    return ModelDims(model.width, model.heads, settings["model", "decoder"].depth)


def check_keys(tree: MapNode, problems: Problems, path: KeyPath = ()) -> MapNode:
    """Report unknown keys and sections that are no mappings; the tree without them."""
    # Options of components are checked where their Config is known.
    known = {*LAYER_SLOTS} if path[:-1] == _LAYERS else _KEYS.get(path)
    checked = MapNode(tree.origin)
    for key, node, origin in tree.entries():
        below = (*path, key)
        if known is not None and key not in known:
            # A key that stands somewhere else is no typing error: name its section.
            homes = [".".join((*home, key)) for home, keys in _KEYS.items() if key in keys]
            fix = f"did you mean `{homes[0]}`?" if homes else did_you_mean(key, known, "keys")
            problems.add(origin, below, f"there is no key `{key}` here", fix)
        elif below not in _MAPPINGS and path != _LAYERS:
            checked.put(key, node, origin)
        elif isinstance(node, MapNode):
            checked.put(key, check_keys(node, problems, below), origin)
        elif node is not None:
            reason = f"`{key}` is a mapping, this is {kind_of(node)}"
            fix = f"write `key: value` lines below `{key}:`"
            problems.add(origin, below, reason, fix)
    return checked


def decode_settings(tree: MapNode, problems: Problems) -> tuple[dict[KeyPath, Any], bool]:
    """Settings by section, defaults for one with problems; whether the model's sizes are valid."""
    settings: dict[KeyPath, Any] = {}
    sizes_known = True
    for path, config in SETTINGS.items():
        written = tree.child(*path).without(*_BESIDE.get(path, ()))
        found = decode_config(config, written, path, problems)
        # Go on with defaults, so that problems of other sections are reported as well.
        settings[path] = found or config.model_construct()
        sizes_known &= bool(found) or path[:1] != ("model",)
    dims = dims_of(settings)
    if dims.width % dims.heads:
        reason = f"{dims.heads} heads do not divide the width {dims.width}"
        fix = f"set model.heads to a divisor of {dims.width}"
        origin = tree.child("model").origin_of("heads", "width")
        problems.add(origin, "model.heads", reason, fix)
    return settings, sizes_known

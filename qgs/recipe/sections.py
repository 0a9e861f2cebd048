"""The sections of a recipe, and a draft: components chosen, not yet checked beside each other."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import Field, ValidationInfo, field_validator

from qgs.contracts import (
    LAYER_SLOTS,
    ComponentConfig,
    EvaluationConfig,
    ModelDims,
    OptionError,
    Plugin,
    TrainingConfig,
    ViewsConfig,
)
from qgs.recipe.decode import Parts, decode_config, decode_place
from qgs.recipe.errors import Origin, Problems, nearest
from qgs.recipe.files import merge
from qgs.recipe.places import apply_swaps, expand
from qgs.recipe.registry import Registry, load_plugins
from qgs.recipe.slots import MODEL_SLOTS, SECTIONS
from qgs.recipe.yaml_text import KeyPath, MapNode, brief, from_plain
from qgs.wording import listed


class ModelSettings(ComponentConfig):
    """The model: sizes that all of its components share."""

    width: int = Field(default=1024, ge=1, le=65_536)
    """Features of a token and of a query (D in the papers)."""
    heads: int = Field(default=16, ge=1, validate_default=True)
    """Attention heads (h in the papers), a divisor of the width."""

    @field_validator("heads")
    @classmethod
    def _divides_the_width(cls, heads: int, info: ValidationInfo) -> int:
        # A width that is refused itself is not among the data.
        width = info.data.get("width", heads)
        if width % heads:
            reason = f"{heads} heads do not divide the width {width}"
            raise OptionError(reason, f"set model.heads to a divisor of {width}")
        return heads


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
    plugins: tuple[str, ...] | None = ()
    """Plugins whose components the recipe may name."""


SETTINGS: dict[KeyPath, type[ComponentConfig]] = {
    (): RecipeSettings,
    ("model",): ModelSettings,
    ("model", "decoder"): DecoderSettings,
    ("views",): ViewsConfig,
    ("training",): TrainingConfig,
    ("evaluation",): EvaluationConfig,
}
_BESIDE: dict[KeyPath, tuple[str, ...]] = {
    (): ("swap", "model", *SECTIONS, "views", "training", "evaluation"),
    ("model",): (*MODEL_SLOTS, "decoder"),
    ("model", "decoder"): (*LAYER_SLOTS, "layers"),
}
"""Keys that stand beside the settings of a section."""
_KEYS = {path: {*SETTINGS[path].model_fields, *keys} for path, keys in _BESIDE.items()}
_HOMES = {key: ".".join((*path, key)) for path, keys in _KEYS.items() for key in keys}
_LAYERS: KeyPath = ("model", "decoder", "layers")
_NAMED = [(name,) for name, section in SECTIONS.items() if section.named]
_MAPPINGS: set[KeyPath] = {("swap",), _LAYERS, *SETTINGS, *_NAMED}


def check_keys(tree: MapNode, problems: Problems, path: KeyPath = ()) -> MapNode:
    """Report unknown keys and sections that are no mappings; the tree without them."""
    # Options of components are checked where their Config is known.
    known = LAYER_SLOTS if path[:-1] == _LAYERS else _KEYS.get(path)
    checked = MapNode(tree.origin)
    for key, node, origin in tree.entries():
        below = (*path, key)
        if known is not None and key not in known:
            # A key that stands somewhere else is no typing error: name its section.
            near = nearest(key, _HOMES)
            fix = f"did you mean `{_HOMES[near]}`?" if near else f"keys: {listed(sorted(known))}"
            problems.add(origin, below, f"there is no key `{key}` here", fix)
        elif below not in _MAPPINGS and path != _LAYERS:
            checked.put(key, node, origin)
        elif isinstance(node, MapNode):
            checked.put(key, check_keys(node, problems, below), origin)
        elif node is not None:
            reason = f"`{key}` is a mapping, this is {brief(node)}"
            fix = f"write `key: value` lines below `{key}:`"
            problems.add(origin, below, reason, fix)
    return checked


def decode_settings(tree: MapNode, problems: Problems) -> dict[KeyPath, Any]:
    """Settings by section, defaults for one with problems."""
    settings: dict[KeyPath, Any] = {}
    for path, config in SETTINGS.items():
        written = tree.child(*path).without(*_BESIDE.get(path, ()))
        # Go on with defaults, so that problems of other sections are reported as well.
        settings[path] = decode_config(config, written, path, problems) or config.model_construct()
    return settings


@dataclass(frozen=True)
class Draft:
    """A recipe that has been read.

    tree: all files and overrides merged, with the default losses and metrics. settings: of each
    section. parts: what stands at each place, decoder layers numbered.
    """

    tree: MapNode
    settings: Mapping[KeyPath, Any]
    registry: Registry
    parts: Parts

    @property
    def dims(self) -> ModelDims:
        """Width, heads and depth of the model."""
        model = self.settings["model",]
        return ModelDims(model.width, model.heads, self.settings["model", "decoder"].depth)


def draft_of(written: MapNode, problems: Problems, plugins: Sequence[Plugin]) -> Draft:
    """Choose the components of a merged recipe; raises RecipeError with all that it finds.

    plugins: those that it may name although they are not installed.
    """
    # Under what is written: `losses: {}` has none, a recipe without `losses` the default ones.
    tree = _with_defaults(check_keys(written, problems))
    settings = decode_settings(tree, problems)
    registry = load_plugins(settings[()].plugins or (), tree, problems, plugins)
    expanded = expand(tree, settings["model", "decoder"].depth, problems)
    places = apply_swaps(tree.child("swap"), expanded, problems)
    found = [decode_place(place, registry, problems) for place in places.values()]
    # Components that are not known cannot be checked beside each other.
    problems.raise_any()
    return Draft(tree, settings, registry, {part.path: part for part in found if part})


def _with_defaults(tree: MapNode) -> MapNode:
    """`tree` with the default components of sections such as `losses` under what is written."""
    missing = {
        name: {key: {"type": kind} for key, kind in section.defaults.items()}
        for name, section in SECTIONS.items()
        if section.named and (section.defaults_stay or name not in tree)
    }
    return merge(from_plain(missing, Origin("default")), tree)

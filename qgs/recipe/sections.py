"""Sections of a recipe, and drafts: recipes before the check that their components fit together."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field, PositiveFloat, WithJsonSchema, create_model

from qgs.contracts import (
    LAYER_SLOTS,
    ComponentConfig,
    EvaluationConfig,
    ModelDims,
    Plugin,
    TrainingConfig,
    ViewsConfig,
)
from qgs.contracts.settings import Heads
from qgs.recipe.decode import Parts, decode_place, report, validated
from qgs.recipe.errors import Origin, Problems
from qgs.recipe.files import merge
from qgs.recipe.places import apply_swaps, expand
from qgs.recipe.registry import Registry, load_plugins
from qgs.recipe.slots import AFTER_LAYERS, SECTIONS, SLOTS, summary_of
from qgs.recipe.yaml_text import KeyPath, MapNode, find, from_plain


class ModelSettings(ComponentConfig):
    """Sizes that all components of the model share."""

    width: int = Field(default=1024, ge=1, le=65_536)
    """Number of features of a token and of a query (D in the papers)."""
    heads: Heads = 16
    """Number of attention heads (h in the papers). It must divide the width."""


class DecoderSettings(ComponentConfig):
    """Settings of the decoder, apart from the components of its layers."""

    depth: int = Field(default=12, ge=0, le=256)
    """Number of layers (L in the papers). With 0, the head decodes the initial queries."""
    layer_scale: PositiveFloat = 5e-5
    """Initial value of LayerScale, the learned factor on each sublayer's output. The default is
    from the TokenGS release."""


class RecipeSettings(ComponentConfig):
    """Settings at the top of a recipe."""

    recipe: int = Field(ge=1, le=1)
    """Version of the recipe format."""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Seed of the model's initial parameters and of training (default 0)."""
    init_from: str | None = None
    """Path of a checkpoint, from whose weights training starts. If its number of queries differs
    from that of this recipe, queries are dropped or copied, as in the LocusGS release. null starts
    from the initial parameters that `seed` gives."""
    plugins: tuple[str, ...] | None = ()
    """Plugins whose components the recipe may use besides the built-in ones; null means none."""


SETTINGS: dict[KeyPath, type[ComponentConfig]] = {
    (): RecipeSettings,
    ("model",): ModelSettings,
    ("model", "decoder"): DecoderSettings,
    ("views",): ViewsConfig,
    ("training",): TrainingConfig,
    ("evaluation",): EvaluationConfig,
}


def _parts(*slots: str) -> dict[str, Any]:
    """Return pydantic fields for the components of `slots`; `decode_place` checks their options."""
    fields: dict[str, Any] = {}
    for name in slots:
        about = summary_of(SLOTS[name].contract)
        part = Annotated[Any, WithJsonSchema({"slot": name})]
        fields[name] = part, Field(default=None, description=about)
        if SLOTS[name].defaults:
            about = f"Components by name. {about}"
            fields[name] = dict[str, part], Field(default_factory=dict, description=about)
    return fields


def _section(settings: type[ComponentConfig], **places: Any) -> Any:
    """Return a pydantic field for a section that has the options of `settings`.

    places: further fields of the section, by name, for components and for sections inside it.
    """
    kind: Any = settings
    if places:
        named = settings.__name__
        kind = create_model(named, __base__=settings, __doc__=settings.__doc__, **places)
    return kind, Field(default_factory=kind)


_LAYER = _parts(*LAYER_SLOTS)
_LAYERS: Any = dict[str, create_model("Layer", __base__=ComponentConfig, **_LAYER)]
_BY_INDEX: Any = Field(
    default_factory=dict,
    description="Changes of single decoder layers, by the index of the layer from 0.",
    json_schema_extra={"propertyNames": {"pattern": "^[0-9]+$"}},
)
Layout: Any = create_model(
    "Layout",
    __base__=RecipeSettings,
    # Components by pattern of the places that they replace; null drops an inherited swap.
    swap=(dict[str, Any], {}),
    model=_section(
        ModelSettings,
        **_parts("encoder", "queries"),
        decoder=_section(DecoderSettings, **_LAYER, layers=(_LAYERS, _BY_INDEX)),
        **_parts(*AFTER_LAYERS),
    ),
    **_parts(*SECTIONS),
    views=_section(ViewsConfig),
    training=_section(TrainingConfig),
    evaluation=_section(EvaluationConfig),
)
"""Pydantic model of a whole recipe: its settings, and fields for its components."""


def decode_settings(tree: MapNode, problems: Problems) -> tuple[MapNode, Any]:
    """Return `tree` without invalid values and null sections, and all settings as a `Layout`.

    A problem is added for each invalid value, which is replaced by its default.
    """
    settings, faults = validated(Layout, tree)
    for fault in faults:
        # A null section means the default one.
        if fault["input"] is not None or fault["type"] not in ("model_type", "dict_type"):
            report(fault, Layout, tree, (), problems)
    sound = deepcopy(tree)
    # Go on with defaults, so that problems of components are reported as well.
    while faults:
        faulty = [
            [step for step in find(sound, fault["loc"])[0] if isinstance(step, str)]
            for fault in faults
        ]
        if not any(faulty):
            # After a fault of the whole, such as text invalid in JSON, nothing is left to check.
            problems.raise_any()
        for keys in filter(None, faulty):
            # Two faults may lie in one list.
            sound.child(*keys[:-1]).pop(keys[-1], None)
        sound.put("recipe", 1, sound.origin_of("recipe"))
        settings, faults = validated(Layout, sound)
    return sound, settings


@dataclass(frozen=True)
class Draft:
    """Recipe with its components chosen, but not yet checked to fit each other.

    tree: all files and overrides merged, with the default losses and metrics.
    settings: a `Layout` with all settings.
    parts: chosen components, by path in the recipe. Every decoder layer has paths of its own.
    """

    tree: MapNode
    settings: Any
    registry: Registry
    parts: Parts

    @property
    def dims(self) -> ModelDims:
        """Width, heads and depth of the model."""
        model = self.settings.model
        return ModelDims(model.width, model.heads, model.decoder.depth)


def draft_of(written: MapNode, problems: Problems, plugins: Sequence[Plugin]) -> Draft:
    """Choose the components of a merged recipe; raise RecipeError with all problems.

    plugins: plugins that the recipe may name although they are not installed.
    """
    # `losses: {}` means no losses, a recipe without `losses` gets the defaults.
    sound, settings = decode_settings(written, problems)
    tree = _with_defaults(sound)
    registry = load_plugins(tree, problems, plugins)
    expanded = expand(tree, settings.model.decoder.depth, problems)
    places = apply_swaps(tree.child("swap"), expanded, problems)
    found = [decode_place(place, registry, problems) for place in places.values()]
    # Unknown components cannot be checked together.
    problems.raise_any()
    return Draft(tree, settings, registry, {part.path: part for part in found if part})


def _with_defaults(tree: MapNode) -> MapNode:
    """Merge `tree` over the default components of sections such as `losses`."""
    missing = {
        name: {key: {"type": kind} for key, kind in section.defaults.items()}
        for name, section in SECTIONS.items()
        if section.defaults and (section.defaults_stay or name not in tree)
    }
    return merge(from_plain(missing, Origin("default")), tree)

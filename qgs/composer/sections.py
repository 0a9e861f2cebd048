"""The parts of a recipe that are no components: its sections, their settings, its plugins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from qgs.composer.decode import ConfigT, decode_config
from qgs.composer.errors import Problems, did_you_mean
from qgs.composer.nodes import KeyPath, ListNode, MapNode, Origin, kind_of
from qgs.composer.registry import PluginError, Registry, builtin, load_plugin, not_installed
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS, SECTIONS
from qgs.contracts import ComponentConfig, EvaluationConfig, Plugin, TrainingConfig, ViewsConfig


class ModelSettings(ComponentConfig):
    """Sizes that the whole model shares."""

    width: int = Field(default=1024, ge=1, le=65_536)
    """Features of a token and of a query (D in the papers)."""
    heads: int = Field(default=16, ge=1)
    """Attention heads (h in the papers), a divisor of the width."""


class DecoderSettings(ComponentConfig):
    """The decoder, but for the components of its layers."""

    depth: int = Field(default=12, ge=1, le=1024)
    """Number of layers (L in the papers)."""
    layer_scale: float = Field(default=5e-5, gt=0)
    """Initial LayerScale of every sublayer (TokenGS release)."""


class RecipeSettings(ComponentConfig):
    """What concerns the recipe as a whole."""

    recipe: Literal[1]
    """Version of the recipe format."""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Of the model's initial parameters and of training."""
    init_from: str | None = None
    """Checkpoint whose weights training starts from, its queries made as many as this recipe has
    (LocusGS release: finetuning); null to start from the initial parameters."""


_SETTINGS: dict[KeyPath, type[ComponentConfig]] = {
    (): RecipeSettings,
    ("model",): ModelSettings,
    ("model", "decoder"): DecoderSettings,
}
_COMPONENTS: dict[KeyPath, tuple[str, ...]] = {
    (): ("plugins", "swap", "model", *SECTIONS, "views", "training", "evaluation"),
    ("model",): (*MODEL_SLOTS, "decoder"),
    ("model", "decoder"): (*LAYER_SLOTS, "layers"),
}
"""Keys that stand beside the `_SETTINGS` of a section."""

_KEYS = {path: {*_SETTINGS[path].model_fields, *names} for path, names in _COMPONENTS.items()}
_MAPPINGS: set[KeyPath] = {
    *(("model",), ("model", "decoder"), ("model", "decoder", "layers"), ("swap",)),
    *((name,) for name, section in SECTIONS.items() if section.named),
    *(("views",), ("training",), ("evaluation",)),
}


@dataclass(frozen=True)
class Settings:
    """Decoded settings; defaults stand in for a section that has problems.

    sizes_known: whether `model` and `decoder` are what the recipe says.
    """

    recipe: RecipeSettings
    model: ModelSettings
    decoder: DecoderSettings
    views: ViewsConfig
    training: TrainingConfig
    evaluation: EvaluationConfig
    sizes_known: bool


def check_tree(tree: MapNode, problems: Problems, path: KeyPath = ()) -> MapNode:
    """Report unknown keys and sections that are no mappings; the tree without them."""
    checked = []
    for key, node, origin in tree.entries():
        below, known = (*path, key), _KEYS.get(path)
        if known is not None and key not in known:
            reason = f"there is no key `{key}` here"
            problems.add(origin, ".".join(below), reason, _right_key(key, path, known))
        elif below not in _MAPPINGS:
            checked.append((key, node, origin))
        elif isinstance(node, MapNode):
            checked.append((key, check_tree(node, problems, below), origin))
        elif node is not None:
            reason = f"`{key}` is a mapping, this is {kind_of(node)}"
            fix = f"write `key: value` lines below `{key}:`"
            problems.add(origin, ".".join(below), reason, fix)
    return MapNode(tree.origin, checked)


def _right_key(key: str, path: KeyPath, known: set[str]) -> str:
    """A fix for the unknown `key` at `path`: the section that has it, or a similar key."""
    for home, keys in _KEYS.items():
        if home != path and key in keys:
            return f"did you mean `{'.'.join((*home, key))}`?"
    return did_you_mean(key, known, "keys")


def decode_settings(tree: MapNode, problems: Problems) -> Settings:
    """All settings of a checked tree; defaults where nothing is written."""

    def read(config: type[ConfigT], *path: str) -> ConfigT | None:
        node = tree.child(*path).without(*_COMPONENTS.get(path, ()))
        return decode_config(config, node, path, problems)

    recipe = read(RecipeSettings)
    model, decoder = read(ModelSettings, "model"), read(DecoderSettings, "model", "decoder")
    if model is not None:
        _check_heads(tree.child("model"), model, problems)
    return Settings(
        recipe or RecipeSettings(recipe=1),
        model or ModelSettings(),
        decoder or DecoderSettings(),
        read(ViewsConfig, "views") or ViewsConfig(),
        read(TrainingConfig, "training") or TrainingConfig(),
        read(EvaluationConfig, "evaluation") or EvaluationConfig(),
        sizes_known=model is not None and decoder is not None,
    )


def _check_heads(node: MapNode, model: ModelSettings, problems: Problems) -> None:
    if model.width % model.heads:
        fitting = [n for n in range(1, model.width + 1) if model.width % n == 0]
        near = min(fitting, key=lambda n: abs(n - model.heads))
        problems.add(
            node.origins.get("heads", node.origins.get("width", node.origin)),
            "model.heads",
            f"{model.heads} heads do not divide the width {model.width}",
            f"set model.heads to {near}, or make model.width a multiple of {model.heads}",
        )


def load_plugins(tree: MapNode, problems: Problems, given: Sequence[Plugin] = ()) -> Registry:
    """The components of the recipe's `plugins`; a problem for each that cannot be used.

    given: plugins that need not be installed.
    """
    at_hand = {plugin.name: not_installed(plugin) for plugin in given}
    plugins, seen = {"qgs": builtin()}, dict[str, Origin]()
    written = tree.get("plugins")
    if written is not None and not isinstance(written, ListNode):
        reason = f"`plugins` is a list, this is {kind_of(written)}"
        problems.add(tree.origins["plugins"], "plugins", reason, "write `plugins: [NAME]`")
    written = written if isinstance(written, ListNode) else ListNode(tree.origin)
    for index, (name, origin) in enumerate(zip(written, written.origins, strict=True)):
        path = f"plugins.{index}"
        if not isinstance(name, str):
            reason = f"a plugin is a name, this is {kind_of(name)}"
            problems.add(origin, path, reason, "write `plugins: [NAME]`")
        elif name in seen:
            reason = f"the plugin `{name}` is already listed at {seen[name]}"
            problems.add(origin, path, reason, "list it once")
        else:
            seen[name] = origin
            try:
                plugins[name] = at_hand.get(name) or load_plugin(name)
            except PluginError as error:
                problems.add(origin, path, error.reason, error.fix, error)
    return Registry(plugins, unusable=frozenset(seen.keys() - plugins.keys()))

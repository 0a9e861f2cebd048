"""The parts of a recipe that are no components: which keys there are, and their values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from qgs.composer.decode import ConfigT, decode_config
from qgs.composer.errors import Problems, did_you_mean
from qgs.composer.nodes import KeyPath, ListNode, MapNode, Origin, ScalarNode, is_null, kind_of
from qgs.composer.registry import PluginError, Registry, builtin, load_plugin, not_installed
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS, SECTIONS
from qgs.contracts import ComponentConfig, EvaluationConfig, Plugin, TrainingConfig, ViewsConfig


class ModelSettings(ComponentConfig):
    """width: D. heads: h, a divisor of D (both papers)."""

    width: int = Field(default=1024, ge=1, le=65_536)
    heads: int = Field(default=16, ge=1)


class DecoderSettings(ComponentConfig):
    """depth: L. layer_scale: initial LayerScale of every sublayer (TokenGS release)."""

    depth: int = Field(default=12, ge=1, le=1024)
    layer_scale: float = Field(default=5e-5, gt=0)


class RecipeSettings(ComponentConfig):
    """recipe: version of the recipe format. seed: of the model's initial parameters.

    init_from: checkpoint whose weights training starts from, grown or shrunk to this recipe's
    number of queries (LocusGS release: finetuning).
    """

    recipe: Literal[1]
    seed: int = Field(default=0, ge=0, lt=2**63)
    init_from: str | None = None


_SETTINGS: dict[KeyPath, type[ComponentConfig]] = {
    (): RecipeSettings,
    ("model",): ModelSettings,
    ("model", "decoder"): DecoderSettings,
}
"""Sections that hold settings beside other things."""

_CHILDREN: dict[KeyPath, tuple[str, ...]] = {
    (): ("plugins", "swap", "model", *SECTIONS, "views", "training", "evaluation"),
    ("model",): (*MODEL_SLOTS, "decoder"),
    ("model", "decoder"): (*LAYER_SLOTS, "layers"),
}
"""Keys of a section that are no settings of its own."""

_MAPPINGS: tuple[KeyPath, ...] = (
    ("model",),
    ("model", "decoder"),
    ("model", "decoder", "layers"),
    *((name,) for name, section in SECTIONS.items() if section.named),
    ("swap",),
    ("views",),
    ("training",),
    ("evaluation",),
)


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


def check_tree(tree: MapNode, problems: Problems) -> MapNode:
    """Report unknown keys and sections that are no mappings; the tree without them."""
    for path in _MAPPINGS:
        tree = _without_misfit(tree, path, (), problems)
    _report_unknown(tree, problems)
    return tree


def _without_misfit(tree: MapNode, path: KeyPath, above: KeyPath, problems: Problems) -> MapNode:
    name, rest = path[0], path[1:]
    node = tree.items.get(name)
    if node is None or is_null(node):
        return tree.without(name)
    if not isinstance(node, MapNode):
        where = ".".join((*above, name))
        reason = f"`{name}` is a mapping, this is {kind_of(node)}"
        problems.add(tree.keys[name], where, reason, f"write `key: value` lines below `{name}:`")
        return tree.without(name)
    if rest:
        child = _without_misfit(node, rest, (*above, name), problems)
        return tree.with_item(name, child, tree.keys[name])
    return tree


def _report_unknown(tree: MapNode, problems: Problems) -> None:
    for path, children in _CHILDREN.items():
        node = tree
        for step in path:
            node = node.child_map(step)
        known = {*children, *_SETTINGS[path].model_fields}
        for key in sorted(set(node.items) - known):
            problems.add(
                node.keys[key],
                ".".join((*path, key)),
                f"there is no key `{key}` here",
                _fix_key(key, path, known),
            )


def _fix_key(key: str, path: KeyPath, known: set[str]) -> str:
    for home, children in _CHILDREN.items():
        if home != path and key in {*children, *_SETTINGS[home].model_fields}:
            return f"did you mean `{'.'.join((*home, key))}`?"
    return did_you_mean(key, known, "keys")


def decode_settings(tree: MapNode, problems: Problems) -> Settings:
    """All settings of a checked tree; defaults where nothing is written."""

    def read(path: KeyPath, config: type[ConfigT]) -> ConfigT | None:
        node = tree
        for step in path:
            node = node.child_map(step)
        if path in _CHILDREN:
            node = node.without(*{*node.items} - {*config.model_fields})
        return decode_config(config, node, path, problems)

    recipe = read((), RecipeSettings)
    model, decoder = read(("model",), ModelSettings), read(("model", "decoder"), DecoderSettings)
    views, training = read(("views",), ViewsConfig), read(("training",), TrainingConfig)
    evaluation = read(("evaluation",), EvaluationConfig)
    if model is not None:
        _check_heads(tree.child_map("model"), model, problems)
    return Settings(
        recipe or RecipeSettings(recipe=1),
        model or ModelSettings(),
        decoder or DecoderSettings(),
        views or ViewsConfig(),
        training or TrainingConfig(),
        evaluation or EvaluationConfig(),
        sizes_known=model is not None and decoder is not None,
    )


def _check_heads(node: MapNode, model: ModelSettings, problems: Problems) -> None:
    if model.width % model.heads:
        fitting = [n for n in range(1, model.width + 1) if model.width % n == 0]
        near = min(fitting, key=lambda n: abs(n - model.heads))
        problems.add(
            node.keys.get("heads", node.keys.get("width", node.origin)),
            "model.heads",
            f"{model.heads} heads do not divide the width {model.width}",
            f"set model.heads to {near}, or make model.width a multiple of {model.heads}",
        )


def load_plugins(tree: MapNode, problems: Problems, given: Sequence[Plugin] = ()) -> Registry:
    """The components of the recipe's `plugins`; a problem for each that cannot be used.

    given: plugins that need not be installed.
    """
    at_hand = {plugin.name: not_installed(plugin) for plugin in given}
    plugins, unusable = {"qgs": builtin()}, set()
    seen: dict[str, Origin] = {}
    written = tree.items.get("plugins")
    if written is not None and not isinstance(written, ListNode) and not is_null(written):
        reason = f"`plugins` is a list, this is {kind_of(written)}"
        problems.add(tree.keys["plugins"], "plugins", reason, "write `plugins: [NAME]`")
    for index, item in enumerate(written.items if isinstance(written, ListNode) else ()):
        path = f"plugins.{index}"
        if not (isinstance(item, ScalarNode) and isinstance(item.value, str)):
            reason = f"a plugin is a name, this is {kind_of(item)}"
            problems.add(item.origin, path, reason, "write `plugins: [NAME]`")
            continue
        if item.value in seen:
            reason = f"the plugin `{item.value}` is already listed at {seen[item.value]}"
            problems.add(item.origin, path, reason, "list it once")
            continue
        seen[item.value] = item.origin
        try:
            plugins[item.value] = at_hand.get(item.value) or load_plugin(item.value)
        except PluginError as error:
            unusable.add(item.value)
            problems.add(item.origin, path, error.reason, error.fix, error)
    return Registry(plugins, frozenset(unusable))

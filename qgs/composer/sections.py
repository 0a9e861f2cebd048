"""The parts of a recipe that are no components: its sections, their settings, its plugins."""

from collections.abc import Sequence
from typing import Any, Literal

from pydantic import Field

from qgs.composer.decode import decode_config
from qgs.composer.errors import Problems, did_you_mean
from qgs.composer.nodes import KeyPath, ListNode, MapNode, Origin, kind_of
from qgs.composer.registry import InstalledPlugin, PluginError, Registry, builtin, load_plugin
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS, SECTIONS
from qgs.contracts import ComponentConfig, EvaluationConfig, Plugin, TrainingConfig, ViewsConfig


class ModelSettings(ComponentConfig):
    """The model: sizes that all of its components share."""

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
_MAPPINGS: set[KeyPath] = {
    *(("swap",), _LAYERS, *SETTINGS),
    *((name,) for name, section in SECTIONS.items() if section.named),
}


def check_tree(tree: MapNode, problems: Problems, path: KeyPath = ()) -> MapNode:
    """Report unknown keys and sections that are no mappings; the tree without them."""
    known = {*LAYER_SLOTS} if path[:-1] == _LAYERS else _KEYS.get(path)
    checked = []
    for key, node, origin in tree.entries():
        below = (*path, key)
        if known is not None and key not in known:
            homes = [".".join((*home, key)) for home, keys in _KEYS.items() if key in keys]
            fix = f"did you mean `{homes[0]}`?" if homes else did_you_mean(key, known, "keys")
            problems.add(origin, ".".join(below), f"there is no key `{key}` here", fix)
        elif below not in _MAPPINGS and path != _LAYERS:
            checked.append((key, node, origin))
        elif isinstance(node, MapNode):
            checked.append((key, check_tree(node, problems, below), origin))
        elif node is not None:
            reason = f"`{key}` is a mapping, this is {kind_of(node)}"
            fix = f"write `key: value` lines below `{key}:`"
            problems.add(origin, ".".join(below), reason, fix)
    return MapNode(tree.origin, checked)


def decode_settings(tree: MapNode, problems: Problems) -> tuple[dict[KeyPath, Any], bool]:
    """Settings by section, defaults for one with problems; whether the model's sizes are sound."""
    settings: dict[KeyPath, Any] = {}
    sizes_known = True
    for path, config in SETTINGS.items():
        node = tree.child(*path).without(*_BESIDE.get(path, ()))
        found = decode_config(config, node, path, problems)
        settings[path] = found or config.model_construct()
        sizes_known &= bool(found) or path[:1] != ("model",)
    model, node = settings["model",], tree.child("model")
    if model.width % model.heads:
        fitting = [n for n in range(1, model.width + 1) if model.width % n == 0]
        near = min(fitting, key=lambda n: abs(n - model.heads))
        problems.add(
            node.origins.get("heads", node.origins.get("width", node.origin)),
            "model.heads",
            f"{model.heads} heads do not divide the width {model.width}",
            f"set model.heads to {near}, or make model.width a multiple of {model.heads}",
        )
    return settings, sizes_known


def load_plugins(tree: MapNode, problems: Problems, given: Sequence[Plugin] = ()) -> Registry:
    """The components of the recipe's `plugins`; a problem for each that cannot be used."""
    at_hand = {plugin.name: InstalledPlugin(plugin) for plugin in given}
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

"""The resolved tree of a recipe, every default spelled out, and where each value comes from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from qgs.composer.decode import Chosen
from qgs.composer.nodes import MapNode, Node, Path
from qgs.composer.registry import Registry
from qgs.composer.sections import Settings
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS
from qgs.contracts import ComponentConfig


class Resolution:
    """Builds the resolved tree and its provenance side by side.

    tree: plain values, composing it again gives the same tree. provenance: dotted path of each
    value to `FILE:LINE`, `--set #n`, or the default that set it.
    """

    def __init__(
        self,
        source: MapNode,
        settings: Settings,
        registry: Registry,
        parts: Mapping[Path, Chosen],
        depth: int,
    ) -> None:
        self.source = source
        self.parts = parts
        self.tree: dict[str, Any] = {}
        self.provenance: dict[str, str] = {}
        recipe, model, decoder, views, training, evaluation = (
            settings.recipe,
            settings.model,
            settings.decoder,
            settings.views,
            settings.training,
            settings.evaluation,
        )
        assert recipe and model and decoder and views and training and evaluation
        self.put_settings((), recipe)
        names = [name for name in registry.plugins if name != "qgs"]
        self.put(("plugins",), names, self.written(("plugins",)))
        self.put_settings(("model",), model)
        for name in MODEL_SLOTS[:2]:
            self.put_component(("model", name))
        self.put_settings(("model", "decoder"), decoder)
        self.put_decoder(depth)
        for name in MODEL_SLOTS[2:]:
            self.put_component(("model", name))
        self.put_losses()
        if ("data",) in parts:
            self.put_component(("data",))
        self.put_settings(("views",), views)
        self.put_settings(("training",), training)
        self.put_settings(("evaluation",), evaluation)

    def put_settings(self, path: Path, config: ComponentConfig) -> None:
        for name, value in config.model_dump(mode="json").items():
            self.put((*path, name), value, self.written((*path, name)))

    def put_component(self, path: Path, chosen: Chosen | None = None) -> None:
        chosen = chosen or self.parts[path]
        node = chosen.place.node
        items = node if isinstance(node, MapNode) else MapNode(chosen.place.origin)
        kind = items.keys.get("type")
        self.put((*path, "type"), chosen.type, str(kind) if kind else "default of the slot")
        for name, value in chosen.config.model_dump(mode="json").items():
            self.put_option((*path, name), value, items.items.get(name), items, chosen.type)

    def put_option(
        self, path: Path, value: Any, node: Node | None, parent: MapNode, owner: str
    ) -> None:
        """Put an option, going into mappings that are written in part."""
        if isinstance(value, dict) and value and isinstance(node, MapNode):
            for name, item in value.items():
                self.put_option((*path, name), item, node.items.get(name), node, owner)
            return
        origin = parent.keys.get(path[-1])
        self.put(path, value, str(origin) if origin else f"default of {owner}")

    def put_decoder(self, depth: int) -> None:
        """The template, then every layer that differs; a template that no layer uses gives way."""
        overrides: list[tuple[int, str]] = []
        for name in LAYER_SLOTS:
            template = self.parts["model", "decoder", name]
            layers = [
                self.parts["model", "decoder", "layers", str(index), name]
                for index in range(depth)
            ]
            if all(_same(layer, layers[0]) for layer in layers):
                template = layers[0]
            self.put_component(("model", "decoder", name), template)
            overrides += [(i, name) for i, layer in enumerate(layers) if not _same(layer, template)]
        for index, name in sorted(overrides, key=lambda pair: pair[0]):
            self.put_component(("model", "decoder", "layers", str(index), name))

    def put_losses(self) -> None:
        self.tree["losses"] = {}
        for path in self.parts:
            if path[0] == "losses":
                self.put_component(path)

    def put(self, path: Path, value: Any, origin: str) -> None:
        node = self.tree
        for key in path[:-1]:
            node = node.setdefault(key, {})
        node[path[-1]] = value
        if isinstance(value, dict) and value:
            for below in _paths_below(value, path):
                self.provenance[".".join(below)] = origin
        else:
            self.provenance[".".join(path)] = origin

    def written(self, path: Path) -> str:
        node = self.source
        for step in path[:-1]:
            node = node.child_map(step)
        return str(node.keys[path[-1]]) if path[-1] in node.items else "default"


def _same(a: Chosen, b: Chosen) -> bool:
    return a.type == b.type and a.config == b.config


def _paths_below(value: Mapping[str, Any], path: Path) -> list[Path]:
    found: list[Path] = []
    for key, item in value.items():
        below = (*path, key)
        found += _paths_below(item, below) if isinstance(item, dict) and item else [below]
    return found

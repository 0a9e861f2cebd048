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
    ) -> None:
        self.source = source
        self.parts = parts
        self.tree: dict[str, Any] = {}
        self.provenance: dict[str, str] = {}
        self._put_settings((), settings.recipe)
        names = [name for name in registry.plugins if name != "qgs"]
        self._put(("plugins",), names, self._written(("plugins",)))
        self._put_settings(("model",), settings.model)
        for name in MODEL_SLOTS[:2]:
            self._put_component(("model", name))
        self._put_settings(("model", "decoder"), settings.decoder)
        self._put_decoder(settings.decoder.depth)
        for name in MODEL_SLOTS[2:]:
            self._put_component(("model", name))
        self._put_losses()
        if ("data",) in parts:
            self._put_component(("data",))
        self._put_settings(("views",), settings.views)
        self._put_settings(("training",), settings.training)
        self._put_settings(("evaluation",), settings.evaluation)

    def _put_settings(self, path: Path, config: ComponentConfig) -> None:
        for name, value in config.model_dump(mode="json").items():
            self._put((*path, name), value, self._written((*path, name)))

    def _put_component(self, path: Path, chosen: Chosen | None = None) -> None:
        chosen = chosen or self.parts[path]
        node = chosen.place.node
        items = node if isinstance(node, MapNode) else MapNode(chosen.place.origin)
        kind = items.keys.get("type")
        self._put((*path, "type"), chosen.type, str(kind) if kind else "default of the slot")
        for name, value in chosen.config.model_dump(mode="json").items():
            self._put_option((*path, name), value, items.items.get(name), items, chosen.type)

    def _put_option(
        self, path: Path, value: Any, node: Node | None, parent: MapNode, owner: str
    ) -> None:
        """Put an option, going into mappings that are written in part."""
        if isinstance(value, dict) and value and isinstance(node, MapNode):
            for name, item in value.items():
                self._put_option((*path, name), item, node.items.get(name), node, owner)
            return
        origin = parent.keys.get(path[-1])
        self._put(path, value, str(origin) if origin else f"default of {owner}")

    def _put_decoder(self, depth: int) -> None:
        """The template, then every layer that differs; a template that no layer uses gives way."""
        overrides: list[tuple[int, str]] = []
        for name in LAYER_SLOTS:
            template = self.parts["model", "decoder", name]
            layers = [
                self.parts["model", "decoder", "layers", str(index), name] for index in range(depth)
            ]
            if all(_same(layer, layers[0]) for layer in layers):
                template = layers[0]
            self._put_component(("model", "decoder", name), template)
            overrides += [(i, name) for i, layer in enumerate(layers) if not _same(layer, template)]
        for index, name in sorted(overrides, key=lambda pair: pair[0]):
            self._put_component(("model", "decoder", "layers", str(index), name))

    def _put_losses(self) -> None:
        self.tree["losses"] = {}
        for path in self.parts:
            if path[0] == "losses":
                self._put_component(path)

    def _put(self, path: Path, value: Any, origin: str) -> None:
        node = self.tree
        for key in path[:-1]:
            node = node.setdefault(key, {})
        node[path[-1]] = value
        if isinstance(value, dict) and value:
            for below in _paths_below(value, path):
                self.provenance[".".join(below)] = origin
        else:
            self.provenance[".".join(path)] = origin

    def _written(self, path: Path) -> str:
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

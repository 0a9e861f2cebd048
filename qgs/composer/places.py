"""Every place of a recipe that holds a component, with the decoder's layers written out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from qgs.composer.errors import Problems
from qgs.composer.merge import merge
from qgs.composer.nodes import MapNode, Node, Origin, Path, is_null
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS, SLOTS, Slot
from qgs.composer.suggest import did_you_mean


@dataclass(frozen=True)
class Place:
    """A place and what is written there.

    path: the place, decoder layers numbered. source: where a user would look for it: the decoder's
    template, a layer's override, or a swap. node: None where nothing is written.
    """

    path: Path
    source: Path
    slot: Slot
    node: Node | None
    origin: Origin


def expand(tree: MapNode, depth: int, problems: Problems) -> dict[Path, Place]:
    """All places of `tree`; a layer's overrides are laid over the decoder's template."""
    model = tree.child_map("model")
    decoder = model.child_map("decoder")
    places = [_place(model, ("model", name), SLOTS[name]) for name in MODEL_SLOTS]
    template = [_place(decoder, ("model", "decoder", name), SLOTS[name]) for name in LAYER_SLOTS]
    places += template
    places += _layers(decoder.child_map("layers"), template, depth, problems)
    losses = tree.child_map("losses")
    places += [
        _place(losses, ("losses", name), SLOTS["losses"])
        for name, node in losses.items.items()
        if not is_null(node)
    ]
    if not is_null(tree.items.get("data")):
        places.append(_place(tree, ("data",), SLOTS["data"]))
    return {place.path: place for place in places}


def _place(parent: MapNode, path: Path, slot: Slot) -> Place:
    origin = parent.keys.get(path[-1], parent.origin)
    return Place(path, path, slot, parent.items.get(path[-1]), origin)


def _layers(
    layers: MapNode, template: list[Place], depth: int, problems: Problems
) -> Iterator[Place]:
    overrides = dict(_overrides(layers, depth, problems))
    for index in range(depth):
        for place in template:
            path = ("model", "decoder", "layers", str(index), place.path[-1])
            written = overrides.get(index, MapNode(layers.origin))
            over = written.items.get(place.path[-1])
            if over is None or is_null(over):
                yield Place(path, place.source, place.slot, place.node, place.origin)
                continue
            base = place.node or MapNode(place.origin)
            node = merge(MapNode(place.origin) if is_null(base) else base, over, path)
            yield Place(path, path, place.slot, node, written.keys[place.path[-1]])


def _overrides(layers: MapNode, depth: int, problems: Problems) -> Iterator[tuple[int, MapNode]]:
    for key, node in layers.items.items():
        path, origin = f"model.decoder.layers.{key}", layers.keys[key]
        if not (key.isascii() and key.isdigit() and str(int(key)) == key and int(key) < depth):
            problems.add(
                origin,
                path,
                f"there is no layer `{key}` in a decoder of depth {depth}",
                f"name layers by their index, 0 to {depth - 1}",
            )
        elif not isinstance(node, MapNode):
            if not is_null(node):
                reason = "a layer's overrides are a mapping from slot to component"
                problems.add(origin, path, reason, "write `SLOT: {type: NAME}` below it")
        else:
            for name in set(node.items) - set(LAYER_SLOTS):
                reason = f"`{name}` is no slot of a decoder layer"
                fix = did_you_mean(name, LAYER_SLOTS, "slots")
                problems.add(node.keys[name], f"{path}.{name}", reason, fix)
            yield int(key), node

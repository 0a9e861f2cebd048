"""Laying one tree over another: mappings merge, lists replace, a new `type` replaces its node."""

from __future__ import annotations

from qgs.composer.nodes import MapNode, Node, Path, ScalarNode, is_null
from qgs.composer.slots import type_at

TAGS = ("type", "kind")
"""Keys that say what a mapping is; a node with another tag keeps nothing of the old one."""


def merge(base: Node, over: Node, path: Path = ()) -> Node:
    """`over` laid over `base`, both at `path`.

    `null` replaces what it lies over: in place of an option it is a value, in place of a component
    or a section it leaves the default, in place of a swap it drops the swap.
    """
    if not (isinstance(base, MapNode) and isinstance(over, MapNode)):
        return over
    if _replaces(base, over, path):
        return over
    items, keys = dict(base.items), dict(base.keys)
    for key, node in over.items.items():
        below = (*path, key)
        if path == ("swap",) and is_null(node) and not is_null(base.items.get(key)):
            del items[key], keys[key]
            continue
        items[key] = merge(items[key], node, below) if key in items else node
        keys[key] = over.keys[key]
    return MapNode(over.origin, items, keys)


def _replaces(base: MapNode, over: MapNode, path: Path) -> bool:
    if len(path) == 2 and path[0] == "swap":
        return True
    for tag in TAGS:
        if tag in over.items:
            before = type_at(base, path) if tag == "type" else _scalar(base, tag)
            after = type_at(over, path) if tag == "type" else _scalar(over, tag)
            if before is not None and before != after:
                return True
    return False


def _scalar(node: MapNode, key: str) -> object:
    value = node.items.get(key)
    return value.value if isinstance(value, ScalarNode) else None

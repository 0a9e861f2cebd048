"""The places of a recipe that hold components: defaults, decoder layers, swaps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

from qgs.composer.errors import Problems, did_you_mean, nearest
from qgs.composer.files import merge
from qgs.composer.nodes import KeyPath, MapNode, Node, Origin, is_null, kind_of
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS, SECTIONS, SLOTS, Slot


@dataclass(frozen=True)
class Place:
    """A place and what is written there.

    path: the place, decoder layers numbered. source: where a user would look for it: the decoder's
    template, a layer's override, or a swap. node: None where nothing is written.
    """

    path: KeyPath
    source: KeyPath
    slot: Slot
    node: Node | None
    origin: Origin


def expand(tree: MapNode, depth: int, problems: Problems) -> dict[KeyPath, Place]:
    """All places of `tree`; a layer's overrides are laid over the decoder's template."""
    model = tree.child_map("model")
    decoder = model.child_map("decoder")
    places = [_place(model, ("model", name), SLOTS[name]) for name in MODEL_SLOTS]
    template = [_place(decoder, ("model", "decoder", name), SLOTS[name]) for name in LAYER_SLOTS]
    places += template
    places += _layers(decoder.child_map("layers"), template, depth, problems)
    for name, section in SECTIONS.items():
        slot = SLOTS[name]
        if section.named:
            below = tree.child_map(name)
            written = [key for key, node in below.items.items() if not is_null(node)]
            places += [_place(below, (name, key), slot) for key in written]
        elif slot.default or not is_null(tree.items.get(name)):
            places.append(_place(tree, (name,), slot))
    return {place.path: place for place in places}


def _place(parent: MapNode, path: KeyPath, slot: Slot) -> Place:
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


def apply_swaps(
    swaps: MapNode, places: Mapping[KeyPath, Place], problems: Problems
) -> dict[KeyPath, Place]:
    """`places` with every swap made; `swaps` maps patterns to components.

    A pattern is a place's path in which `*`, `?` and `[...]` stand for parts of one segment, with
    or without the leading `model.`; decoder layers are addressed as `decoder.layers.INDEX.SLOT`.
    `null` in place of a component drops a swap that was inherited.
    """
    swapped: dict[KeyPath, str] = {}
    result = dict(places)
    for pattern, node in swaps.items.items():
        origin, path = swaps.keys[pattern], f"swap.{pattern}"
        if is_null(node):
            reason = f"there is no inherited swap `{pattern}` that null could drop"
            problems.add(origin, path, reason, "remove this line, or name the pattern as inherited")
            continue
        if not _names_component(node, origin, path, problems):
            continue
        hits = [place for place in places if _matches(pattern, place)]
        if not hits:
            fix = _near_pattern(pattern, places)
            problems.add(origin, path, f"the pattern `{pattern}` matches no place", fix)
        for place in hits:
            conflict = _conflict(places[place], swapped.get(place), swaps)
            if conflict:
                problems.add(origin, path, *conflict)
                break
            swapped[place] = pattern
            source = ("swap", pattern)
            result[place] = replace(places[place], source=source, node=node, origin=origin)
    return result


def _conflict(place: Place, other: str | None, swaps: MapNode) -> tuple[str, str] | None:
    """What speaks against a swap at `place`, which the pattern `other` may have swapped before."""
    name = ".".join(place.path)
    if other is not None:
        reason = f"`{name}` is already swapped by `{other}` ({swaps.keys[other]})"
        return reason, "narrow one of the two patterns, or remove one"
    if "layers" in place.source:
        reason = f"`{name}` is already set for this layer at {place.origin}"
        return reason, f"narrow the pattern, or remove `{name}` (null removes an inherited one)"
    return None


def _is_swappable(place: KeyPath) -> bool:
    return place[:2] != ("model", "decoder") or len(place) == 5


def _matches(pattern: str, place: KeyPath) -> bool:
    parts = tuple(pattern.split("."))
    shown = place[1:] if place[0] == "model" and parts[0] != "model" else place
    return _is_swappable(place) and len(parts) == len(shown) and all(map(fnmatchcase, shown, parts))


def _names_component(node: Node, origin: Origin, path: str, problems: Problems) -> bool:
    if isinstance(node, MapNode) and not is_null(node.items.get("type")):
        return True
    problems.add(
        origin,
        path,
        f"a swap puts a component, this is {kind_of(node)} without a `type`",
        "write `PATTERN: {type: PLUGIN/NAME, ...}`",
    )
    return False


def _near_pattern(pattern: str, places: Mapping[KeyPath, Place]) -> str:
    choices: dict[str, None] = {}
    for place in filter(_is_swappable, places):
        parts = place[1:] if place[0] == "model" else place
        if "layers" in parts:
            choices[".".join((*parts[:2], "*", *parts[3:]))] = None
        choices[".".join(parts)] = None
    near = nearest(pattern.removeprefix("model."), choices)
    if near:
        return f"did you mean `{near}`?"
    starred = [choice for choice in choices if "*" in choice or "layers" not in choice]
    return f"places: {', '.join(starred)}"

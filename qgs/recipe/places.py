"""The places of a recipe that hold components: defaults, decoder layers, swaps."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

from qgs.contracts import LAYER_SLOTS
from qgs.recipe.errors import Origin, Problems, nearest
from qgs.recipe.files import merge
from qgs.recipe.slots import AFTER_LAYERS, SECTIONS, Slot, slot_at
from qgs.recipe.yaml_text import KeyPath, MapNode, Node, kind_of


@dataclass(frozen=True)
class Place:
    """A place and what is written there.

    path: the place, decoder layers numbered. source: where a user finds it: the template, a layer's
    override, or a swap. node: None where nothing is written.
    """

    path: KeyPath
    source: KeyPath
    slot: Slot
    node: Node | None
    origin: Origin


def expand(tree: MapNode, depth: int, problems: Problems) -> dict[KeyPath, Place]:
    """All places of `tree`, in the order in which a recipe is read.

    A layer's overrides are laid over the decoder's template.
    """
    decoder = ("model", "decoder")
    template = [_place(tree, (*decoder, name)) for name in LAYER_SLOTS]
    places = [_place(tree, ("model", name)) for name in ("encoder", "queries")] + template
    # A layer with an index beyond the depth is often one of a base that was deeper.
    layers = tree.child(*decoder, "layers")
    indices = [str(index) for index in range(depth)]
    for key, _, origin in layers.without(*indices).entries():
        reason = f"there is no layer `{key}` in a decoder of depth {depth}"
        fix = f"name layers by their index, 0 to {depth - 1}"
        problems.add(origin, (*decoder, "layers", key), reason, fix)
    for index in indices:
        places += [_layer_place(place, index, layers.child(index)) for place in template]
    places += [_place(tree, ("model", name)) for name in AFTER_LAYERS]
    for name, section in SECTIONS.items():
        if section.named:
            written = tree.child(name).items()
            places += [_place(tree, (name, key)) for key, node in written if node is not None]
        elif section.default or tree.get(name) is not None:
            places.append(_place(tree, (name,)))
    return {place.path: place for place in places}


def _place(tree: MapNode, path: KeyPath) -> Place:
    slot = slot_at(path)
    assert slot is not None
    *above, name = path
    parent = tree.child(*above)
    return Place(path, path, slot, parent.get(name), parent.origin_of(name))


def _layer_place(template: Place, index: str, layer: MapNode) -> Place:
    """The place of one slot in layer `index`. layer: what is written for this layer alone."""
    name = template.path[-1]
    path = ("model", "decoder", "layers", index, name)
    node = layer.get(name)
    if node is None:
        return replace(template, path=path)
    # Only what is written for this layer changes; the rest is the template's.
    base = MapNode(template.origin) if template.node is None else template.node
    if isinstance(node, MapNode) and isinstance(base, MapNode):
        node = merge(base, node, path)
    return Place(path, path, template.slot, node, layer.origins[name])


def apply_swaps(
    swaps: MapNode, places: Mapping[KeyPath, Place], problems: Problems
) -> dict[KeyPath, Place]:
    """`places` with every swap made; `swaps` maps patterns to components.

    A pattern is a place's path in which `*`, `?` and `[...]` stand for parts of one segment, with
    or without the leading `model.`; decoder layers are addressed as `decoder.layers.INDEX.SLOT`.
    `null` in place of a component drops a swap that was inherited.
    """
    result = dict(places)
    # Swaps of the decoder's template would be lost under the layers made from it.
    swappable = [path for path in places if path[:2] != ("model", "decoder") or len(path) == 5]
    for pattern, node, origin in swaps.entries():
        source = ("swap", pattern)
        hits = [path for path in swappable if _matches(pattern, path)]
        if node is None:
            reason = f"there is no inherited swap `{pattern}` that null could drop"
            fix = "remove this line, or name the pattern as inherited"
            problems.add(origin, source, reason, fix)
        elif not isinstance(node, MapNode) or node.get("type") is None:
            reason = f"a swap puts a component, this is {kind_of(node)} without a `type`"
            problems.add(origin, source, reason, "write `PATTERN: {type: PLUGIN/NAME, ...}`")
        elif not hits:
            reason = f"the pattern `{pattern}` matches no place"
            known = dict.fromkeys(_starred(path).removeprefix("model.") for path in swappable)
            fix = near_pattern(pattern, swappable) or f"places: {', '.join(known)}"
            problems.add(origin, source, reason, fix)
        elif conflict := next(filter(None, (_conflict(result[path]) for path in hits)), None):
            problems.add(origin, source, *conflict)
        else:
            swapped = {"source": source, "node": node, "origin": origin}
            result |= {path: replace(result[path], **swapped) for path in hits}
    return result


def _conflict(place: Place) -> tuple[str, str] | None:
    """Reason and fix where `place` cannot be swapped (again)."""
    shown = ".".join(place.path)
    if place.source[0] == "swap":
        reason = f"`{shown}` is already swapped by `{place.source[1]}` ({place.origin})"
        return reason, "narrow one of the two patterns, or remove one"
    if "layers" in place.source:
        reason = f"`{shown}` is already set for this layer at {place.origin}"
        return reason, f"narrow the pattern, or remove `{shown}` (null removes an inherited one)"
    return None


def _matches(pattern: str, path: KeyPath) -> bool:
    parts = pattern.split(".")
    # `model.` may be left out, so `*.renderer` is no place of the model.
    shown = path[1:] if path[0] == "model" and parts[0] != "model" else path
    return len(parts) == len(shown) and all(map(fnmatchcase, shown, parts))


def near_pattern(pattern: str, paths: Iterable[KeyPath]) -> str:
    """A fix: the nearest name of `paths`, at the layers of `pattern` if it is there, else at all.

    Layers are compared as one: of hundreds, each has the same names.
    """
    names = {".".join(path).removeprefix("model.") for path in paths}
    given = pattern.removeprefix("model.").split(".")
    near = nearest(_starred(given), {_starred(name.split(".")) for name in names})
    if not near:
        return ""
    pairs = zip(near.split("."), given, strict=False)
    at_layers = ".".join(own if own.isdigit() and x == "*" else x for x, own in pairs)
    return f"did you mean `{at_layers if at_layers in names else near}`?"


def _starred(path: Iterable[str]) -> str:
    return ".".join("*" if x.isdigit() else x for x in path)

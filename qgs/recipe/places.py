"""Places where a recipe sets components, after defaults, decoder layers and swaps are applied."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

from qgs.contracts import LAYER_SLOTS
from qgs.recipe.errors import Origin, Problems
from qgs.recipe.files import merge
from qgs.recipe.slots import AFTER_LAYERS, SECTIONS, slot_at
from qgs.recipe.yaml_text import KeyPath, MapNode, Node, brief
from qgs.wording import did_you_mean

DECODER: KeyPath = ("model", "decoder")


@dataclass(frozen=True)
class Place:
    """Position of a component in a recipe, such as `model.encoder`, and what is written there.

    path: path of the component; a decoder layer has its number: `model.decoder.layers.0.layer`.
    source: path at which the recipe sets the component: `path`, a path of a swap, or
        `model.decoder.SLOT`, which sets it for all layers.
    node: value at `source`; an empty mapping if the recipe writes nothing there.
    origin: file and line of `node`.
    """

    path: KeyPath
    source: KeyPath
    node: Node
    origin: Origin

    @property
    def slot(self) -> str:
        """Name of the slot at `path`."""
        slot = slot_at(self.path)
        assert slot is not None
        return slot.name


def layer_place(index: int, slot: str) -> KeyPath:
    """Return the recipe path of the slot `slot` in the decoder layer `index`, counted from 0."""
    return (*DECODER, "layers", str(index), slot)


def expand(tree: MapNode, depth: int, problems: Problems) -> dict[KeyPath, Place]:
    """Return a Place for each component, by its path, in the order of a recipe's sections.

    tree: the merged recipe. depth: number of decoder layers. Adds a problem for each layer in
        `tree` that has the number `depth` or a higher one.
    """
    # A layer with an index beyond the depth often comes from a deeper base recipe.
    layers = tree.child(*DECODER, "layers").without(*map(str, range(depth)))
    for key, _, origin in layers.entries():
        reason = f"there is no layer `{key}` in a decoder of depth {depth}"
        fix = f"name layers by their index, 0 to {depth - 1}"
        problems.add(origin, (*DECODER, "layers", key), reason, fix)
    paths: list[KeyPath] = [("model", "encoder"), ("model", "queries")]
    paths += [(*DECODER, name) for name in LAYER_SLOTS]
    for index in range(depth):
        paths += [layer_place(index, name) for name in LAYER_SLOTS]
    paths += [("model", name) for name in AFTER_LAYERS]
    for name, section in SECTIONS.items():
        if section.defaults:
            paths += [(name, key) for key, node in tree.child(name).items() if node is not None]
        elif section.default or tree.get(name) is not None:
            paths.append((name,))
    return {path: _place(tree, path) for path in paths}


def _place(tree: MapNode, path: KeyPath) -> Place:
    """Return the Place of the component at `path`.

    Options for a single decoder layer are merged over the options for all layers.
    """
    *above, name = path
    parent = tree.child(*above)
    node = parent.get(name)
    if "layers" in above:
        template = _place(tree, (*DECODER, name))
        if node is None:
            return replace(template, path=path)
        # Options written for this layer win over the template.
        if isinstance(node, MapNode) and isinstance(template.node, MapNode):
            node = merge(template.node, node, path)
    origin = parent.origin_of(name)
    return Place(path, path, MapNode(origin) if node is None else node, origin)


def apply_swaps(
    swaps: MapNode, places: Mapping[KeyPath, Place], problems: Problems
) -> dict[KeyPath, Place]:
    """Return `places` with new components where a pattern of the recipe's section `swap` matches.

    swaps: maps each pattern to the new component, or to null to drop a swap of a base recipe.
    A pattern is the dotted path of a component, with or without `model.` in front. `*`, `?` and
    `[...]` match within one key. Decoder layers have the paths `decoder.layers.INDEX.SLOT`.
    """
    result = dict(places)
    # Swaps of the decoder's template would be lost under the layers made from it.
    swappable = [path for path in places if path[:2] != DECODER or len(path) == 5]
    for pattern, node, origin in swaps.entries():
        source = ("swap", pattern)
        hits = {path: result[path] for path in swappable if matches(pattern, path)}
        set_before = [x for x in hits.values() if x.source[0] == "swap" or "layers" in x.source]
        if not isinstance(node, MapNode) or node.get("type") is None:
            reason = f"a swap must be a component with a `type`, got {brief(node)}"
            fix = (
                "write `PATTERN: {type: PLUGIN/NAME, ...}`, or null to drop a swap of a base recipe"
            )
        elif not hits:
            reason = f"the pattern `{pattern}` matches no component of the recipe"
            known = [".".join(path).removeprefix("model.") for path in swappable]
            fix = did_you_mean(pattern, known, "places")
        elif set_before:
            place = set_before[0]
            reason = f"`{'.'.join(place.path)}` is already set at {place.origin}"
            fix = "narrow or remove one of the two (null removes a swap of a base recipe)"
        else:
            for path, place in hits.items():
                result[path] = replace(place, source=source, node=node, origin=origin)
            continue
        problems.add(origin, source, reason, fix)
    return result


def matches(pattern: str, path: KeyPath, *, below: bool = False) -> bool:
    """Return whether `pattern` matches `path` or, if `below`, the first keys of `path`."""
    # `model.` is optional, so `*.renderer` matches no place of the model.
    wanted = pattern.removeprefix("model.").split(".")
    shown = path[1:] if path[0] == "model" else path
    fits = len(shown) >= len(wanted) if below else len(shown) == len(wanted)
    return fits and all(map(fnmatchcase, shown, wanted))

"""A recipe with every default written out, each value with where it comes from."""

from collections.abc import Iterator, Mapping
from typing import Any

from qgs.recipe.decode import Chosen
from qgs.recipe.draft import Draft
from qgs.recipe.errors import Origin
from qgs.recipe.sections import SETTINGS
from qgs.recipe.slots import SECTIONS
from qgs.recipe.yaml_text import KeyPath, MapNode, items_of

_DEFAULT = Origin("default")


def spell_out(draft: Draft, parts: Mapping[KeyPath, Chosen]) -> MapNode:
    """Return all that a draft describes, in the order of a recipe; only plugins in use."""
    shown = _shown(parts)
    whole = _section(draft, ())
    _put_plugins(whole, draft, {part.installed.plugin.name for part in shown.values()})
    for path, part in shown.items():
        if path == ("model", "feedback"):
            # The decoder stands before it, also one of depth 0, which has no component.
            _holder(whole, ("model", "decoder", ""), draft)
        _holder(whole, path, draft)[path[-1]] = _component(part)
    for name, section in SECTIONS.items():
        written = draft.tree.child(name)
        # Without a `null` the default metric would come back when the recipe is read again.
        dropped = [key for key in section.defaults if (name, key) not in parts]
        for key in dropped if section.defaults_stay else ():
            _holder(whole, (name, key), draft).put(key, None, written.origin_of(key))
        # An empty section is not a missing one, which stands for the defaults.
        if section.named and name not in whole:
            whole.put(name, {}, draft.tree.origins.get(name, _DEFAULT))
    for name in ("views", "training", "evaluation"):
        whole[name] = _section(draft, (name,))
    return whole


def _shown(parts: Mapping[KeyPath, Chosen]) -> dict[KeyPath, Chosen]:
    """Parts as a recipe writes them: the decoder's template, and what differs from it in layers.

    A template that no layer uses gives way to what all layers have.
    """
    shown = {path: part for path, part in parts.items() if "layers" not in path}
    layers = {path: part for path, part in parts.items() if "layers" in path}
    for path in [*shown]:
        # A swap of all layers reads better as the template.
        standing = [part for at, part in layers.items() if (*at[:2], at[-1]) == path]
        if standing and all(part.equals(standing[0]) for part in standing):
            shown[path] = standing[0]
    own = {p: part for p, part in layers.items() if not part.equals(shown[*p[:2], p[-1]])}
    return shown | own


def _holder(whole: MapNode, path: KeyPath, draft: Draft) -> MapNode:
    """The mapping that holds `path`; one that is new begins with the settings of its section."""
    holder = whole
    for end, key in enumerate(path[:-1], start=1):
        if key not in holder:
            holder[key] = _section(draft, path[:end])
        holder = holder[key]
    return holder


def _section(draft: Draft, path: KeyPath) -> MapNode:
    """The settings of a section, if it has any."""
    values = draft.settings[path].model_dump(mode="json") if path in SETTINGS else {}
    return _spelled(values, draft.tree.child(*path), _DEFAULT)


def _component(chosen: Chosen) -> MapNode:
    """`type` and options of a component."""
    default = Origin(f"default of {chosen.type}")
    spelled = _spelled({"type": chosen.type, **chosen.options}, chosen.node, default)
    spelled.origins["type"] = chosen.node.origins.get("type", Origin("default of the slot"))
    return spelled


def _spelled(values: Mapping[str, Any], written: MapNode, default: Origin) -> MapNode:
    """`values`, with `default` as the origin of those that are not written."""
    spelled = MapNode(written.origin)
    for name, value in values.items():
        origin = written.origins.get(name, default)
        if isinstance(value, dict):
            known = isinstance(written.get(name), MapNode)
            value = _spelled(value, written.child(name), default if known else origin)
        spelled.put(name, value, origin)
    return spelled


def _put_plugins(whole: MapNode, draft: Draft, used: set[str]) -> None:
    kept = [
        name
        for name, installed in draft.registry.plugins.items()
        # One with weight layouts alone has no component to use: `qgs import` reads it.
        if name != "qgs" and (name in used or not installed.plugin.components)
    ]
    origin = draft.tree.origins.get("plugins", _DEFAULT)
    lines = [str(at) for name, at in items_of(draft.tree.get("plugins"), origin) if name in kept]
    if lines:
        origin = Origin(", ".join(dict.fromkeys(lines)))
    whole.put("plugins", kept, origin)


def leaves(tree: Mapping[str, Any], path: KeyPath = ()) -> Iterator[tuple[str, Any, str]]:
    """Dotted path of each value, mappings opened; the mapping that holds it, and its key there."""
    for key, value in tree.items():
        below = (*path, key)
        if isinstance(value, Mapping) and value:
            yield from leaves(value, below)
        else:
            yield ".".join(below), tree, key


def flat(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted path to value, mappings opened."""
    return {path: holder[key] for path, holder, key in leaves(tree)}

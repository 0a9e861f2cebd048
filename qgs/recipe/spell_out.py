"""A recipe with every default written out, each value with where it comes from."""

from collections.abc import Mapping
from typing import Any

from qgs.contracts import LAYER_SLOTS
from qgs.recipe.decode import Chosen
from qgs.recipe.draft import Draft
from qgs.recipe.errors import Origin
from qgs.recipe.slots import AFTER_LAYERS, SECTIONS
from qgs.recipe.yaml_text import KeyPath, ListNode, MapNode

_DEFAULT = Origin("default")


def spell_out(draft: Draft, parts: Mapping[KeyPath, Chosen]) -> MapNode:
    """What a draft describes, in the order in which a recipe is read; only plugins in use."""
    whole = _section(draft)
    whole["plugins"] = None  # known at the end
    model = _section(draft, "model")
    for name in ("encoder", "queries"):
        model[name] = _component(parts["model", name])
    model["decoder"] = _decoder(draft, parts)
    for name in AFTER_LAYERS:
        model[name] = _component(parts["model", name])
    whole["model"] = model
    for name, section in SECTIONS.items():
        if section.named:
            _put_named(whole, name, draft, parts)
        elif (name,) in parts:
            whole[name] = _component(parts[name,])
    for name in ("views", "training", "evaluation"):
        whole[name] = _section(draft, name)
    _put_plugins(whole, draft)
    return whole


def _section(draft: Draft, *path: str) -> MapNode:
    """The settings of a section."""
    values = draft.settings[path].model_dump(mode="json")
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
        inner = written.get(name)
        if isinstance(value, dict) and isinstance(inner, MapNode):
            value = _spelled(value, inner, default)
        spelled.put(name, value, written.origins.get(name, default))
    return spelled


def _decoder(draft: Draft, parts: Mapping[KeyPath, Chosen]) -> MapNode:
    """The template, then every layer that differs; a template that no layer uses gives way."""
    path = ("model", "decoder")
    decoder = _section(draft, *path)
    templates = {}
    for name in LAYER_SLOTS:
        if (*path, name) not in parts:
            continue
        standing = [part for at, part in parts.items() if at[2:3] == ("layers",) and at[-1] == name]
        same = all(part.equals(standing[0]) for part in standing)
        templates[name] = standing[0] if same else parts[*path, name]
        decoder[name] = _component(templates[name])
    for at, part in parts.items():
        if at[2:3] == ("layers",) and not part.equals(templates[at[-1]]):
            layers = decoder.setdefault("layers", MapNode(part.place.origin))
            layers.setdefault(at[3], MapNode(part.place.origin))[at[-1]] = _component(part)
    return decoder


def _put_named(whole: MapNode, name: str, draft: Draft, parts: Mapping[KeyPath, Chosen]) -> None:
    """The components of a section such as `losses`, and defaults of it that `null` drops."""
    written = draft.tree.child(name)
    section = MapNode(written.origin)
    for path, part in parts.items():
        if path[0] == name:
            section[path[1]] = _component(part)
    for key in SECTIONS[name].defaults if SECTIONS[name].defaults_stay else ():
        if key not in section:
            section.put(key, None, written.origin_of(key))
    whole.put(name, section, draft.tree.origins.get(name, _DEFAULT))


def _put_plugins(whole: MapNode, draft: Draft) -> None:
    kinds = [str(value) for path, value in flat(whole).items() if path.endswith(".type")]
    kept = [
        name
        for name, installed in draft.registry.plugins.items()
        # One with weight layouts alone has no component to use: `qgs import` reads it.
        if not installed.plugin.components or any(kind.startswith(f"{name}/") for kind in kinds)
    ]
    kept = [name for name in kept if name != "qgs"]
    origin = draft.tree.origins.get("plugins", _DEFAULT)
    written = draft.tree.get("plugins")
    if isinstance(written, ListNode) and kept:
        lines = [str(line) for name, line in written.entries() if name in kept]
        origin = Origin(", ".join(dict.fromkeys(lines)))
    whole.put("plugins", kept, origin)


def provenance(tree: MapNode, path: KeyPath = ()) -> dict[str, str]:
    """Dotted path of each value to where it comes from."""
    found: dict[str, str] = {}
    for key, value in tree.items():
        if isinstance(value, MapNode) and value:
            found |= provenance(value, (*path, key))
        else:
            found |= dict.fromkeys(flat({key: value}, path), str(tree.origins[key]))
    return found


def flat(tree: Mapping[str, Any], path: KeyPath = ()) -> dict[str, Any]:
    """Dotted path to value, mappings opened."""
    values: dict[str, Any] = {}
    for key, value in tree.items():
        below = (*path, key)
        if isinstance(value, Mapping) and value:
            values |= flat(value, below)
        else:
            values[".".join(below)] = value
    return values

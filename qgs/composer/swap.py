"""`swap:` puts one component in every place that a pattern matches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from fnmatch import fnmatchcase

from qgs.composer.errors import Problems
from qgs.composer.nodes import MapNode, Node, Origin, Path, is_null, kind_of
from qgs.composer.places import Place
from qgs.composer.suggest import nearest


def apply_swaps(
    swaps: MapNode, places: Mapping[Path, Place], problems: Problems
) -> dict[Path, Place]:
    """`places` with every swap made; `swaps` maps patterns to components.

    A pattern is a place's path in which `*`, `?` and `[...]` stand for parts of one segment, with
    or without the leading `model.`; decoder layers are addressed as `decoder.layers.INDEX.SLOT`.
    `null` in place of a component drops a swap that was inherited.
    """
    swapped: dict[Path, str] = {}
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


def _is_swappable(place: Path) -> bool:
    return place[:2] != ("model", "decoder") or len(place) == 5


def _matches(pattern: str, place: Path) -> bool:
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


def _near_pattern(pattern: str, places: Mapping[Path, Place]) -> str:
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

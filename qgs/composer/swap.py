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
        if is_null(node) or not _names_component(node, origin, path, problems):
            continue
        hits = [place for place in places if _matches(pattern, place)]
        if not hits:
            fix = _near_pattern(pattern, places)
            problems.add(origin, path, f"the pattern `{pattern}` matches no place", fix)
        for place in hits:
            if place in swapped:
                other = swapped[place]
                problems.add(
                    origin,
                    path,
                    f"`{'.'.join(place)}` is already swapped by `{other}` ({swaps.keys[other]})",
                    "narrow one of the two patterns, or remove one",
                )
                break
            swapped[place] = pattern
            source = ("swap", pattern)
            result[place] = replace(places[place], source=source, node=node, origin=origin)
    return result


def _is_swappable(place: Path) -> bool:
    return place[:2] != ("model", "decoder") or len(place) == 5


def _matches(pattern: str, place: Path) -> bool:
    parts = tuple(pattern.split("."))
    shown = place[1:] if place[0] == "model" and parts[0] != "model" else place
    return _is_swappable(place) and len(parts) == len(shown) and all(map(fnmatchcase, shown, parts))


def _names_component(node: Node, origin: Origin, path: str, problems: Problems) -> bool:
    if isinstance(node, MapNode) and "type" in node.items:
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

"""A resolved recipe as text that can be read, and composed, again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from qgs.composer.recipe import Recipe
from qgs.composer.yaml12 import dump


def annotated(recipe: Recipe) -> str:
    """The resolved recipe in YAML; comments, aligned at the right, say what set each value."""
    lines = list(_lines(recipe.tree, (), recipe.provenance))
    width = max(len(text) for text, _ in lines)
    return "\n".join(f"{text:<{width}}  # {origin}" if origin else text for text, origin in lines)


def flat(tree: Mapping[str, Any], path: tuple[str, ...] = ()) -> dict[str, Any]:
    """Dotted path to value, mappings opened."""
    values: dict[str, Any] = {}
    for key, value in tree.items():
        below = (*path, key)
        if isinstance(value, Mapping) and value:
            values |= flat(value, below)
        else:
            values[".".join(below)] = value
    return values


def _lines(
    tree: Mapping[str, Any], path: tuple[str, ...], provenance: Mapping[str, str]
) -> Iterator[tuple[str, str]]:
    indent = "  " * len(path)
    for key, value in tree.items():
        below = (*path, key)
        word = _word(key)
        if isinstance(value, Mapping) and value:
            yield f"{indent}{word}:", ""
            yield from _lines(value, below, provenance)
        else:
            yield f"{indent}{word}: {_word(value)}", provenance[".".join(below)]


def _word(value: Any) -> str:
    return dump(value, flow=True).removesuffix("\n").removesuffix("\n...")

"""Which recipe fits published weights, as far as their names and shapes can tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from qgs.composer import Recipe, RecipeError, resolve
from qgs.composer.registry import load_sound_plugins
from qgs.composer.yaml12 import dump
from qgs.contracts import LayoutError, WeightLayout
from qgs.contracts.layout import Shapes
from qgs.io.differences import differing_options, shapes_of
from qgs.io.published import PublishedError, names_in
from qgs.io.weight_file import WeightFile


def recognise(shapes: Shapes) -> tuple[WeightLayout | None, list[WeightLayout]]:
    """The layout, of any installed plugin, that a state dict is of; and all that there are."""
    registry, _ = load_sound_plugins()
    layouts = [layout for p in registry.plugins.values() for layout in p.plugin.layouts]
    return next((layout for layout in layouts if layout.marks_all_in(shapes)), None), layouts


def without_prefix(file: WeightFile) -> WeightFile:
    """`file` without what all its names begin with, where published names remain; with a note.

    Training frameworks put the name of the attribute that holds the model before each (`model.`).
    """
    modules = next(iter(file.tensors)).split(".")[:-1]
    for depth in range(1, len(modules) + 1):
        prefix = ".".join(modules[:depth]) + "."
        if not all(name.startswith(prefix) for name in file.tensors):
            break
        tensors = {name.removeprefix(prefix): tensor for name, tensor in file.tensors.items()}
        if recognise(shapes_of(tensors))[0]:
            note = f"took {prefix!r} off all {len(tensors)} names"
            return WeightFile(file.path, tensors, (*file.notes, note))
    return file


def fitting_recipe(shapes: Shapes, origin: str) -> tuple[WeightLayout, dict[str, Any]]:
    """The layout of a state dict and the recipe that its sizes give, a plain mapping.

    Raises PublishedError, about `origin`, when no installed layout knows the names or when names
    and shapes make no recipe.
    """
    layout, known = recognise(shapes)
    if layout is None:
        names = "; ".join(f"{one.name} has {', '.join(one.marks)}" for one in known)
        raise PublishedError(
            f"{origin} has the names of no published model that is known here ({names}); its first "
            f"names are {', '.join(list(shapes)[:3])}"
        )
    try:
        tree = layout.read(shapes)
        resolve(tree)
    except (LayoutError, RecipeError) as error:
        raise PublishedError(
            f"{origin} looks like {layout.name}, but no recipe fits its shapes: {error}"
        ) from error
    return layout, tree


def recipe_text(
    tree: Mapping[str, Any], layout: WeightLayout, origin: str, overrides: Sequence[str] = ()
) -> str:
    """The recipe of `fitting_recipe`, or what `overrides` made of it, as a file."""
    lines = [
        f"# Read off the names and shapes of {origin}, weights of {layout.name} ({layout.source}).",
        "# Shapes leave open, and this recipe takes from the published model:",
        *(f"#   {choice}" for choice in layout.undecided),
        *(f"# Given beside: {override}" for override in overrides),
    ]
    return "\n".join(lines) + "\n" + dump(dict(tree))


def advice(recipe: Recipe, expected: WeightLayout | None, shapes: Shapes) -> list[str]:
    """What a recipe that does not fit a state dict would have to say, line by line.

    expected: the layout of the recipe's own model.
    """
    layout, _ = recognise(shapes)
    if layout is None:
        return ["these are the names of no published model that is known here"]
    lines = []
    if expected is not None and expected.name != layout.name:
        lines.append(f"these are weights of {layout.name}, the recipe composes {expected.name}")
    try:
        tree = layout.read(shapes)
        fitting = resolve(tree)
    except (LayoutError, RecipeError) as error:
        return [*lines, f"no recipe fits the shapes: {error}"]
    options = _differing(recipe, fitting, layout)
    if options:
        lines.append("options that would fit, by names and shapes:")
        lines += [f"  {option}" for option in options]
        lines.append("names and shapes cannot tell:")
        lines += [f"  {choice}" for choice in layout.undecided]
        lines.append("`--recipe auto` writes a recipe that fits")
    remaining = names_in(fitting, layout).mismatches(shapes)
    if remaining:
        lines.append(_whatever_the_recipe(remaining, layout))
    return lines


def _whatever_the_recipe(remaining: list[str], layout: WeightLayout) -> str:
    number = len(remaining)
    if all(line.startswith("unexpected: ") for line in remaining):
        keys = "key" if number == 1 else "keys"
        return f"whatever the recipe says, the file has {number} {keys} that {layout.name} has not"
    return (
        f"{number} of the differences stay whatever the recipe says: the file is no whole state "
        f"dict of {layout.name}, or more than one"
    )


def _differing(recipe: Recipe, fitting: Recipe, layout: WeightLayout) -> list[str]:
    """`path: value (the recipe has ...)` of every legible option that differs."""
    apart = differing_options(recipe.tree, fitting.tree)
    lines = []
    for path in layout.legible:
        has, wanted = apart.get(path, (None, None))
        if wanted is not None:
            lines.append(f"{path}: {wanted} ({f'the recipe has {has}' if has else 'not in it'})")
    return lines

"""Published state dicts and ours: which parameter is which, and which recipe fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from qgs.composer import Recipe, RecipeError, resolve
from qgs.composer.registry import load_registry, load_sound_plugins
from qgs.composer.yaml_text import dump
from qgs.contracts import LayoutError, WeightLayout
from qgs.contracts.weights import Shapes
from qgs.io.checkpoint import unique_tensors
from qgs.io.differences import differing_options, differing_tensors, shapes_of
from qgs.io.weight_file import WeightFile


class PublishedError(ValueError):
    """Weights that do not fit a recipe, or a model that a published layout cannot hold."""


@dataclass(frozen=True)
class Names:
    """The parameters of one recipe's model under both names.

    shapes: of our parameters. published: our name to the published one, both unique.
    unnamed: ours that the codebase has no name for. unused: what a published file may hold besides.
    """

    shapes: Shapes
    published: Mapping[str, str]
    unnamed: tuple[str, ...]
    unused: tuple[str, ...]

    def mismatches(self, shapes: Shapes) -> list[str]:
        """What stands against taking a published state dict of these `shapes`, line by line."""
        found = [f"no published name: {name}" for name in self.unnamed]
        named = {theirs: self.shapes[ours] for ours, theirs in self.published.items()}
        return found + differing_tensors(shapes, named, set(self.unused))

    def from_published(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """A published state dict without mismatches under our names, `unused` left out."""
        return {ours: weights[theirs] for ours, theirs in self.published.items()}

    def to_published(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Our parameters under their published names; the inverse of `from_published`."""
        return {theirs: weights[ours] for ours, theirs in self.published.items()}


def layouts_of(recipe: Recipe) -> list[WeightLayout]:
    """The published layouts of the plugins that `recipe` uses, the framework's first."""
    names = [name for name in recipe.plugin_versions if name != "qgs"]
    plugins = load_registry(names).plugins.values()
    return [layout for installed in plugins for layout in installed.plugin.layouts]


def strangers(recipe: Recipe, layout: WeightLayout) -> list[str]:
    """Components of `recipe` that a codebase does not know, each told in one line."""
    found: dict[str, None] = {}
    varied: dict[str, set[str]] = {}
    for path, chosen in recipe.parts.items():
        slot = path[-1]
        if path[0] != "model" or slot not in layout.components:
            continue
        known = layout.components[slot]
        varied.setdefault(slot, set()).add(chosen.type)
        if chosen.type not in known:
            found[f"{chosen.written_at} is {chosen.type}; {layout.name} has {_or(known)}"] = None
    for slot, types in varied.items():
        if len(types) > 1:
            found[f"decoder layers differ in their {slot} ({', '.join(sorted(types))})"] = None
    return list(found)


def layout_of(recipe: Recipe) -> WeightLayout:
    """The published layout that can hold the model of `recipe`.

    Raises PublishedError that says of each layout what stands against it.
    """
    reasons = []
    for layout in layouts_of(recipe):
        found = strangers(recipe, layout)
        if not found:
            return layout
        reasons += [f"{layout.name}: {line}" for line in found]
    raise PublishedError(
        "no published layout can hold this model:" + "".join(f"\n  {line}" for line in reasons)
    )


def names_in(recipe: Recipe, layout: WeightLayout) -> Names:
    """The parameters of the model of `recipe`; composed on the meta device."""
    model = recipe.build_model("meta")
    shapes = {name: tuple(tensor.shape) for name, tensor in unique_tensors(model).items()}
    named = {name: layout.published_name(name) for name in shapes}
    published = {ours: theirs for ours, theirs in named.items() if theirs is not None}
    assert len(set(published.values())) == len(published)
    unused = layout.unused_names(published.values())
    unnamed = tuple(name for name, theirs in named.items() if theirs is None)
    return Names(shapes, published, unnamed, tuple(unused))


def from_published(weights: Mapping[str, Tensor], recipe: Recipe) -> dict[str, Tensor]:
    """A published state dict under our names, what the codebase never uses left out.

    Raises PublishedError that lists every name that is missing or unexpected, and every shape that
    is another one.
    """
    names = names_in(recipe, layout_of(recipe))
    found = names.mismatches(shapes_of(weights))
    if found:
        raise PublishedError(
            f"the weights do not fit the recipe, {len(found)} differences:\n  " + "\n  ".join(found)
        )
    return names.from_published(weights)


def to_published(weights: Mapping[str, Tensor], recipe: Recipe) -> dict[str, Tensor]:
    """Weights under our names, as `unique_tensors` has them, under their published names.

    The inverse of `from_published`. Raises PublishedError for a model that no layout can hold.
    """
    return names_in(recipe, exact_layout_of(recipe)).to_published(weights)


def exact_layout_of(recipe: Recipe) -> WeightLayout:
    """The layout whose codebase has exactly the parameters of the model of `recipe`.

    Raises PublishedError that lists what the codebase lacks, and what it has besides.
    """
    layout = layout_of(recipe)
    names = names_in(recipe, layout)
    problems = [f"{name}: {layout.name} has no such parameter" for name in names.unnamed]
    if not problems:
        problems = _differences(names, layout)
    if problems:
        raise PublishedError(
            f"the layout of {layout.name} cannot hold this model:\n  " + "\n  ".join(problems)
        )
    return layout


def _differences(names: Names, layout: WeightLayout) -> list[str]:
    """How the model that the codebase builds at these sizes differs from this one."""
    shapes = {theirs: names.shapes[ours] for ours, theirs in names.published.items()}
    try:
        theirs = names_in(resolve(layout.read(shapes)), layout)
    except (LayoutError, ValueError) as error:
        return [str(error)]
    extra = [name for name in names.shapes if name not in theirs.shapes]
    return [f"{name}: {layout.name} has no such parameter" for name in extra] + [
        f"{name}: {layout.name} has it with the shape {shape}, this model has "
        + (f"{names.shapes[name]}" if name in names.shapes else "no such parameter")
        for name, shape in theirs.shapes.items()
        if names.shapes.get(name) != shape
    ]


def _or(words: tuple[str, ...]) -> str:
    return " or ".join(words)


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
    """`path: value (the recipe has ...)` of every option read from the weights that differs."""
    apart = differing_options(recipe.tree, fitting.tree)
    lines = []
    for path in layout.read_options:
        has, wanted = apart.get(path, (None, None))
        if wanted is not None:
            lines.append(f"{path}: {wanted} ({f'the recipe has {has}' if has else 'not in it'})")
    return lines

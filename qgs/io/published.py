"""Published state dicts and ours: which parameter is which, and which recipe fits."""

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
from qgs.wording import listed


class PublishedError(ValueError):
    """Weights that do not fit a recipe, or a model that a published layout cannot hold."""


@dataclass(frozen=True)
class Names:
    """The parameters of one recipe's model under both names.

    shapes: of our parameters. published: our name to the published one, both unique.
    unnamed: ours that the codebase has no name for. unused: what a published file may hold besides.
    """

    layout: WeightLayout
    shapes: Shapes
    published: Mapping[str, str]
    unnamed: tuple[str, ...]
    unused: tuple[str, ...]

    def mismatches(self, shapes: Shapes) -> list[str]:
        """Problems of a published state dict of these `shapes` with this recipe, line by line."""
        found = [f"no published name: {name}" for name in self.unnamed]
        return found + differing_tensors(shapes, self.published_shapes(), set(self.unused))

    def published_shapes(self) -> dict[str, tuple[int, ...]]:
        """Published names of our parameters to their shapes."""
        return {theirs: self.shapes[ours] for ours, theirs in self.published.items()}

    def from_published(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """A published state dict under our names, `unused` left out.

        Raises PublishedError that lists every name that is missing or unexpected, and every shape
        that is another one.
        """
        found = self.mismatches(shapes_of(weights))
        if found:
            raise PublishedError(
                f"the weights do not fit the recipe, {len(found)} differences:\n  "
                + "\n  ".join(found)
            )
        return {ours: weights[theirs] for ours, theirs in self.published.items()}

    def to_published(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Our parameters under their published names; the inverse of `from_published`."""
        return {theirs: weights[ours] for ours, theirs in self.published.items()}


def names_of(recipe: Recipe) -> Names:
    """Both names of the parameters of the model of `recipe`, by the first layout that can hold it.

    Raises PublishedError with the components that each layout does not know.
    """
    registry = load_registry([name for name in recipe.plugin_versions if name != "qgs"])
    reasons = []
    for layout in _layouts(registry.plugins.values()):
        found = _unknown_components(recipe, layout)
        if not found:
            return _names_in(recipe, layout)
        reasons += [f"\n  {layout.name}: {line}" for line in found]
    raise PublishedError("no published layout can hold this model:" + "".join(reasons))


def exact_names_of(recipe: Recipe) -> Names:
    """`names_of` for a model that has exactly the parameters that the codebase builds.

    Raises PublishedError that lists what the codebase lacks, and what it has besides.
    """
    names = names_of(recipe)
    layout, extra, theirs, problems = names.layout, names.unnamed, names.shapes, []
    if not extra:
        try:
            theirs = _names_in(resolve(layout.read(names.published_shapes())), layout).shapes
        except ValueError as error:  # a LayoutError or RecipeError
            problems.append(str(error))
        extra = [name for name in names.shapes if name not in theirs]
    problems += [f"{name}: {layout.name} has no such parameter" for name in extra]
    problems += [
        f"{name}: {layout.name} has it with the shape {shape}, this model has "
        f"{names.shapes.get(name, 'no such parameter')}"
        for name, shape in theirs.items()
        if names.shapes.get(name) != shape
    ]
    if problems:
        raise PublishedError(
            f"the layout of {layout.name} cannot hold this model:\n  " + "\n  ".join(problems)
        )
    return names


def _layouts(plugins: Any) -> list[WeightLayout]:
    return [layout for installed in plugins for layout in installed.plugin.layouts]


def _unknown_components(recipe: Recipe, layout: WeightLayout) -> list[str]:
    """Components of `recipe` that a codebase does not know, one line each."""
    found: dict[str, None] = {}
    types: dict[str, set[str]] = {}
    for path, chosen in recipe.parts.items():
        slot = path[-1]
        if path[0] != "model" or slot not in layout.components:
            continue
        known = layout.components[slot]
        types.setdefault(slot, set()).add(chosen.type)
        if chosen.type not in known:
            has = f"{layout.name} has {' or '.join(known)}"
            found[f"{chosen.path} is {chosen.type}; {has}"] = None
    return list(found) + [
        f"decoder layers differ in their {slot} ({', '.join(sorted(several))})"
        for slot, several in types.items()
        if len(several) > 1
    ]


def _names_in(recipe: Recipe, layout: WeightLayout) -> Names:
    model = recipe.build_model("meta")
    shapes = shapes_of(unique_tensors(model))
    named = {name: layout.published_name(name) for name in shapes}
    published = {ours: theirs for ours, theirs in named.items() if theirs is not None}
    assert len(set(published.values())) == len(published)
    unnamed = tuple(name for name in shapes if name not in published)
    unused = tuple(layout.unused_names(published.values()))
    return Names(layout, shapes, published, unnamed, unused)


def recognise(shapes: Shapes) -> tuple[WeightLayout | None, list[WeightLayout]]:
    """The layout, of any installed plugin, that a state dict is of; and all that there are."""
    layouts = _layouts(load_sound_plugins()[0].plugins.values())
    return next((layout for layout in layouts if set(layout.marks) <= set(shapes)), None), layouts


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
            f"{origin} has the names of no published model that is known here ({names}); its "
            f"names are {listed(shapes, 3)}"
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
        fitting = resolve(layout.read(shapes))
    except (LayoutError, RecipeError) as error:
        return [*lines, f"no recipe fits the shapes: {error}"]
    differing = differing_options(recipe.tree, fitting.tree)
    options = []
    for path in layout.read_options:
        has, wanted = differing.get(path, (None, None))
        if wanted is not None:
            found = f"the recipe has {has}" if has else "not in it"
            options.append(f"  {path}: {wanted} ({found})")
    if options:
        lines += ["options that would fit, by names and shapes:", *options]
        lines += ["names and shapes cannot tell:", *(f"  {line}" for line in layout.undecided)]
        lines.append("`--recipe auto` writes a recipe that fits")
    remaining = _names_in(fitting, layout).mismatches(shapes)
    count = len(remaining)
    if remaining and all(line.startswith("unexpected: ") for line in remaining):
        keys = "key" if count == 1 else "keys"
        lines.append(
            f"whatever the recipe says, the file has {count} {keys} that {layout.name} has not"
        )
    elif remaining:
        lines.append(
            f"{count} of the differences stay whatever the recipe says: the file is no whole "
            f"state dict of {layout.name}, or more than one"
        )
    return lines

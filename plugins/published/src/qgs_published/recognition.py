"""Which published codebase a state dict is of, and the recipe that its shapes give."""

from typing import Any

from qgs.composer import RecipeError, resolve
from qgs.composer.registry import load_usable_plugins
from qgs.contracts import LayoutError, WeightLayout
from qgs.contracts.weights import Shapes
from qgs.io.tensors import shapes_of
from qgs.wording import listed
from qgs_published.names import PublishedError, layouts_of
from qgs_published.weight_files import WeightFile


def recognise(shapes: Shapes) -> tuple[WeightLayout | None, list[WeightLayout]]:
    """The layout that fits a state dict best, None without one, and the layouts of all plugins."""
    layouts = layouts_of(load_usable_plugins()[0].plugins.values())
    found = [layout for layout in layouts if set(layout.marks) <= set(shapes)]
    # A codebase's later release has all names of the earlier one.
    return max(found, key=lambda layout: len(layout.marks), default=None), layouts


def without_prefix(file: WeightFile) -> WeightFile:
    """`file` without a prefix that all its names share, where published names remain; with a note.

    Training frameworks prepend the attribute that holds the model (`model.`, `module.`).
    """
    modules = next(iter(file.tensors)).split(".")[:-1]
    for depth in range(1, len(modules) + 1):
        prefix = ".".join(modules[:depth]) + "."
        tensors = {name.removeprefix(prefix): tensor for name, tensor in file.tensors.items()}
        if (
            all(name.startswith(prefix) for name in file.tensors)
            and recognise(shapes_of(tensors))[0]
        ):
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

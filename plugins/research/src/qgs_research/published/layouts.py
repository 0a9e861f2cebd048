"""Published codebases: their parameter names, and recipes derived from shapes of weights."""

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from qgs.checkpoint.model_file import unique_tensors
from qgs.checkpoint.tensors import Shapes, differing_tensors, shapes_of
from qgs.recipe import Recipe, RecipeError, resolve
from qgs.wording import listed
from qgs_research.published.mvsplat import DEPTHSPLAT, MVSPLAT
from qgs_research.published.tokengs import LOCUSGS, TOKENGS, TOKENGS_2026_6
from qgs_research.published.weight_layout import LayoutError, Tree, WeightLayout, renamed

# TokenGS comes first, because it is the most general.
LAYOUTS = (TOKENGS, LOCUSGS, MVSPLAT, DEPTHSPLAT, TOKENGS_2026_6)
"""All published codebases whose weights can be imported."""


class PublishedError(ValueError):
    """Error for weights that do not fit a recipe, or a model that fits no published layout."""


@dataclass(frozen=True)
class Names:
    """Parameter names of a recipe's model, in qgs and in the published weights.

    shapes: shapes of the parameters by name in qgs. published: published names by name in qgs.
    unused: names of tensors that a published file may hold, but that the published code ignores.
    """

    layout: WeightLayout
    shapes: Shapes
    published: Mapping[str, str]
    unused: tuple[str, ...]

    def from_published(
        self, weights: Mapping[str, Tensor], origin: object = "the file"
    ) -> dict[str, Tensor]:
        """Rename published tensors to their names in qgs; leave out the tensors in `unused`.

        origin: name of the published file, for the error message. Raises PublishedError that lists
        all differences in names and shapes.
        """
        wanted = {theirs: self.shapes[ours] for ours, theirs in self.published.items()}
        found = [f"{name} has no published name" for name in self.shapes.keys() - self.published]
        given = {name: w for name, w in weights.items() if name not in self.unused}
        if found := found + differing_tensors(shapes_of(given), wanted):
            raise PublishedError(
                f"{origin} does not fit the recipe of a {self.layout.name}; "
                f"`--recipe auto` writes a recipe that fits. {len(found)} differences:\n  "
                + listed(found, 20, "\n  ")
            )
        return {ours: weights[theirs] for ours, theirs in self.published.items()}


def names_of(recipe: Recipe) -> Names:
    """Return the parameter names of `recipe` in qgs and in the first layout that fits it.

    Raises PublishedError if no layout fits; the message lists, for each layout, the components that
    the published codebase does not have.
    """
    reasons = []
    # Use only plugins of this recipe, because others could claim its names.
    for layout in (one for one in LAYOUTS if one.plugin in recipe.releases):
        found = _unknown_components(recipe, layout)
        if not found:
            break
        reasons += [f"\n  {layout.name}: {line}" for line in found]
    else:
        raise PublishedError(
            "the model of this recipe fits no published layout; use a recipe with the components "
            "of one layout" + "".join(reasons)
        )
    shapes = shapes_of(unique_tensors(recipe.build_model("meta")))
    named = {name: layout.published_name(name) for name in shapes}
    published = {ours: theirs for ours, theirs in named.items() if theirs}
    # These are stored beside the used ones, but the published code never reads them.
    beside = (renamed(name, *rule) for name in published.values() for rule in layout.unused)
    return Names(layout, shapes, published, tuple(filter(None, beside)))


def _unknown_components(recipe: Recipe, layout: WeightLayout) -> list[str]:
    """Return one line for each component of `recipe` that a published codebase does not have."""
    known = layout.components
    # Such as model.encoder: no loss or metric changes the weights.
    parts = [x for path, x in recipe.parts.items() if path[0] == "model" and x.slot in known]
    # A component of all layers is listed once.
    found = dict.fromkeys(
        f"{part.shown_path} is {part.type}; {layout.name} has {' or '.join(known[part.slot])}"
        for part in parts
        if part.type not in known[part.slot]
    )
    types = {slot: {part.type for part in parts if part.slot == slot} for slot in known}
    return list(found) + [
        f"decoder layers differ in their {slot} ({', '.join(sorted(several))})"
        for slot, several in types.items()
        if len(several) > 1
    ]


def recognise(shapes: Shapes) -> WeightLayout | None:
    """Return the layout whose identifying names are all in a state dict; None if there is none."""
    found = [layout for layout in LAYOUTS if set(layout.marks) <= set(shapes)]
    # A later release of a codebase has all names of the earlier one.
    return max(found, key=lambda layout: len(layout.marks), default=None)


def fitting_recipe(shapes: Shapes, origin: str) -> tuple[WeightLayout, Tree]:
    """Return the layout of a state dict, and a recipe that fits it, as a plain mapping.

    origin: name of the file for messages. Raises PublishedError if no layout has these names, or if
    no recipe fits the names and shapes.
    """
    layout = recognise(shapes)
    if layout is None:
        names = "; ".join(f"{one.name} has {', '.join(one.marks)}" for one in LAYOUTS)
        raise PublishedError(
            f"{origin} is not from a known published model ({names}); the file's tensors are named "
            f"{listed(shapes, 3)}"
        )
    try:
        tree = layout.read(shapes)
        # Contradictions between shapes show only in the whole recipe.
        resolve(tree)
    except (LayoutError, RecipeError) as error:
        raise PublishedError(
            f"{origin} looks like {layout.name}, but no recipe fits its shapes: {error}"
        ) from error
    return layout, tree

"""A recipe whose components are chosen and have their options, before it is checked as a whole."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from qgs.contracts import ModelDims, Plugin
from qgs.recipe.decode import Parts, decode_place
from qgs.recipe.errors import Origin, Problems
from qgs.recipe.files import merge
from qgs.recipe.places import apply_swaps, expand
from qgs.recipe.registry import Registry, load_plugins
from qgs.recipe.sections import check_keys, decode_settings
from qgs.recipe.slots import SECTIONS
from qgs.recipe.yaml_text import KeyPath, MapNode, from_plain


@dataclass(frozen=True)
class Draft:
    """A recipe that has been read.

    tree: all files and overrides merged, with the default losses and metrics. settings: of each
    section. parts: what stands at each place, decoder layers numbered.
    """

    tree: MapNode
    settings: Mapping[KeyPath, Any]
    registry: Registry
    parts: Parts

    @property
    def dims(self) -> ModelDims:
        """Width, heads and depth of the model."""
        model = self.settings["model",]
        return ModelDims(model.width, model.heads, self.settings["model", "decoder"].depth)


def draft_of(written: MapNode, problems: Problems, plugins: Sequence[Plugin]) -> Draft:
    """Choose the components of a merged recipe; raises RecipeError with all that it finds.

    plugins: those that it may name although they are not installed.
    """
    # Under what is written: `losses: {}` has none, a recipe without `losses` the default ones.
    tree = _with_defaults(check_keys(written, problems))
    settings = decode_settings(tree, problems)
    registry = load_plugins(settings[()].plugins or (), tree, problems, plugins)
    expanded = expand(tree, settings["model", "decoder"].depth, problems)
    places = apply_swaps(tree.child("swap"), expanded, problems)
    found = [decode_place(place, registry, problems) for place in places.values()]
    # Components that are not known cannot be checked beside each other.
    problems.raise_any()
    return Draft(tree, settings, registry, {part.path: part for part in found if part})


def _with_defaults(tree: MapNode) -> MapNode:
    """`tree` with the default components of sections such as `losses` under what is written."""
    missing = {
        name: {key: {"type": kind} for key, kind in section.defaults.items()}
        for name, section in SECTIONS.items()
        if section.named and (section.defaults_stay or name not in tree)
    }
    return merge(from_plain(missing, Origin("default")), tree)

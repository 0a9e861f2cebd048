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
from qgs.recipe.sections import check_keys, decode_settings, dims_of
from qgs.recipe.slots import SECTIONS
from qgs.recipe.yaml_text import KeyPath, MapNode, from_plain


@dataclass(frozen=True)
class Draft:
    """A recipe that has been read.

    written: all files and overrides merged. tree: that with the default losses and metrics, without
        unknown keys. settings: of each section. sizes_known: whether those of the model are valid.
    parts: what stands at each place, decoder layers numbered.
    """

    written: MapNode
    tree: MapNode
    settings: Mapping[KeyPath, Any]
    sizes_known: bool
    registry: Registry
    parts: Parts

    @property
    def dims(self) -> ModelDims:
        """Width, heads and depth of the model."""
        return dims_of(self.settings)


def draft_of(written: MapNode, problems: Problems, plugins: Sequence[Plugin]) -> Draft:
    """Choose the components of a merged recipe; mistakes go to `problems`.

    plugins: those that it may name although they are not installed.
    """
    tree = check_keys(written, problems)
    # What a file that cannot be read would have set is not missing from the recipe.
    problems.raise_if_stopped()
    # Under what is written: `losses: {}` has none, a recipe without `losses` the default ones.
    tree = _with_defaults(tree)
    settings, sizes_known = decode_settings(tree, problems)
    registry = load_plugins(tree, problems, plugins)
    depth = dims_of(settings).depth
    places = apply_swaps(tree.child("swap"), expand(tree, depth, problems), problems)
    parts = {path: decode_place(place, registry, problems) for path, place in places.items()}
    return Draft(written, tree, settings, sizes_known, registry, parts)


def _with_defaults(tree: MapNode) -> MapNode:
    """`tree` with the default components of sections such as `losses` under what is written."""
    missing = {
        name: {key: {"type": kind} for key, kind in section.defaults.items()}
        for name, section in SECTIONS.items()
        if section.named and (section.defaults_stay or name not in tree)
    }
    return merge(from_plain(missing, Origin("default")), tree)

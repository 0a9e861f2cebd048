"""Import of published weights: names of their parameters, recipe that fits, checkpoint."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from qgs.composer import Recipe, RecipeError, resolve
from qgs.composer.recipe import differing_predictions
from qgs.composer.registry import load_registry, load_usable_plugins
from qgs.composer.yaml_text import dump
from qgs.contracts import LayoutError, WeightLayout
from qgs.contracts.weights import Shapes
from qgs.io.checkpoint import (
    new_checkpoint_path,
    refuse_nonfinite,
    unique_tensors,
    write_checkpoint,
)
from qgs.io.files import refuse_existing, write_text
from qgs.io.tensors import CheckpointError, TensorFile, differing_tensors, pickle_kind, shapes_of
from qgs.wording import listed

TORCH = (".pt", ".pth", ".bin", ".ckpt")
NESTING = ("model", "state_dict", "module")
"""Keys under which training scripts store the weights beside other things."""


@dataclass(frozen=True)
class WeightFile:
    """A flat state dict. tensors: memory-mapped, by name. notes: where they were in the file."""

    path: Path
    tensors: Mapping[str, Tensor]
    notes: tuple[str, ...] = ()


def read_weight_file(path: str | Path) -> WeightFile:
    """The tensors in a file; pages are read when they are used.

    Raises FileNotFoundError and CheckpointError.
    """
    path, notes = Path(path), list[str]()
    if not path.is_file():
        raise FileNotFoundError(f"no file of weights at {path}")
    if path.suffix.lower() == ".safetensors":
        with TensorFile(path) as file:
            if "qgs.recipe" in file.metadata:
                raise CheckpointError(f"{path} is a qgs checkpoint, no published weights")
            tensors = file.read()
    elif path.suffix.lower() in TORCH:
        tensors = _read_torch(path, notes)
    else:
        known = ", ".join((".safetensors", *TORCH))
        raise CheckpointError(f"{path}: weights are read from files named {known}")
    if not tensors:
        raise CheckpointError(f"{path} holds no tensors")
    return WeightFile(path, tensors, tuple(notes))


def _read_torch(path: Path, notes: list[str]) -> dict[str, Tensor]:
    zipped = "zip" in pickle_kind(path)  # only these can be memory-mapped
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)
    except Exception as error:  # whatever torch raises about a file that it cannot read
        raise CheckpointError(
            f"{path} is not a whole torch file of plain tensors ({type(error).__name__}); it is "
            "cut off, or holds Python objects, which could run code: copy it again, or save "
            "`model.state_dict()` alone"
        ) from error
    return _state_dict(content, path, notes)


def _state_dict(content: Any, path: Path, notes: list[str]) -> dict[str, Tensor]:
    """The tensors of a state dict, flat or below the keys in NESTING."""
    if not isinstance(content, Mapping):
        raise CheckpointError(f"{path} holds {type(content).__name__}, no state dict")
    others = [str(key) for key, value in content.items() if not isinstance(value, Tensor)]
    if not others:
        return {str(name): tensor.detach() for name, tensor in content.items()}
    inner = [key for key in NESTING if isinstance(content.get(key), Mapping)]
    if len(inner) != 1:
        raise CheckpointError(
            f"{path} holds entries that are no tensors ({listed(others)}); one state dict may lie "
            f"below {', '.join(NESTING)}, found {', '.join(inner) or 'none'}: save it alone"
        )
    left = [str(key) for key in content if key != inner[0]]
    beside = f"; left out: {listed(left)}" if left else ""
    notes.append(f"the weights lie below {inner[0]!r}{beside}")
    return _state_dict(content[inner[0]], path, notes)


class PublishedError(ValueError):
    """Weights that do not fit a recipe, or a model that a published layout cannot hold."""


@dataclass(frozen=True)
class Names:
    """The parameters of one recipe's model under both names.

    shapes: of our parameters. published: our name to the published one, both unique.
    unnamed: ours that the codebase has no name for. unused: what a published file may also hold.
    """

    layout: WeightLayout
    shapes: Shapes
    published: Mapping[str, str]
    unnamed: tuple[str, ...]
    unused: tuple[str, ...]

    def from_published(
        self, weights: Mapping[str, Tensor], origin: object = "the file"
    ) -> dict[str, Tensor]:
        """A published state dict under our names, `unused` left out.

        Raises PublishedError with every difference in names and shapes.
        """
        wanted = {theirs: self.shapes[ours] for ours, theirs in self.published.items()}
        found = [f"no published name: {name}" for name in self.unnamed]
        if found := found + differing_tensors(shapes_of(weights), wanted, self.unused):
            raise PublishedError(
                f"{origin} does not fit the recipe, whose model is a {self.layout.name} "
                f"(`--recipe auto` writes one that fits), {len(found)} differences:\n  "
                + listed(found, 20, "\n  ")
            )
        return {ours: weights[theirs] for ours, theirs in self.published.items()}


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
    layouts = _layouts(load_usable_plugins()[0].plugins.values())
    found = [layout for layout in layouts if set(layout.marks) <= set(shapes)]
    # A codebase's later release has all names of the earlier one.
    return max(found, key=lambda layout: len(layout.marks), default=None), layouts


def without_prefix(file: WeightFile) -> WeightFile:
    """`file` without the prefix of all its names, where published names remain; with a note.

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


@dataclass(frozen=True)
class Transfer:
    """What `import_weights` did.

    count: parameters taken over. unused: names in the file that the published code never reads.
    settings: paths of options that weights do not show and in which the model differs from the
    published one, to both values. notes: how the file was read and converted.
    recipe_file: the recipe that was written, if one was.
    """

    layout: WeightLayout
    recipe: Recipe
    count: int
    unused: tuple[str, ...]
    settings: Mapping[str, tuple[str, str]]
    notes: tuple[str, ...] = ()
    recipe_file: Path | None = None


def import_weights(
    weights: str | Path,
    recipe: Recipe | None,
    out: str | Path,
    *,
    overrides: Sequence[str] = (),
    to_float32: bool = False,
) -> Transfer:
    """Write a checkpoint of `recipe` with published weights.

    recipe: None for the one that fits, changed by `overrides` (such as "data.image_size=[64, 64]"),
        which is then also written beside `out`, as .yaml.
    out: a new .safetensors file.
    to_float32: convert weights of other floating-point types instead of refusing them.
    Raises FileNotFoundError, FileExistsError, ValueError for another suffix, RecipeError about
    `overrides`, CheckpointError and PublishedError; nothing is written then.
    """
    out = new_checkpoint_path(out)
    recipe_file = out.with_suffix(".yaml") if recipe is None else None
    if recipe_file:
        refuse_existing(recipe_file)
    file = without_prefix(read_weight_file(weights))
    shapes = shapes_of(file.tensors)
    text = ""
    if recipe is None:
        layout, tree = fitting_recipe(shapes, str(weights))
        recipe = resolve(tree, overrides)
        origin = f"{file.path.name}, weights of {layout.name} ({layout.source})"
        lines = [
            f"# Derived from the names and shapes of {origin}.",
            "# Shapes do not determine the following, which is as published:",
            *(f"#   {choice}" for choice in layout.undecided),
            *(f"# Overridden: {override}" for override in overrides),
        ]
        text = "\n".join(lines) + "\n" + dump(dict(recipe.tree if overrides else tree))
    try:
        names = names_of(recipe)
    except PublishedError as error:
        raise PublishedError(f"{file.path} does not fit the recipe: {error}") from error
    tensors, converted = _as_float32(file, names, to_float32)
    settings = differing_predictions(recipe.tree, resolve(names.layout.read(shapes)).tree)
    imported = f"{names.layout.name} weights {file.path.name}"
    write_checkpoint(out, tensors, recipe.tree, {"imported": imported})
    if recipe_file:
        try:
            write_text(recipe_file, text)
        except BaseException:
            out.unlink()
            raise
    dropped = tuple(name for name in names.unused if name in file.tensors)
    notes = (*file.notes, *converted)
    return Transfer(names.layout, recipe, len(tensors), dropped, settings, notes, recipe_file)


def _as_float32(
    file: WeightFile, names: Names, allowed: bool
) -> tuple[dict[str, Tensor], list[str]]:
    """Contiguous float32 tensors under our names, and a note of what was converted.

    Raises PublishedError for other types, where they are not `allowed`, and for NaN and infinity.
    """
    given = names.from_published(file.tensors, file.path)
    others = {name: t.dtype for name, t in given.items() if t.dtype != torch.float32}
    kinds = Counter(str(dtype).removeprefix("torch.") for dtype in others.values())
    report = ", ".join(f"{count} of {len(given)} are {kind}" for kind, count in kinds.items())
    strange = [names.published[n] for n, dtype in others.items() if not dtype.is_floating_point]
    if strange:
        raise PublishedError(
            f"{file.path} holds weights that are no real numbers: {listed(strange)} ({report})"
        )
    if others and not allowed:
        raise PublishedError(
            f"{file.path} holds weights that are not float32 ({report}); take the float32 file, or "
            "convert with --to-float32"
        )
    tensors: dict[str, Tensor] = {}
    stored: set[int] = set()
    for name, tensor in given.items():
        tensor = tensor.to(torch.float32).contiguous()
        # A torch file may store several names once; a checkpoint holds each on its own.
        tensors[name] = tensor.clone() if tensor.data_ptr() in stored else tensor
        stored.add(tensor.data_ptr())
    refuse_nonfinite({names.published[name]: t for name, t in tensors.items()}, file.path)
    return tensors, [f"converted to float32: {report}"] if others else []

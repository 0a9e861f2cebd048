"""Published weights in and out of checkpoints, every tensor accounted for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from qgs.composer import Recipe, resolve
from qgs.contracts import WeightLayout
from qgs.contracts.weights import Shapes
from qgs.io.checkpoint import CheckpointError, load_recipe, write_checkpoint
from qgs.io.differences import options_beside_weights, shapes_of
from qgs.io.files import replacing, write_text
from qgs.io.published import (
    Names,
    PublishedError,
    advice,
    exact_layout_of,
    fitting_recipe,
    layout_of,
    names_in,
    recipe_text,
    without_prefix,
)
from qgs.io.weight_file import WeightFile, read_weight_file

LISTED = 8
"""Tensors that a message about values names; names and shapes that differ are all listed."""


@dataclass(frozen=True)
class Imported:
    """What `import_weights` did.

    used: parameters installed. dropped: published names that nothing reads. notes: what was made of
    the file. recipe_file: the recipe that was written, if one was. settings: as of `Exported`.
    """

    layout: WeightLayout
    recipe: Recipe
    used: int
    dropped: tuple[str, ...]
    notes: tuple[str, ...]
    recipe_file: Path | None
    settings: tuple[str, ...]


@dataclass(frozen=True)
class Exported:
    """What `export_weights` did.

    absent: parameters that the codebase stores, never reads, and finds missing in the file.
    settings: options that the file cannot carry and in which the model differs from the published
    one, as `path: value (published value)`.
    """

    layout: WeightLayout
    written: int
    absent: tuple[str, ...]
    settings: tuple[str, ...]


def import_weights(
    weights: str | Path,
    recipe: Recipe | None,
    out: str | Path,
    *,
    overrides: Sequence[str] = (),
    to_float32: bool = False,
) -> Imported:
    """Write a checkpoint of `recipe` with published weights.

    recipe: None for the one that fits, changed by `overrides` (such as "data.image_size=[64, 64]"),
        which is then also written beside `out`, as .yaml.
    out: a new .safetensors file.
    to_float32: convert weights of other floating-point types instead of refusing them.
    Raises FileNotFoundError, FileExistsError, ValueError for another suffix, RecipeError about
    `overrides`, WeightFileError and PublishedError; nothing is written then.
    """
    out = safetensors_path(out)
    recipe_file = out.with_suffix(".yaml") if recipe is None else None
    for target in filter(None, (out, recipe_file)):
        refuse_taken(target)
    file = without_prefix(read_weight_file(weights))
    text = ""
    if recipe is None:
        layout, tree = fitting_recipe(shapes_of(file.tensors), str(weights))
        recipe = resolve(tree, overrides)
        tree = recipe.tree if overrides else tree
        text = recipe_text(tree, layout, file.path.name, overrides)
    layout, names = _fitting_names(file, recipe)
    tensors = names.from_published(file.tensors)
    tensors, converted = _as_float32(tensors, names, file.path, to_float32)
    _refuse_nonfinite(tensors, names, file.path)
    origin = {"imported": f"{layout.name} weights {file.path.name}"}
    settings = _settings(recipe, layout, shapes_of(file.tensors))
    write_checkpoint(out, tensors, recipe.tree, origin)
    if recipe_file:
        _write_beside(out, recipe_file, text)
    dropped = tuple(name for name in names.unused if name in file.tensors)
    notes = (*file.notes, *converted)
    return Imported(layout, recipe, len(tensors), dropped, notes, recipe_file, settings)


def export_weights(checkpoint: str | Path, out: str | Path) -> Exported:
    """Write the weights of a checkpoint under their published names.

    out: a new .safetensors file. Raises FileNotFoundError, FileExistsError, CheckpointError,
    ValueError for another suffix, and PublishedError for a model that no published layout can hold;
    nothing is written then.
    """
    out = safetensors_path(out)
    refuse_taken(out)
    recipe = load_recipe(checkpoint)
    layout = exact_layout_of(recipe)
    names = names_in(recipe, layout)
    with safe_open(checkpoint, "pt") as file:
        stored = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    if shapes_of(stored) != names.shapes:
        raise CheckpointError(f"{checkpoint} does not fit the model of its recipe; see qgs.load")
    published = names.to_published(stored)
    with replacing(out) as temporary:
        save_file(published, temporary, {"format": "pt"})
    settings = _settings(recipe, layout, shapes_of(published))
    return Exported(layout, len(published), names.unused, settings)


def safetensors_path(path: str | Path) -> Path:
    """`path`; raises ValueError unless it is named .safetensors."""
    path = Path(path)
    if path.suffix.lower() != ".safetensors":
        raise ValueError(f"{path}: weights are written as safetensors; name it .safetensors")
    return path


def refuse_taken(path: Path) -> None:
    """Raise FileExistsError for a path at which something lies already."""
    if path.exists():
        raise FileExistsError(f"{path} exists and is never overwritten; choose another name")


def _write_beside(checkpoint: Path, recipe_file: Path, text: str) -> None:
    """Write the recipe of a new checkpoint, or take the checkpoint away again."""
    try:
        write_text(recipe_file, text)
    except BaseException:
        checkpoint.unlink()
        raise


def _fitting_names(file: WeightFile, recipe: Recipe) -> tuple[WeightLayout, Names]:
    """The layout and names of a recipe's model; raises PublishedError where the file differs."""
    shapes = shapes_of(file.tensors)
    try:
        layout = layout_of(recipe)
    except PublishedError as error:
        help_ = "".join(f"\n  {line}" for line in advice(recipe, None, shapes))
        raise PublishedError(f"{file.path} does not fit the recipe: {error}{help_}") from error
    names = names_in(recipe, layout)
    found = names.mismatches(shapes)
    if found:
        counts = Counter(line.partition(":")[0].partition(" of ")[0] for line in found)
        told = ", ".join(f"{count} {kind}" for kind, count in counts.items())
        lines = [*advice(recipe, layout, shapes), f"the differences ({told}):"]
        lines += [f"  {line}" for line in found]
        raise PublishedError(
            f"{file.path} does not fit the recipe, whose model is a {layout.name}; nothing is "
            "written" + "".join(f"\n  {line}" for line in lines)
        )
    return layout, names


def _as_float32(
    tensors: Mapping[str, Tensor], names: Names, path: Path, allowed: bool
) -> tuple[dict[str, Tensor], list[str]]:
    """Contiguous float32 tensors, and what was converted."""
    others = {name: t.dtype for name, t in tensors.items() if t.dtype != torch.float32}
    kinds = Counter(str(dtype).removeprefix("torch.") for dtype in others.values())
    told = ", ".join(f"{count} of {len(tensors)} are {kind}" for kind, count in kinds.items())
    strange = [name for name, dtype in others.items() if not dtype.is_floating_point]
    if strange:
        listed = _listed(names.published[name] for name in strange)
        raise PublishedError(f"{path} holds weights that are no real numbers: {listed} ({told})")
    if others and not allowed:
        raise PublishedError(
            f"{path} holds weights that are not float32 ({told}); {_loss(others.values())}"
        )
    notes = [f"converted to float32: {told}"] if others else []
    return _apart({name: t.to(torch.float32).contiguous() for name, t in tensors.items()}), notes


def _loss(dtypes: Iterable[torch.dtype]) -> str:
    """What converting weights of these types to float32 means, and what to do."""
    if any(dtype.itemsize < torch.float32.itemsize for dtype in dtypes):
        lost = "half precision has lost digits that no conversion brings back"
        return f"{lost}. Take the float32 file, or convert with --to-float32"
    return "--to-float32 rounds them to the float32 that models here compute in"


def _apart(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors, those that a torch file stored once for several names copied."""
    seen: set[int] = set()
    apart = {}
    for name, tensor in tensors.items():
        apart[name] = tensor.clone() if tensor.data_ptr() in seen else tensor
        seen.add(tensor.data_ptr())
    return apart


def _refuse_nonfinite(tensors: Mapping[str, Tensor], names: Names, path: Path) -> None:
    broken = [names.published[name] for name, t in tensors.items() if not t.isfinite().all()]
    if broken:
        raise PublishedError(
            f"{path} holds NaN or infinite values in {len(broken)} tensors: {_listed(broken)}; the "
            "training that wrote it had diverged, or the file is damaged"
        )


def _settings(recipe: Recipe, layout: WeightLayout, shapes: Shapes) -> tuple[str, ...]:
    """Options of the model in which it predicts otherwise than the published one of its sizes."""
    apart = options_beside_weights(recipe.tree, resolve(layout.read(shapes)).tree)
    return tuple(
        f"{path}: {own} ({layout.name}: {theirs})" for path, (own, theirs) in apart.items()
    )


def _listed(names: Iterable[str]) -> str:
    every = list(names)
    more = f" and {len(every) - LISTED} more" if len(every) > LISTED else ""
    return ", ".join(every[:LISTED]) + more

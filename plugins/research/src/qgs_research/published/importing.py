"""Import of published weights as checkpoints, and export of checkpoints.

A published tensor that is neither used nor listed as unused by its layout is an error.
"""

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from qgs.checkpoint.model_file import CheckpointFile, refuse_nonfinite, write_checkpoint
from qgs.checkpoint.tensors import CheckpointError, nonfinite, shapes_of
from qgs.files import refuse_existing, write_text
from qgs.recipe import Recipe, resolve
from qgs.recipe.recipe import differing_predictions
from qgs.recipe.yaml_text import dump
from qgs.wording import listed
from qgs_research.published.layouts import (
    Names,
    PublishedError,
    fitting_recipe,
    names_of,
    recognise,
)
from qgs_research.published.weight_files import WeightFile, read_weight_file


def import_weights(
    weights: str | Path,
    recipe: Recipe | None,
    out: str | Path,
    *,
    overrides: Sequence[str] = (),
) -> list[str]:
    """Write a checkpoint of `recipe` with published weights, and return a report as lines of text.

    The report says how the file was read and converted, which tensors are unused, and which options
    of the recipe differ from the published model although the weights fit, such as activations.

    recipe: None derives the recipe from the weights, changes it by `overrides`, for example
        "data.image_size=[64, 64]", and writes it to a .yaml file beside `out`.
    out: path of a new .safetensors file.
    Raises FileNotFoundError, FileExistsError, ValueError for a wrong suffix of `out`, RecipeError,
    CheckpointError and PublishedError. After an error no file is left.
    """
    out = new_checkpoint_path(out)
    # A given recipe needs no second file.
    recipe_file = out.with_suffix(".yaml") if recipe is None else None
    if recipe_file:
        refuse_existing(recipe_file)
    file = _without_prefix(read_weight_file(weights))
    shapes = shapes_of(file.tensors)
    text = ""
    if recipe is None:
        layout, tree = fitting_recipe(shapes, str(weights))
        recipe = resolve(tree, overrides)
        lines = [
            f"# Derived from {file.path.name}, weights of {layout.name} ({layout.source}).",
            "# Shapes do not determine these options; the published values are used:",
            *(f"#   {choice}" for choice in layout.undecided),
            *(f"# Overridden: {override}" for override in overrides),
        ]
        text = "\n".join([*lines, dump(dict(recipe.tree if overrides else tree))])
    names = names_of(recipe)
    tensors, converted = _as_float32(file, names)
    # Weights do not show activations, so report where the recipe differs from the published one.
    settings = differing_predictions(recipe.tree, resolve(names.layout.read(shapes)).tree)
    name = names.layout.name
    imported = f"{name} weights {file.path.name}"
    write_checkpoint(out, tensors, recipe.tree, recipe.releases, {"imported": imported})
    if recipe_file:
        try:
            write_text(recipe_file, text)
        except BaseException:
            # A checkpoint without a known recipe would be useless.
            out.unlink()
            raise
    used = f"{name} ({names.layout.source}): {len(tensors)} tensors used"
    report = [*file.notes, *converted, used]
    dropped = [tensor for tensor in names.unused if tensor in file.tensors]
    if dropped:
        report.append(f"dropped {len(dropped)} tensors that the code of {name} never reads:")
        report += [f"  {tensor}" for tensor in dropped]
    if settings:
        report.append(f"options that weights do not determine differ from {name}:")
        report += [f"  {path}: {a} ({name}: {b})" for path, (a, b) in settings.items()]
    report.append(f"wrote {out}")
    if recipe_file:
        report.append(f"wrote {recipe_file}; its head lists options that weights do not determine")
    return report


def _without_prefix(file: WeightFile) -> WeightFile:
    """Remove the prefix of all names of tensors if a known layout has the names without it.

    Training frameworks prepend the attribute that holds the model, such as `model.` or `module.`.
    """
    # A common prefix is a prefix of any name, so the first name is enough.
    modules = next(iter(file.tensors)).split(".")[:-1]
    for depth in range(1, len(modules) + 1):
        prefix = ".".join(modules[:depth]) + "."
        tensors = {name.removeprefix(prefix): tensor for name, tensor in file.tensors.items()}
        if all(name.startswith(prefix) for name in file.tensors) and recognise(shapes_of(tensors)):
            note = f"removed the prefix {prefix!r} from all {len(tensors)} names"
            return WeightFile(file.path, tensors, (*file.notes, note))
    return file


def _as_float32(file: WeightFile, names: Names) -> tuple[dict[str, Tensor], list[str]]:
    """Return contiguous float32 tensors by their names in qgs, and notes about conversions.

    Raises PublishedError for weights that are not floating-point numbers, and the error of
    `refuse_nonfinite` for NaN and infinity.
    """
    given = names.from_published(file.tensors, file.path)
    others = {name: t.dtype for name, t in given.items() if t.dtype != torch.float32}
    kinds = Counter(str(dtype).removeprefix("torch.") for dtype in others.values())
    report = ", ".join(f"{count} of {len(given)} are {kind}" for kind, count in kinds.items())
    # For example, quantised weights, whose scales are stored elsewhere.
    strange = [names.published[n] for n, dtype in others.items() if not dtype.is_floating_point]
    if strange:
        raise PublishedError(
            f"{file.path} holds weights that are not floating-point numbers: {listed(strange)} "
            f"({report}); save the weights as float32"
        )
    tensors: dict[str, Tensor] = {}
    stored: set[int] = set()
    for name, tensor in given.items():
        tensor = tensor.to(torch.float32).contiguous()
        # Names may share a tensor in a torch file; a checkpoint stores each on its own.
        tensors[name] = tensor.clone() if tensor.data_ptr() in stored else tensor
        stored.add(tensor.data_ptr())
    refuse_nonfinite({names.published[name]: t for name, t in tensors.items()}, file.path)
    return tensors, [f"converted to float32: {report}"] if others else []


def export_checkpoint(name: str | os.PathLike[str], out: str | Path, half: bool) -> None:
    """Copy a checkpoint to a new file. half: True stores floating-point weights as float16.

    Raises the errors of `CheckpointFile`, and CheckpointError if a weight is too large for float16.
    """
    out = new_checkpoint_path(out)
    with CheckpointFile(name) as file:
        tensors = file.tensors
        refuse_nonfinite(tensors, file.path)
        if half:
            real = {name: t.half() for name, t in tensors.items() if t.is_floating_point()}
            tensors = {**tensors, **real}
        # A finite float32 may be infinite in float16.
        if broken := nonfinite(tensors):
            raise CheckpointError(
                f"{file.path} has weights that float16 cannot hold (larger than 65504): "
                f"{listed(broken)}; export it without --half"
            )
        write_checkpoint(out, tensors, file.recipe.tree, file.recipe.releases, file.extra)


def new_checkpoint_path(path: str | Path) -> Path:
    """Return `path`, after a check that no such file exists and that it ends in .safetensors.

    Raises ValueError for another suffix, and FileExistsError for an existing file.
    """
    path = Path(path)
    if path.suffix.lower() != ".safetensors":
        raise ValueError(
            f"{path}: checkpoints are safetensors files; choose a name that ends in .safetensors"
        )
    refuse_existing(path)
    return path

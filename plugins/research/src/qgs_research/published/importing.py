"""Checkpoints from published weights: every tensor used, dropped by name, or an error. Exports."""

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

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


class Transfer(NamedTuple):
    """What `import_weights` did. report: in lines.

    How the file was read and converted, which tensors are unused, which options weights do not
    determine, and in which of these the model differs from the published one.
    """

    recipe: Recipe
    report: list[str]


def import_weights(
    weights: str | Path,
    recipe: Recipe | None,
    out: str | Path,
    *,
    overrides: Sequence[str] = (),
) -> Transfer:
    """Write a checkpoint of `recipe` with published weights.

    recipe: None for the one that fits, changed by `overrides` (such as "data.image_size=[64, 64]"),
        which is then also written beside `out`, as .yaml.
    out: a new .safetensors file.
    Raises FileNotFoundError, FileExistsError, ValueError for another suffix, RecipeError about
    `overrides`, CheckpointError and PublishedError; nothing is written then.
    """
    out = new_checkpoint_path(out)
    # A recipe that was given needs no second file.
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
            "# Shapes do not determine the following, which is as published:",
            *(f"#   {choice}" for choice in layout.undecided),
            *(f"# Overridden: {override}" for override in overrides),
        ]
        text = "\n".join([*lines, dump(dict(recipe.tree if overrides else tree))])
    names = names_of(recipe)
    tensors, converted = _as_float32(file, names)
    # Weights show no activations: tell where the recipe differs from what was published.
    settings = differing_predictions(recipe.tree, resolve(names.layout.read(shapes)).tree)
    name = names.layout.name
    imported = f"{name} weights {file.path.name}"
    write_checkpoint(out, tensors, recipe.tree, recipe.releases, {"imported": imported})
    if recipe_file:
        try:
            write_text(recipe_file, text)
        except BaseException:
            # A checkpoint of an unknown recipe would be of no use.
            out.unlink()
            raise
    used = f"{name} ({names.layout.source}): {len(tensors)} tensors used"
    report = [*file.notes, *converted, used]
    dropped = [tensor for tensor in names.unused if tensor in file.tensors]
    if dropped:
        report.append(f"knowingly dropped, {name} never reads these {len(dropped)}:")
        report += [f"  {tensor}" for tensor in dropped]
    if settings:
        report.append(f"the recipe differs from {name} in options that no weight shows:")
        report += [f"  {path}: {a} ({name}: {b})" for path, (a, b) in settings.items()]
    report.append(f"wrote {out}")
    if recipe_file:
        report.append(f"wrote {recipe_file}, which says what shapes do not determine")
    return Transfer(recipe, report)


def _without_prefix(file: WeightFile) -> WeightFile:
    """`file` without a prefix that all its names share, where published names remain; with a note.

    Training frameworks prepend the attribute that holds the model (`model.`, `module.`).
    """
    # Any name shows the prefixes that all could have.
    modules = next(iter(file.tensors)).split(".")[:-1]
    for depth in range(1, len(modules) + 1):
        prefix = ".".join(modules[:depth]) + "."
        tensors = {name.removeprefix(prefix): tensor for name, tensor in file.tensors.items()}
        if all(name.startswith(prefix) for name in file.tensors) and recognise(shapes_of(tensors)):
            note = f"took {prefix!r} off all {len(tensors)} names"
            return WeightFile(file.path, tensors, (*file.notes, note))
    return file


def _as_float32(file: WeightFile, names: Names) -> tuple[dict[str, Tensor], list[str]]:
    """Contiguous float32 tensors under our names, and a note of what was converted.

    Raises PublishedError for numbers that are not real, and for NaN and infinity.
    """
    given = names.from_published(file.tensors, file.path)
    others = {name: t.dtype for name, t in given.items() if t.dtype != torch.float32}
    kinds = Counter(str(dtype).removeprefix("torch.") for dtype in others.values())
    report = ", ".join(f"{count} of {len(given)} are {kind}" for kind, count in kinds.items())
    # Quantised weights, for example, whose scales are elsewhere.
    strange = [names.published[n] for n, dtype in others.items() if not dtype.is_floating_point]
    if strange:
        raise PublishedError(
            f"{file.path} holds weights that are no real numbers: {listed(strange)} ({report})"
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


def export_checkpoint(name: str | os.PathLike[str], out: str | Path, half: bool = False) -> None:
    """Write a checkpoint again. half: its real numbers as float16; all else stays as it is.

    Raises as `CheckpointFile`, and CheckpointError where float16 cannot hold a weight.
    """
    out = new_checkpoint_path(out)
    with CheckpointFile(name) as file:
        tensors = file.tensors
        refuse_nonfinite(tensors, file.path)
        if half:
            real = {name: t.half() for name, t in tensors.items() if t.is_floating_point()}
            tensors = {**tensors, **real}
        # Finite in float32, they may be infinite now.
        if broken := nonfinite(tensors):
            raise CheckpointError(
                f"{file.path} has weights that float16 cannot hold (larger than 65504): "
                f"{listed(broken)}; ship it as it is"
            )
        write_checkpoint(out, tensors, file.recipe.tree, file.recipe.releases, file.extra)


def new_checkpoint_path(path: str | Path) -> Path:
    """`path`; raises ValueError for another suffix, FileExistsError where something lies."""
    path = Path(path)
    if path.suffix.lower() != ".safetensors":
        raise ValueError(f"{path}: weights are written as safetensors; name it .safetensors")
    refuse_existing(path)
    return path

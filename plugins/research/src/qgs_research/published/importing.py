"""Import of published weights as checkpoints, and export of checkpoints.

Published weights are flat state dicts in safetensors files or torch files. A published tensor that
is neither used nor listed as unused by its layout is an error.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from qgs.checkpoint.model_file import CheckpointFile, refuse_nonfinite, write_checkpoint
from qgs.checkpoint.tensors import (
    CheckpointError,
    TensorFile,
    Weights,
    copied,
    inside,
    nonfinite,
    pickle_kind,
    shapes_of,
)
from qgs.files import AnyPath, refuse_existing, write_text
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
from qgs_research.published.weight_layout import WeightLayout

TORCH = (".pt", ".pth", ".bin", ".ckpt")
NESTING = ("model", "state_dict", "module")
"""Keys under which training scripts store the state dict in a file with other values."""


def read_weight_file(path: Path, notes: list[str]) -> Weights:
    """Return the state dict in a file. Memory-mapped tensors are read when they are used.

    notes: list to which lines are appended that say how the state dict was found in the file.
    Raises FileNotFoundError for a missing file, and CheckpointError for a file that does not hold a
    state dict of tensors.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file of weights {path}; correct the path")
    if path.suffix.lower() == ".safetensors":
        with TensorFile(path) as file:
            # An import would lose its recipe.
            if "qgs.recipe" in file.metadata:
                raise CheckpointError(
                    f"{path} is already a qgs checkpoint, so there is nothing to import; use it as "
                    "it is"
                )
            tensors = file.read()
    elif path.suffix.lower() in TORCH:
        tensors = _read_torch(path, notes)
    else:
        known = ", ".join((".safetensors", *TORCH))
        raise CheckpointError(f"{path}: the name of a file of weights must end in one of {known}")
    if not tensors:
        raise CheckpointError(f"{path} holds no tensors; save `model.state_dict()` to this file")
    return tensors


def _read_torch(path: Path, notes: list[str]) -> dict[str, Tensor]:
    zipped = "zip" in pickle_kind(path)  # only these can be memory-mapped
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)
    except Exception as error:  # whatever torch raises about a file that it cannot read
        raise CheckpointError(
            f"{path} cannot be read as a torch file of tensors ({type(error).__name__}): it is "
            "incomplete, or it holds Python objects, which could run code. Copy it again, or save "
            "only `model.state_dict()`"
        ) from error
    try:
        return _state_dict(content, path, notes)
    except RecursionError:  # a dict may hold itself
        raise CheckpointError(
            f"{path}: the weights are nested too deeply; save only `model.state_dict()`"
        ) from None


def _state_dict(content: Any, path: Path, notes: list[str]) -> dict[str, Tensor]:
    """Return the state dict in `content`: `content` itself, or the value of a key in NESTING."""
    if not isinstance(content, Mapping):
        raise CheckpointError(
            f"{path} holds a {type(content).__name__}, not a state dict; save only "
            "`model.state_dict()`"
        )
    # A training script stores other values too, usually one level above the weights.
    others = [str(key) for key, value in content.items() if not isinstance(value, Tensor)]
    if not others:
        return {str(name): tensor.detach() for name, tensor in content.items()}
    inner = [key for key in NESTING if isinstance(content.get(key), Mapping)]
    # The user must choose between two state dicts, for example one of a moving average.
    if len(inner) != 1:
        raise CheckpointError(
            f"{path} holds entries that are not tensors ({listed(others)}), and a state dict is "
            f"expected under exactly one of the keys {', '.join(NESTING)}, but found under "
            f"{', '.join(inner) or 'none'}. Save only the state dict"
        )
    left = [str(key) for key in content if key != inner[0]]
    beside = f"; left out: {listed(left)}" if left else ""
    notes.append(f"the weights are below the key {inner[0]!r}{beside}")
    return _state_dict(content[inner[0]], path, notes)


def import_weights(
    weights: Path, recipe: Recipe | None, out: Path, *, overrides: Sequence[str] = ()
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
    check_new_checkpoint(out)
    # A given recipe needs no second file.
    recipe_file = out.with_suffix(".yaml") if recipe is None else None
    if recipe_file:
        refuse_existing(recipe_file)
    report = list[str]()
    given = _without_prefix(read_weight_file(weights, report), report)
    shapes = shapes_of(given)
    text = ""
    if recipe is None:
        layout, tree = fitting_recipe(shapes, str(weights))
        recipe = resolve(tree, overrides)
        head = _head(weights, layout, overrides)
        text = "\n".join([*head, dump(dict(recipe.tree if overrides else tree))])
    names = names_of(recipe)
    tensors = _as_float32(given, names, weights, report)
    # Weights do not show activations, so report where the recipe differs from the published one.
    settings = differing_predictions(recipe.tree, resolve(names.layout.read(shapes)).tree)
    name = names.layout.name
    imported = f"{name} weights {weights.name}"
    write_checkpoint(out, tensors, recipe.tree, recipe.releases, {"imported": imported})
    if recipe_file:
        try:
            write_text(recipe_file, text)
        except BaseException:
            # A checkpoint without a known recipe would be useless.
            out.unlink()
            raise
    report.append(f"{name} ({names.layout.source}): {len(tensors)} tensors used")
    dropped = [tensor for tensor in names.unused if tensor in given]
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


def _head(weights: Path, layout: WeightLayout, overrides: Sequence[str]) -> Sequence[str]:
    """Return lines of YAML that say what a derived recipe rests on."""
    return [
        f"# Derived from {weights.name}, weights of {layout.name} ({layout.source}).",
        "# Shapes do not determine these options; the published values are used:",
        *(f"#   {choice}" for choice in layout.undecided),
        *(f"# Overridden: {override}" for override in overrides),
    ]


def _without_prefix(given: Weights, notes: list[str]) -> Weights:
    """Remove the prefix of all names of tensors if a known layout has the names without it.

    Training frameworks prepend the attribute that holds the model, such as `model.` or `module.`.
    notes: list to which a line about a removed prefix is appended.
    """
    # A common prefix is a prefix of any name, so the first name is enough.
    modules = next(iter(given)).split(".")[:-1]
    for prefix in accumulate(f"{module}." for module in modules):
        tensors = inside(prefix, given)
        if len(tensors) == len(given) and recognise(shapes_of(tensors)):
            notes.append(f"removed the prefix {prefix!r} from all {len(tensors)} names")
            return tensors
    return given


def _as_float32(weights: Weights, names: Names, path: Path, notes: list[str]) -> dict[str, Tensor]:
    """Return contiguous float32 tensors by their names in qgs.

    path: file of the weights, for messages. notes: list to which a line about conversions is
    appended. Raises PublishedError for weights that are not floating-point numbers, and the error
    of `refuse_nonfinite` for NaN and infinity.
    """
    given = names.from_published(weights, path)
    others = {name: t.dtype for name, t in given.items() if t.dtype != torch.float32}
    kinds = Counter(str(dtype).removeprefix("torch.") for dtype in others.values())
    report = ", ".join(f"{count} of {len(given)} are {kind}" for kind, count in kinds.items())
    # For example, quantised weights, whose scales are stored elsewhere.
    strange = [names.published[n] for n, dtype in others.items() if not dtype.is_floating_point]
    if strange:
        raise PublishedError(
            f"{path} holds weights that are not floating-point numbers: {listed(strange)} "
            f"({report}); save the weights as float32"
        )
    # Names may share a tensor in a torch file; a checkpoint stores each on its own.
    tensors = copied({name: tensor.to(torch.float32) for name, tensor in given.items()})
    refuse_nonfinite({names.published[name]: t for name, t in tensors.items()}, path)
    if others:
        notes.append(f"converted to float32: {report}")
    return tensors


def export_checkpoint(name: AnyPath, out: Path, half: bool) -> None:
    """Copy a checkpoint to a new file. half: True stores floating-point weights as float16.

    Raises the errors of `CheckpointFile`, and CheckpointError if a weight is too large for float16.
    """
    check_new_checkpoint(out)
    with CheckpointFile(name) as file:
        tensors = file.tensors
        refuse_nonfinite(tensors, file.path)
        if half:
            tensors = {
                name: t.half() if t.is_floating_point() else t for name, t in tensors.items()
            }
        # A finite float32 may be infinite in float16.
        if broken := nonfinite(tensors):
            raise CheckpointError(
                f"{file.path} has weights that float16 cannot hold (larger than 65504): "
                f"{listed(broken)}; export it without --half"
            )
        write_checkpoint(out, tensors, file.recipe.tree, file.recipe.releases, file.extra)


def check_new_checkpoint(path: Path) -> None:
    """Raise FileExistsError for an existing file, and ValueError unless it is a .safetensors."""
    if path.suffix.lower() != ".safetensors":
        raise ValueError(
            f"{path}: checkpoints are safetensors files; choose a name that ends in .safetensors"
        )
    refuse_existing(path)

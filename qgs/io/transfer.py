"""Published weights in and out of checkpoints, every tensor accounted for."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from qgs.composer import Recipe, resolve
from qgs.contracts import WeightLayout
from qgs.contracts.weights import Shapes
from qgs.io.checkpoint import (
    CheckpointError,
    load_extra,
    load_recipe,
    read_tensors,
    refuse_damaged,
    write_checkpoint,
)
from qgs.io.differences import options_beside_weights, refuse_broken, shapes_of
from qgs.io.files import refuse_existing, replacing, write_text
from qgs.io.published import (
    Names,
    PublishedError,
    advice,
    exact_names_of,
    fitting_recipe,
    names_of,
    recipe_text,
    without_prefix,
)
from qgs.io.weight_file import WeightFile, read_weight_file
from qgs.wording import listed


@dataclass(frozen=True)
class Transfer:
    """What `import_weights` or `export_weights` did.

    count: parameters taken over. unused: published names that nothing reads, of an import those
    that the file had, of an export all, which the file lacks. settings: options that weights do not
    show and in which the model differs from the published one, as `path: value (published value)`.
    notes: what was made of the file. recipe_file: the recipe that was written, if one was.
    """

    layout: WeightLayout
    recipe: Recipe
    count: int
    unused: tuple[str, ...]
    settings: tuple[str, ...]
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
    out = _new_safetensors(out)
    recipe_file = out.with_suffix(".yaml") if recipe is None else None
    if recipe_file:
        refuse_existing(recipe_file)
    file = without_prefix(read_weight_file(weights))
    shapes = shapes_of(file.tensors)
    text = ""
    if recipe is None:
        layout, tree = fitting_recipe(shapes, str(weights))
        recipe = resolve(tree, overrides)
        text = recipe_text(recipe.tree if overrides else tree, layout, file.path.name, overrides)
    names = _fitting_names(file, recipe)
    tensors, converted = _as_float32(file, names, to_float32)
    origin = {"imported": f"{names.layout.name} weights {file.path.name}"}
    settings = _settings(recipe, names.layout, shapes)
    write_checkpoint(out, tensors, recipe.tree, origin)
    if recipe_file:
        try:
            write_text(recipe_file, text)
        except BaseException:
            out.unlink()
            raise
    dropped = tuple(name for name in names.unused if name in file.tensors)
    notes = (*file.notes, *converted)
    return Transfer(names.layout, recipe, len(tensors), dropped, settings, notes, recipe_file)


def export_weights(checkpoint: str | Path, out: str | Path) -> Transfer:
    """Write the weights of a checkpoint under their published names.

    out: a new .safetensors file. Raises FileNotFoundError, FileExistsError, CheckpointError,
    ValueError for another suffix, and PublishedError for a model that no published layout can hold;
    nothing is written then.
    """
    out = _new_safetensors(out)
    recipe = load_recipe(checkpoint)
    names = exact_names_of(recipe)
    stored = read_tensors(checkpoint)
    if shapes_of(stored) != names.shapes:
        raise CheckpointError(f"{checkpoint} does not fit the model of its recipe; see qgs.load")
    refuse_damaged(stored, checkpoint)
    published = names.to_published(stored)
    with replacing(out) as temporary:
        save_file(published, temporary, {"format": "pt"})
    settings = _settings(recipe, names.layout, shapes_of(published))
    return Transfer(names.layout, recipe, len(published), names.unused, settings)


def export_half(checkpoint: str | Path, out: str | Path) -> None:
    """Write a checkpoint again with its real numbers as float16; all else stays as it is.

    Raises as `export_weights` does, and CheckpointError where float16 cannot hold a weight.
    """
    out = _new_safetensors(out)
    recipe, stored = load_recipe(checkpoint), read_tensors(checkpoint)
    refuse_damaged(stored, checkpoint)
    halved = {n: t.half() if t.is_floating_point() else t for n, t in stored.items()}
    broken = [name for name, tensor in halved.items() if not tensor.isfinite().all()]
    if broken:
        raise CheckpointError(
            f"{checkpoint} has weights that float16 cannot hold (infinite, or beyond 65504): "
            f"{listed(broken)}; ship it as it is"
        )
    write_checkpoint(out, halved, recipe.tree, load_extra(checkpoint))


def _new_safetensors(path: str | Path) -> Path:
    """`path`; raises ValueError for another suffix, FileExistsError where something lies."""
    path = Path(path)
    if path.suffix.lower() != ".safetensors":
        raise ValueError(f"{path}: weights are written as safetensors; name it .safetensors")
    refuse_existing(path)
    return path


def _fitting_names(file: WeightFile, recipe: Recipe) -> Names:
    """The names of a recipe's model; raises PublishedError where the file differs."""
    shapes = shapes_of(file.tensors)
    try:
        names = names_of(recipe)
    except PublishedError as error:
        lines = "".join(f"\n  {line}" for line in advice(recipe, None, shapes))
        raise PublishedError(f"{file.path} does not fit the recipe: {error}{lines}") from error
    found = names.mismatches(shapes)
    if found:
        counts = Counter(line.partition(":")[0].partition(" of ")[0] for line in found)
        kinds = ", ".join(f"{count} {kind}" for kind, count in counts.items())
        lines = advice(recipe, names.layout, shapes)
        lines += [f"the differences ({kinds}):", *(f"  {line}" for line in found)]
        raise PublishedError(
            f"{file.path} does not fit the recipe, whose model is a {names.layout.name}; nothing "
            "is written" + "".join(f"\n  {line}" for line in lines)
        )
    return names


def _as_float32(
    file: WeightFile, names: Names, allowed: bool
) -> tuple[dict[str, Tensor], list[str]]:
    """Contiguous float32 tensors under our names, and a note of what was converted.

    Raises PublishedError for other types, where they are not `allowed`, and for NaN and infinity.
    """
    given = names.from_published(file.tensors)
    others = {name: t.dtype for name, t in given.items() if t.dtype != torch.float32}
    kinds = Counter(str(dtype).removeprefix("torch.") for dtype in others.values())
    report = ", ".join(f"{count} of {len(given)} are {kind}" for kind, count in kinds.items())
    strange = [names.published[n] for n, dtype in others.items() if not dtype.is_floating_point]
    if strange:
        raise PublishedError(
            f"{file.path} holds weights that are no real numbers: {listed(strange)} ({report})"
        )
    if others and not allowed:
        fix = "--to-float32 rounds them to the float32 that models here compute in"
        if any(dtype.itemsize < torch.float32.itemsize for dtype in others.values()):
            fix = (
                "half precision has lost digits that no conversion brings back. Take the float32 "
                "file, or convert with --to-float32"
            )
        raise PublishedError(f"{file.path} holds weights that are not float32 ({report}); {fix}")
    tensors: dict[str, Tensor] = {}
    stored: set[int] = set()
    for name, tensor in given.items():
        tensor = tensor.to(torch.float32).contiguous()
        # A torch file may store several names once; a checkpoint holds each on its own.
        tensors[name] = tensor.clone() if tensor.data_ptr() in stored else tensor
        stored.add(tensor.data_ptr())
    refuse_broken({names.published[name]: t for name, t in tensors.items()}, file.path)
    return tensors, [f"converted to float32: {report}"] if others else []


def _settings(recipe: Recipe, layout: WeightLayout, shapes: Shapes) -> tuple[str, ...]:
    """Options of the model in which it predicts otherwise than the published one of its sizes."""
    apart = options_beside_weights(recipe.tree, resolve(layout.read(shapes)).tree)
    return tuple(
        f"{path}: {own} ({layout.name}: {theirs})" for path, (own, theirs) in apart.items()
    )

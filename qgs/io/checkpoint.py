"""A model as one safetensors file that carries its recipe; no pickle is ever read."""

import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

import qgs
from qgs.composer import Recipe, RecipeError
from qgs.composer.registry import available_plugins, load_registry
from qgs.contracts import CONTRACT_VERSION
from qgs.contracts.schedule import END, follow, steps_followed
from qgs.data.domain import KEY, Domain
from qgs.io.differences import (
    CONTENTS,
    contents,
    differing_tensors,
    differing_types,
    refuse_broken,
    refuse_changed,
    shapes_of,
)
from qgs.io.files import replacing
from qgs.io.metadata import CheckpointError, mapping_in, reading, refuse_newer, stored_recipe
from qgs.io.models import checkpoint_path
from qgs.memory import TooLargeError
from qgs.model import QueryGaussianModel
from qgs.wording import listed, name_shown

FORMAT_VERSION = 2
"""Raised when what a checkpoint holds changes."""

_RECIPE, _CONTRACT = "qgs.recipe", "qgs.contract_version"
_PLUGINS, _DISTRIBUTIONS = "qgs.plugins", "qgs.distributions"
_FORMAT, _VERSION, _EXTRA = "qgs.format_version", "qgs.version", "qgs.extra."
_PICKLES = {b"PK\x03\x04": "a PyTorch (zip) file", b"\x80": "a Python pickle"}


def write_tensors(
    path: str | os.PathLike[str], tensors: Mapping[str, Tensor], metadata: Mapping[str, str]
) -> None:
    """Write `tensors`, on the CPU and contiguous, to `path`, whole or not at all.

    Raises OSError that tells the space needed and the space there is, CheckpointError for what the
    format cannot hold; what `path` held before is then still there.
    """
    needed = sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())
    told = f" It takes {needed / 1e6:.1f} MB beside the file that it replaces, and"
    with replacing(path, told) as temporary:
        try:
            save_file(dict(tensors), temporary, dict(metadata))
        except SafetensorError as error:  # which tells the number in words alone
            if number := re.search(r"os error (\d+)", str(error)):
                raise OSError(int(number[1]), str(error), os.fspath(path)) from error
            raise CheckpointError(f"{path} cannot be written: {error}") from error


@contextmanager
def opened_tensors(path: str | os.PathLike[str]) -> Iterator[Any]:
    """The safetensors file at `path`, as `safetensors.safe_open` gives it.

    Raises CheckpointError when it is cut off or something else.
    """
    try:
        with safe_open(path, "pt") as file:
            yield file
    except (SafetensorError, MemoryError) as error:  # MemoryError: a file of terabytes
        raise CheckpointError(
            f"{path} is not a whole safetensors file ({name_shown(str(error))}); it may be cut "
            "off: copy it again"
        ) from error


def read_tensors(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """All tensors of a safetensors file, memory-mapped. Raises as `opened_tensors` does."""
    with opened_tensors(path) as file:
        return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


def pickle_kind(path: str | os.PathLike[str]) -> str:
    """What a file is that can run code when it is read, in words; "" for any other file."""
    with open(path, "rb") as file:
        start = file.read(9)
    if start[8:] == b"{":  # safetensors: a length that may look like a pickle, then JSON
        return ""
    return next((kind for magic, kind in _PICKLES.items() if start.startswith(magic)), "")


def save(
    model: QueryGaussianModel,
    path: str | os.PathLike[str],
    *,
    extra: Mapping[str, str] | None = None,
    weights: Mapping[str, Tensor] | None = None,
) -> None:
    """Write the weights of `model` and its resolved recipe to `path`, whole or not at all.

    extra: more metadata, such as the training step. weights: take these, named as by
    `unique_tensors`, instead of the model's present ones.
    Raises ValueError for a model that was not composed from a recipe, OSError for a full disk.
    """
    if model.recipe is None:
        raise ValueError(
            "this model was built by hand and has no recipe to save; build it with qgs.compose"
        )
    tensors = {
        name: tensor.detach().cpu().clone(memory_format=torch.contiguous_format)
        for name, tensor in (weights or unique_tensors(model)).items()
    }
    step = steps_followed(model.modules())
    followed = {} if step in (None, END) else {"step": str(step)}  # END: as without a step
    write_checkpoint(path, tensors, model.recipe, followed | dict(extra or {}))


def write_checkpoint(
    path: str | os.PathLike[str],
    tensors: Mapping[str, Tensor],
    tree: Mapping[str, Any],
    extra: Mapping[str, str],
) -> None:
    """Write a checkpoint from its parts, as `save` does, without copying a tensor.

    tensors: on the CPU, contiguous, named as by `unique_tensors`. tree: the resolved recipe.
    """
    plugins = load_registry(tree["plugins"]).plugins
    metadata = {
        _RECIPE: json.dumps(tree),
        CONTENTS: json.dumps(contents(tensors)),
        _PLUGINS: json.dumps({name: plugin.version for name, plugin in plugins.items()}),
        _DISTRIBUTIONS: json.dumps({name: used.distribution for name, used in plugins.items()}),
        _CONTRACT: str(CONTRACT_VERSION),
        _FORMAT: str(FORMAT_VERSION),
        _VERSION: qgs.__version__,
        **{_EXTRA + key: value for key, value in extra.items()},
    }
    write_tensors(path, tensors, metadata)


def load(
    path: str | os.PathLike[str], device: str | torch.device | None = None
) -> QueryGaussianModel:
    """Rebuild the model that `save` wrote, on `device` (default: CPU), in evaluation mode.

    path: also a run folder of `qgs train`, PLUGIN/NAME of a shipped model, or a URL, see
    `checkpoint_path`. Weights of half precision become float32.
    Raises FileNotFoundError, ValueError for weights that are NaN or infinite, or CheckpointError,
    which names the releases that wrote the file where a plugin is missing or another release of it
    cannot stand for it.
    """
    name, path = os.fspath(path), checkpoint_path(path)
    recipe, tensors = load_recipe(path), read_tensors(path)
    try:
        _refuse_misfit(recipe.build_model("meta"), tensors, str(path))  # takes no memory
        model = recipe.build_model(pretrained=False)
    except (RecipeError, TooLargeError) as error:
        raise CheckpointError(
            f"{path}: the model of its recipe cannot be built: {error}"
        ) from error
    load_weights(model, tensors, str(path))
    refuse_damaged(tensors, path)
    step = load_step(path)
    follow(model.modules(), END if step is None else step)
    model.trained_on = load_domain(path)
    model.loaded_from = str(path.resolve()) if Path(name).expanduser().exists() else name
    return (model if device is None else model.to(device)).eval()


def refuse_damaged(tensors: Mapping[str, Tensor], path: str | os.PathLike[str]) -> None:
    """Raise when the weights `tensors` of the checkpoint at `path` cannot be what was learned.

    ValueError for NaN and infinity, CheckpointError for bytes that were not written so. Files of
    releases that wrote no checksums pass.
    """
    refuse_broken(tensors, path)
    metadata = _read_metadata(path)
    if CONTENTS in metadata:
        refuse_changed(tensors, mapping_in(metadata, CONTENTS, path), path)


def load_recipe(path: str | os.PathLike[str]) -> Recipe:
    """The recipe that a checkpoint carries. Raises as `load` does."""
    metadata = _read_metadata(path)
    try:
        return stored_recipe(metadata, _RECIPE, path)
    except RecipeError as error:
        written = {_PLUGINS: "{}", _DISTRIBUTIONS: "{}"} | metadata
        names = {**mapping_in(written, _DISTRIBUTIONS, path), "qgs": "query-gaussians"}
        releases = {
            plugin: f"{names.get(plugin) or f'the plugin `{plugin}`'} {version}"
            for plugin, version in mapping_in(written, _PLUGINS, path).items()
        }
        available = {"qgs", *available_plugins()}
        absent = [release for plugin, release in releases.items() if plugin not in available]
        raise CheckpointError(
            f"{path} was made with {listed(releases.values())}, and its recipe fails here; "
            f"install {listed(absent) or 'those releases'}:\n{error}"
        ) from error


def load_extra(path: str | os.PathLike[str]) -> dict[str, str]:
    """The `extra` metadata that `save` was given. Raises as `load` does."""
    metadata = _read_metadata(path)
    return {k.removeprefix(_EXTRA): v for k, v in metadata.items() if k.startswith(_EXTRA)}


def load_step(path: str | os.PathLike[str]) -> int | None:
    """The training step that `save` was given as `extra`, None without. Raises as `load` does."""
    step = load_extra(path).get("step")
    with reading(path, _EXTRA + "step"):
        return int(step) if step else None


def load_domain(path: str | os.PathLike[str]) -> Domain:
    """On what views a checkpoint was trained; empty where it does not tell. Raises as `load`."""
    key, metadata = _EXTRA + KEY, _read_metadata(path)
    with reading(path, key):
        return Domain.read(mapping_in(metadata, key, path)) if key in metadata else Domain()


def unique_tensors(model: nn.Module) -> dict[str, Tensor]:
    """Parameters and persistent buffers, a shared one only under its first name."""
    first_names: dict[int, str] = {}
    state = model.state_dict(keep_vars=True)
    for name, tensor in state.items():
        first_names.setdefault(id(tensor), name)
    return {name: state[name] for name in first_names.values()}


def load_weights(model: nn.Module, tensors: Mapping[str, Tensor], origin: str) -> None:
    """Copy `tensors` into `model`; names, shapes and types must match exactly.

    Raises CheckpointError that lists the differences; `origin` names the source in it.
    """
    _refuse_misfit(model, tensors, origin)
    with torch.no_grad():
        for name, tensor in unique_tensors(model).items():
            tensor.copy_(tensors[name])


def _refuse_misfit(model: nn.Module, tensors: Mapping[str, Tensor], origin: str) -> None:
    own = unique_tensors(model)
    differences = differing_tensors(shapes_of(tensors), shapes_of(own))
    differences += differing_types(tensors, own, widened=True)
    if differences:
        raise CheckpointError(
            f"{origin} does not fit the model of its recipe, {len(differences)} differences:\n  "
            + listed(differences, 20, "\n  ")
            + "\nInstall the versions of qgs and of its plugins that wrote the file; if they are, "
            "it is damaged: copy it again."
        )


def _read_metadata(path: str | os.PathLike[str]) -> dict[str, str]:
    if not Path(path).is_file():
        raise FileNotFoundError(
            f"no checkpoint at {path}; give a .safetensors file, its URL, or PLUGIN/NAME of a "
            "trained model that `qgs list` shows"
        )
    kind = pickle_kind(path)
    if kind:
        raise CheckpointError(
            f"{path} is {kind}, whatever its name says; such files can run code when they are "
            "read, so qgs never opens them: use the safetensors file of the run"
        )
    with opened_tensors(path) as file:
        metadata: dict[str, str] = file.metadata() or {}
    if _RECIPE not in metadata:
        raise CheckpointError(
            f"{path} is a safetensors file without a qgs recipe; only files written by qgs.save "
            "or `qgs train` can be loaded. If it holds published weights, turn them into a "
            f"checkpoint: `qgs import {path} --recipe auto --out CHECKPOINT.safetensors`"
        )
    known = {_CONTRACT: CONTRACT_VERSION, _FORMAT: FORMAT_VERSION}
    refuse_newer(dict.fromkeys(known, "0") | metadata, known, _VERSION, path)
    return metadata

"""Models saved as safetensors files that contain the recipe. Pickle files are never read."""

import json
import os
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from qgs.checkpoint.models import checkpoint_path
from qgs.checkpoint.tensors import (
    RECIPE,
    SEAL,
    CheckpointError,
    TensorFile,
    Weights,
    copied,
    differing_tensors,
    differing_types,
    inside,
    nonfinite,
    shapes_of,
    write_tensors,
)
from qgs.contracts import Component
from qgs.contracts.schedule import END, follow
from qgs.domain import KEY, Domain
from qgs.files import AnyPath
from qgs.machine import TooLargeError
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe, RecipeError, resolve
from qgs.version import __version__
from qgs.wording import listed

FORMAT_VERSION = 3
"""Version of the file format. It rises when the metadata of checkpoints change."""

_FORMAT = "qgs.format_version"
_EXTRA = "qgs.extra."
_PLUGINS = "qgs.plugins"
_DISTRIBUTIONS = "qgs.distributions"


class CheckpointFile(TensorFile):
    """A checkpoint that is opened once to read model, recipe and metadata from it.

        with CheckpointFile("rooms/locus-64") as file:
            model = file.model()
            recipe = file.recipe

    name: path of a file or run folder, PLUGIN/NAME of a model that a plugin ships, or a URL; see
    `checkpoint_path`. Recipe and weights are read at first use. extra: the metadata that `save` was
    given. gaussians: about how many Gaussians the recipe's model makes; None keeps the recipe.
    Raises FileNotFoundError, and CheckpointError for a file that is not a checkpoint of this format
    version.
    """

    def __init__(self, name: AnyPath, gaussians: int | None = None) -> None:
        super().__init__(checkpoint_path(name))
        self.name = os.fspath(name)
        self.gaussians = gaussians
        if RECIPE not in self.metadata:
            raise CheckpointError(
                f"{self.path} is a safetensors file without a qgs recipe; only files written by "
                "qgs.save or `qgs train` can be loaded. Published weights become a checkpoint by "
                f"`qgs import {self.path} --recipe auto --out CHECKPOINT.safetensors`"
            )
        with self.entry(_FORMAT) as text:
            written = int(text[:20])
        if written != FORMAT_VERSION:
            raise CheckpointError(
                f"{self.path} has {_FORMAT} {written}, but qgs {__version__} reads only "
                f"version {FORMAT_VERSION}: install the version of qgs that wrote the file"
            )
        if SEAL not in self.metadata:
            raise self.damaged(f"its metadata lack the checksum {SEAL}")
        self.extra: dict[str, str] = inside(_EXTRA, self.metadata)

    @cached_property
    def recipe(self) -> Recipe:
        """Recipe of the model.

        Raises CheckpointError if components of the recipe are not installed or have changed. The
        message names the releases of the packages that wrote the file. Raises ValueError if the
        number of Gaussians cannot be chosen.
        """
        try:
            return self._resized(self.stored_recipe())
        except RecipeError as error:
            names = self.mapping(_DISTRIBUTIONS)
            versions = self.mapping(_PLUGINS).items()
            releases = listed(
                f"{names.get(plugin, plugin)} {version}" for plugin, version in versions
            )
            raise CheckpointError(
                f"{self.path} was written with {releases}; install these releases, because the "
                f"installed ones do not fit its recipe:\n{error}"
            ) from error

    def _resized(self, recipe: Recipe) -> Recipe:
        """Return `recipe` with queries for about `self.gaussians`; unchanged if this is None."""
        if self.gaussians is None:
            return recipe
        model = recipe.build_model("meta", pretrained=False)
        each = model.head.gaussians_per_query
        count = round(self.gaussians / each)
        if count == model.queries.count:
            return recipe
        least, most = model.queries.trained_counts or (1, 0)
        if not least <= count <= most:
            trained = f"was trained with {least * each:,} to {most * each:,} Gaussians: choose one"
            reason = trained if most else "makes a number of Gaussians that is fixed: choose none"
            raise ValueError(f"{self.path} {reason}")
        return resolve(recipe.tree, [f"model.queries.count={count}"])

    @cached_property
    def tensors(self) -> dict[str, Tensor]:
        """Weights by name, memory-mapped."""
        return self.read()

    @cached_property
    def step(self) -> int | None:
        """Number of training steps when the file was saved; None if unknown (imported weights)."""
        if "step" not in self.extra:
            return None
        with self.entry(_EXTRA + "step") as text:
            return int(text)

    @cached_property
    def domain(self) -> Domain:
        """Ranges of camera distances, angles and depths in the training data; empty if unknown."""
        key = _EXTRA + KEY
        if key not in self.metadata:
            return Domain()
        with self.entry(key):
            domain = Domain.read(self.mapping(key))
        # Older files do not record the image sizes of their training.
        data = self.recipe.data_config
        if data and domain.values:
            sizes = (data.image_size, *self.recipe.training.image_sizes)
            domain.values.setdefault("side", [float(min(size)) for size in sizes])
        return domain

    def untrained(self, device: str | torch.device | None = None) -> QueryGaussianModel:
        """Build the recipe's model without the saved weights. The device "meta" takes no memory.

        Raises CheckpointError if the model cannot be built.
        """
        try:
            return self.recipe.build_model(device, pretrained=False)
        except (RecipeError, TooLargeError) as error:
            raise CheckpointError(
                f"{self.path}: the model of its recipe cannot be built: {error}"
            ) from error

    def model(self, device: str | torch.device | None = None) -> QueryGaussianModel:
        """Load the model in float32 and evaluation mode on `device` (default: CPU).

        Raises CheckpointError if weights do not fit, and ValueError for NaN or infinite weights.
        """
        # On the meta device first: sizes are compared before the recipe's model takes memory.
        refuse_misfit(self.untrained("meta"), self.tensors, self.path)
        model = self.untrained()
        load_weights(model, self.tensors, self.path)
        follow(model.modules(), END if self.step is None else self.step)
        model.trained_on = self.domain
        local = Path(self.name).expanduser().exists()
        model.loaded_from = str(self.path.resolve()) if local else self.name
        return (model if device is None else model.to(device)).eval()


def load(
    name: AnyPath, device: str | torch.device | None = None, *, gaussians: int | None = None
) -> QueryGaussianModel:
    """Load the model of a checkpoint in evaluation mode.

    name: path of a checkpoint file or of a run folder, PLUGIN/NAME of a model that an installed
    plugin ships, or a URL. device: None means the CPU. gaussians: about how many Gaussians the
    model makes of a scene; None means as in its recipe. Raises FileNotFoundError, CheckpointError
    for a file that is not a checkpoint or does not fit the installed components, and ValueError for
    NaN or infinite weights, or if the number of Gaussians cannot be chosen.
    """
    with CheckpointFile(name, gaussians) as file:
        return file.model(device)


def save(
    model: QueryGaussianModel,
    path: AnyPath,
    *,
    extra: Mapping[str, str] | None = None,
    weights: Weights | None = None,
) -> None:
    """Write the weights of `model` and its complete recipe to `path`, atomically.

    extra: additional metadata, such as {"step": "1000"}. weights: weights to write in place of the
    model's present weights, with the names that `unique_tensors` returns. Raises ValueError for a
    model that was not built from a recipe, and OSError if the file cannot be written.
    """
    if model.recipe is None:
        raise ValueError(
            "this model was built by hand and has no recipe to save; build it with qgs.compose"
        )
    # Copied, since safetensors refuses tensors that share memory or are strided.
    tensors = copied(weights or unique_tensors(model))
    # The step at which scheduled options have their present values, the same in all components.
    steps = (x.followed for x in model.modules() if isinstance(x, Component) and x.schedules)
    step = next(steps, END)
    followed = {} if step == END else {"step": str(step)}
    write_checkpoint(path, tensors, model.recipe, model.releases, followed | dict(extra or {}))


def write_checkpoint(
    path: AnyPath,
    tensors: Weights,
    tree: Mapping[str, Any],
    releases: Mapping[str, tuple[str, str]],
    extra: Mapping[str, str],
) -> None:
    """Write a checkpoint from its parts, without copying a tensor.

    tensors: contiguous CPU tensors, with the names that `unique_tensors` returns. tree: complete
    recipe. releases: (distribution, version) of qgs and the plugins that the recipe uses, by name
    of the plugin. extra: additional metadata.
    """
    metadata = {
        RECIPE: json.dumps(tree),
        _PLUGINS: json.dumps({name: version for name, (_, version) in releases.items()}),
        _DISTRIBUTIONS: json.dumps({name: origin for name, (origin, _) in releases.items()}),
        _FORMAT: str(FORMAT_VERSION),
        "qgs.version": __version__,
        **{_EXTRA + key: value for key, value in extra.items()},
    }
    write_tensors(path, tensors, metadata)


def unique_tensors(model: nn.Module) -> dict[str, Tensor]:
    """Return parameters and persistent buffers by name; a shared tensor has only its first name."""
    first: dict[int, tuple[str, Tensor]] = {}
    for name, tensor in model.state_dict(keep_vars=True).items():
        first.setdefault(id(tensor), (name, tensor))
    return dict(first.values())


def load_weights(model: nn.Module, tensors: Weights, origin: object) -> None:
    """Copy `tensors` into `model`. If any tensor does not fit, no tensor is copied.

    origin: file of the tensors, for messages. Raises a CheckpointError that lists differences in
    names, shapes and types, and ValueError for NaN or infinity.
    """
    # Everything is compared before anything is copied.
    refuse_misfit(model, tensors, origin)
    refuse_nonfinite(tensors, origin)
    # A tensor that modules share comes under its first name alone, so that others are missing.
    model.load_state_dict(tensors, strict=False)


def refuse_nonfinite(tensors: Weights, origin: object) -> None:
    """Raise ValueError for NaN or infinity in `tensors`. origin: their file, for the message."""
    if broken := nonfinite(tensors):
        fix = "its training diverged, or the file is damaged: take another checkpoint"
        raise ValueError(f"{origin}: weights are not finite: {listed(broken)}; {fix}")


def refuse_misfit(model: nn.Module, tensors: Weights, origin: object) -> None:
    """Raise CheckpointError if names, shapes or types of `tensors` differ from those of `model`."""
    own = unique_tensors(model)
    differences = differing_tensors(shapes_of(tensors), shapes_of(own))
    differences += differing_types(tensors, own)
    if differences:
        raise CheckpointError(
            f"{origin} does not fit the model of its recipe, {len(differences)} differences:\n  "
            + listed(differences, 20, "\n  ")
            + "\nInstall the versions of qgs and its plugins that wrote the file. If they are "
            "installed, the file is damaged: copy it again."
        )

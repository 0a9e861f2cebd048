"""Inputs of a size, and operations that are ready to be called again and again."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import torch
from torch import nn

from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe
from qgs.train.parameters import make_optimizer
from qgs.train.training_pass import TrainingPass
from qgs.types import Cameras, Gaussians, Views


@dataclass(frozen=True)
class Workload:
    """views, targets: photos read and photos rendered per scene. size: (H, W) of both, in pixels.

    batch: scenes at once. precision: float32, or bf16 for autocast.
    """

    views: int
    targets: int
    size: tuple[int, int]
    batch: int = 1
    device: str = "cpu"
    precision: Literal["float32", "bf16"] = "float32"

    def autocast(self) -> torch.autocast:
        """The context in which the model runs."""
        return torch.autocast(self.device, torch.bfloat16, enabled=self.precision == "bf16")


def workload_of(
    recipe: Recipe, views: int | None = None, size: tuple[int, int] | None = None, **more: Any
) -> Workload:
    """The workload of `recipe`: its `views` and `data.image_size`, unless given here.

    more: further fields. Raises ValueError when nothing says how large the images are.
    """
    if size is None and recipe.data_config:
        size = recipe.data_config.image_size
    if size is None:
        raise ValueError(
            "the recipe has no data.image_size, so the size of the photos is not known; "
            "give one with --size HxW, such as --size 256x256"
        )
    return Workload(views or recipe.views.inputs, recipe.views.targets, size, **more)


def posed_photos(batch: int, count: int, size: tuple[int, int], seed: int) -> Views:
    """Random pixels from cameras on an arc around (0, 0, 1), all looking at that point, in time.

    The first is the identity; the field of view is some 53 degrees across the longer side.
    """
    # Equal photos in all recipes and processes.
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(batch, count, 3, *size, generator=generator)
    c2w = torch.eye(4).repeat(batch, count, 1, 1)
    for index in range(count):
        # Ten degrees apart, as neighbouring photos of a walk are.
        angle = math.radians(10 * index)
        sine = math.sin(angle)
        cosine = math.cos(angle)
        turn = [[cosine, 0, sine, -sine], [0, 1, 0, 0], [-sine, 0, cosine, 1 - cosine]]
        c2w[:, index, :3] = torch.tensor(turn)
    height, width = size
    focal = float(max(size))
    intrinsics = torch.tensor([focal, focal, width / 2, height / 2]).expand(batch, count, 4)
    times = torch.linspace(0, 1, count).expand(batch, count)
    return Views(images, Cameras(c2w, intrinsics, size), None, times, times[:, :1])


Task: TypeAlias = Callable[[], object]
Operation: TypeAlias = Literal["forward", "render", "step"]


def make_task(
    operation: Operation, recipe: Recipe, model: QueryGaussianModel, workload: Workload
) -> Task:
    """`operation` as a call without arguments that leaves nothing behind but changed weights.

    forward: photos to the last layer's Gaussians, no gradients. render: those Gaussians at the
    targets' cameras, no gradients. step: a whole training step.
    """
    inputs, targets = (
        posed_photos(workload.batch, count, workload.size, seed).to(workload.device)
        for seed, count in enumerate((workload.views, workload.targets))
    )
    if operation == "step":
        # A whole step as `qgs train` makes it, so that losses and renderer are in its time.
        objective = TrainingPass(recipe, model.train()).to(workload.device)
        factors = recipe.rate_factors(objective)
        optimizer = make_optimizer(objective, recipe.build_optimizer(), factors)

        def step() -> None:
            optimizer.zero_grad(set_to_none=True)
            with workload.autocast():
                outcome = objective(inputs, targets)
            outcome.total.backward()
            nn.utils.clip_grad_norm_(objective.parameters(), recipe.training.clip)
            optimizer.step()

        return step
    model.eval()

    @torch.inference_mode()
    def forward() -> Gaussians:
        with workload.autocast():
            return model(inputs).gaussians

    if operation == "forward":
        return forward
    # Made once, outside of what is timed.
    gaussians = forward()
    return torch.inference_mode()(lambda: model.render(gaussians, targets.cameras))

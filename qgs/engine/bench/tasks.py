"""The operations that are measured, ready to be called again and again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeAlias

import torch
from torch import nn

from qgs.composer import Recipe
from qgs.engine.bench.workload import Workload
from qgs.engine.objective import Objective
from qgs.engine.optimizer import make_optimizer
from qgs.model import QueryGaussianModel

Task: TypeAlias = Callable[[], object]
Operation: TypeAlias = Literal["forward", "render", "step"]


def make_task(
    operation: Operation, recipe: Recipe, model: QueryGaussianModel, workload: Workload
) -> Task:
    """`operation` as a call without arguments that leaves nothing behind but changed weights.

    forward: photos to the Gaussians of the last layer, no gradients. render: those Gaussians from
    the cameras of the targets, no gradients. step: forward, every supervised layer rendered,
    losses, backward, clipped gradients, AdamW.
    """
    if operation == "step":
        return _step(recipe, model.train(), workload)
    model.eval()
    return _forward(model, workload) if operation == "forward" else _render(model, workload)


def _forward(model: QueryGaussianModel, workload: Workload) -> Task:
    views = workload.inputs()

    @torch.inference_mode()
    def forward() -> None:
        with workload.autocast():
            model(views)

    return forward


def _render(model: QueryGaussianModel, workload: Workload) -> Task:
    cameras = workload.supervision().cameras
    with torch.inference_mode(), workload.autocast():
        gaussians = model(workload.inputs()).gaussians

    @torch.inference_mode()
    def render() -> None:
        model.render(gaussians, cameras)

    return render


def _step(recipe: Recipe, model: QueryGaussianModel, workload: Workload) -> Task:
    losses, render_views = recipe.build_losses(), recipe.training.render_views
    objective = Objective(model, losses, render_views).to(workload.device)
    optimizer = make_optimizer(objective, recipe.training)
    inputs, targets = workload.inputs(), workload.supervision()

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        with workload.autocast():
            outcome = objective(inputs, targets)
        outcome.total.backward()
        nn.utils.clip_grad_norm_(objective.parameters(), recipe.training.clip)
        optimizer.step()

    return step

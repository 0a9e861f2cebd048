"""Test-time token tuning: the queries of one scene, fitted to its input views (TokenGS release)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from qgs.composer import Recipe
from qgs.contracts.schedule import END, follow
from qgs.losses import Photometric
from qgs.model import QueryGaussianModel
from qgs.types import Prediction, Views, map_tensors, named_tensors


@dataclass(frozen=True)
class Tuning:
    """prediction: from the tuned queries. losses: before each step, and after the last one."""

    prediction: Prediction
    losses: Sequence[float]


def tuning_loss(recipe: Recipe) -> Photometric:
    """What tuning minimises: the first `qgs/photometric` of `recipe`, else one with defaults.

    Weights that follow the training are those of its end, so that a protocol means one thing.
    """
    follow((losses := recipe.build_losses()).values(), END)
    for loss in losses.values():
        if isinstance(loss, Photometric) and (loss.config.mse_weight or loss.config.ssim_weight):
            return loss
    return Photometric(Photometric.Config())


def tune(
    model: QueryGaussianModel, views: Views, loss: Photometric, steps: int, rate: float = 1e-4
) -> Tuning:
    """Fit the initial queries of `views` (B, V) to these views with Adam; weights stay as they are.

    All features and floating fields of the state are fitted, so LocusGS's anchors too. `loss`
    compares the last layer with the photos. TokenGS takes 50 steps at a rate of 1e-4.
    Raises ValueError for less than one step.
    """
    if steps < 1:
        raise ValueError(f"token tuning takes at least one step, got {steps}")
    with torch.no_grad():
        memory = model.encoder(views)
        start = model.queries(views.images.shape[0])
    state = map_tensors(lambda x: x.detach().clone().requires_grad_(x.is_floating_point()), start)
    leaves = [tensor for _, tensor in named_tensors(state) if tensor.requires_grad]
    optimizer = torch.optim.Adam(leaves, lr=rate)

    def predicted() -> tuple[Prediction, Tensor]:
        prediction = model.predict(memory, state, ())
        rendering = model.render(prediction.gaussians, views.cameras)
        terms = loss(prediction.layers[model.depth], rendering, views, views)
        return prediction, torch.stack(list(terms.values())).sum()

    losses = []
    with torch.enable_grad():
        for _ in range(steps):
            _, value = predicted()
            gradients = torch.autograd.grad(value, leaves, allow_unused=True)
            for leaf, gradient in zip(leaves, gradients, strict=True):
                leaf.grad = gradient
            optimizer.step()
            losses.append(float(value.detach()))
    with torch.no_grad():
        prediction, value = predicted()
    return Tuning(prediction, [*losses, float(value)])

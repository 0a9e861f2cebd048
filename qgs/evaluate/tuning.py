"""Test-time tuning: fit the queries or the image memory of a scene to its input views (TokenGS)."""

import re
from typing import Any

import torch

from qgs.containers import map_tensors, named_tensors
from qgs.contracts.schedule import END, follow
from qgs.losses import Photometric
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe
from qgs.types import Gaussians, Views


def tuning_settings(tune: str | None) -> list[str]:
    """Return recipe overrides for the value of --tune: "STEPS", "WHAT:STEPS" or "WHAT".

    WHAT is queries or latents, by default that of the recipe. STEPS is 50 by default (TokenGS).
    None gives no overrides. Raises ValueError for any other text.
    """
    if tune is None:
        return []
    match = re.fullmatch(r"(?:(queries|latents)(?::|$))?(\d*)", tune)
    if match is None or not tune:
        raise ValueError(f"--tune must be STEPS, queries[:STEPS] or latents[:STEPS], got {tune!r}")
    what = [f"evaluation.tuning={match[1]}"] if match[1] else []
    return [f"evaluation.tuning_steps={match[2] or 50}", *what]


def tuning_loss(recipe: Recipe) -> Photometric:
    """Return the loss that test-time tuning minimises.

    It is the first `qgs/photometric` among the losses of `recipe`, or, without one, a
    `qgs/photometric` with default options.
    Scheduled weights have their values at the end of training, so that equal protocols mean the
    same loss.
    """
    # The photometric loss reads no weights of others, which may be large.
    losses = recipe.build_losses(pretrained=False).values()
    follow(losses, END)
    for loss in losses:
        if isinstance(loss, Photometric):
            options = loss.config
            terms = options.mse_weight or options.l1_weight or options.ssim_weight
            if options.weight and terms:
                return loss
    return Photometric(Photometric.Config())


def tune(
    model: QueryGaussianModel, views: Views, recipe: Recipe
) -> tuple[Gaussians, dict[str, Any]]:
    """Fit queries or latents of scenes to their input `views` (B, V). The weights do not change.

    The option `evaluation.tuning` decides what is fitted. "queries" are all features and
    floating-point fields of the initial state, including LocusGS's anchors. "latents" are the
    features of the image memory, from which the encoder recomputes keys and values in every step.
    Adam minimises `tuning_loss` between renderings of the last layer and the photos. TokenGS takes
    50 steps, with a learning rate of 1e-4 for queries and 1e-2 for latents.

    Returns the Gaussians after tuning, and a record of settings and losses.
    """
    settings = recipe.evaluation
    loss = tuning_loss(recipe)
    what = settings.tuning
    views = views.to(model.device)
    # Encoded once: weights and photos stay, so the memory does too.
    with torch.no_grad():
        memory = model.encoder(views)
        start = model.queries(memory, views)
    tuned = map_tensors(
        lambda x: x.detach().clone().requires_grad_(x.is_floating_point()),
        start if what == "queries" else memory.features,
    )
    leaves = [tensor for _, tensor in named_tensors(tuned) if tensor.requires_grad]
    # As published: no schedule, no weight decay.
    optimizer = torch.optim.Adam(leaves, lr=settings.rate)
    losses: list[float] = []

    for step in range(settings.tuning_steps + 1):
        with torch.set_grad_enabled(step < settings.tuning_steps):
            # The part that is fixed was computed once, outside.
            if what == "queries":
                prediction = model.predict(views, memory, tuned, ())
            else:
                prediction = model.predict(views, model.encoder.project(tuned, memory), start, ())
            rendering = model.render(prediction.gaussians, views.cameras)
            terms = loss(prediction.layers[model.depth], rendering, views, views)
            value = torch.stack(list(terms.values())).sum()
            losses.append(float(value.detach()))
            if step == settings.tuning_steps:
                break
            optimizer.zero_grad()
            # Of these alone: others would be left in the model's weights.
            value.backward(inputs=leaves)
            optimizer.step()
    record = {
        "what": what,
        "steps": settings.tuning_steps,
        "rate": settings.rate,
        "loss_before": losses[0],
        "loss_after": losses[-1],
    }
    return prediction.gaussians, record

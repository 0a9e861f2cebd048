"""What a recipe lacks is told when it is composed, not in the middle of a forward pass."""

from __future__ import annotations

from typing import Any

import torch

from qgs.composer import RecipeError
from qgs.composer.recipe import Recipe, resolve
from qgs.contracts import CONTRACT_VERSION, Plugin
from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import MODULES, check
from qgs.testing.subjects import Maker, Sizes, required_fields
from qgs.testing.trees import scalar

PLUGIN = "under_test"


@check(MODULES - {"renderer"})
def check_unmet_requirement_fails_at_compose(case: Case) -> None:
    """In a recipe without what it needs a component is refused by name; else the model runs."""
    needed = set(required_fields(case))
    try:
        recipe = resolve(recipe_with(case), plugins=(_plugin(case),))
    except RecipeError as error:
        told = [name for name in needed if name in str(error)]
        expect(bool(needed), f"a recipe that gives it all it requires is refused: {error}")
        expect(len(told) == len(needed), f"the refusal does not name what is missing: {error}")
        return
    expect(not needed, f"a recipe without {', '.join(sorted(needed))} is composed")
    run_training_step(recipe, case)


def recipe_with(case: Case) -> dict[str, Any]:
    """A small recipe of built-in components, but for the one under test."""
    dims, slot = case.dims, case.slot
    chosen = {"type": f"{PLUGIN}/{case.component.name}", **case.config.model_dump(mode="json")}
    decoder: dict[str, Any] = {"depth": dims.depth}
    model: dict[str, Any] = {
        "width": dims.width,
        "heads": dims.heads,
        "encoder": {"depth": 1},
        "queries": {"count": 6},
        "head": {"gaussians_per_query": 2},
        "supervision": {"layers": [dims.depth]},
        "renderer": {"type": "qgs/torch"},
        "decoder": decoder,
    }
    losses = {"photometric": {"type": "qgs/photometric"}}
    if slot in ("cross_attention", "self_attention", "feed_forward", "refinement"):
        decoder[slot] = chosen
    elif slot == "losses":
        losses["case"] = chosen
    else:
        model[slot] = chosen
    return {"recipe": 1, "plugins": [PLUGIN], "model": model, "losses": losses}


def run_training_step(recipe: Recipe, case: Case) -> None:
    """A forward pass with rendering and losses, and its backward pass."""
    maker = Maker(case, Sizes(), torch.Generator().manual_seed(0))
    model, losses = recipe.build_model().train(), recipe.build_losses()
    views = maker.target()
    total = torch.zeros((), dtype=torch.float64)
    for prediction in model(views).layers.values():
        rendering = model.render(prediction.gaussians, views.cameras)
        for loss in losses.values():
            seen = rendering
            if loss.renderings == "none":
                seen = type(rendering)(
                    rendering.rgb[:, :0], rendering.alpha[:, :0], rendering.depth[:, :0]
                )
            total = total + scalar(loss(prediction, seen, views))
    total.backward()
    expect(
        bool(total.isfinite()), "the model that it is composed into gives a loss that is not finite"
    )


def _plugin(case: Case) -> Plugin:
    return Plugin(PLUGIN, CONTRACT_VERSION, (case.component,))

"""What a recipe lacks is told when it is composed, not in the middle of a forward pass."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import nn

from qgs.components import LatentQueries
from qgs.composer import RecipeError
from qgs.composer.recipe import Recipe, resolve
from qgs.composer.slots import LAYER_SLOTS
from qgs.contracts import CONTRACT_VERSION, Component, ComponentConfig, Fields, Plugin
from qgs.model import QueryGaussianModel
from qgs.testing.case import Case
from qgs.testing.chance import drawn_from
from qgs.testing.faults import expect
from qgs.testing.registry import MODULES, check
from qgs.testing.subjects import Maker, Sizes, inputs_of, required_fields
from qgs.testing.trees import not_finite, scalar
from qgs.types import QueryState

PLUGIN = "under_test"
GIVEN = "given_fields"
"""Names of the plugin that offers the component, and of the queries that it may need."""


USUAL = Sizes()

UPDATES = ("cross_attention", "self_attention", "feed_forward")
"""Slots of which every decoder layer has an instance, whose whole output is made use of."""


@check(MODULES - {"renderer"})
def check_unmet_requirement_fails_at_compose(case: Case) -> None:
    """A recipe that lacks one thing a component needs is refused by name; one with all runs.

    Then every decoder layer's instance learns with all its parameters, as it does alone.
    """
    needed = required_fields(case)
    for missing in needed:
        given = {name: spec for name, spec in needed.items() if name != missing}
        told = _refusal(case, given)
        expect(bool(told), f"a recipe without {missing} is composed")
        expect(missing in told, f"the refusal does not name {missing}, which is missing: {told}")
    told = _refusal(case, needed)
    expect(not told, f"a recipe that gives it all it requires is refused: {told}")
    model = run_training_step(_resolved(case, needed), case)
    if case.slot in UPDATES:
        _expect_every_layer_learns(case, model)


def _refusal(case: Case, given: Fields) -> str:
    """What is said of a recipe in which the queries provide `given` alone; "" if it is accepted."""
    try:
        _resolved(case, given)
    except RecipeError as error:
        return str(error)
    return ""


def _resolved(case: Case, given: Fields) -> Recipe:
    components = [case.component]
    recipe = _recipe_with(case)
    if given:
        components.append(_queries_with(case, given))
        recipe["model"]["queries"]["type"] = f"{PLUGIN}/{GIVEN}"
    return resolve(recipe, plugins=(Plugin(PLUGIN, CONTRACT_VERSION, components),))


def _queries_with(case: Case, given: Fields) -> type[Component]:
    """Queries that provide the fields `given`, of one scene, expanded to all of them."""

    class GivenQueries(LatentQueries):
        name: ClassVar[str] = GIVEN

        @classmethod
        def provides(cls, config: ComponentConfig) -> Fields:
            return given

        def forward(self, batch_size: int) -> QueryState:
            sizes = Sizes(batch=1, queries=self.count)
            maker = Maker(case, sizes, torch.Generator().manual_seed(0))
            fields = {
                name: one.expand(batch_size, *one.shape[1:])
                for name, spec in given.items()
                for one in [maker.field(name, spec)]
            }
            return super().forward(batch_size).replace(fields=fields)

    return GivenQueries


def _recipe_with(case: Case) -> dict[str, Any]:
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
    if slot in LAYER_SLOTS:
        decoder[slot] = chosen
    elif slot == "losses":
        losses["case"] = chosen
    else:
        model[slot] = chosen
    return {"recipe": 1, "plugins": [PLUGIN], "model": model, "losses": losses}


@drawn_from(0)
def run_training_step(recipe: Recipe, case: Case, sizes: Sizes = USUAL) -> QueryGaussianModel:
    """A forward pass, one view rendered and held against the target, and the backward pass.

    sizes: of the views. The model, with its gradients, is given back.
    Raises ContractError for predictions, images, losses or gradients that are not finite.
    """
    maker = Maker(case, sizes, torch.Generator().manual_seed(0))
    model, losses = recipe.build_model().train(), recipe.build_losses()
    views = maker.target()
    target = views.select([0])
    total = torch.zeros((), dtype=torch.float64)
    for prediction in model(views).layers.values():
        _expect_finite("prediction", prediction)
        rendering = model.render(prediction.gaussians, target.cameras)
        _expect_finite("rendering", rendering)
        for loss in losses.values():
            seen = rendering
            if loss.renderings == "none":
                seen = type(rendering)(
                    rendering.rgb[:, :0], rendering.alpha[:, :0], rendering.depth[:, :0]
                )
            terms = loss(prediction, seen, target)
            _expect_finite("losses", terms)
            total = total + scalar(terms)
    total.backward()
    slopes = {n: p.grad for n, p in model.named_parameters() if p.grad is not None}
    expect(bool(slopes), "in the model that it is composed into nothing gets a gradient")
    _expect_finite("gradients", slopes)
    return model


def _expect_every_layer_learns(case: Case, model: nn.Module) -> None:
    """The same parameters have a gradient in each layer as in the component alone."""
    alone = case.build().train()
    total = scalar(alone(*inputs_of(case).values()))
    if total.requires_grad:
        total.backward()
    learning = {name for name, p in alone.named_parameters() if p.grad is not None}
    layers = [part for part in model.modules() if isinstance(part, case.component)]
    for index, layer in enumerate(layers, start=1):
        idle = sorted(n for n, p in layer.named_parameters() if n in learning and p.grad is None)
        expect(not idle, f"in decoder layer {index} no gradient reaches {', '.join(idle)}")


def _expect_finite(what: str, tree: Any) -> None:
    broken = not_finite(tree)
    expect(not broken, f"composed into a model, {what} are not finite: {', '.join(broken)}")

"""Fields of the state: what a component reads and writes is what it declares, and recipes obey."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from qgs.components import LatentQueries
from qgs.composer import RecipeError
from qgs.composer.recipe import Recipe, resolve
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS, SECTIONS
from qgs.contracts import CONTRACT_VERSION, Component, ComponentConfig, Fields, Loss, Plugin
from qgs.testing.case import Case, expect
from qgs.testing.inputs import Maker, Sizes, inputs_of, required_fields
from qgs.testing.modules import each_mode, seeded
from qgs.testing.recording import Reads, recorded
from qgs.testing.registry import ALL_SLOTS, MODULES, STATEFUL, check
from qgs.testing.trees import described, not_finite, scalar
from qgs.types import QueryState, map_tensors

PLUGIN = "under_test"
GIVEN = "given_fields"
"""Names of the plugin that offers the component, and of the queries that give it its fields."""

USUAL = Sizes()


@check(STATEFUL)
def check_reads_within_requires(case: Case) -> None:
    """Only fields in `requires` are asked for, of the state and of the image memory.

    Looking whether a field is there is asking for it. The other fields are passed on with
    `QueryState.replace`. A loss looks at no rendering if it declares that it needs none.
    """
    reads, failure = _reads(case)
    beyond = sorted((reads.asked | _fields_of(reads.numbers)) - set(_required(case)))
    expect(not beyond, f"it reads {', '.join(beyond)}, which it does not require")
    expect(
        not reads.all_asked,
        "it goes through all fields of the state; read those in `requires` by their names, and "
        "pass the others on with `state.replace`",
    )
    component = case.component
    if issubclass(component, Loss) and component.renderings == "none":
        seen = sorted(name for name in reads.numbers if name.startswith("rendering."))
        expect(not seen, f"it reads {', '.join(seen)}, although `renderings` is none")
    if failure is not None:
        raise failure


@check(STATEFUL)
def check_requires_are_read(case: Case) -> None:
    """Every field in `requires` is read: else recipes that lack it are refused for nothing."""
    reads, failure = _reads(case)
    if failure is not None:
        raise failure
    idle = sorted(set(_required(case)) - _fields_of(reads.numbers) - reads.numbers)
    expect(not idle, f"it requires {', '.join(idle)}, which it does not read")


def _fields_of(names: set[str]) -> set[str]:
    """The fields of the state and the tensors of the image memory among tensors of the inputs."""
    of_state = {name.partition(".fields.")[2] for name in names} - {""}
    return of_state | {name for name in names if name.startswith("memory.")}


def _required(case: Case) -> Fields:
    return case.component.requires(case.config)


def _reads(case: Case) -> tuple[Reads, Exception | None]:
    """What passes in both modes look at, and the error of the last one, as of a missing field."""
    module = case.lively()
    inputs, reads = recorded(inputs_of(case))
    failure = None
    for _ in each_mode(module):
        try:
            module(*inputs.values())
        except Exception as error:
            failure = error
    return reads, failure


@check({"refinement", "queries"})
def check_writes_equal_provides(case: Case) -> None:
    """The fields that are written are those in `provides`, in the shape and dtype given there.

    A refinement passes on the features and all other fields as they are.
    """
    module = case.lively()
    for mode in each_mode(module):
        inputs, before = inputs_of(case), {}
        if case.slot == "refinement":
            state = inputs["state"]
            before = {"unrelated.field": torch.randn(*state.features.shape[:2], 3), **state.fields}
            inputs = {"state": QueryState(state.features, before)}
        with seeded(0):
            output = module(*inputs.values())
        expect(isinstance(output, QueryState), f"it gives a {type(output).__name__}")
        provided = case.component.provides(case.config)
        kept = {n for n, x in output.fields.items() if n in before and _same(x, before[n])}
        written = set(output.fields) - kept
        for told, names in (
            ("it writes {} besides", written - set(provided)),
            ("it does not write {}", set(provided) - written),
            ("it loses {}", set(before) - set(output.fields)),
        ):
            expect(not names, f"in {mode} {told.format(', '.join(sorted(names)))}")
        if case.slot == "refinement":
            passed = _same(output.features, inputs["state"].features)
            expect(passed, f"in {mode} it changes the features, which a refinement passes on")
        for name, spec in provided.items():
            right = output[name].dtype == spec.dtype
            expect(right, f"in {mode} `{name}` is {described(output[name])}, declared as {spec}")


def _same(one: Tensor, other: Tensor) -> bool:
    return one is other or (one.data_ptr() == other.data_ptr() and one.shape == other.shape)


@check(ALL_SLOTS)
def check_unmet_requirement_fails_at_compose(case: Case) -> None:
    """A recipe that lacks one thing a component needs is refused by name; one with all runs."""
    needed = required_fields(case)
    for missing in needed:
        refusal = _refusal(case, {name: spec for name, spec in needed.items() if name != missing})
        expect(bool(refusal), f"a recipe without {missing} is composed")
        expect(missing in refusal, f"the refusal does not name the missing {missing}: {refusal}")
    refusal = _refusal(case, needed)
    expect(not refusal, f"a recipe that gives it all it requires is refused: {refusal}")
    if case.slot in MODULES - {"renderer"}:
        run_training_step(_resolved(case, needed), case)


def _refusal(case: Case, given: Fields) -> str:
    """The message about a recipe in which the queries provide `given` alone; "" if accepted."""
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
            fields = {name: maker.field(name, spec) for name, spec in given.items()}
            fields = map_tensors(lambda x: x.expand(batch_size, *x.shape[1:]), fields)
            return super().forward(batch_size).replace(fields=fields)

    return GivenQueries


def _recipe_with(case: Case) -> dict[str, Any]:
    """A small recipe of built-in components, but for the one under test."""
    dims, slot = case.dims, case.slot
    chosen = {"type": f"{PLUGIN}/{case.component.name}", **case.config.model_dump(mode="json")}
    model: dict[str, Any] = {
        "width": dims.width,
        "heads": dims.heads,
        "encoder": {"depth": 1},
        "queries": {"count": 6},
        "head": {"gaussians_per_query": 2},
        "supervision": {"layers": [dims.depth]},
        "renderer": {"type": "qgs/torch"},
        "decoder": {"depth": dims.depth},
    }
    losses = {"photometric": {"type": "qgs/photometric"}}
    recipe: dict[str, Any] = {"recipe": 1, "plugins": [PLUGIN], "model": model, "losses": losses}
    if slot in LAYER_SLOTS:
        model["decoder"][slot] = chosen
    elif slot in MODEL_SLOTS:
        model[slot] = chosen
    elif SECTIONS[slot].named:
        recipe[slot] = {**recipe.get(slot, {}), "case": chosen}
    else:
        recipe[slot] = chosen
    return recipe


@seeded(0)
def run_training_step(recipe: Recipe, case: Case, sizes: Sizes = USUAL) -> None:
    """A forward pass, one view rendered and compared with the target, and the backward pass.

    sizes: of the views.
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
            none = loss.renderings == "none"
            seen = map_tensors(lambda x: x[:, :0], rendering) if none else rendering
            terms = loss(prediction, seen, target)
            _expect_finite("losses", terms)
            total = total + scalar(terms)
    total.backward()
    gradients = {n: p.grad for n, p in model.named_parameters() if p.grad is not None}
    expect(bool(gradients), "in the model that it is composed into nothing gets a gradient")
    _expect_finite("gradients", gradients)


def _expect_finite(what: str, tree: Any) -> None:
    broken = not_finite(tree)
    expect(not broken, f"composed into a model, {what} are not finite: {', '.join(broken)}")

"""Checks that a component reads and writes exactly the fields that it declares."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import CONTRACT_VERSION, GAUSSIAN_FIELDS, MEMORY_FIELDS, Fields, Plugin
from qgs.recipe import Recipe, RecipeError, resolve
from qgs.recipe.slots import SECTIONS
from qgs.recipe.yaml_text import inline
from qgs.tokengs import GaussianHead, LatentQueries, MultiViewViT
from qgs.types import QueryState
from qgs_dev.case import Case, ContractError, seeded
from qgs_dev.inputs import FACTS, Inputs, Maker, Sizes, inputs_of, memory_width, required_fields
from qgs_dev.schema import recipe_path
from qgs_dev.vocabulary import (
    Trial,
    described,
    difference,
    expect,
    expect_finite,
    expect_none,
    expect_same,
    gradients,
    leaves,
    mapped,
    scalar,
)

PLUGIN = "under_test"
# Names of the plugin with the component, and of components that provide its fields.
GIVEN = "given_fields"


def check_reads_are_declared(case: Case) -> None:
    """Require that a component reads only the fields of state and memory in `reads`.

    A test whether a field exists counts as reading. Pass fields on with `QueryState.replace`, which
    does not read them. A loss whose `renderings` is "none" must not read renderings.
    """
    trial = Trial(case)
    inputs = trial.inputs
    unread = {name for name in leaves(inputs) if name.startswith("memory.")} - {*case.reads}
    if getattr(case.component, "sublayers", ()):
        # The sublayers in its slots may read them.
        unread = set()
    if getattr(case.component, "renderings", "") == "none":
        inputs["rendering"] = Maker(case).all_views()
        unread = {name for name in leaves(inputs) if name.startswith("rendering.")}
    # A component that reads a NaN returns one.
    poisoned = mapped(inputs, lambda name, x: x + torch.nan if name in unread else x)
    if "memory" in inputs and "memory.grid" not in case.reads:
        poisoned = {**poisoned, "memory": poisoned["memory"].replace(grid=None)}
        unread.add("memory.grid")
    asked: set[str] = set()
    for mode, output in trial.in_each_mode(_with_asked_fields(inputs, asked)):
        expect_none(asked - {*case.reads}, f"read in {mode}, but not required")
        if poisoned is not inputs:
            names = ", ".join(sorted(unread))
            where = f"in {mode} the component reads some of {names}, which it does not declare"
            with seeded(0):
                try:
                    other = trial(poisoned)
                # It fails with the declared parts alone, and works with all parts.
                except Exception as error:
                    raise ContractError(f"{where}: add what it reads to `reads`") from error
            # A layer may pass on a memory that it does not read.
            expect_same(trial.state_of(output), trial.state_of(other), where)


@dataclass(eq=False)
class AskedFields(Mapping[str, Tensor]):
    """Fields of a state that record in the set `asked` the names of the fields read.

    The base class answers `get` and `in` by reading a field.
    """

    fields: Mapping[str, Tensor]
    asked: set[str]

    def __getitem__(self, name: str) -> Tensor:
        self.asked.add(name)
        return self.fields[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.fields)

    def __len__(self) -> int:
        return len(self.fields)


def _with_asked_fields(inputs: Inputs, asked: set[str]) -> Inputs:
    changed = {**inputs}
    if "state" in inputs:
        state = inputs["state"]
        changed["state"] = replace(state, fields=AskedFields(state.fields, asked))
    if "prediction" in inputs:
        prediction = inputs["prediction"]
        inside = _with_asked_fields({"state": prediction.state}, asked)
        changed["prediction"] = prediction.replace(**inside)
    return changed


def check_declared_reads_are_used(case: Case) -> None:
    """Require that every field in `reads` affects the outputs.

    Otherwise recipes without the field would be refused for no reason. Features of Gaussians count
    as used if a change of their rendering affects the outputs.
    """
    trial = Trial(case)
    # At least one of several draws must differ, since a ReLU may be closed for some.
    outputs = trial()
    for field in case.reads:
        others = _with_others(trial, field)
        read = any(difference(outputs, trial(inputs)) for inputs in others)
        expect(read, f"the component requires {field}, but other values of it change nothing")


def _with_others(trial: Trial, field: str) -> Iterator[Inputs]:
    """Yield copies of a trial's inputs, each with other values of the required field `field`."""
    inputs = trial.inputs
    if field == "memory.grid":
        views, rows, columns = inputs["memory"].grid
        for grid in ((views, columns, rows), (columns, rows, views)):
            yield {**inputs, "memory": inputs["memory"].replace(grid=grid)}
        return
    ends = (field, f"rendering.{field.removeprefix('gaussians.')}")
    others = [inputs_of(trial.case, seed=seed) for seed in (1, 2, 3)]
    # Rays do not depend on the seed.
    others.append(map_tensors(lambda x: x.roll(1, 1), inputs))
    for other in map(leaves, others):
        yield mapped(inputs, lambda n, x, other=other: other[n] if n.endswith(ends) else x)


def check_writes_are_declared(case: Case) -> None:
    """Require that a component writes exactly the fields in `writes`, with their shape and dtype.

    All components but queries must pass on other fields unchanged. A refinement must also pass on
    the features unchanged.
    """
    trial = Trial(case)
    before: dict[str, Tensor] = {}
    state: Any = None
    if case.slot != "queries":
        state = trial.inputs["state"]
        before = {"unrelated.center": torch.randn(*state.features.shape[:2], 3), **state.fields}
        trial.inputs["state"] = QueryState(state.features, before)
    for mode, outputs in trial.in_each_mode():
        output = trial.state_of(outputs)
        kept = {n for n, x in output.fields.items() if n in before and _same(x, before[n])}
        written = output.fields.keys() - kept
        expect_none(written - case.writes.keys(), f"written in {mode}, but not provided")
        expect_none(case.writes.keys() - written, f"provided, but not written in {mode}")
        expect_none(before.keys() - output.fields.keys(), f"lost in {mode}")
        if case.slot == "refinement":
            passed = _same(output.features, state.features)
            expect(passed, f"in {mode} the refinement changes the features; it must pass them on")
        for name, spec in case.writes.items():
            right = output[name].dtype == spec.dtype
            expect(right, f"in {mode} `{name}` is {described(output[name])}, declared as {spec}")


def _same(one: Tensor, other: Tensor) -> bool:
    # A view of the same memory is passed on, not written.
    return one.data_ptr() == other.data_ptr() and one.shape == other.shape


def check_unmet_reads_fail_at_compose(case: Case) -> None:
    """Require that recipes are refused if a required field is missing, and only then.

    A recipe that provides all fields in `reads` must be accepted, and must run.
    """
    needed = required_fields(case)
    for missing in needed:
        refusal = _refusal(case, {name: spec for name, spec in needed.items() if name != missing})
        expect(refusal, f"a recipe without the required {missing} is accepted")
        expect(missing in refusal, f"the message does not name the missing {missing}: {refusal}")
    refusal = _refusal(case, needed)
    expect(not refusal, f"a recipe with all that the component requires is refused: {refusal}")
    if case.slot in FACTS and case.slot != "renderer":
        # A recipe that is accepted must run.
        run_training_step(resolved(case, needed), case)


def _refusal(case: Case, given: Fields) -> str:
    """Return the error of a recipe with queries that provide the fields `given`; "" if accepted."""
    try:
        resolved(case, given)
    except RecipeError as error:
        return str(error)
    return ""


def resolved(case: Case, given: Fields) -> Recipe:
    """Return a small recipe with the component of `case` and queries with the fields `given`."""
    slot = case.slot
    # Thousands of queries would take seconds to render and test nothing more.
    config = (case.with_at_most(count=6) if slot == "queries" else case).config
    options = {"type": f"{PLUGIN}/{case.component.name}", **config.model_dump(mode="json")}
    of_encoder = case.writes if slot == "encoder" else MEMORY_FIELDS
    # The default layers read keys and values.
    depth = case.dims.depth if {"memory.keys", "memory.values"} <= of_encoder.keys() else 0
    place = recipe_path(slot)
    if slot in SECTIONS and SECTIONS[slot].defaults:
        place = f"{place}.case"
    changes = [
        f"model.width={case.dims.width}",
        f"model.heads={case.dims.heads}",
        f"model.decoder.depth={depth}",
        f"model.supervision.layers=[{depth}]",
        f"{place}={inline(options)}",
    ]
    components = [case.component]
    if given:
        components.append(_queries_with(case, given))
        changes.append(f"model.queries={{type: {PLUGIN}/{GIVEN}, count: 6}}")
    usual = MEMORY_FIELDS["memory.features"]
    if case.reads.get("memory.features", usual) != usual:
        components.append(_encoder_with(case))
        changes.append(f"model.encoder={{type: {PLUGIN}/{GIVEN}, depth: 1}}")
    look = {name: spec for name, spec in case.reads.items() if name in GAUSSIAN_FIELDS}
    if look:
        components.append(_head_with(look))
        changes.append(f"model.head={{type: {PLUGIN}/{GIVEN}, gaussians_per_query: 2}}")
    recipe = Path(__file__).parents[1] / "small_recipe.yaml"
    return resolve(recipe, changes, [Plugin(PLUGIN, CONTRACT_VERSION, components)])


def _given(base: type, provides: Fields, **methods: Any) -> Any:
    """Return a subclass of the component class `base` with `provides` as its written fields.

    methods: further methods of the subclass, by name.
    """
    # Make a new class each time; otherwise two cases would share one registry entry.
    written = classmethod(lambda cls, config: provides)
    return type(
        f"Given{base.__name__}", (base,), {"name": GIVEN, "fields_written": written, **methods}
    )


def _head_with(look: Fields) -> Any:
    """Return a head class whose Gaussians have `sh` or `features` only if `look` lists them.

    look: fields `gaussians.sh` or `gaussians.features`, which the head provides.
    """

    def forward(self: GaussianHead, state: QueryState) -> Any:
        made = GaussianHead.forward(self, state)
        parts = {"sh": torch.stack([made.offsets] * 3, -2), "features": made.quats}
        chosen = {name: x for name, x in parts.items() if f"gaussians.{name}" in look}
        return made.replace(**chosen)

    return _given(GaussianHead, look, forward=forward)


def _encoder_with(case: Case) -> Any:
    """Return an encoder class whose memory features have the width that the component requires."""
    wide = torch.arange(memory_width(case))

    def forward(self: MultiViewViT, views: Any) -> Any:
        memory = MultiViewViT.forward(self, views)
        features = memory.features[..., wide % memory.features.shape[-1]]
        return memory.replace(features=features)

    provides = {**MEMORY_FIELDS, "memory.features": case.reads["memory.features"]}
    return _given(MultiViewViT, provides, forward=forward)


def _queries_with(case: Case, given: Fields) -> Any:
    """Return a queries class that provides the fields `given`, with equal values in all scenes."""

    def start(self: LatentQueries, batch_size: int) -> QueryState:
        maker = Maker(case, Sizes(batch=1, queries=self.count))
        fields = {name: maker.field(spec) for name, spec in given.items()}
        fields = map_tensors(lambda x: x.expand(batch_size, *x.shape[1:]), fields)
        return LatentQueries.start(self, batch_size).replace(fields=fields)

    return _given(LatentQueries, given, start=start)


@seeded(0)
def run_training_step(recipe: Recipe, case: Case) -> None:
    """Run one training step without an optimiser: forward pass, rendering, losses, gradients.

    Raises ContractError if predictions, images, losses or gradients are not finite.
    """
    model = recipe.build_model().train()
    losses = recipe.build_losses().values()
    views = Maker(case).target()
    target = views.select([0])
    total = torch.zeros(()).double()
    for prediction in model(views).layers.values():
        expect_finite(prediction, "in a prediction of a model with this component")
        rendering = model.render(prediction.gaussians, target.cameras)
        expect_finite(rendering, "in a rendering of a model with this component")
        for loss in losses:
            unseen = loss.renderings == "none"
            seen = map_tensors(lambda x: x[:, :0], rendering) if unseen else rendering
            terms = loss(prediction, seen, target, views)
            expect_finite(terms, "as a loss of a model with this component")
            total = total + scalar(terms)
    found = gradients(total, dict(model.named_parameters()))
    expect(found, "no parameter of a model with this component gets a gradient")
    expect_finite(found, "in its gradient in a model with this component")

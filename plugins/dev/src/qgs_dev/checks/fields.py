"""Fields of the state: what a component reads and writes is what it declares, and recipes obey."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import (
    CONTRACT_VERSION,
    GAUSSIAN_FIELDS,
    LAYER_SLOTS,
    MEMORY_FIELDS,
    Fields,
    Plugin,
)
from qgs.recipe import RecipeError
from qgs.recipe.recipe import Recipe, resolve
from qgs.recipe.slots import MODEL_SLOTS, SECTIONS
from qgs.recipe.yaml_text import inline
from qgs.tokengs import GaussianHead, LatentQueries, MultiViewViT
from qgs.types import QueryState
from qgs_dev.case import Case
from qgs_dev.inputs import FACTS, Inputs, Maker, Sizes, inputs_of, memory_width, required_fields
from qgs_dev.modules import seeded
from qgs_dev.vocabulary import (
    ContractError,
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
# Names of the plugin that offers the component, and of those that give it its fields.
GIVEN = "given_fields"


def check_reads_within_requires(case: Case) -> None:
    """Only fields in `requires` are asked for, of the state and of the image memory.

    Looking whether a field is there is asking for it. The other fields are passed on with
    `QueryState.replace`. A loss looks at no rendering if it declares that it needs none.
    """
    trial = Trial(case)
    inputs = trial.inputs
    unread = {name for name in leaves(inputs) if name.startswith("memory.")} - {*case.reads}
    if getattr(case.component, "sublayers", ()):
        # What stands in its slots may read them.
        unread = set()
    if getattr(case.component, "renderings", "") == "none":
        inputs["rendering"] = Maker(case).all_views()
        unread = {name for name in leaves(inputs) if name.startswith("rendering.")}
    # What reads a NaN gives one.
    poisoned = mapped(inputs, lambda name, x: x + torch.nan if name in unread else x)
    if "memory" in inputs and "memory.grid" not in case.reads:
        poisoned = {**poisoned, "memory": replace(poisoned["memory"], grid=None)}
        unread.add("memory.grid")
    asked: set[str] = set()
    for mode, output in trial.in_each_mode(_with_asked_fields(inputs, asked)):
        expect_none(asked - {*case.reads}, f"read in {mode}, but not required")
        if poisoned is not inputs:
            names = ", ".join(sorted(unread))
            where = f"in {mode} it reads some of {names}, which it declares not to"
            with seeded(0):
                try:
                    other = trial(poisoned)
                # With the declared parts alone it fails, and with all it does not.
                except Exception as error:
                    raise ContractError(f"{where}: add it to `reads`") from error
            # A layer passes on a memory that it does not read.
            expect_same(trial.state_of(output), trial.state_of(other), where)


class AskedFields(dict[str, Tensor]):
    """Fields of a state that add the names they are asked for to `asked`."""

    def __init__(self, fields: Mapping[str, Tensor], asked: set[str]) -> None:
        super().__init__(fields)
        self.asked = asked

    def __getitem__(self, name: str) -> Tensor:
        self.asked.add(name)
        return super().__getitem__(name)

    def __contains__(self, name: object) -> bool:
        self.asked.add(str(name))
        return super().__contains__(name)

    def get(self, name: str, default: Any = None) -> Any:
        """As of any dict."""
        self.asked.add(name)
        return super().get(name, default)


def _with_asked_fields(inputs: Inputs, asked: set[str]) -> Inputs:
    changed = {**inputs}
    if "state" in inputs:
        state = inputs["state"]
        changed["state"] = replace(state, fields=AskedFields(state.fields, asked))
    if "prediction" in inputs:
        prediction = inputs["prediction"]
        inside = _with_asked_fields({"state": prediction.state}, asked)
        changed["prediction"] = replace(prediction, **inside)
    return changed


def check_requires_are_read(case: Case) -> None:
    """Every field in `requires` is read: else recipes that lack it are refused for nothing.

    Features of Gaussians may be read off their rendering.
    """
    trial = Trial(case)
    # One of several draws must differ: a ReLU may be closed for some.
    outputs = trial()
    for field in case.reads:
        others = _with_others(trial, field)
        read = any(difference(outputs, trial(inputs)) for inputs in others)
        expect(read, f"it requires {field}, which changes nothing")


def _with_others(trial: Trial, field: str) -> Iterator[Inputs]:
    """Inputs of a trial with something else for a required field."""
    inputs = trial.inputs
    if field == "memory.grid":
        views, rows, columns = inputs["memory"].grid
        for grid in ((views, columns, rows), (columns, rows, views)):
            yield {**inputs, "memory": replace(inputs["memory"], grid=grid)}
        return
    ends = (field, f"rendering.{field.removeprefix('gaussians.')}")
    others = [inputs_of(trial.case, seed=seed) for seed in (1, 2, 3)]
    # Rays have no seed.
    others.append(map_tensors(lambda x: x.roll(1, 1), inputs))
    for other in map(leaves, others):
        yield mapped(inputs, lambda n, x, other=other: other[n] if n.endswith(ends) else x)


def check_writes_equal_provides(case: Case) -> None:
    """The fields that are written are those in `provides`, in the shape and dtype given there.

    The others pass on all other fields as they are, a refinement the features too.
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
            expect(passed, f"in {mode} it changes the features, which a refinement passes on")
        for name, spec in case.writes.items():
            right = output[name].dtype == spec.dtype
            expect(right, f"in {mode} `{name}` is {described(output[name])}, declared as {spec}")


def _same(one: Tensor, other: Tensor) -> bool:
    # A view of the same memory is handed on, not written.
    return one is other or (one.data_ptr() == other.data_ptr() and one.shape == other.shape)


def check_unmet_requirement_fails_at_compose(case: Case) -> None:
    """A recipe that lacks one thing a component needs is refused by name; one with all runs."""
    needed = required_fields(case)
    for missing in needed:
        refusal = _refusal(case, {name: spec for name, spec in needed.items() if name != missing})
        expect(refusal, f"a recipe without {missing} is composed")
        expect(missing in refusal, f"the refusal does not name the missing {missing}: {refusal}")
    refusal = _refusal(case, needed)
    expect(not refusal, f"a recipe that gives it all it requires is refused: {refusal}")
    if case.slot in FACTS and case.slot != "renderer":
        # A recipe that is accepted must run.
        run_training_step(resolved(case, needed), case)


def _refusal(case: Case, given: Fields) -> str:
    """The message about a recipe in which the queries provide `given` alone; "" if accepted."""
    try:
        resolved(case, given)
    except RecipeError as error:
        return str(error)
    return ""


def resolved(case: Case, given: Fields) -> Recipe:
    """The small recipe with the component of `case`, whose queries provide `given`."""
    slot = case.slot
    # Thousands of queries take seconds to render and show nothing more.
    config = (case.with_at_most(count=6) if slot == "queries" else case).config
    options = {"type": f"{PLUGIN}/{case.component.name}", **config.model_dump(mode="json")}
    of_encoder = case.writes if slot == "encoder" else MEMORY_FIELDS
    # The default layers read both.
    depth = case.dims.depth if {"memory.keys", "memory.values"} <= of_encoder.keys() else 0
    place = f"{slot}.case" if slot in SECTIONS and SECTIONS[slot].named else slot
    place = f"model.{slot}" if slot in MODEL_SLOTS else place
    place = f"model.decoder.{slot}" if slot in LAYER_SLOTS else place
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
    """A component that provides the fields `provides`, derived from a built-in one."""
    # A new class each time: two cases would share one registry entry otherwise.
    written = classmethod(lambda cls, config: provides)
    return type(
        f"Given{base.__name__}", (base,), {"name": GIVEN, "fields_written": written, **methods}
    )


def _head_with(look: Fields) -> Any:
    """A head whose Gaussians have harmonics or features, read off those of the queries."""

    def forward(self: GaussianHead, state: QueryState) -> Any:
        x_BNKD = state.features[:, :, None].expand(-1, -1, self.gaussians_per_query, -1)
        parts = {"sh": x_BNKD[..., :9].unflatten(-1, (3, 3)), "features": x_BNKD[..., :4]}
        chosen = {name: x for name, x in parts.items() if f"gaussians.{name}" in look}
        return replace(GaussianHead.forward(self, state), **chosen)

    return _given(GaussianHead, look, forward=forward)


def _encoder_with(case: Case) -> Any:
    """An encoder whose features have a width of their own."""
    wide = torch.arange(memory_width(case))

    def forward(self: MultiViewViT, views: Any) -> Any:
        memory = MultiViewViT.forward(self, views)
        features = memory.features[..., wide % memory.features.shape[-1]]
        return replace(memory, features=features)

    provides = {**MEMORY_FIELDS, "memory.features": case.reads["memory.features"]}
    return _given(MultiViewViT, provides, forward=forward)


def _queries_with(case: Case, given: Fields) -> Any:
    """Queries that provide the fields `given`, of one scene, expanded to all of them."""

    def start(self: LatentQueries, batch_size: int) -> QueryState:
        maker = Maker(case, Sizes(batch=1, queries=self.count))
        fields = {name: maker.field(spec) for name, spec in given.items()}
        fields = map_tensors(lambda x: x.expand(batch_size, *x.shape[1:]), fields)
        return LatentQueries.start(self, batch_size).replace(fields=fields)

    return _given(LatentQueries, given, start=start)


@seeded(0)
def run_training_step(recipe: Recipe, case: Case) -> None:
    """A forward pass, one view rendered and compared with the target, and the backward pass.

    Raises ContractError for predictions, images, losses or gradients that are not finite.
    """
    model = recipe.build_model().train()
    losses = recipe.build_losses().values()
    views = Maker(case).target()
    target = views.select([0])
    total = torch.zeros((), dtype=torch.float64)
    for prediction in model(views).layers.values():
        expect_finite(prediction, "in a prediction of a model that has it")
        rendering = model.render(prediction.gaussians, target.cameras)
        expect_finite(rendering, "in a rendering of a model that has it")
        for loss in losses:
            unseen = loss.renderings == "none"
            seen = map_tensors(lambda x: x[:, :0], rendering) if unseen else rendering
            terms = loss(prediction, seen, target, views)
            expect_finite(terms, "as a loss of a model that has it")
            total = total + scalar(terms)
    found = gradients(total, dict(model.named_parameters()))
    expect(found, "in the model that it is composed into nothing gets a gradient")
    expect_finite(found, "in its gradient in a model that has it")

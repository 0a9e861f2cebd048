"""Fields of the state: what a component reads and writes is what it declares, and recipes obey."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import (
    CONTRACT_VERSION,
    GAUSSIAN_FIELDS,
    LAYER_SLOTS,
    MEMORY_FIELDS,
    Component,
    ComponentConfig,
    DecoderLayer,
    Fields,
    FieldSpec,
    Loss,
    Plugin,
)
from qgs.recipe import RecipeError
from qgs.recipe.recipe import Recipe, resolve
from qgs.recipe.slots import MODEL_SLOTS, SECTIONS
from qgs.tokengs import GaussianHead, LatentQueries, MultiViewViT
from qgs.types import GaussianAttributes, ImageMemory, LayerPrediction, QueryState, Views
from qgs_dev.case import Case, expect
from qgs_dev.inputs import Inputs, Maker, Sizes, inputs_of, memory_width, required_fields
from qgs_dev.modules import each_mode, seeded
from qgs_dev.registry import ALL_SLOTS, MODULES, READERS, WITH_MEMORY, check
from qgs_dev.trees import (
    described,
    difference,
    gradients,
    leaves,
    mapped,
    not_finite,
    scalar,
)

PLUGIN = "under_test"
GIVEN = "given_fields"
"""Names of the plugin that offers the component, and of the queries that give it its fields."""


@check(READERS, variants=True)
def check_reads_within_requires(case: Case) -> None:
    """Only fields in `requires` are asked for, of the state and of the image memory.

    Looking whether a field is there is asking for it. The other fields are passed on with
    `QueryState.replace`. A loss looks at no rendering if it declares that it needs none.
    """
    module, inputs, required = (
        case.lively(),
        inputs_of(case),
        case.component.fields_read(case.config),
    )
    unread = {name for name in leaves(inputs) if name.startswith("memory.")} - set(required)
    if issubclass(case.component, DecoderLayer) and case.component.sublayers:
        unread = set()  # what stands in its slots may read them
    if issubclass(case.component, Loss) and case.component.renderings == "none":
        inputs["rendering"] = Maker(case, Sizes(), torch.Generator()).rendering(views=2)
        unread = {name for name in leaves(inputs) if name.startswith("rendering.")}
    poisoned = mapped(inputs, lambda name, x: x + torch.nan if name in unread else x)
    names = ", ".join(sorted(unread))
    if "memory" in inputs and "memory.grid" not in required:
        poisoned["memory"] = replace(poisoned["memory"], grid=None)
        unread |= {"memory.grid"}
    for mode in each_mode(module):
        asked: set[str] = set()
        with seeded(0):
            first = _read_off(case, module, _with_asked_fields(inputs, asked))
        beyond = sorted(asked - set(required))
        expect(not beyond, f"in {mode} it reads {', '.join(beyond)}, which it does not require")
        with seeded(0):
            found = difference(first, _read_off(case, module, poisoned)) if unread else ""
        expect(not found, f"in {mode} it reads some of {names}, which it declares not to: {found}")


def _read_off(case: Case, module: Any, inputs: Inputs) -> Any:
    """The output; of a layer the state, since it passes on a memory that it does not read."""
    output = module(*inputs.values())
    return output[0] if case.slot in WITH_MEMORY else output


class AskedFields(dict[str, Tensor]):
    """Fields of a state that add the names they are asked for to `asked`."""

    asked: set[str]

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
    def changed(value: Any) -> Any:
        if isinstance(value, LayerPrediction):
            return replace(value, state=changed(value.state))
        if not isinstance(value, QueryState):
            return value
        fields = AskedFields(value.fields)
        fields.asked = asked
        return replace(value, fields=fields)

    return {name: changed(value) for name, value in inputs.items()}


@check(READERS, variants=True)
def check_requires_are_read(case: Case) -> None:
    """Every field in `requires` is read: else recipes that lack it are refused for nothing.

    Features of Gaussians may be read off their rendering.
    """
    module, inputs = case.lively(), inputs_of(case)
    outputs = module(*inputs.values())
    for field in case.component.fields_read(case.config):
        changed = list(_with_others(case, inputs, field))
        read = any(difference(outputs, module(*given.values())) for given in changed)
        expect(read, f"it requires {field}, which changes nothing")


def _with_others(case: Case, inputs: Inputs, field: str) -> Iterator[Inputs]:
    """`inputs` with something else for a required field."""
    if field == "memory.grid":
        views, rows, columns = inputs["memory"].grid
        for grid in ((views, columns, rows), (columns, rows, views)):
            yield {**inputs, "memory": replace(inputs["memory"], grid=grid)}
        return
    rendered = f"rendering.{field.removeprefix('gaussians.')}"
    full = {name for name in leaves(inputs) if name.endswith((field, rendered))}
    others = [leaves(inputs_of(case, seed=seed)) for seed in (1, 2, 3)]
    others.append(leaves(map_tensors(lambda x: x.roll(1, 1), inputs)))  # rays have no seed
    for other in others:
        yield mapped(inputs, lambda n, x, o=other: o[n] if n in full else x)


@check({"layer", "refinement", "feedback", "queries"}, variants=True)
def check_writes_equal_provides(case: Case) -> None:
    """The fields that are written are those in `provides`, in the shape and dtype given there.

    The others pass on all other fields as they are, a refinement the features too.
    """
    module = case.lively()
    for mode in each_mode(module):
        inputs, before = inputs_of(case), {}
        if case.slot != "queries":
            state = inputs["state"]
            before = {"unrelated.center": torch.randn(*state.features.shape[:2], 3), **state.fields}
            inputs = {**inputs, "state": QueryState(state.features, before)}
        with seeded(0):
            output = module(*inputs.values())
        output = output[0] if case.slot in WITH_MEMORY else output
        provided = case.component.fields_written(case.config)
        kept = {n for n, x in output.fields.items() if n in before and _same(x, before[n])}
        written = set(output.fields) - kept
        for fault, names in (
            ("it writes {}, which it does not provide", written - set(provided)),
            ("it does not write {}", set(provided) - written),
            ("it loses {}", set(before) - set(output.fields)),
        ):
            expect(not names, f"in {mode} {fault.format(', '.join(sorted(names)))}")
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
    features = case.component.fields_read(case.config).get("memory.features")
    if features and features != MEMORY_FIELDS["memory.features"]:
        components.append(_encoder_with(case, features))
        recipe["model"]["encoder"]["type"] = f"{PLUGIN}/{GIVEN}"
    look = {
        n: s for n, s in case.component.fields_read(case.config).items() if n in GAUSSIAN_FIELDS
    }
    if look:
        components.append(_head_with(look))
        recipe["model"]["head"]["type"] = f"{PLUGIN}/{GIVEN}"
    return resolve(recipe, plugins=(Plugin(PLUGIN, CONTRACT_VERSION, components),))


def _head_with(look: Fields) -> type[Component]:
    """A head whose Gaussians have harmonics or features, read off those of the queries."""

    class GivenHead(GaussianHead):
        name: ClassVar[str] = GIVEN

        @classmethod
        def fields_written(cls, config: ComponentConfig) -> Fields:
            return look

        def forward(self, state: QueryState) -> GaussianAttributes:
            x_BNKD = state.features[:, :, None].expand(-1, -1, self.gaussians_per_query, -1)
            parts = {"sh": x_BNKD[..., :9].unflatten(-1, (3, 3)), "features": x_BNKD[..., :4]}
            chosen = {name: x for name, x in parts.items() if f"gaussians.{name}" in look}
            return replace(super().forward(state), **chosen)

    return GivenHead


def _encoder_with(case: Case, spec: FieldSpec) -> type[Component]:
    """An encoder whose features have a width of their own."""

    class GivenEncoder(MultiViewViT):
        name: ClassVar[str] = GIVEN

        @classmethod
        def fields_written(cls, config: ComponentConfig) -> Fields:
            return {**MEMORY_FIELDS, "memory.features": spec}

        def forward(self, views: Views) -> ImageMemory:
            memory, wide = super().forward(views), memory_width(case)
            repeats = -(-wide // memory.features.shape[-1])
            return replace(memory, features=memory.features.repeat(1, 1, repeats)[..., :wide])

    return GivenEncoder


def _queries_with(case: Case, given: Fields) -> type[Component]:
    """Queries that provide the fields `given`, of one scene, expanded to all of them."""

    class GivenQueries(LatentQueries):
        name: ClassVar[str] = GIVEN

        @classmethod
        def fields_written(cls, config: ComponentConfig) -> Fields:
            return given

        def start(self, batch_size: int) -> QueryState:
            sizes = Sizes(batch=1, queries=self.count)
            maker = Maker(case, sizes, torch.Generator().manual_seed(0))
            fields = {name: maker.field(name, spec) for name, spec in given.items()}
            fields = map_tensors(lambda x: x.expand(batch_size, *x.shape[1:]), fields)
            return super().start(batch_size).replace(fields=fields)

    return GivenQueries


def _recipe_with(case: Case) -> dict[str, Any]:
    """A small recipe of built-in components, but for the one under test."""
    dims, slot = case.dims, case.slot
    # Thousands of queries take seconds to render and show nothing more.
    config = (case.with_at_most(count=6) if slot == "queries" else case).config
    chosen = {"type": f"{PLUGIN}/{case.component.name}", **config.model_dump(mode="json")}
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
    of_encoder = case.component.fields_written(case.config) if slot == "encoder" else MEMORY_FIELDS
    if not {"memory.keys", "memory.values"} <= of_encoder.keys():  # the default layers read both
        model |= {"decoder": {"depth": 0}, "supervision": {"layers": [0]}}
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
def run_training_step(recipe: Recipe, case: Case, sizes: Sizes | None = None) -> None:
    """A forward pass, one view rendered and compared with the target, and the backward pass.

    sizes: of the views; None for the usual ones.
    Raises ContractError for predictions, images, losses or gradients that are not finite.
    """
    maker = Maker(case, sizes or Sizes(), torch.Generator().manual_seed(0))
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
            terms = loss(prediction, seen, target, views)
            _expect_finite("losses", terms)
            total = total + scalar(terms)
    found = gradients(total, dict(model.named_parameters()))
    expect(bool(found), "in the model that it is composed into nothing gets a gradient")
    _expect_finite("gradients", found)


def _expect_finite(what: str, tree: Any) -> None:
    broken = not_finite(tree)
    expect(not broken, f"composed into a model, {what} are not finite: {', '.join(broken)}")

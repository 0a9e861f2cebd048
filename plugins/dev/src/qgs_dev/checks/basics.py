"""Checks that a component can be built, called with any sizes and strides, and compiled.

Methods of the bases `Component`, `Config` and `nn.Module` are checked too, because a class may
override them.
"""

import random
from collections.abc import Iterable
from typing import Any, get_args, get_origin, get_type_hints
from unittest.mock import ANY, patch

import numpy
import torch
from pydantic import BaseModel
from safetensors.torch import load, save
from torch import Tensor, nn

from qgs.containers import map_tensors
from qgs.contracts import ComponentConfig
from qgs.recipe.build import OnMeta
from qgs.recipe.decode import decode_config
from qgs.recipe.errors import Problems
from qgs.recipe.slots import SLOTS
from qgs.recipe.yaml_text import dump, load_mapping
from qgs_dev.case import Case, seeded
from qgs_dev.inputs import FACTS, WITH_MEMORY, Inputs, Maker, Sizes, inputs_of, sizes_of
from qgs_dev.vocabulary import (
    Trial,
    expect,
    expect_none,
    expect_same,
    floating,
    gradients,
    leaves,
    scalar,
    tensors_of,
    tracked,
)

VARIED = (
    Sizes(),
    Sizes(batch=1, queries=1, views=1),
    Sizes(batch=3, queries=7, views=3),
    Sizes(batch=1, queries=9, views=4, gaussians=1),
)

WARM_UP = (Sizes(batch=2, queries=6), Sizes(batch=3, queries=8, views=3, gaussians=3))
# Later sizes for a compiled component; none of their numbers occurs in WARM_UP.
LATER = [Sizes(count, queries, count, count) for count, queries in ((4, 9), (5, 11), (7, 13))]
# Number of further graphs that the later sizes may need, because one of them may be special.
SLACK = 2


def check_builds(case: Case) -> None:
    """Require that `problems` accepts the options, and that the component can be built."""
    found = [f"`{p.option}`: {p.reason}" for p in case.problems()]
    # A case with invalid options says nothing about the component.
    expect(not found, f"`problems` refuses the options of this case: {', '.join(found)}")
    case.build()


def check_runs(case: Case) -> None:
    """Require that a forward pass on random inputs returns the type that the slot prescribes."""
    output = Trial(case)()
    contract: Any = SLOTS[case.slot].contract
    wanted = get_type_hints(contract.forward)["return"]
    kind = get_origin(wanted) or wanted
    seen = f"the component returns {type(output).__name__}, not {kind.__name__}"
    expect(isinstance(output, kind), seen)
    if case.slot in WITH_MEMORY:
        kinds = [type(part).__name__ for part in output]
        seen = f"the component returns {kinds}, not state and memory"
        expect(kinds == ["QueryState", "ImageMemory"], seen)
    if isinstance(output, dict):
        odd = [name for name, term in output.items() if not isinstance(term, Tensor)]
        expect_none(odd, "not a tensor")


def check_sizes_vary(case: Case) -> None:
    """Require correct output shapes for any number of scenes, queries and views.

    One instance must accept all these sizes. The check is repeated with another model width and
    number of heads, for which a second instance is built.
    """
    _expect_shapes(case, [*VARIED, Sizes(image=(case.size[1], case.size[0]))])
    other = case.with_dims(width=48, heads=3)
    if case.has_parameters and not other.problems():
        try:
            _expect_shapes(other, VARIED[:2])
        except Exception as error:
            error.add_note("in a model of width 48 with 3 heads")
            raise


def _expect_shapes(case: Case, varied: Iterable[Sizes]) -> None:
    trial = Trial(case)
    for sizes in varied:
        if sizes.image and case.slot == "encoder" and case.problems(sizes.image):
            # The component declares that it does not accept this image size.
            continue
        shapes = _expected_shapes(trial, sizes)
        for mode, output in trial.in_each_mode(inputs_of(case, sizes)):
            outputs = leaves(output)
            for name, shape in shapes.items():
                expect(name in outputs, f"in {mode}, with {sizes}, there is no output `{name}`")
                seen = list(outputs[name].shape)
                wrong = f"in {mode}, with {sizes}, `{name}` has shape {seen}, not {shape}"
                expect(seen == shape, wrong)


def _expected_shapes(trial: Trial, sizes: Sizes) -> dict[str, list[int]]:
    """Return the required shape of every output, by name. ANY equals any size."""
    case = trial.case
    maker = Maker(case, sizes)
    # The component chooses.
    maker.axes["M"] = ANY
    # Queries have their own number, whatever the sizes of the inputs.
    if case.slot == "queries":
        maker.axes["N"] = trial.module.count or ANY
    if case.slot == "head":
        maker.axes["K"] = trial.module.gaussians_per_query
    fixed = FACTS[case.slot].get("shapes", {"output": "BND"})
    shapes = {name: maker.shape(axes) for name, axes in fixed.items()}
    for name, spec in case.writes.items():
        axes = "BN"
        place = f"0.fields.{name}" if case.slot in WITH_MEMORY else f"fields.{name}"
        if name == "memory.grid" or case.slot in ("head", "renderer"):
            # Such an output is not a tensor, or another check covers it.
            continue
        if case.slot == "encoder":
            axes = "BhM" if name in ("memory.keys", "memory.values") else "BM"
            place = name.removeprefix("memory.")
        shapes[place] = [*maker.shape(axes), *sizes_of(spec, case.dims)]
    return shapes


def check_strides_make_no_difference(case: Case) -> None:
    """Require that results do not change if inputs are not contiguous in memory, such as slices."""
    trial = Trial(case)
    strided = map_tensors(_with_gaps, trial.inputs)
    # With other strides, sums run in another order.
    expect_same(trial(), trial(strided), "with inputs that are not contiguous", 1e-3, 1e-4)


def _with_gaps(tensor: Tensor) -> Tensor:
    """Return a copy of `tensor` with gaps in memory along every dimension."""
    room = tensor.new_zeros([size + 1 for size in tensor.shape])
    return room[tuple(slice(size) for size in tensor.shape)].copy_(tensor)


def check_compiles(case: Case) -> None:
    """Require that torch.compile keeps results and gradients, and new sizes need no new graphs.

    The traced graphs run eagerly, so the check does not test generated code.
    """
    from torch._dynamo.testing import CompileCounterWithBackend

    trial = Trial(case)
    module = trial.module
    counter = CompileCounterWithBackend("aot_eager")
    # Otherwise graphs of an earlier case would count too.
    torch._dynamo.reset()
    try:
        compiled: Any = torch.compile(module, backend=counter)
        for sizes in (*WARM_UP, *LATER):
            # Graphs of the first sizes count for nothing: torch makes a second one where a size
            # varies.
            if sizes == LATER[0]:
                counter.clear()
            ours, theirs = (trial.tracked(inputs_of(case, sizes)) for _ in range(2))
            eager = module(*ours.values())
            outputs = compiled(*theirs.values())
            expect_same(eager, outputs, f"compiled, with {sizes}", 1e-3, 1e-4)
    finally:
        torch._dynamo.reset()
    found = _gradients(module, ours, eager)
    of_compiled = _gradients(module, theirs, outputs)
    odd = found.keys() ^ of_compiled.keys()
    expect_none(odd, "has a gradient only with, or only without, torch.compile")
    largest = max((gradient.abs().max().item() for gradient in found.values()), default=0.0)
    for name, gradient in found.items():
        # Gradients of different inputs differ by orders of magnitude; a small one may be the rest
        # of large terms, as that of a bias before a softmax is, and has their rounding.
        atol = 1e-3 * gradient.abs().max().item() + 1e-6 * max(largest, 1.0)
        where = f"compiled, the gradient of {name} differs"
        expect_same(gradient, of_compiled[name], where, atol=atol)
    more = counter.frame_count
    seen = f"{more} new graphs are compiled for {len(LATER)} sizes after the first {len(WARM_UP)}"
    expect(more <= SLACK, seen)


def _gradients(module: Any, inputs: Inputs, outputs: Any) -> dict[str, Tensor]:
    """Return the gradients of inputs and parameters by name, but no gradient that is all zero."""
    given = {**inputs, "parameter": dict(module.named_parameters())}
    return {name: x for name, x in gradients(scalar(outputs), given).items() if x.any()}


def check_construction(case: Case) -> None:
    """Require that options survive writing and reading, and modules survive saving and moving.

    Options must be the same after they are written as YAML and read again, and after a component is
    built. A misspelt option must be refused with a suggestion. A component with parameters must
    allocate no memory under the meta device, keep every tensor as a parameter or a buffer, and use
    only torch's global random generator. From saved weights it must give bitwise equal results, and
    it must compute on the device to which it is moved.
    """
    _expect_strict_options(case)
    if case.slot != "data":
        # A shallow copy would share lists and hide changes of them.
        own = case.with_config(case.config.model_copy(deep=True))
        own.build()
        same = own.config == case.config
        seen = f"building changes the options from {case.config!r} to {own.config!r}"
        expect(same, seen)
    if case.has_parameters:
        with torch.device("meta"), OnMeta():
            tensors = tensors_of(case.construct())
        real = [name for name, tensor in tensors.items() if not tensor.is_meta]
        expect_none(real, "allocated under the meta device; leave the device to the caller")
        _expect_drawn_from_torch(case)
        _expect_registered(case.build())
        _expect_loadable(case)
        _expect_movable(case)


def _expect_strict_options(case: Case) -> None:
    options = case.config.model_dump(mode="json")
    names = list(type(case.config).model_fields)
    expect_none(set(names) - options.keys(), "missing when the options are written")
    again, message = _decoded(case, options)
    expect(again is not None, f"its own options {options} are refused: {message}")
    expect(again == case.config, f"{case.config!r} is read back as {again!r}")
    # This name is close enough for a suggestion.
    wrong = f"{names[0]}_x" if names else "no_such_option"
    config, message = _decoded(case, {**options, wrong: 1})
    expect(config is None, f"the unknown option `{wrong}` is accepted")
    close = not names or f"did you mean `{names[0]}`" in message
    expect(close, f"the message for `{wrong}` does not suggest the right name: {message}")
    for model in _configs_in(type(case.config)):
        strict = model.model_config.get("extra") == "forbid"
        expect(strict, f"{model.__qualname__} accepts any option; derive it from ComponentConfig")


def _configs_in(annotation: Any) -> set[type[BaseModel]]:
    """Return all config classes in the type `annotation` of an option, including nested ones."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        inside = [field.annotation for field in annotation.model_fields.values()]
        return {annotation}.union(*map(_configs_in, inside))
    return {model for part in get_args(annotation) for model in _configs_in(part)}


def _decoded(case: Case, options: dict[str, Any]) -> tuple[ComponentConfig | None, str]:
    """Write options as YAML and read them again as a recipe does.

    Returns the options that were read and "". If a recipe would refuse the options, returns the
    error message instead of ""; the first result may then be None.
    """
    problems = Problems()
    node = load_mapping(dump(options), "case", problems)
    config = decode_config(case.component.Config, node, (), problems)
    return config, "\n".join(map(str, problems.found))


def _expect_drawn_from_torch(case: Case) -> None:
    # A resumed training restores torch's generator alone.
    others = other_generators()
    after = []
    for seed in (1, 2):
        with seeded(seed):
            case.construct()
            after.append(torch.get_rng_state())
    expect(not torch.equal(*after), "building sets the seed of torch's generator")
    expect(others == other_generators(), "building draws from numpy's or random's generator")
    first, second = (dict(case.build(seed=3).state_dict()) for _ in range(2))
    expect_same(first, second, "two instances built from one seed differ")


def other_generators() -> tuple[Any, str]:
    """Return the states of the random generators of numpy and of Python's module `random`.

    Components must use torch's generator instead of these two.
    """
    return random.getstate(), str(numpy.random.get_state())


def _expect_registered(module: nn.Module) -> None:
    for name, part in module.named_modules():
        # Torch's own layers may list their parameters twice, as its recurrent layers do.
        of_torch = type(part).__module__.startswith("torch.")
        for key, value in vars(part).items():
            listed = value if isinstance(value, list | tuple) and not of_torch else ()
            kept = [value] if isinstance(value, Tensor) else listed
            outside = any(isinstance(x, Tensor | nn.Module) for x in kept)
            where = f"{name or 'the component'} keeps {key}"
            expect(not outside, f"{where} outside of its parameters, buffers and modules")


def _expect_loadable(case: Case) -> None:
    module = case.lively(seed=1)
    weights = {name: x.contiguous() for name, x in module.state_dict().items()}
    other = case.build(seed=2).eval()
    other.load_state_dict(load(save(weights)))
    inputs = inputs_of(case).values()
    expect_same(module(*inputs), other(*inputs), "two instances with the same state dict differ")


def _expect_movable(case: Case) -> None:
    device = "cuda" if torch.cuda.is_available() else "meta"
    inputs = tracked(map_tensors(lambda x: x.to(device), inputs_of(case)))
    with _autocast_accepts_meta():
        outputs = floating(case.lively().to(device)(*inputs.values()))
    for name, tensor in outputs.items():
        moved = tensor.device.type == device
        expect(moved, f"`{name}` is on {tensor.device}, but the component is on {device}")
    # The backward pass may use other devices.
    totals = [x.sum() for x in outputs.values() if x.requires_grad]
    if totals:
        torch.autograd.backward(totals)


def _autocast_accepts_meta() -> Any:
    """Allow `torch.autocast("meta", enabled=False)`, which torch refuses otherwise."""
    start = torch.autocast.__init__

    def begin(self: Any, device_type: str, *args: Any, **kwargs: Any) -> None:
        start(self, "cpu" if device_type == "meta" else device_type, *args, **kwargs)

    return patch.object(torch.autocast, "__init__", begin)

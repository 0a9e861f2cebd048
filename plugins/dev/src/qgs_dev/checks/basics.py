"""A component can be built and called: with any sizes and strides, and compiled.

What `Component`, its `Config` and `nn.Module` give a class that does as usual is checked, too.
"""

import random
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, get_args
from unittest.mock import patch

import numpy
import torch
from pydantic import BaseModel
from safetensors.torch import load, save
from torch import Tensor, nn

from qgs.containers import map_tensors
from qgs.contracts import ComponentConfig
from qgs.recipe.build import OnMeta
from qgs.recipe.decode import decode_config
from qgs.recipe.errors import Problems, RecipeError
from qgs.recipe.yaml_text import dump, load_mapping
from qgs.types import GaussianAttributes, ImageMemory, QueryState, Rendering
from qgs_dev.case import Case
from qgs_dev.inputs import FACTS, WITH_MEMORY, Inputs, Maker, Sizes, inputs_of, sizes_of
from qgs_dev.modules import seeded, tensors_of
from qgs_dev.vocabulary import (
    Trial,
    expect,
    expect_none,
    expect_same,
    floating,
    gradients,
    leaves,
    scalar,
    tracked,
)

# Types that a forward pass gives; a tensor in all other slots.
OUTPUTS: Mapping[str, type] = {
    "encoder": ImageMemory,
    "queries": QueryState,
    "layer": tuple,
    "feedback": tuple,
    "refinement": QueryState,
    "head": GaussianAttributes,
    "renderer": Rendering,
    "losses": Mapping,
}

VARIED = (
    Sizes(),
    Sizes(batch=1, queries=1, views=1),
    Sizes(batch=3, queries=7, views=3),
    Sizes(batch=1, queries=9, views=4, gaussians=1),
)

WARM_UP = (Sizes(batch=2, queries=6), Sizes(batch=3, queries=8, views=3, gaussians=3))
# Sizes for a compiled component; none of the later ones was seen before, in no number.
LATER = (
    Sizes(batch=4, queries=9, views=4, gaussians=4),
    Sizes(batch=5, queries=11, views=5, gaussians=5),
    Sizes(batch=7, queries=13, views=7, gaussians=7),
)
# More graphs that the later sizes may take together, where one of them is special.
SLACK = 2


def check_builds(case: Case) -> None:
    """A component can be built from its options, in which its `problems` finds none."""
    found = [f"`{p.option}`: {p.reason}" for p in case.problems(case.size)]
    # A case that its component refuses says nothing about the component.
    expect(not found, f"the options of this case are refused: {', '.join(found)}")
    case.build()


def check_runs(case: Case) -> None:
    """A forward pass on ordinary inputs gives what the contract of the slot says that it gives."""
    output = Trial(case)()
    kind = OUTPUTS.get(case.slot, Tensor)
    expect(isinstance(output, kind), f"it gives a {type(output).__name__}, not a {kind.__name__}")
    if case.slot in WITH_MEMORY:
        kinds = [type(part).__name__ for part in output]
        expect(kinds == ["QueryState", "ImageMemory"], f"it gives {kinds}, not state and memory")
    if isinstance(output, Mapping):
        odd = [name for name, term in output.items() if not isinstance(term, Tensor)]
        expect_none(odd, "no tensor")


def check_sizes_vary(case: Case) -> None:
    """One instance takes any number of scenes, queries and views, and gives the shapes it must.

    So does one of a model of another width and number of heads.
    """
    _expect_shapes(case, [*VARIED, Sizes(image=(case.size[1], case.size[0]))])
    other = case.with_dims(width=48, heads=3)
    if case.has_parameters and not other.problems(other.size):
        try:
            _expect_shapes(other, VARIED[:2])
        except Exception as error:
            error.add_note("in a model of width 48 with 3 heads")
            raise


def _expect_shapes(case: Case, varied: Iterable[Sizes]) -> None:
    trial = Trial(case)
    for sizes in varied:
        if sizes.image and case.slot == "encoder" and case.problems(sizes.image):
            # The component refuses these images, and says so.
            continue
        shapes = _expected_shapes(trial, sizes)
        for mode, output in trial.in_each_mode(inputs_of(case, sizes)):
            outputs = leaves(output)
            for name, shape in shapes.items():
                expect(name in outputs, f"in {mode}, with {sizes}, it gives no `{name}`")
                seen = list(outputs[name].shape)
                # None: the component chooses.
                right = len(seen) == len(shape) and all(
                    size in (None, given) for size, given in zip(shape, seen, strict=True)
                )
                expect(right, f"in {mode}, with {sizes}, `{name}` is of shape {seen}, not {shape}")


def _expected_shapes(trial: Trial, sizes: Sizes) -> dict[str, list[int | None]]:
    """Shape of every output that the contract fixes; None for a size that it leaves open."""
    case = trial.case
    maker = Maker(case, sizes)
    maker.axes["M"] = None
    # Queries bring their own number, whatever the sizes of the inputs.
    if case.slot == "queries":
        maker.axes["N"] = trial.module.count
    if case.slot == "head":
        maker.axes["K"] = trial.module.gaussians_per_query
    fixed = FACTS[case.slot].get("shapes", {"output": "BND"})
    shapes: dict[str, list[int | None]] = {n: [*maker.shape(axes)] for n, axes in fixed.items()}
    for name, spec in case.writes.items():
        axes = "BN"
        place = f"0.fields.{name}" if case.slot in WITH_MEMORY else f"fields.{name}"
        if name == "memory.grid" or case.slot in ("head", "renderer"):
            # No tensor, or the subject of another check.
            continue
        if case.slot == "encoder":
            axes = "BhM" if name in ("memory.keys", "memory.values") else "BM"
            place = name.removeprefix("memory.")
        shapes[place] = [*maker.shape(axes), *sizes_of(spec, case.dims)]
    return shapes


def check_strides_make_no_difference(case: Case) -> None:
    """Inputs that are not contiguous, such as expanded or sliced ones, give the same results."""
    trial = Trial(case)
    strided = map_tensors(_with_gaps, trial.inputs)
    # Other strides are summed up in another order.
    expect_same(trial(), trial(strided), "with inputs that are not contiguous", 1e-3, 1e-4)


def _with_gaps(tensor: Tensor) -> Tensor:
    """The same numbers, with gaps in memory along every dimension."""
    room = tensor.new_zeros([size + 1 for size in tensor.shape])
    return room[tuple(slice(size) for size in tensor.shape)].copy_(tensor)


def check_compiles(case: Case) -> None:
    """Traced by torch.compile, a component is close to eager, and new sizes need no new graphs.

    So are its gradients. The graphs run eagerly: what a compiler makes of them is torch's business.
    """
    from torch._dynamo.testing import CompileCounterWithBackend

    trial = Trial(case)
    module = trial.module
    counter = CompileCounterWithBackend("aot_eager")
    # Graphs of another case would count as its own.
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
    expect_none(odd, "a gradient only if compiled, or only if not")
    largest = max((gradient.abs().max().item() for gradient in found.values()), default=0.0)
    for name, gradient in found.items():
        # Gradients of different inputs differ by orders of magnitude; a small one may be the rest
        # of large terms, as that of a bias before a softmax is, and has their rounding.
        atol = 1e-3 * gradient.abs().max().item() + 1e-6 * max(largest, 1.0)
        where = f"compiled, the gradient of {name} differs"
        expect_same(gradient, of_compiled[name], where, atol=atol)
    more = counter.frame_count
    seen = f"{more} more graphs are compiled for {len(LATER)} new sizes after {len(WARM_UP)}"
    expect(more <= SLACK, seen)


def _gradients(module: Any, inputs: Inputs, outputs: Any) -> dict[str, Tensor]:
    """Gradients in the inputs and in the parameters, without those that are all zeros."""
    given = {**inputs, "parameter": dict(module.named_parameters())}
    return {name: x for name, x in gradients(scalar(outputs), given).items() if bool(x.any())}


def check_construction(case: Case) -> None:
    """Options are those that were written, and modules are drawn, saved, loaded and moved whole.

    Options written as YAML and read again are the same, also after building; a misspelt one is
    refused with the nearest one. A component with parameters allocates nothing under the meta
    device, keeps every tensor as a parameter or a buffer, draws from torch's global generator
    alone, gives the same bits from saved weights, and computes on the device that it is moved to.
    """
    _expect_strict_options(case)
    if case.slot != "data":
        # A shallow copy would share lists, and their change would go unseen.
        own = case.with_config(case.config.model_copy(deep=True))
        own.build()
        same = own.config == case.config
        expect(same, f"when it is built, {case.config!r} becomes {own.config!r}")
    if case.has_parameters:
        with torch.device("meta"), OnMeta():
            tensors = tensors_of(case.construct())
        real = [name for name, tensor in tensors.items() if not tensor.is_meta]
        expect_none(real, "allocated; leave the device to the caller")
        _expect_drawn_from_torch(case)
        _expect_registered(case.build())
        _expect_loadable(case)
        _expect_movable(case)


def _expect_strict_options(case: Case) -> None:
    options = case.config.model_dump(mode="json")
    names = list(type(case.config).model_fields)
    expect_none(set(names) - options.keys(), "not written")
    again, message = _decoded(case, options)
    expect(again is not None, f"{options} is refused: {message}")
    expect(again == case.config, f"{case.config!r} is read again as {again!r}")
    # One letter too many: near enough for a suggestion.
    wrong = f"{names[0]}_x" if names else "no_such_option"
    config, message = _decoded(case, {**options, wrong: 1})
    expect(config is None, f"the option `{wrong}` is accepted")
    expect(not names or f"did you mean `{names[0]}`" in message, f"the message is: {message}")
    for model in _configs_in(type(case.config)):
        strict = model.model_config.get("extra") == "forbid"
        expect(strict, f"{model.__qualname__} accepts any option; derive it from ComponentConfig")


def _configs_in(annotation: Any) -> set[type[BaseModel]]:
    """The configs that an option of this type can hold, with those in their own options."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        inside = [field.annotation for field in annotation.model_fields.values()]
        return {annotation}.union(*map(_configs_in, inside))
    return {model for part in get_args(annotation) for model in _configs_in(part)}


def _decoded(case: Case, options: dict[str, Any]) -> tuple[ComponentConfig | None, str]:
    """The options that the composer reads from YAML, and the message if it refuses them."""
    problems = Problems()
    node = load_mapping(dump(options), "case", problems)
    config = decode_config(case.component.Config, node, (), problems)
    try:
        problems.raise_any()
    except RecipeError as error:
        return config, str(error)
    return config, ""


def _expect_drawn_from_torch(case: Case) -> None:
    # Training resumes torch's generator alone.
    others = other_generators()
    after = []
    for seed in (1, 2):
        with seeded(seed):
            case.construct()
            after.append(torch.get_rng_state())
    expect(not torch.equal(*after), "after being built from two seeds, torch is in one state")
    expect(others == other_generators(), "building draws from numpy's or random's generator")
    first, second = (dict(case.build(seed=3).state_dict()) for _ in range(2))
    expect_same(first, second, "two instances built from one seed differ")


def other_generators() -> tuple[Any, str]:
    """The states of the random generators that components must not use."""
    return random.getstate(), str(numpy.random.get_state())


def _expect_registered(module: nn.Module) -> None:
    for name, part in module.named_modules():
        # Torch's own layers may list their parameters a second time, as its recurrent ones do.
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
    expect_same(module(*inputs), other(*inputs), "with the same state dict")


def _expect_movable(case: Case) -> None:
    device = "cuda" if torch.cuda.is_available() else "meta"
    inputs = tracked(map_tensors(lambda x: x.to(device), inputs_of(case)))
    with _autocast_accepts_meta():
        outputs = floating(case.lively().to(device)(*inputs.values()))
    for name, tensor in outputs.items():
        moved = tensor.device.type == device
        expect(moved, f"`{name}` is on {tensor.device}, the component on {device}")
    # The backward pass has devices of its own.
    totals = [x.sum() for x in outputs.values() if x.requires_grad]
    if totals:
        torch.autograd.backward(totals)


@contextmanager
def _autocast_accepts_meta() -> Iterator[None]:
    """`torch.autocast(x.device.type, enabled=False)` is valid code, which torch refuses on meta."""
    start = torch.autocast.__init__

    def begin(self: Any, device_type: str, *args: Any, **kwargs: Any) -> None:
        start(self, "cpu" if device_type == "meta" else device_type, *args, **kwargs)

    with patch.object(torch.autocast, "__init__", begin):
        yield

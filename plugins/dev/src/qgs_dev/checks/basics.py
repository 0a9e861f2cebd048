"""A component can be built and called: with any sizes and strides, and compiled."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import torch
from torch import Tensor

from qgs.containers import map_tensors
from qgs.types import GaussianAttributes, ImageMemory, QueryState, Rendering
from qgs_dev.case import Case, ContractError, expect
from qgs_dev.inputs import Inputs, Maker, Sizes, inputs_of, sizes_of, tracked_inputs
from qgs_dev.modules import each_mode, seeded
from qgs_dev.places import file_of
from qgs_dev.registry import ALL_SLOTS, MODULES, PARAMETRIC, WITH_MEMORY, check
from qgs_dev.running import with_place
from qgs_dev.trees import difference, floating, gradients, leaves, scalar

Shape: TypeAlias = tuple[int | None, ...]
"""None where the component is free to choose."""

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
"""What a forward pass gives; a tensor in all other slots."""

VARIED = (
    Sizes(),
    Sizes(batch=1, queries=1, views=1),
    Sizes(batch=3, queries=7, views=3),
    Sizes(batch=1, queries=9, views=4, gaussians=1),
)

WARM_UP = (Sizes(batch=2, queries=6), Sizes(batch=3, queries=8, views=3, gaussians=3))
LATER = (
    Sizes(batch=4, queries=9, views=4, gaussians=4),
    Sizes(batch=5, queries=11, views=5, gaussians=5),
    Sizes(batch=7, queries=13, views=7, gaussians=7),
)
"""Sizes for a compiled component; none of the later ones was seen before, in no number."""
SLACK = 2
"""More graphs that the later sizes may take together, where one of them is special."""


@check(ALL_SLOTS, variants=True)
def check_builds(case: Case) -> None:
    """A component can be built from its options, in which its `problems` finds none."""
    found = [f"`{p.option}`: {p.reason}" for p in case.problems(case.size)]
    expect(not found, f"the options of this case are refused: {', '.join(found)}")
    case.build()


@check(MODULES, variants=True)
def check_runs(case: Case) -> None:
    """A forward pass on ordinary inputs gives what the contract of the slot says that it gives."""
    output = case.lively()(*inputs_of(case).values())
    kind = OUTPUTS.get(case.slot, Tensor)
    expect(isinstance(output, kind), f"it gives a {type(output).__name__}, not a {kind.__name__}")
    if case.slot in WITH_MEMORY:
        kinds = [type(part).__name__ for part in output]
        expect(kinds == ["QueryState", "ImageMemory"], f"it gives {kinds}, not state and memory")
    if isinstance(output, Mapping):
        odd = [name for name, term in output.items() if not isinstance(term, Tensor)]
        expect(not odd, f"{', '.join(map(str, odd))} is no tensor")


@check(MODULES)
def check_sizes_vary(case: Case) -> None:
    """One instance takes any number of scenes, queries and views, and gives the shapes it must.

    So does one of a model of another width and number of heads.
    """
    turned = Sizes(image=(case.size[1], case.size[0]))
    _expect_shapes(case, (*VARIED, turned))
    other = case.with_dims(width=48, heads=3)
    if case.has_parameters and not other.problems(other.size):
        try:
            _expect_shapes(other, VARIED[:2])
        except Exception as error:
            seen = with_place(error, file_of(case.component))
            raise ContractError(f"in a model of width 48 with 3 heads, {seen}") from error


def _expect_shapes(case: Case, varied: Iterable[Sizes]) -> None:
    module = case.lively()
    for sizes in varied:
        if sizes.image and case.slot == "encoder" and case.problems(sizes.image):
            continue  # the component refuses these images, and says so
        for mode in each_mode(module):
            with seeded(0), torch.no_grad():
                outputs = leaves(module(*inputs_of(case, sizes).values()))
            for name, shape in _expected_shapes(case, module, sizes).items():
                expect(name in outputs, f"in {mode}, with {sizes}, it gives no `{name}`")
                seen = tuple(outputs[name].shape)
                wrong = f"in {mode}, with {sizes}, `{name}` is of shape {seen}, not {shape}"
                expect(_fits(seen, shape), wrong)


def _fits(seen: tuple[int, ...], wanted: tuple[Any, ...]) -> bool:
    """Whether `seen` has the sizes that are numbers in `wanted`; any other may be any."""
    return len(seen) == len(wanted) and all(
        not isinstance(size, int) or size == given for size, given in zip(wanted, seen, strict=True)
    )


def _expected_shapes(case: Case, module: Any, sizes: Sizes) -> dict[str, Shape]:
    """Shape of every output that the contract fixes."""
    width, heads = case.dims.width, case.dims.heads
    batch, count = sizes.batch, sizes.queries
    match case.slot:
        case "encoder":
            of_heads = ("memory.keys", "memory.values")
            return {
                name.removeprefix("memory."): (
                    *((batch, heads, None) if name in of_heads else (batch, None)),
                    *sizes_of(spec, case.dims),
                )
                for name, spec in case.component.fields_written(case.config).items()
                if name != "memory.grid"  # no tensor
            }
        case "queries" | "refinement" | "layer" | "feedback":
            count = module.count if case.slot == "queries" else count
            maker = Maker(case, replace(sizes, queries=count or 1), torch.Generator())
            provided = case.component.fields_written(case.config).items()
            where = "0." if case.slot in WITH_MEMORY else ""
            fields = {n: (batch, count, *maker.field(n, s).shape[2:]) for n, s in provided}
            fields = {f"{where}fields.{name}": shape for name, shape in fields.items()}
            return {f"{where}features": (batch, count, width), **fields}
        case "head":
            each = (batch, count, module.gaussians_per_query)
            sized = {"offsets": 3, "scales": 3, "quats": 4, "colors": 3}
            return {"opacities": each, **{name: (*each, size) for name, size in sized.items()}}
        case "centers":
            return {"output": (batch, count, sizes.gaussians, 3)}
        case "renderer":
            each, size = (batch, sizes.views), sizes.image or case.size
            return {n: (*each, c, *size) for n, c in (("rgb", 3), ("alpha", 1), ("depth", 1))}
        case "losses":
            return {}
    return {"output": (batch, count, width)}


@check(MODULES - {"queries"})
def check_strides_make_no_difference(case: Case) -> None:
    """Inputs that are not contiguous, such as expanded or sliced ones, give the same results."""
    module, inputs = case.lively(), inputs_of(case)
    # Other strides are summed up in another order.
    strided = module(*map_tensors(_with_gaps, inputs).values())
    found = difference(module(*inputs.values()), strided, 1e-3, 1e-4)
    expect(not found, f"with inputs that are not contiguous, {found}")


def _with_gaps(tensor: Tensor) -> Tensor:
    """The same numbers, with gaps in memory along every dimension."""
    room = tensor.new_zeros([size + 1 for size in tensor.shape])
    return room[tuple(slice(size) for size in tensor.shape)].copy_(tensor)


@check(PARAMETRIC, tier="extended")
def check_compiles(case: Case) -> None:
    """Traced by torch.compile, a component is close to eager, and new sizes need no new graphs.

    So are its gradients. The graphs run eagerly: what a compiler makes of them is torch's business.
    """
    from torch._dynamo.testing import CompileCounterWithBackend

    module = case.lively()
    counter = CompileCounterWithBackend("aot_eager")
    torch._dynamo.reset()
    try:
        compiled: Any = torch.compile(module, backend=counter)
        for index, sizes in enumerate((*WARM_UP, *LATER)):
            if index == len(WARM_UP):
                counter.clear()
            ours, theirs = (tracked_inputs(case, inputs_of(case, sizes)) for _ in range(2))
            eager, outputs = module(*ours.values()), compiled(*theirs.values())
            found = difference(eager, outputs, 1e-3, 1e-4)
            expect(not found, f"compiled, with {sizes}, {found}")
    finally:
        torch._dynamo.reset()
    eager, outputs = _gradients(module, ours, eager), _gradients(module, theirs, outputs)
    odd = sorted(eager.keys() ^ outputs.keys())
    expect(not odd, f"compiled or not decides whether {', '.join(odd)} has a gradient")
    for name, gradient in eager.items():
        size = gradient.abs().max().item()
        found = difference({name: gradient}, {name: outputs[name]}, 0.0, 1e-3 * size + 1e-6)
        expect(not found, f"compiled, the gradient differs: {found}")
    more = counter.frame_count
    seen = f"{more} more graphs are compiled for {len(LATER)} new sizes after {len(WARM_UP)}"
    expect(more <= SLACK, seen)


def _gradients(module: Any, inputs: Inputs, outputs: Any) -> dict[str, Tensor]:
    """Gradients in the inputs and in the parameters, without those that are all zeros."""
    given = floating(inputs) | {f"parameter {n}": p for n, p in module.named_parameters()}
    return {name: x for name, x in gradients(scalar(outputs), given).items() if bool(x.any())}

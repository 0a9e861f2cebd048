"""A component can be built and called: with any sizes and strides, and compiled."""

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from qgs.containers import map_tensors
from qgs.types import GaussianAttributes, ImageMemory, QueryState, Rendering
from qgs_dev.case import Case
from qgs_dev.inputs import FACTS, WITH_MEMORY, Inputs, Maker, Sizes, inputs_of, sizes_of
from qgs_dev.vocabulary import Trial, expect, expect_none, expect_same, gradients, leaves, scalar

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
    for name, gradient in found.items():
        # Gradients of different inputs differ by orders of magnitude.
        atol = 1e-3 * gradient.abs().max().item() + 1e-6
        where = f"compiled, the gradient of {name} differs"
        expect_same(gradient, of_compiled[name], where, atol=atol)
    more = counter.frame_count
    seen = f"{more} more graphs are compiled for {len(LATER)} new sizes after {len(WARM_UP)}"
    expect(more <= SLACK, seen)


def _gradients(module: Any, inputs: Inputs, outputs: Any) -> dict[str, Tensor]:
    """Gradients in the inputs and in the parameters, without those that are all zeros."""
    given = {**inputs, "parameter": dict(module.named_parameters())}
    return {name: x for name, x in gradients(scalar(outputs), given).items() if bool(x.any())}

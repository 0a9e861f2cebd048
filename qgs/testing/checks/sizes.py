"""Any number of scenes, queries and views, of any shape."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, TypeAlias

import torch
from torch import Tensor

from qgs.composer.flow import fits
from qgs.composer.registry import file_of
from qgs.testing.case import Case
from qgs.testing.chance import drawn_from
from qgs.testing.faults import ContractError, expect
from qgs.testing.modes import each_mode
from qgs.testing.places import raised
from qgs.testing.registry import MODULES, check
from qgs.testing.subjects import Maker, Sizes, inputs_of
from qgs.testing.trees import distance, leaves, mapped

Shape: TypeAlias = tuple[int | None, ...]
"""None where the component is free to choose."""

VARIED = (
    Sizes(),
    Sizes(batch=1, queries=1, views=1),
    Sizes(batch=3, queries=7, views=3),
    Sizes(batch=1, queries=9, views=4, gaussians=1),
)


THREE_HEADS = {"width": 48, "heads": 3}
"""Sizes of another model, no multiples of the usual ones."""


@check(MODULES)
def check_sizes_vary(case: Case) -> None:
    """One instance takes any number of scenes, queries and views, and gives the shapes it must.

    So does one of a model of another width and number of heads.
    """
    turned = Sizes(image=(case.size[1], case.size[0]))
    _expect_shapes(case, (*VARIED, turned))
    other = case.with_dims(**THREE_HEADS)
    if case.has_parameters and not other.problems(other.size):
        _expect_it_fits(other)


def _expect_it_fits(case: Case) -> None:
    """Expect it of a component that is known to run in models of other sizes."""
    where = f"in a model of width {case.dims.width} with {case.dims.heads} heads"
    try:
        _expect_shapes(case, VARIED[:2])
    except ContractError as error:
        expect(False, f"{where}, {error.seen}")
    except Exception as error:
        expect(False, f"{where}, {raised(error, file_of(case.component))}")


def _expect_shapes(case: Case, varied: Iterable[Sizes]) -> None:
    module = case.lively()
    for sizes in varied:
        if sizes.image and case.slot == "encoder" and case.problems(sizes.image):
            continue  # the component refuses these images, and says so
        for mode in each_mode(module):
            with drawn_from(0), torch.no_grad():
                outputs = module(*inputs_of(case, sizes).values())
            _expect_expected(leaves(outputs), expected_shapes(case, module, sizes), mode, sizes)


def _expect_expected(
    outputs: dict[str, Tensor], expected: dict[str, Shape], mode: str, sizes: Sizes
) -> None:
    for name, shape in expected.items():
        expect(name in outputs, f"in {mode}, with {sizes}, it gives no `{name}`")
        seen = tuple(outputs[name].shape)
        told = f"in {mode}, with {sizes}, `{name}` is of shape {seen}, not {shape}"
        expect(fits(seen, shape), told)


@check(MODULES - {"queries", "losses"})
def check_scene_alone_or_in_batch(case: Case) -> None:
    """A scene comes out the same alone as among others."""
    module = case.lively()
    inputs = inputs_of(case)
    alone = mapped(inputs, lambda _, tensor: tensor[:1])
    both = mapped(module(*inputs.values()), lambda _, tensor: tensor[:1])
    found = distance(both, module(*alone.values()), 1e-4, 1e-5)
    expect(not found, f"alone, {found}")


def expected_shapes(case: Case, module: Any, sizes: Sizes) -> dict[str, Shape]:
    """Shape of every output that the contract fixes."""
    width, heads = case.dims.width, case.dims.heads
    batch, count, views = sizes.batch, sizes.queries, sizes.views
    features: dict[str, Shape] = {"features": (batch, count, width)}
    match case.slot:
        case "encoder":
            head = (batch, heads, None, width // heads)
            shapes = {"keys": head, "values": head, "features": (batch, None, width)}
            return {**shapes, "patch_rays": (batch, None, 6)}
        case "queries":
            sizes = replace(sizes, queries=module.count)
            return {"features": (batch, module.count, width), **_provided(case, sizes)}
        case "refinement":
            return {**features, **_provided(case, sizes)}
        case "head":
            each = (batch, count, module.gaussians_per_query)
            sized = {"offsets": 3, "scales": 3, "quats": 4, "colors": 3}
            return {"opacities": each, **{n: (*each, size) for n, size in sized.items()}}
        case "centers":
            return {"output": (batch, count, sizes.gaussians, 3)}
        case "renderer":
            each = (batch, views)
            sized = {"rgb": 3, "alpha": 1, "depth": 1}
            return {n: (*each, c, *(sizes.image or case.size)) for n, c in sized.items()}
        case "losses":
            return {}
    return {"output": (batch, count, width)}


def _provided(case: Case, sizes: Sizes) -> dict[str, Shape]:
    """Shapes of the fields that the component provides."""
    maker = Maker(case, sizes, torch.Generator())
    provided = case.component.provides(case.config)
    return {f"fields.{n}": tuple(maker.field(n, s).shape) for n, s in provided.items()}

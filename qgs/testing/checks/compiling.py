"""torch.compile gives what eager mode gives, and is not started again and again."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import PARAMETRIC, check
from qgs.testing.subjects import Inputs, Sizes, inputs_of, tracked_inputs
from qgs.testing.trees import distance, floating, scalar, slopes

WARM_UP = (Sizes(batch=2, queries=6), Sizes(batch=3, queries=8, views=3, gaussians=3))
LATER = (
    Sizes(batch=4, queries=9, views=4, gaussians=4),
    Sizes(batch=5, queries=11, views=5, gaussians=5),
    Sizes(batch=6, queries=10, views=6, gaussians=6),
    Sizes(batch=7, queries=13, views=7, gaussians=7),
)
"""Sizes none of which was seen before, nor any number in them."""
SLACK = 2
"""More graphs that the later sizes may take together, where one of them is special."""


@check(PARAMETRIC, tier="extended")
def check_compiles(case: Case) -> None:
    """Traced by torch.compile, a component is close to eager, and new sizes need no new graphs.

    So are its gradients.
    """
    module = case.lively()
    graphs, seen = [0], []
    with _fresh_compiler():
        compiled = torch.compile(module, backend=_counting(graphs))
        for sizes in (*WARM_UP, *LATER):
            ours, theirs = (tracked_inputs(case, inputs_of(case, sizes)) for _ in range(2))
            eager, outputs = module(*ours.values()), compiled(*theirs.values())
            found = distance(eager, outputs, 1e-3, 1e-4)
            expect(not found, f"compiled, with {sizes}, {found}")
            seen.append(graphs[0])
        _expect_close(_slopes(module, ours, eager), _slopes(module, theirs, outputs))
    more = seen[-1] - seen[len(WARM_UP) - 1]
    told = f"{more} more graphs are compiled for {len(LATER)} new sizes after {len(WARM_UP)}"
    expect(more <= SLACK, told)


def _slopes(module: Any, inputs: Inputs, outputs: Any) -> dict[str, Tensor]:
    """Gradients in the inputs and in the parameters, but for those of zeros."""
    given = floating(inputs) | {f"parameter {n}": p for n, p in module.named_parameters()}
    return {name: x for name, x in slopes(scalar(outputs), given).items() if bool(x.any())}


def _expect_close(eager: dict[str, Tensor], compiled: dict[str, Tensor]) -> None:
    odd = sorted(eager.keys() ^ compiled.keys())
    expect(not odd, f"compiled or not decides whether {', '.join(odd)} has a gradient")
    for name, slope in eager.items():
        off = (compiled[name] - slope).abs().max().item()
        close = off <= 1e-3 * slope.abs().max().item() + 1e-6
        expect(close, f"compiled, the gradient of `{name}` is off by up to {off:.3g}")


def _counting(graphs: list[int]) -> Any:
    """The backend aot_eager, which counts the graphs that it is given."""
    backend = torch._dynamo.lookup_backend("aot_eager")

    def compile_graph(graph: Any, examples: Any) -> Any:
        graphs[0] += 1
        return backend(graph, examples)

    return compile_graph


@contextmanager
def _fresh_compiler() -> Iterator[None]:
    """Nothing compiled before or after, and no remarks on how well it went."""
    logger = logging.getLogger("torch._dynamo")
    level = logger.level
    torch._dynamo.reset()
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logger.setLevel(level)
        torch._dynamo.reset()

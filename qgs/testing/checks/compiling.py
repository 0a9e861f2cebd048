"""torch.compile gives what eager mode gives, and is not started again and again."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import PARAMETRIC, check
from qgs.testing.subjects import Sizes, inputs_of
from qgs.testing.trees import distance

WARM_UP = (Sizes(batch=2, queries=6), Sizes(batch=3, queries=8))
LATER = (Sizes(batch=4, queries=9), Sizes(batch=2, queries=6), Sizes(batch=5, queries=11))
SLACK = 2
"""More graphs that the later sizes may take together, where one of them is special."""


@check(PARAMETRIC, tier="extended")
def check_compiles(case: Case) -> None:
    """Traced by torch.compile, a component is close to eager, and new sizes need no new graphs."""
    module = case.lively()
    graphs, seen = [0], []
    with _fresh_compiler(), torch.no_grad():
        compiled = torch.compile(module, backend=_counting(graphs))
        for sizes in (*WARM_UP, *LATER):
            inputs = inputs_of(case, sizes)
            found = distance(module(*inputs.values()), compiled(*inputs.values()), 1e-3, 1e-4)
            expect(not found, f"compiled, with {sizes}, {found}")
            seen.append(graphs[0])
    more = seen[-1] - seen[len(WARM_UP) - 1]
    expect(more <= SLACK, f"{more} more graphs are compiled after {len(WARM_UP)} sizes were seen")


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

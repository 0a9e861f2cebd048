"""Measuring recipes: memory first, in processes of their own, then seconds, all in turn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from qgs.composer import Recipe
from qgs.engine.bench.machine import describe
from qgs.engine.bench.memory import Peak, peak_memory
from qgs.engine.bench.report import Report, Result
from qgs.engine.bench.tasks import Operation, make_task
from qgs.engine.bench.timing import Spread, in_turn
from qgs.engine.bench.workload import Workload
from qgs.model import QueryGaussianModel


@dataclass(frozen=True)
class Measures:
    """What is measured besides size and forward latency, and how often.

    rounds: samples of each latency. warmup: calls before the first sample.
    """

    step: bool = False
    memory: bool = False
    renderer: bool = False
    rounds: int = 10
    warmup: int = 2

    def operations(self) -> list[Operation]:
        """What is timed; the step last, because it changes weights."""
        operations: list[Operation] = ["forward"]
        if self.renderer:
            operations.append("render")
        if self.step:
            operations.append("step")
        return operations


@dataclass(frozen=True)
class Subject:
    """What is measured: a recipe, by the name that the report gives it, with its workload."""

    name: str
    recipe: Recipe
    workload: Workload


def bench(
    subjects: Sequence[Subject],
    measures: Measures,
    *,
    overrides: Sequence[str] = (),
    say: Callable[[str], None] = lambda _: None,
) -> Report:
    """Measure all `subjects`, which share device and precision.

    All models are in memory while latencies are measured, so that each round has all of them. They
    have their initial weights. overrides: what the report says of them. `say` hears what is under
    way. Raises ValueError as the models, losses and renderers do, ChildProcessError as
    `peak_memory`.
    """
    peaks = [_peaks(subject, measures, say) for subject in subjects]
    models = [subject.recipe.build_model(subject.workload.device) for subject in subjects]
    sizes = [_size(subject, model) for subject, model in zip(subjects, models, strict=True)]
    times = _times(subjects, models, measures, say)
    results = [
        replace(size, times=spreads, peaks=peak)
        for size, spreads, peak in zip(sizes, times, peaks, strict=True)
    ]
    machine = describe(subjects[0].workload.device, torch.get_num_threads())
    return Report(results, machine, overrides, measures.rounds, measures.warmup)


def _peaks(
    subject: Subject, measures: Measures, say: Callable[[str], None]
) -> dict[Operation, Peak]:
    operations: list[Operation] = ["forward", "step"] if measures.step else ["forward"]
    found: dict[Operation, Peak] = {}
    for operation in operations if measures.memory else []:
        say(f"{subject.name}: memory of the {operation}")
        threads = torch.get_num_threads()
        found[operation] = peak_memory(subject.recipe, operation, subject.workload, threads)
    return found


def _times(
    subjects: Sequence[Subject],
    models: Sequence[QueryGaussianModel],
    measures: Measures,
    say: Callable[[str], None],
) -> list[Mapping[Operation, Spread]]:
    times: list[dict[Operation, Spread]] = [{} for _ in subjects]
    for operation in measures.operations():
        tasks = [
            make_task(operation, subject.recipe, model, subject.workload)
            for subject, model in zip(subjects, models, strict=True)
        ]

        def tell(round_: str, operation: Operation = operation) -> None:
            say(f"{operation}: {round_}")

        spreads = in_turn(tasks, measures.rounds, measures.warmup, tell)
        for column, spread in zip(times, spreads, strict=True):
            column[operation] = spread
    return [*times]


def _size(subject: Subject, model: QueryGaussianModel) -> Result:
    tensors = model.state_dict().values()
    return Result(
        recipe=subject.name,
        workload=subject.workload,
        queries=model.queries.count,
        gaussians=model.queries.count * model.head.gaussians_per_query,
        parameters=sum(parameter.numel() for parameter in model.parameters()),
        weight_bytes=sum(tensor.numel() * tensor.element_size() for tensor in tensors),
    )

"""Measuring recipes: memory first, in processes of their own, then seconds, all in turn."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.benchmark import timer

import qgs
from qgs.composer import Recipe
from qgs.engine.bench.memory import Peak, peak_memory
from qgs.engine.bench.work import Operation, Task, Workload, make_task
from qgs.io.files import write_text
from qgs.model import QueryGaussianModel


def describe(device: str, threads: int) -> dict[str, str | int]:
    """Names and versions without which a number says nothing."""
    return {
        "device": device,
        "processor": torch.cuda.get_device_name() if device == "cuda" else _processor(),
        "cores": os.cpu_count() or 0,
        "threads": threads,
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "qgs": qgs.__version__,
    }


def _processor() -> str:
    """The CPU's name, where the system tells it."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@dataclass(frozen=True)
class Spread:
    """Samples, their median and their lower and upper quartile (linear interpolation)."""

    samples: tuple[float, ...]

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """Lower quartile, median, upper quartile."""
        lower, median, upper = np.quantile(self.samples, (0.25, 0.5, 0.75)).tolist()
        return lower, median, upper

    @property
    def median(self) -> float:
        """The middle of the samples."""
        return self.quartiles[1]

    def over(self, base: Spread) -> Spread:
        """Ratios to the samples that `base` has of the same rounds."""
        pairs = zip(self.samples, base.samples, strict=True)
        return Spread(tuple(ours / theirs for ours, theirs in pairs))


def in_turn(
    tasks: Sequence[Task], rounds: int, warmup: int, say: Callable[[str], None] = lambda _: None
) -> list[Spread]:
    """Seconds of each task: `warmup` calls of each unmeasured, then all of them in every round.

    The clock is that of torch.utils.benchmark, which waits for a GPU. `say` hears of each round.
    """
    for number in range(warmup):
        say(f"warm-up {number + 1} of {warmup}")
        for task in tasks:
            task()
    columns: list[list[float]] = [[] for _ in tasks]
    for number in range(rounds):
        say(f"round {number + 1} of {rounds}")
        for task, column in zip(tasks, columns, strict=True):
            start = timer()
            task()
            column.append(timer() - start)
    return [Spread(tuple(column)) for column in columns]


KIND = "qgs bench"


@dataclass(frozen=True)
class Result:
    """One recipe. weight_bytes: of all parameters and saved buffers. times: seconds per call."""

    recipe: str
    workload: Workload
    queries: int
    gaussians: int
    parameters: int
    weight_bytes: int
    times: Mapping[Operation, Spread] = field(default_factory=dict)
    peaks: Mapping[Operation, Peak] = field(default_factory=dict)


@dataclass(frozen=True)
class Report:
    """All results, the first of which the others are compared with.

    machine: see `qgs.engine.bench.run.describe`.
    """

    results: Sequence[Result]
    machine: Mapping[str, str | int]
    overrides: Sequence[str]
    rounds: int
    warmup: int

    def write(self, path: str | Path) -> None:
        """Write the report as JSON, whole or not at all."""
        write_text(path, json.dumps(self.as_json(), indent=2) + "\n")

    def as_json(self) -> dict[str, Any]:
        """Everything, each sample included; seconds and bytes."""
        settings = {"overrides": [*self.overrides], "rounds": self.rounds, "warmup": self.warmup}
        recipes = [_result(result, self.results[0]) for result in self.results]
        return {"report": KIND, "machine": dict(self.machine), **settings, "recipes": recipes}


def _result(result: Result, base: Result) -> dict[str, Any]:
    return {
        "recipe": result.recipe,
        **asdict(result.workload),
        "queries": result.queries,
        "gaussians": result.gaussians,
        "parameters": {
            "count": result.parameters,
            "weight_bytes": result.weight_bytes,
            "ratio": result.parameters / base.parameters,
        },
        "seconds": {
            operation: {
                **_quartiles(spread),
                "samples": [*spread.samples],
                "ratio": _quartiles(spread.over(base.times[operation])),
            }
            for operation, spread in result.times.items()
        },
        "memory": {
            operation: {
                **asdict(peak),
                "ratio": peak.peak_bytes / base.peaks[operation].peak_bytes,
            }
            for operation, peak in result.peaks.items()
        },
    }


def _quartiles(spread: Spread) -> dict[str, float]:
    return dict(zip(("lower_quartile", "median", "upper_quartile"), spread.quartiles, strict=True))


def refuse_other_file(path: Path) -> None:
    """Raise FileExistsError when `path` holds anything but an earlier report."""
    if not path.exists():
        return
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict) or found.get("report") != KIND:
        raise FileExistsError(
            f"{path} exists and is no report of `{KIND}`; choose another name for the report"
        )


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

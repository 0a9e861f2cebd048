"""Measuring recipes: memory first, in processes of their own, then seconds, all in turn."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from operator import truediv
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

KIND = "qgs bench"


@dataclass(frozen=True)
class Spread:
    """Samples and their quartiles (linear interpolation)."""

    samples: tuple[float, ...]

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """Lower quartile, median, upper quartile."""
        return tuple(np.quantile(self.samples, (0.25, 0.5, 0.75)).tolist())

    def over(self, base: Spread) -> Spread:
        """Ratios to the samples that `base` has of the same rounds."""
        return Spread(tuple(map(truediv, self.samples, base.samples)))

    def as_json(self) -> dict[str, float]:
        """The quartiles by name."""
        return dict(
            zip(("lower_quartile", "median", "upper_quartile"), self.quartiles, strict=True)
        )


@dataclass(frozen=True)
class Subject:
    """What is measured: a recipe, by the name that the report gives it, with its workload."""

    name: str
    recipe: Recipe
    workload: Workload


@dataclass(frozen=True)
class Result:
    """One recipe. weight_bytes: of all parameters and saved buffers. times: seconds per call."""

    recipe: str
    workload: Workload
    queries: int
    gaussians: int
    parameters: int
    weight_bytes: int
    times: Mapping[Operation, Spread]
    peaks: Mapping[Operation, Peak]

    def as_json(self, base: Result) -> dict[str, Any]:
        """Everything, each sample included; seconds, bytes, and ratios to `base`."""
        return {
            "recipe": self.recipe,
            **asdict(self.workload),
            "queries": self.queries,
            "gaussians": self.gaussians,
            "parameters": {
                "count": self.parameters,
                "weight_bytes": self.weight_bytes,
                "ratio": self.parameters / base.parameters,
            },
            "seconds": {
                operation: {
                    **spread.as_json(),
                    "samples": [*spread.samples],
                    "ratio": spread.over(base.times[operation]).as_json(),
                }
                for operation, spread in self.times.items()
            },
            "memory": {
                o: {**asdict(peak), "ratio": peak.peak_bytes / base.peaks[o].peak_bytes}
                for o, peak in self.peaks.items()
            },
        }


@dataclass(frozen=True)
class Report:
    """All results, the first of which the others are compared with. machine: names, versions."""

    results: Sequence[Result]
    machine: Mapping[str, str | int]
    overrides: Sequence[str]
    rounds: int
    warmup: int

    def write(self, path: str | Path) -> None:
        """Write the report as JSON, whole or not at all."""
        report = {
            "report": KIND,
            "machine": dict(self.machine),
            "overrides": list(self.overrides),
            "rounds": self.rounds,
            "warmup": self.warmup,
            "recipes": [result.as_json(self.results[0]) for result in self.results],
        }
        write_text(path, json.dumps(report, indent=2) + "\n")


def refuse_other_file(path: Path) -> None:
    """Raise FileExistsError when `path` holds anything but an earlier report."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict) or found.get("report") != KIND:
        raise FileExistsError(
            f"{path} exists and is no report of `{KIND}`; choose another name for the report"
        )


def bench(
    subjects: Sequence[Subject],
    *,
    step: bool = False,
    memory: bool = False,
    renderer: bool = False,
    rounds: int = 10,
    warmup: int = 2,
    overrides: Sequence[str] = (),
    say: Callable[[str], None] = lambda _: None,
) -> Report:
    """Measure size and forward latency of all `subjects`, which share device and precision.

    All models, with initial weights, are in memory while latencies are measured, so that each round
    has all of them. step, memory, renderer: what is measured besides. rounds: samples of each
    latency. warmup: calls before the first sample. overrides: what the report says of them. `say`
    hears what is under way. Raises ValueError as the models, losses and renderers do,
    ChildProcessError as `peak_memory`.
    """
    threads = torch.get_num_threads()
    operations: list[Operation] = ["forward", "step"] if step else ["forward"]
    peaks: list[dict[Operation, Peak]] = [{} for _ in subjects]
    for s, found in zip(subjects, peaks, strict=True):
        for operation in operations if memory else ():
            say(f"{s.name}: memory of the {operation}")
            found[operation] = peak_memory(s.recipe, operation, s.workload, threads)
    if renderer:
        operations.insert(1, "render")  # the step is last, because it changes weights
    models = [subject.recipe.build_model(subject.workload.device) for subject in subjects]
    times: list[dict[Operation, Spread]] = [{} for _ in subjects]
    for operation in operations:
        pairs = zip(subjects, models, strict=True)
        tasks = [make_task(operation, s.recipe, model, s.workload) for s, model in pairs]
        spreads = in_turn(tasks, rounds, warmup, say, f"{operation}: ")
        for found, spread in zip(times, spreads, strict=True):
            found[operation] = spread
    results = [
        Result(
            recipe=subject.name,
            workload=subject.workload,
            queries=model.queries.count,
            gaussians=model.queries.count * model.head.gaussians_per_query,
            parameters=sum(p.numel() for p in model.parameters()),
            weight_bytes=sum(t.numel() * t.element_size() for t in model.state_dict().values()),
            times=seconds,
            peaks=peak,
        )
        for subject, model, seconds, peak in zip(subjects, models, times, peaks, strict=True)
    ]
    device = subjects[0].workload.device
    machine = {
        "device": device,
        "processor": torch.cuda.get_device_name() if device == "cuda" else _processor(),
        "cores": os.cpu_count() or 0,
        "threads": threads,
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "qgs": qgs.__version__,
    }
    return Report(results, machine, overrides, rounds, warmup)


def in_turn(
    tasks: Sequence[Task],
    rounds: int,
    warmup: int,
    say: Callable[[str], None] = lambda _: None,
    label: str = "",
) -> list[Spread]:
    """Seconds of each task: `warmup` calls of each unmeasured, then all of them in every round.

    torch.utils.benchmark's clock waits for a GPU. `say` hears of each round, after `label`.
    """
    for number in range(warmup):
        say(f"{label}warm-up {number + 1} of {warmup}")
        for task in tasks:
            task()
    columns: list[list[float]] = [[] for _ in tasks]
    for number in range(rounds):
        say(f"{label}round {number + 1} of {rounds}")
        for task, column in zip(tasks, columns, strict=True):
            start = timer()
            task()
            column.append(timer() - start)
    return [Spread(tuple(column)) for column in columns]


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return (names or [platform.processor() or platform.machine()])[0]

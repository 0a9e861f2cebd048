"""Measuring recipes: memory first, in processes of their own, then seconds, all in turn."""

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from operator import truediv
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.benchmark import timer

import qgs
from qgs.recipe import resolve
from qgs_research.bench.memory import Peak, peak_memory
from qgs_research.bench.work import Operation, Task, make_task, workload_of

KIND = "qgs bench"


def measure_recipes(
    names: Sequence[str],
    work: Mapping[str, Any],
    *,
    step: bool = False,
    memory: bool = False,
    renderer: bool = False,
    rounds: int = 10,
    warmup: int = 2,
    overrides: Sequence[str] = (),
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure size and forward latency of all recipes, with initial weights.

    All models are in memory while latencies are measured, so that each round has all of them.

    Args:
        names: recipes, as `resolve` takes them.
        work: fields of the workload, as `workload_of` takes them.
        step, memory, renderer: what is measured too.
        rounds: samples of each latency, after `warmup` calls.
        overrides: of all recipes.
        say: called with what is measured next.

    Returns:
        The report, plain values for JSON: seconds with every sample, bytes, and ratios to the first
        recipe, those of latencies round by round.

    Raises:
        ValueError: as the models, losses and renderers do.
        ChildProcessError: as `peak_memory` does.
    """
    recipes = [resolve(name, overrides) for name in names]
    works = [workload_of(recipe, **work) for recipe in recipes]
    operations: list[Operation] = ["forward", "step"] if step else ["forward"]
    peaks: list[dict[Operation, Peak]] = [{} for _ in names]
    for name, recipe, workload, found in zip(names, recipes, works, peaks, strict=True):
        for operation in operations if memory else ():
            say(f"{name}: memory of the {operation}")
            found[operation] = peak_memory(recipe, operation, workload, torch.get_num_threads())
    if renderer:
        operations.insert(1, "render")  # the step is last, because it changes weights
    models = [recipe.build_model(work["device"]) for recipe in recipes]
    times: list[dict[Operation, list[float]]] = [{} for _ in names]
    for operation in operations:
        tasks = [make_task(operation, *given) for given in zip(recipes, models, works, strict=True)]
        columns = in_turn(tasks, rounds, warmup, say, f"{operation}: ")
        for found, column in zip(times, columns, strict=True):
            found[operation] = column
    entries = []
    for name, workload, model, seconds, found in zip(
        names, works, models, times, peaks, strict=True
    ):
        entry: dict[str, Any] = {"recipe": name, **asdict(workload)}
        queries = model.queries.count
        entry |= {"queries": queries, "gaussians": None}
        if queries:  # otherwise the views decide
            entry["gaussians"] = queries * model.head.gaussians_per_query
        entry["parameters"] = {
            "count": sum(p.numel() for p in model.parameters()),
            "weight_bytes": sum(t.nbytes for t in model.state_dict().values()),
        }
        entry["seconds"] = {
            operation: {
                **quartiles(samples),
                "samples": samples,
                "ratio": quartiles(list(map(truediv, samples, times[0][operation]))),
            }
            for operation, samples in seconds.items()
        }
        entry["memory"] = {
            operation: {
                **asdict(peak),
                "ratio": peak.peak_bytes / peaks[0][operation].peak_bytes,
            }
            for operation, peak in found.items()
        }
        entries.append(entry)
    for entry in entries:
        parameters = entry["parameters"]
        parameters["ratio"] = parameters["count"] / entries[0]["parameters"]["count"]
    settings = {"overrides": list(overrides), "rounds": rounds, "warmup": warmup}
    return {"report": KIND, "machine": machine(work["device"]), **settings, "recipes": entries}


def machine(device: str) -> dict[str, Any]:
    """Processor, threads and versions, for the report."""
    return {
        "device": device,
        "processor": torch.cuda.get_device_name() if device == "cuda" else _processor(),
        "cores": os.cpu_count() or 0,
        "threads": torch.get_num_threads(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "qgs": qgs.__version__,
    }


def quartiles(samples: Sequence[float]) -> dict[str, float]:
    """Quartiles by name (linear interpolation)."""
    names = ("lower_quartile", "median", "upper_quartile")
    return dict(zip(names, np.quantile(samples, (0.25, 0.5, 0.75)).tolist(), strict=True))


def in_turn(
    tasks: Sequence[Task],
    rounds: int,
    warmup: int,
    say: Callable[[str], None] = lambda _: None,
    label: str = "",
) -> list[list[float]]:
    """Seconds of each task: `warmup` calls of each unmeasured, then all of them in every round.

    torch.utils.benchmark's clock waits for a GPU. say: called before each round.
    """
    columns: list[list[float]] = [[] for _ in tasks]
    for what, count in (("warm-up", warmup), ("round", rounds)):
        for number in range(count):
            say(f"{label}{what} {number + 1} of {count}")
            for task, column in zip(tasks, columns, strict=True):
                start = timer()
                task()
                column.append(timer() - start)
    return [column[warmup:] for column in columns]


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return (names or [platform.processor() or platform.machine()])[0]

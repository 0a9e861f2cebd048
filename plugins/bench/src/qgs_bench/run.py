"""Measuring recipes: memory first, in processes of their own, then seconds, all in turn."""

import json
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from operator import truediv
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.benchmark import timer

import qgs
from qgs.composer import Recipe
from qgs_bench.memory import Peak, peak_memory
from qgs_bench.work import Operation, Task, Workload, make_task

KIND = "qgs bench"


@dataclass(frozen=True)
class Subject:
    """A recipe to measure. name: in the report."""

    name: str
    recipe: Recipe
    workload: Workload


def refuse_other_file(path: Path, kind: str = KIND) -> None:
    """Raise FileExistsError when `path` holds anything but an earlier report of that kind."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict) or found.get("report") != kind:
        raise FileExistsError(
            f"{path} exists and is no report of `{kind}`; choose another name for the report"
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
) -> dict[str, Any]:
    """Measure size and forward latency of all `subjects`, which share device and precision.

    All models, with initial weights, are in memory while latencies are measured, so that each round
    has all of them. step, memory, renderer: what is measured besides. rounds: samples of each
    latency. warmup: calls before the first sample. overrides: what the report says of them. say:
    called with what is measured next. Returns the report, plain values for JSON: seconds with every
    sample, bytes, and ratios to the first subject, those of latencies round by round.
    Raises ValueError as the models, losses and renderers do, ChildProcessError as `peak_memory`.
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
    times: list[dict[Operation, list[float]]] = [{} for _ in subjects]
    for operation in operations:
        pairs = zip(subjects, models, strict=True)
        tasks = [make_task(operation, s.recipe, model, s.workload) for s, model in pairs]
        columns = in_turn(tasks, rounds, warmup, say, f"{operation}: ")
        for found, column in zip(times, columns, strict=True):
            found[operation] = column
    counts = [sum(p.numel() for p in model.parameters()) for model in models]
    weights = [sum(t.nbytes for t in model.state_dict().values()) for model in models]
    recipes = [
        {
            "recipe": subject.name,
            **asdict(subject.workload),
            "queries": (queries := model.queries.count),
            "gaussians": queries and queries * model.head.gaussians_per_query,
            "parameters": {"count": count, "weight_bytes": size, "ratio": count / counts[0]},
            "seconds": {
                operation: {
                    **quartiles(samples),
                    "samples": samples,
                    "ratio": quartiles(list(map(truediv, samples, times[0][operation]))),
                }
                for operation, samples in seconds.items()
            },
            "memory": {
                o: {**asdict(peak), "ratio": peak.peak_bytes / peaks[0][o].peak_bytes}
                for o, peak in found.items()
            },
        }
        for subject, model, count, size, seconds, found in zip(
            subjects, models, counts, weights, times, peaks, strict=True
        )
    ]
    settings = {"overrides": list(overrides), "rounds": rounds, "warmup": warmup}
    return {
        "report": KIND,
        "machine": machine(subjects[0].workload.device),
        **settings,
        "recipes": recipes,
    }


def machine(device: str) -> dict[str, Any]:
    """What was measured on, for the report."""
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

"""Measurement of recipes: memory in separate processes, then latency in alternating rounds."""

import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from operator import truediv
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.benchmark import timer
from torch.utils.flop_counter import FlopCounterMode

import qgs
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe, resolve
from qgs_research.bench.work import (
    Operation,
    Task,
    Workload,
    make_task,
    peak_memory,
    posed_photos,
    workload_of,
)


def measure_recipes(
    names: Sequence[str],
    work: Mapping[str, Any],
    *,
    step: bool,
    memory: bool,
    renderer: bool,
    rounds: int,
    warmup: int,
    overrides: Sequence[str],
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Measure size and forward latency of the models of all recipes, with initial weights.

    All models are in memory at once, because each round runs all of them.

    Args:
        names: names or files of recipes, see `resolve`.
        work: arguments of `workload_of` by name, apart from the recipe.
        step, memory, renderer: True also measures training steps, peak memory or rendering.
        rounds: number of measured calls of each operation, after `warmup` unmeasured calls.
        overrides: options to set in all recipes.
        say: function that is called with a description of each measurement before it starts.

    Returns the report as plain values for JSON: all measured seconds, bytes, and ratios to the
    first recipe in each round. Raises the errors of the models and of `peak_memory`.
    """
    recipes = [resolve(name, overrides) for name in names]
    works = [workload_of(recipe, **work) for recipe in recipes]
    entries: list[dict[str, Any]] = [
        {"recipe": name, **asdict(workload), "memory": {}, "seconds": {}}
        for name, workload in zip(names, works, strict=True)
    ]
    operations: list[Operation] = ["forward", "step"] if step else ["forward"]
    for operation in operations if memory else ():
        for entry, recipe, workload in zip(entries, recipes, works, strict=True):
            say(f"{entry['recipe']}: measuring memory of the {operation}")
            peak = asdict(peak_memory(recipe, operation, workload, torch.get_num_threads()))
            entry["memory"][operation] = peak
            first = entries[0]["memory"][operation]
            peak["ratio"] = peak["peak_bytes"] / first["peak_bytes"]
    if renderer:
        # The step comes last, because it changes the weights.
        operations.insert(1, "render")
    models = [recipe.build_model(work["device"]) for recipe in recipes]
    for entry, recipe, workload, model in zip(entries, recipes, works, models, strict=True):
        entry |= _sizes(model)
        entry["flops"] = forward_flops(recipe, workload)
        first = entries[0]["parameters"]
        entry["parameters"]["ratio"] = entry["parameters"]["count"] / first["count"]
    for operation in operations:
        tasks = [make_task(operation, *given) for given in zip(recipes, models, works, strict=True)]
        say(f"measuring seconds of the {operation}")
        columns = in_turn(tasks, rounds, warmup)
        for entry, samples in zip(entries, columns, strict=True):
            # Ratios within a round cancel the load of the machine.
            ratio = quartiles([*map(truediv, samples, columns[0])])
            entry["seconds"][operation] = {**quartiles(samples), "samples": samples, "ratio": ratio}
    settings = {"overrides": [*overrides], "rounds": rounds, "warmup": warmup}
    return {"machine": machine(work["device"]), **settings, "recipes": entries}


def _sizes(model: QueryGaussianModel) -> dict[str, Any]:
    """Return the numbers of queries, Gaussians, parameters and bytes of weights.

    The number of Gaussians is None if it depends on the number of input photos.
    """
    queries = model.queries.count
    return {
        "queries": queries,
        "gaussians": queries * model.head.gaussians_per_query if queries else None,
        "parameters": {
            "count": sum(parameter.numel() for parameter in model.parameters()),
            "weight_bytes": sum(tensor.nbytes for tensor in model.state_dict().values()),
        },
    }


def forward_flops(recipe: Recipe, workload: Workload) -> int:
    """Return the number of floating-point operations in a forward pass.

    Only matrix products and convolutions are counted, from their shapes. A multiply-add counts as
    two operations.
    """
    # On the meta device nothing is computed, and attention is matrix products, which are counted;
    # kernels of our own would not be. The counter hooks into modules, which needs gradients to be
    # off in the parameters themselves: torch.no_grad is not enough.
    model = recipe.build_model("meta").eval().requires_grad_(False)
    photos = posed_photos(workload.batch, workload.views, workload.size, seed=0).to("meta")
    with FlopCounterMode(display=False) as counter:
        model(photos)
    return counter.get_total_flops()


def machine(device: str) -> dict[str, Any]:
    """Return the report's entry on the machine: device, processor, threads, torch and qgs."""
    return {
        "device": device,
        "processor": torch.cuda.get_device_name() if device == "cuda" else _processor(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "qgs": qgs.__version__,
    }


def quartiles(samples: Sequence[float]) -> dict[str, float]:
    """Return the lower quartile, the median and the upper quartile of `samples`, by name."""
    names = ("lower_quartile", "median", "upper_quartile")
    return dict(zip(names, np.quantile(samples, (0.25, 0.5, 0.75)).tolist(), strict=True))


def in_turn(
    tasks: Sequence[Task],
    rounds: int,
    warmup: int,
) -> list[list[float]]:
    """Call all tasks in each round, and return the seconds of each task in each round.

    The first `warmup` rounds are not measured. On a GPU, the clock waits for the end of the work.
    """
    columns: list[list[float]] = [[] for _ in tasks]
    for _ in range(warmup + rounds):
        # Every round runs all tasks, so that a slow moment affects every recipe.
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

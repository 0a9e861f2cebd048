"""Measurement of recipes: memory in separate processes, then latency in alternating rounds.

A workload sets the size of the inputs of a measured call; a task executes an operation once.
"""

import platform
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from operator import truediv
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import nn
from torch.utils.benchmark import timer
from torch.utils.flop_counter import FlopCounterMode

import qgs
from qgs.geometry.poses import look_at
from qgs.model import QueryGaussianModel
from qgs.precision import Precision, autocast
from qgs.recipe import Recipe, resolve
from qgs.train.state import make_optimizer
from qgs.train.training_pass import TrainingPass
from qgs.types import Cameras, Gaussians, Size, Views


@dataclass(frozen=True)
class Workload:
    """Inputs of a measured call, and where and how it runs.

    views: number of input photos per scene. targets: number of rendered photos per scene. size: (H,
    W) of all photos in pixels. batch: scenes per call. precision: float32, or bf16 for autocast.
    """

    views: int
    targets: int
    size: Size
    batch: int = 1
    device: str = "cpu"
    precision: Precision = "float32"


def workload_of(
    recipe: Recipe, views: int | None = None, size: Size | None = None, **more: Any
) -> Workload:
    """Return the workload for `recipe`.

    views: number of input photos; None takes that of the recipe. size: (H, W) in pixels; None takes
    `data.image_size`. more: the remaining fields of `Workload`, by name. Raises ValueError if the
    image size is unknown.
    """
    if size is None and recipe.data_config:
        size = recipe.data_config.image_size
    if size is None:
        raise ValueError(
            "the recipe has no data.image_size, so the size of the photos is unknown; "
            "give it with --size HxW, for example --size 256x256"
        )
    return Workload(views or recipe.views.inputs, recipe.views.targets, size, **more)


def posed_photos(batch: int, count: int, size: Size, seed: int) -> Views:
    """Return `count` random photos (noise) for each of `batch` scenes, with cameras and times.

    Cameras are on an arc and look at its centre (0, 0, 1). The pose of the first camera is the
    identity. The field of view is about 53 degrees along the longer side of a photo.
    """
    # All recipes and processes get equal photos.
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(batch, count, 3, *size, generator=generator)
    # Cameras are ten degrees apart, like neighbouring photos of a walk.
    angle = torch.deg2rad(10.0 * torch.arange(count))
    forward = torch.stack([angle.sin(), torch.zeros(count), angle.cos()], -1)
    down = torch.tensor([0.0, 1.0, 0.0])
    centre = torch.tensor([0.0, 0.0, 1.0])
    c2w = look_at(centre - forward, forward, down).repeat(batch, 1, 1, 1)
    height, width = size
    focal = float(max(size))
    intrinsics = torch.tensor([focal, focal, width / 2, height / 2]).expand(batch, count, 4)
    times = torch.linspace(0, 1, count).expand(batch, count)
    return Views(images, Cameras(c2w, intrinsics, size), None, times, times[:, :1])


Task = Callable[[], object]
Operation = Literal["forward", "render", "step"]


def make_task(
    operation: Operation, recipe: Recipe, model: QueryGaussianModel, workload: Workload
) -> Task:
    """Return a function without arguments that executes `operation` once.

    forward: from photos to the Gaussians of the last layer, without gradients. render: rendering of
    these Gaussians at the target cameras, without gradients. step: a whole training step, which
    changes the weights.
    """
    inputs, targets = (
        posed_photos(workload.batch, count, workload.size, seed).to(workload.device)
        for seed, count in enumerate((workload.views, workload.targets))
    )
    if operation == "step":
        # A whole step as in `qgs train`, so that its time includes losses and renderer.
        objective = TrainingPass(recipe, model.train()).to(workload.device)
        factors = recipe.rate_factors(objective)
        optimizer = make_optimizer(objective, recipe.build_optimizer(), factors)

        def step() -> None:
            optimizer.zero_grad(set_to_none=True)
            with autocast(workload.precision, workload.device):
                outcome = objective(inputs, targets)
            outcome.total.backward()
            nn.utils.clip_grad_norm_(objective.parameters(), recipe.training.clip)
            optimizer.step()

        return step
    model.eval()

    @torch.inference_mode()
    def forward() -> Gaussians:
        with autocast(workload.precision, workload.device):
            return model(inputs).gaussians

    if operation == "forward":
        return forward
    # Made once, outside the measured time.
    gaussians = forward()
    return torch.inference_mode()(lambda: model.render(gaussians, targets.cameras))


@dataclass(frozen=True)
class Peak:
    """Peak memory of an operation, in bytes.

    peak_bytes: on a CPU, the largest resident set size of the process; on a GPU, the largest memory
    that torch allocated. idle_bytes: memory in use before the model was built.
    """

    peak_bytes: int
    idle_bytes: int


def peak_memory(recipe: Recipe, operation: Operation, workload: Workload, threads: int) -> Peak:
    """Run `operation` once in a fresh process and return its peak memory.

    Raises ChildProcessError if the process was killed, and the errors of the model.
    """
    # Spawned, because a forked process would start with the memory of this one.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(measure, dict(recipe.tree), operation, workload, threads).result()
        except BrokenProcessPool:
            raise ChildProcessError(
                f"the process that measured the memory of the {operation} was killed, probably "
                "because memory ran out; choose fewer or smaller views, or a smaller batch or model"
            ) from None


def measure(tree: dict[str, Any], operation: Operation, workload: Workload, threads: int) -> Peak:
    """Run `operation` in this process and return its peak memory.

    tree: recipe as a mapping. threads: number of CPU threads.
    """
    torch.set_num_threads(threads)
    recipe = resolve(tree)
    on_gpu = workload.device == "cuda"
    idle = 0 if on_gpu else resident_bytes("VmRSS")
    task = make_task(operation, recipe, recipe.build_model(workload.device), workload)
    if operation == "step":
        # The first step creates the optimiser's moments and compiles kernels: measure the second.
        task()
        restart = Path("/proc/self/clear_refs")
        if on_gpu:
            torch.cuda.reset_peak_memory_stats()
        elif restart.exists():  # on Linux
            # Linux then forgets the peak, VmHWM, but keeps the memory.
            restart.write_text("5")
    task()
    peak = torch.cuda.max_memory_allocated() if on_gpu else resident_bytes("VmHWM")
    return Peak(peak_bytes=peak, idle_bytes=idle)


def resident_bytes(field: str) -> int:
    """Return the resident memory of this process in bytes.

    field: VmRSS for the present memory, VmHWM for the peak. Systems without /proc always give the
    peak.
    """
    status = Path("/proc/self/status")
    if status.exists():
        (kibibytes,) = re.findall(rf"^{field}:\s*(\d+)", status.read_text(), re.MULTILINE)
        return int(kibibytes) * 1024
    # Imported here: Windows has none, and on Linux it would count the parent of the process.
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


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
    for entry, recipe, workload in zip(entries, recipes, works, strict=True):
        for operation in operations if memory else ():
            say(f"{entry['recipe']}: measuring memory of the {operation}")
            peak = asdict(peak_memory(recipe, operation, workload, torch.get_num_threads()))
            entry["memory"][operation] = peak
            first = entries[0]["memory"][operation]
            peak["ratio"] = peak["peak_bytes"] / first["peak_bytes"]
        entry |= _sizes(recipe.build_model("meta"))
        entry["flops"] = forward_flops(recipe, workload)
        first = entries[0]["parameters"]
        entry["parameters"]["ratio"] = entry["parameters"]["count"] / first["count"]
    if renderer:
        # The step comes last, because it changes the weights.
        operations.insert(1, "render")
    models = [recipe.build_model(work["device"]) for recipe in recipes]
    for operation in operations:
        tasks = [*map(partial(make_task, operation), recipes, models, works)]
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


def in_turn(tasks: Sequence[Task], rounds: int, warmup: int) -> list[list[float]]:
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
    text = information.read_text() if information.exists() else ""
    found = re.search(r"^model name\s*:\s*(.*\S)", text, re.MULTILINE)
    return found[1] if found else platform.processor() or platform.machine()

"""Inputs of a size, and operations that are ready to be called again and again."""

import math
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, TypeAlias

import torch
from torch import nn

from qgs.model import QueryGaussianModel
from qgs.precision import Precision, autocast
from qgs.recipe import Recipe, resolve
from qgs.train.state import make_optimizer
from qgs.train.training_pass import TrainingPass
from qgs.types import Cameras, Gaussians, Views


@dataclass(frozen=True)
class Workload:
    """views, targets: photos read and photos rendered per scene. size: (H, W) of both, in pixels.

    batch: scenes at once. precision: float32, or bf16 for autocast.
    """

    views: int
    targets: int
    size: tuple[int, int]
    batch: int = 1
    device: str = "cpu"
    precision: Precision = "float32"


def workload_of(
    recipe: Recipe, views: int | None = None, size: tuple[int, int] | None = None, **more: Any
) -> Workload:
    """The workload of `recipe`: its `views` and `data.image_size`, unless given here.

    more: further fields. Raises ValueError when nothing says how large the images are.
    """
    if size is None and recipe.data_config:
        size = recipe.data_config.image_size
    if size is None:
        raise ValueError(
            "the recipe has no data.image_size, so the size of the photos is not known; "
            "give one with --size HxW, such as --size 256x256"
        )
    return Workload(views or recipe.views.inputs, recipe.views.targets, size, **more)


def posed_photos(batch: int, count: int, size: tuple[int, int], seed: int) -> Views:
    """Random pixels from cameras on an arc around (0, 0, 1), all looking at that point, in time.

    The first is the identity; the field of view is some 53 degrees across the longer side.
    """
    # Equal photos in all recipes and processes.
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(batch, count, 3, *size, generator=generator)
    c2w = torch.eye(4).repeat(batch, count, 1, 1)
    for index in range(count):
        # Ten degrees apart, as neighbouring photos of a walk are.
        angle = math.radians(10 * index)
        sine = math.sin(angle)
        cosine = math.cos(angle)
        turn = [[cosine, 0, sine, -sine], [0, 1, 0, 0], [-sine, 0, cosine, 1 - cosine]]
        c2w[:, index, :3] = torch.tensor(turn)
    height, width = size
    focal = float(max(size))
    intrinsics = torch.tensor([focal, focal, width / 2, height / 2]).expand(batch, count, 4)
    times = torch.linspace(0, 1, count).expand(batch, count)
    return Views(images, Cameras(c2w, intrinsics, size), None, times, times[:, :1])


Task: TypeAlias = Callable[[], object]
Operation: TypeAlias = Literal["forward", "render", "step"]


def make_task(
    operation: Operation, recipe: Recipe, model: QueryGaussianModel, workload: Workload
) -> Task:
    """`operation` as a call without arguments that leaves nothing behind but changed weights.

    forward: photos to the last layer's Gaussians, no gradients. render: those Gaussians at the
    targets' cameras, no gradients. step: a whole training step.
    """
    inputs, targets = (
        posed_photos(workload.batch, count, workload.size, seed).to(workload.device)
        for seed, count in enumerate((workload.views, workload.targets))
    )
    if operation == "step":
        # A whole step as `qgs train` makes it, so that losses and renderer are in its time.
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
    # Made once, outside of what is timed.
    gaussians = forward()
    return torch.inference_mode()(lambda: model.render(gaussians, targets.cameras))


@dataclass(frozen=True)
class Peak:
    """peak_bytes: on the CPU the largest resident set of the whole process; on a GPU the most that
    torch had allocated. idle_bytes: before the model was built."""

    peak_bytes: int
    idle_bytes: int


def peak_memory(recipe: Recipe, operation: Operation, workload: Workload, threads: int) -> Peak:
    """Build the model in a fresh process, run `operation` there, and return the peak.

    Raises ChildProcessError when the process was killed, and what the model raises in it.
    """
    # Spawned: a forked process would begin with the memory of this one.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(measure, dict(recipe.tree), operation, workload, threads).result()
        except BrokenProcessPool:
            raise ChildProcessError(
                f"the process that measured the memory of the {operation} was killed, most likely "
                "because the machine has too little: choose fewer or smaller views, or a smaller "
                "batch or model"
            ) from None


def measure(tree: dict[str, Any], operation: Operation, workload: Workload, threads: int) -> Peak:
    """Return the peak of this process; see `peak_memory`."""
    torch.set_num_threads(threads)
    recipe = resolve(tree)
    on_gpu = workload.device == "cuda"
    idle = 0 if on_gpu else resident_bytes("VmRSS")
    task = make_task(operation, recipe, recipe.build_model(workload.device), workload)
    if operation == "step":
        # The first step makes the optimiser's moments and compiles kernels: count from the second.
        task()
        restart = Path("/proc/self/clear_refs")
        if on_gpu:
            torch.cuda.reset_peak_memory_stats()
        elif restart.exists():  # on Linux
            restart.write_text("5")
    task()
    peak = torch.cuda.max_memory_allocated() if on_gpu else resident_bytes("VmHWM")
    return Peak(peak_bytes=peak, idle_bytes=idle)


def resident_bytes(field: str) -> int:
    """Bytes resident now (VmRSS) or at most so far (VmHWM); the latter for both outside Linux."""
    status = Path("/proc/self/status")
    if status.exists():
        lines = status.read_text().splitlines()
        (kibibytes,) = (line.split()[1] for line in lines if line.startswith(f"{field}:"))
        return int(kibibytes) * 1024
    # Imported here: Windows has none, and on Linux it would count the parent of the process.
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024

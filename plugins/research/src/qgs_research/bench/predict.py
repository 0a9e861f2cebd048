"""Memory and time of recipes before they run: counted work times the rates of this machine."""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import torch
import torch.nn.functional as F
from rich.console import Console
from torch.utils.benchmark import timer

from qgs.contracts import RendererConfig
from qgs.evaluate.results import print_table
from qgs.recipe import resolve
from qgs.renderers import CpuRenderer
from qgs.types import Gaussians
from qgs.wording import short_names
from qgs_research.bench.counting import Count, Work, count
from qgs_research.bench.memory import resident_bytes
from qgs_research.bench.work import Operation, Workload, make_task, posed_photos, workload_of

RESERVE = 0.1  # of the counted memory: kernels' own buffers, and what allocators scatter
LARGEST = 2**25  # multiplications and additions of a measured operator: some ms
OPERATIONS: tuple[Operation, ...] = ("forward", "step")
SPLATS = 2048
SMALL: dict[str, Any] = {
    "recipe": 1,
    "model": {
        "width": 16,
        "heads": 2,
        "encoder": {"type": "qgs/multiview_vit", "patch_size": 8, "depth": 1},
        "queries": {"type": "qgs/latent", "count": 8, "std": 1.0},
        "decoder": {"depth": 2},
        "head": {"type": "qgs/gaussian_head", "gaussians_per_query": 4},
        "supervision": {"type": "qgs/layers", "layers": [1, 2]},
    },
    "losses": {"photometric": {"type": "qgs/photometric"}},
}
"""A model whose time is that of Python and of launching operators."""


def predict_recipes(
    names: Sequence[str],
    work: Mapping[str, Any],
    overrides: Sequence[str] = (),
    say: Callable[[str], None] = lambda _: None,
) -> list[dict[str, Any]]:
    """Parameters, peak bytes and seconds of a forward pass and of a training step on the CPU.

    Arguments as in `measure_recipes`. ValueError for a recipe that cannot run on shapes alone.
    """
    recipes = [resolve(name, overrides) for name in names]
    for recipe in recipes:  # before calibration: a process holds what their plugins load
        recipe.build_model("meta")
    say("calibrating")
    process, overhead = _calibrate()
    entries: list[dict[str, Any]] = []
    for name, recipe in zip(names, recipes, strict=True):
        workload = workload_of(recipe, **work)
        entry: dict[str, Any] = {"recipe": name}
        for operation in OPERATIONS:
            say(f"{name}: counting the {operation}")
            found = count(recipe, operation, workload)
            say(f"{name}: timing operators of the {operation}")
            loaded = "render" if operation == "forward" and found.compiled else operation
            entry["parameters"] = found.parameters
            entry[operation] = {
                "peak_bytes": round(process[loaded] + (1 + RESERVE) * found.peak),
                "seconds": _computing(found, workload) + overhead[operation] * found.computed,
            }
        entries.append(entry)
    return entries


def show_predictions(entries: Sequence[dict[str, Any]], console: Console, within: float) -> None:
    """A table; with `within` gigabytes (10^9 bytes; 0: no limit) whether a step fits."""
    rows = [["recipe", "parameters", "forward, GB", "ms", "training step, GB", "ms"]]
    for entry, name in zip(entries, short_names([e["recipe"] for e in entries]), strict=True):
        rows.append([name, f"{entry['parameters']:,}"])
        for operation in OPERATIONS:
            found = entry[operation]
            rows[-1] += [f"{found['peak_bytes'] / 1e9:,.2f}", f"{1000 * found['seconds']:,.0f}"]
        if within:
            fits = entry["step"]["peak_bytes"] <= within * 1e9
            rows[-1].append("fits" if fits else "does not fit")
    print_table(
        console, "predicted for this CPU", [rows[0] + [f"{within:g} GB"] * bool(within), *rows[1:]]
    )


def _calibrate() -> tuple[dict[str, int], dict[str, float]]:
    """Bytes of a process, and seconds an operator takes beside its computation, by operation.

    Both of a small model. Bytes are read when the libraries and compiled kernels of the operation
    are loaded, as in a process of its own, and before counting loads more.
    """
    recipe, workload = resolve(SMALL), Workload(1, 1, (16, 16))
    model, process, overhead = recipe.build_model(), {}, {}
    for name in ("forward", "render", "step"):
        overhead[name] = _median(make_task(name, recipe, model, workload), 10, most=0.2)
        process[name] = resident_bytes("VmRSS")
    for name in OPERATIONS:
        found = count(recipe, name, workload)
        rest = overhead[name] - _computing(found, workload)
        overhead[name] = max(rest, 0) / found.computed
    return process, overhead


def _computing(found: Count, workload: Workload) -> float:
    rendering = found.splats * _render(workload.size) if found.splats else 0.0
    return rendering + sum(n * _seconds(work) for work, n in found.work.items() if work.shape)


def _median(task: Callable[[], object], rounds: int = 5, most: float = 0.02) -> float:
    """Seconds of a call, as `qgs bench` reports them; no further round after `most` seconds.

    Where other processes use the cores, a call can take ten times as long.
    """
    task()
    found: list[float] = []
    while len(found) < rounds and sum(found) < most:
        start = timer()
        task()
        found.append(timer() - start)
    return statistics.median(found)


def _seconds(work: Work) -> float:
    """Seconds of an operator: of a large one those of a smaller one, in proportion."""
    if work.kind == "pointwise":
        power = 4 ** round(math.log(max(work.shape[0], 1), 4))
        return work.shape[0] * _per_byte(min(max(power, 2**12), 2**24), work.dtype.itemsize)
    sides = list(work.shape[1:])
    while math.prod(sides) > LARGEST:  # still a product of three long sides
        sides[sides.index(max(sides))] //= 2
    # small products take their batch along: a call takes longer than one of them
    batch = max(min(work.shape[0], LARGEST // max(math.prod(sides), 1)), 1)
    part = work._replace(shape=(batch, *sides))
    return _measured(part) * math.prod(work.shape) / max(math.prod(part.shape), 1)


@cache
def _measured(work: Work) -> float:
    (batch, rows, second, third), dtype = work.shape, work.dtype
    if work.kind == "matmul":
        left, right = (
            torch.rand(batch, n, m, dtype=dtype).mT
            if turned
            else torch.rand(batch, m, n, dtype=dtype)
            for (m, n), turned in zip(((rows, second), (second, third)), work.flags, strict=True)
        )
        return _median(lambda: left @ right)
    (backward,) = work.flags
    q = torch.rand(1, batch, rows, third, dtype=dtype, requires_grad=backward)
    k = torch.rand(1, batch, second, third, dtype=dtype, requires_grad=backward)
    with torch.inference_mode(not backward):
        if not backward:
            return _median(lambda: F.scaled_dot_product_attention(q, k, k))
        out = F.scaled_dot_product_attention(q, k, k).sum()
        return _median(lambda: out.backward(retain_graph=True))


@cache
def _per_byte(size: int, item: int) -> float:
    """Seconds per byte read or written, the mean of some operators: exponentials are frequent."""
    x = torch.rand(size // 2 // item // 64, 64, dtype=torch.bfloat16 if item == 2 else None)
    tasks = (lambda: x + 1, lambda: F.gelu(x), lambda: F.layer_norm(x, (64,)), x.clone)
    return sum(map(_median, tasks)) / len(tasks) / (2 * x.nbytes)


@cache
def _render(size: tuple[int, int]) -> float:
    """Seconds of the renderer, forward and backward, for a Gaussian of average size in a view."""
    cameras = posed_photos(1, 1, size, seed=0).cameras
    place = torch.rand(1, SPLATS, 3) - 0.5 + torch.tensor([0, 0, 1.0])
    means = place.requires_grad_()
    scales, opacities = torch.full_like(place, 0.03), torch.full((1, SPLATS), 0.3)
    quats = F.normalize(torch.rand(1, SPLATS, 4), dim=-1)
    gaussians = Gaussians(means, scales, quats, opacities, torch.rand_like(place))

    renderer = CpuRenderer(RendererConfig())

    def task() -> None:
        renderer(gaussians, cameras).rgb.sum().backward()

    return _median(task) / SPLATS

"""Whether a training fits into a memory, counted before it begins: `qgs bench --predict`."""

import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from qgs.composer import Recipe
from qgs.data.sampling import image_bytes
from qgs.memory import available_bytes
from qgs_bench.counting import count
from qgs_bench.work import Workload

KIND = "qgs bench --predict"

PROCESS = {"cpu": 470 * 2**20, "cuda": 512 * 2**20}
"""What a process takes before it has a tensor. On a CPU Python, torch, numba and compiled kernels,
measured; on a GPU the context of CUDA, a round number that nobody measured here."""

RESERVE = 0.1
"""Of the counted tensors, on top of them: what kernels take inside an operator, and what allocators
round up and scatter. glibc may keep more, see docs/performance.md."""

_UNITS = {"": 1, "k": 1000, "M": 1000**2, "G": 1000**3, "T": 1000**4}


@dataclass(frozen=True)
class Need:
    """Bytes that a training takes at its peak. tensors: of a step alone. step: of a process that
    does it, by what for. besides: what `qgs train` holds besides on the same device. kept: of the
    step, what each part of the model keeps for the backward pass.
    """

    tensors: int
    step: Mapping[str, int]
    besides: Mapping[str, int]
    kept: Mapping[str, int]

    @property
    def total(self) -> int:
        """All of a training."""
        return sum(self.step.values()) + sum(self.besides.values())


def need_of(recipe: Recipe, workload: Workload) -> Need:
    """What training `recipe` takes. Raises ValueError as `count` does.

    device "cuda": of the GPU alone; no GPU is asked for.
    """
    on_gpu = workload.device == "cuda"
    found = count(recipe, "step", replace(workload, device="cpu"))
    held = {
        "weights": found.weights,
        "moments of the optimiser, buffers": found.moments,
        "photos and poses": found.inputs,
    }
    held["activations, gradients and buffers at the peak"] = found.peak - sum(held.values())
    held["reserve for kernels and allocator"] = round(RESERVE * found.peak)
    held["context of CUDA" if on_gpu else "Python, torch, compiled kernels"] = PROCESS[
        workload.device
    ]
    besides = {}
    config = recipe.training
    if config.ema:
        besides["moving average of the weights"] = found.weights
    if config.accumulate > 1:  # gradients stay while the next activations are made
        besides["gradients between the batches of a step"] = found.gradients
    if not on_gpu:
        besides["two copies of good weights"] = 2 * found.weights
        images = workload.batch * (workload.views + workload.targets)
        besides["batches on their way"] = config.accumulate * image_bytes(images, workload.size)
    return Need(found.peak, held, besides, found.kept)


def predict(recipe: Recipe, workload: Workload, limit: int) -> dict[str, Any]:
    """What training `recipe` takes and whether that fits into `limit` bytes, for the report."""
    need = need_of(recipe, workload)
    most = largest_batch(lambda n: need_of(recipe, replace(workload, batch=n)).total, limit)
    return {
        **asdict(workload),
        "tensor_bytes": need.tensors,
        "step": dict(need.step),
        "besides": dict(need.besides),
        "kept": dict(need.kept),
        "total_bytes": need.total,
        "fits": need.total <= limit,
        "largest_batch": most,
    }


def available(device: str) -> int:
    """Bytes that are free now; ValueError for a GPU that is not there."""
    if device != "cuda":
        return available_bytes()
    if not torch.cuda.is_available():
        raise ValueError("there is no GPU whose memory could be asked for: say it with --within")
    return torch.cuda.mem_get_info()[0]


def largest_batch(need: Callable[[int], int], limit: int, most: int = 2**16) -> int:
    """The largest batch whose `need`, in bytes, is at most `limit`; 0 where that of 1 is more.

    need: of a batch size, the largest of some straight lines, so that a secant never stops short.
    """
    found: dict[int, int] = {}

    def at(batch: int) -> int:
        if batch not in found:
            found[batch] = need(batch)
        return found[batch]

    if at(1) > limit:
        return 0
    low, high = 1, most + 1  # low fits; high does not, or is beyond all that is tried
    guess = 2
    while high - low > 1:
        low, high = (guess, high) if at(guess) <= limit else (low, guess)
        slope = (at(guess) - at(1)) // (guess - 1)
        guess = low + (limit - at(low)) // slope if slope > 0 else high
        guess = min(max(guess, low + 1), high - 1)
    return low


def parse_bytes(text: str) -> int:
    """Bytes of "24GB", "512 MB" (powers of 1000) or "24GiB" (of 1024); ValueError for others."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kMGT]?)(i?)B\s*", text)
    if match is None or (match[3] and not match[2]):
        raise ValueError(f"--within must be a size such as 24GB or 80GiB, got {text!r}")
    unit = _UNITS[match[2]]
    if match[3]:
        unit = 1024 ** [*_UNITS].index(match[2])
    return int(float(match[1]) * unit)

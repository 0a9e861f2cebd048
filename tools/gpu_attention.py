"""Attention with the biases of LocusGS and of ellipsoids by every kernel there is, on a GPU.

    python tools/gpu_attention.py [--json FILE] [--device cuda] [--size 4096x7168] [--heads 16]

For each kernel and precision: the largest relative error of the output and of each gradient against
float64 autograd of the formula, from the same rounded inputs, at the sizes and bounds of `CASES`.
Then time and peak memory of forward and backward with LocusGS's bias at full size, in float32,
beside attention without a bias. `--device cpu` leaves out Triton, which needs a GPU.
Exit code 1 where a kernel failed or an error is above its tolerance.
"""

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from qgs_bench.run import in_turn, quartiles
from qgs_ellipsoid.fields import anchor_rotation
from qgs_ellipsoid.ray_bias import EllipsoidBias
from qgs_ellipsoid.ray_bias import ray_tokens as ellipsoid_tokens
from qgs_locus.ray_bias import RayBias
from qgs_locus.ray_bias import ray_tokens as locus_tokens
from torch import Tensor

from qgs.components import AttentionBias
from qgs.components.attention_bias import biased_attention
from qgs.components.attention_choice import AttentionKernel

KERNELS: dict[str, tuple[AttentionKernel, ...]] = {
    "cuda": ("plain", "blocks", "triton"),
    "cpu": ("plain", "blocks"),
}
TOLERANCES = {torch.float32: 1e-5, torch.bfloat16: 4 * 2**-7, torch.float16: 4 * 2**-10}
"""A number in half precision is off by at most half of 2^-7 or 2^-10 of itself. The output is
rounded once. The kernels also round the weights, and backward their derivative and the output. The
plain path rounds the bias, so that weights at a bias of -4 to -5 are off by 4 to 5 halves. Errors
of single weights average out over tokens, so that 8 halves are more than either reaches."""


@dataclass(frozen=True)
class Case:
    """lowest: bound of the bias. width: of q, k, v, (scenes, h, ., width)."""

    kind: type[AttentionBias]
    lowest: float = -5.0
    scenes: int = 1
    queries: int = 257
    tokens: int = 1031
    width: int = 64


ODD: dict[str, dict[str, Any]] = {
    "some pairs at the bound": {},
    "none at the bound": {"lowest": -1e9},
    "all at the bound": {"lowest": -1e-9},
    "one query": {"queries": 1, "scenes": 50},
    "one token": {"tokens": 1, "scenes": 2},
    "heads 96 wide": {"width": 96},
}
CASES = {
    f"{kind.__name__}, {name}": Case(kind, **odd)
    for kind in (RayBias, EllipsoidBias)
    for name, odd in ODD.items()
}
Leaves = dict[str, Tensor]


def drawn(case: Case, heads: int, device: str, dtype: torch.dtype) -> Leaves:
    """q, k, v and the output's gradient in `dtype`; what the bias reads in float32."""
    draw = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(case.scenes, *shape, generator=draw)

    counts = {"q": case.queries, "k": case.tokens, "v": case.tokens, "gradient": case.queries}
    found = {name: normal(heads, n, case.width).to(dtype) for name, n in counts.items()}
    directions = F.normalize(normal(case.tokens, 3), dim=-1)
    rays = torch.cat([torch.linalg.cross(normal(case.tokens, 3), directions), directions], -1)
    center, sigma_sq = normal(case.queries, 3), (0.3 + normal(case.queries, 3).abs()).square()
    last = case.lowest, torch.tensor(0.9)
    if case.kind is RayBias:
        bias = RayBias.of(center, sigma_sq[..., :1], locus_tokens(rays), *last)
    else:
        shape = anchor_rotation(normal(case.queries, 4)), sigma_sq
        bias = EllipsoidBias.of(center, *shape, ellipsoid_tokens(rays), *last)
    found |= {"queries": bias.queries, "tokens": bias.tokens}
    return {name: x.to(device) for name, x in found.items()}


def attend(kernel: AttentionKernel, case: Case, x: Leaves) -> Tensor:
    """Attention by a kernel."""
    bias = case.kind(x["queries"], x["tokens"])
    return biased_attention(x["q"], x["k"], x["v"], bias, kernel)


def formula(case: Case, x: Leaves) -> Tensor:
    """The same for all pairs at once."""
    value, scenes = (
        case.kind(x["queries"], x["tokens"]).value,
        zip(x["queries"], x["tokens"], strict=True),
    )
    bias = torch.stack([value(*read) for read in scenes])[:, None]
    return ((x["q"] @ x["k"].mT) / case.width**0.5 + bias).softmax(-1) @ x["v"]


def derived(attention: Callable[[Case, Leaves], Tensor], case: Case, given: Leaves) -> Leaves:
    """The output and the gradients of q, k, v and of each number that the bias reads of queries."""
    learnt = ("q", "k", "v", "queries")
    x = {name: leaf.clone().requires_grad_(name in learnt) for name, leaf in given.items()}
    out = attention(case, x)
    gradients = torch.autograd.grad(out, [x[name] for name in learnt], x["gradient"])
    found = {"out": out, **dict(zip(learnt, gradients, strict=True))}
    numbers = found.pop("queries").unbind(-1)
    found |= {f"number {n} of the bias": gradient for n, gradient in enumerate(numbers)}
    return {name: leaf.detach().double() for name, leaf in found.items()}


@cache
def truth(case: Case, heads: int, device: str, dtype: torch.dtype) -> Leaves:
    """In float64, of the inputs as they are in `dtype`."""
    given = drawn(case, heads, device, dtype)
    return derived(formula, case, {name: x.double() for name, x in given.items()})


def worst(
    kernel: AttentionKernel, dtype: torch.dtype, device: str, heads: int
) -> tuple[float, str]:
    """The largest |difference| as a share of the largest true value, of what, and in which case.

    Where the truth is 0 but for rounding, as gradients through one token: of that with two tokens.
    """
    errors = []
    for name, case in CASES.items():
        ours = derived(partial(attend, kernel), case, drawn(case, heads, device, dtype))
        for what, true in truth(case, heads, device, dtype).items():
            size = true.abs().max()
            if size < 1e-10:
                size = truth(Case(case.kind, tokens=2), heads, device, dtype)[what].abs().max()
            error = float((true - ours[what]).abs().max() / size)
            errors.append((math.inf if math.isnan(error) else error, f"{what}; {name}"))
    return max(errors)


def peak_mebibytes(task: Callable[[], object]) -> float:
    """What a call allocates at most on the GPU."""
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    task()
    torch.cuda.synchronize()
    return (torch.cuda.max_memory_allocated() - before) / 2**20


def main() -> None:
    """Print a row for each kernel."""
    parser = argparse.ArgumentParser(description="Kernels of attention, checked and timed.")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--device", choices=[*KERNELS], default="cuda")
    parser.add_argument("--size", default="4096x7168", help="queries x tokens")
    parser.add_argument("--heads", type=int, default=16)
    options = parser.parse_args()
    queries, tokens = map(int, options.size.split("x"))
    device, heads = options.device, options.heads
    large = Case(RayBias, queries=queries, tokens=tokens)
    x = drawn(large, heads, device, torch.float32)
    for name in ("q", "k", "v", "queries"):
        x[name].requires_grad_()
    tasks: dict[str, Callable[[], object]] = {
        "no bias": lambda: F.scaled_dot_product_attention(x["q"], x["k"], x["v"]).sum().backward()
    }
    for kernel in KERNELS[device]:
        tasks[kernel] = lambda kernel=kernel: attend(kernel, large, x).sum().backward()
    rows: dict[str, dict[str, Any]] = {name: {"kernel": name} for name in tasks}
    failed = False
    for kernel in KERNELS[device]:
        for dtype, tolerance in TOLERANCES.items():
            column = f"error, {str(dtype).removeprefix('torch.')}"
            try:
                error, where = worst(kernel, dtype, device, heads)
                rows[kernel][column] = f"{error:.1e} ({where})"
                failed |= error > tolerance
            except Exception as error:
                rows[kernel][column], failed = reason(error), True
    for name, task in [*tasks.items()]:
        try:
            task()
            if device == "cuda":
                rows[name]["MiB"] = round(peak_mebibytes(task), 1)
        except Exception as error:
            rows[name]["failed"], failed = reason(error), True
            del tasks[name]
    for name, samples in zip(tasks, in_turn([*tasks.values()], 10, 1), strict=True):
        rows[name]["ms"] = round(1000 * quartiles(samples)["median"], 1)
    for row in rows.values():
        print(row, flush=True)
    if options.json:
        found = {"size": [queries, tokens], "rows": [*rows.values()]}
        options.json.write_text(json.dumps(found, indent=1))
    raise SystemExit(failed)


def reason(error: Exception) -> str:
    """Its kind and the first line of what it says."""
    return f"{type(error).__name__}: {error}".splitlines()[0]


if __name__ == "__main__":
    main()

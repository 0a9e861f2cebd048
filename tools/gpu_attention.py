"""Attention with LocusGS's bias by every kernel there is, against float64, timed, on a GPU.

    python tools/gpu_attention.py [--json FILE] [--device cuda] [--size 4096x7168] [--heads 16]

For each kernel: the largest relative error of the output and of each gradient against float64
autograd of the direct formula at 257 x 1,031 pairs (none, some and all of them clamped), then time
and peak memory of forward and backward at full size, beside attention without a bias.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from qgs_locus.ray_bias import RayBias
from torch import Tensor

from qgs.components.attention_bias import biased_attention
from qgs.components.attention_choice import AttentionKernel

KERNELS: tuple[AttentionKernel, ...] = ("plain", "blocks", "triton")
CLAMPS = {"none": -1e9, "some": -5.0, "all": -1e-9}


def leaves(
    sizes: tuple[int, int, int], device: str, dtype: torch.dtype, seed: int = 0
) -> dict[str, Tensor]:
    """q, k, v (1, h, ., 64), centres (1, N, 3), sigmas (1, N, 1), gamma; all with gradients."""
    heads, queries, tokens = sizes
    draw = torch.Generator().manual_seed(seed)
    shapes = {
        "q": (1, heads, queries, 64),
        "k": (1, heads, tokens, 64),
        "v": (1, heads, tokens, 64),
    }
    found = {n: torch.randn(s, generator=draw, dtype=torch.float64) for n, s in shapes.items()}
    found["center"] = torch.randn(1, queries, 3, generator=draw, dtype=torch.float64)
    found["sigma"] = 0.3 + torch.rand(1, queries, 1, generator=draw, dtype=torch.float64)
    found["gamma"] = torch.tensor(0.9, dtype=torch.float64)
    return {name: x.to(device, dtype).requires_grad_() for name, x in found.items()}


def rays(tokens: int, device: str, dtype: torch.dtype) -> Tensor:
    """Moments and unit directions (1, 6, M)."""
    draw = torch.Generator().manual_seed(1)
    origin = torch.randn(tokens, 3, generator=draw, dtype=torch.float64)
    direction = F.normalize(torch.randn(tokens, 3, generator=draw, dtype=torch.float64), dim=-1)
    lines = torch.cat([torch.linalg.cross(origin, direction), direction], -1)
    return lines.mT[None].contiguous().to(device, dtype)


def attend(
    given: dict[str, Tensor], lines: Tensor, lowest: float, kernel: AttentionKernel
) -> Tensor:
    bias = RayBias.of(given["center"], given["sigma"] ** 2, lines, lowest, given["gamma"])
    return biased_attention(given["q"], given["k"], given["v"], bias, kernel)


def exact(given: dict[str, Tensor], lines: Tensor, lowest: float) -> Tensor:
    """The formula itself, for all pairs at once."""
    moments, directions = lines.mT.split(3, -1)
    apart = torch.linalg.cross(given["center"][:, :, None], directions[:, None], dim=-1)
    squared = (apart - moments[:, None]).square().sum(-1)
    bias = given["gamma"] * (-squared / (2 * given["sigma"] ** 2)).clamp_min(lowest)
    logits = given["q"] @ given["k"].mT / given["q"].shape[-1] ** 0.5 + bias[:, None]
    return logits.softmax(-1) @ given["v"]


def errors(kernel: AttentionKernel, clamp: str, device: str, heads: int) -> dict[str, float]:
    """Largest |difference| of output and gradients, as a share of the largest true value.

    Of one that is at least 0.01: where all pairs are clamped the bias has no gradient but rounding.
    """
    sizes, found = (heads, 257, 1031), []
    for dtype in (torch.float64, torch.float32):
        given, lines = leaves(sizes, device, dtype), rays(sizes[2], device, dtype)
        true = dtype == torch.float64
        read = given, lines, CLAMPS[clamp]
        out = exact(*read) if true else attend(*read, kernel)
        weights = torch.randn(out.shape, generator=torch.Generator().manual_seed(2))
        (out * weights.to(out)).sum().backward()
        found.append({"out": out.detach(), **{n: x.grad for n, x in given.items()}})
    (truth, ours), result = found, {}
    for name, value in truth.items():
        other = torch.zeros_like(value) if ours[name] is None else ours[name].double()
        largest = value.abs().max().clamp_min(0.01)
        result[name] = float((value - other).abs().max() / largest)
    return result


def timed(run: Callable[[], object], device: str, rounds: int = 10) -> tuple[float, float]:
    """Milliseconds, median, and MiB that it allocates at most (0 on a CPU)."""
    on_gpu, samples = device == "cuda", []
    run()
    if on_gpu:
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated() if on_gpu else 0
    for _ in range(rounds):
        start = time.perf_counter()
        run()
        if on_gpu:
            torch.cuda.synchronize()
        samples.append(time.perf_counter() - start)
    peak = torch.cuda.max_memory_allocated() - before if on_gpu else 0
    return 1000 * statistics.median(samples), peak / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description="Kernels of attention, checked and timed.")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--size", default="4096x7168", help="queries x tokens")
    parser.add_argument("--heads", type=int, default=16)
    options = parser.parse_args()
    queries, tokens = map(int, options.size.split("x"))
    device, heads = options.device, options.heads
    rows: list[dict[str, Any]] = []
    failed = False
    for kernel in KERNELS:
        row: dict[str, Any] = {"kernel": kernel}
        try:
            for clamp in CLAMPS:
                worst = max(errors(kernel, clamp, device, heads).items(), key=lambda x: x[1])
                row[f"error, {clamp} clamped"] = f"{worst[1]:.1e} ({worst[0]})"
                failed |= worst[1] > 1e-4
            given = leaves((heads, queries, tokens), device, torch.float32)
            lines = rays(tokens, device, torch.float32)

            def run(
                kernel: AttentionKernel = kernel, given: Any = given, lines: Any = lines
            ) -> None:
                attend(given, lines, -5.0, kernel).sum().backward()

            row["ms"], row["MiB"] = (round(x, 1) for x in timed(run, device))
        except Exception as error:
            row["failed"], failed = f"{type(error).__name__}: {error}".splitlines()[0], True
        rows.append(row)
    given = leaves((heads, queries, tokens), device, torch.float32)

    def unbiased() -> None:
        F.scaled_dot_product_attention(given["q"], given["k"], given["v"]).sum().backward()

    time_, memory = timed(unbiased, device)
    rows.append({"kernel": "no bias", "ms": round(time_, 1), "MiB": round(memory, 1)})
    for row in rows:
        print(row, flush=True)
    if options.json:
        options.json.write_text(json.dumps({"size": [queries, tokens], "rows": rows}, indent=1))
    raise SystemExit(failed)


if __name__ == "__main__":
    main()

"""Forward and backward of `qgs/cpu` against the dense oracle `qgs/torch`, and its memory.

python tools/bench_renderer.py [--threads 2] [--repeats 7]

Times are medians per call in milliseconds, both renderers in one run, taking turns. The oracle
renders fewer cameras, one after the other as always, and its time is multiplied. Extra memory
is the growth of the peak resident size over a process that has rendered a small scene before.
"""

import argparse
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from statistics import median
from time import perf_counter

import torch
from process_memory import megabytes

from qgs.contracts import Renderer, RendererConfig
from qgs.renderers import CpuRenderer, TorchRenderer
from qgs.types import Cameras, Gaussians

# pixels, Gaussians, cameras, scale, cameras the oracle renders (0: too slow)
CASES = [
    (64, 2048, 16, 0.03, 4),
    (64, 2048, 16, 0.15, 2),
    (128, 8192, 16, 0.015, 1),
    (256, 65536, 4, 0.006, 0),
]


def make_scene(pixels: int, count: int, views: int, scale: float) -> tuple[Gaussians, Cameras]:
    """Gaussians of log-normal sizes filling a frustum, and cameras scattered before it."""
    generator = torch.Generator().manual_seed(0)
    spread = torch.rand(1, count, 3, generator=generator)
    means = spread * torch.tensor([2.4, 2.4, 3.0]) + torch.tensor([-1.2, -1.2, 1.5])
    gaussians = Gaussians(
        means=means,
        scales=scale * (0.5 * torch.randn(1, count, 3, generator=generator)).exp(),
        quats=torch.nn.functional.normalize(torch.randn(1, count, 4, generator=generator), dim=-1),
        opacities=0.05 + 0.9 * torch.rand(1, count, generator=generator),
        colors=torch.rand(1, count, 3, generator=generator),
    )
    c2w = torch.eye(4).repeat(1, views, 1, 1)
    c2w[..., :3, 3] = 0.05 * torch.randn(1, views, 3, generator=generator)
    intrinsics = torch.tensor([pixels, pixels, pixels / 2, pixels / 2]).expand(1, views, 4)
    return gaussians, Cameras(c2w, intrinsics, (pixels, pixels))


def step(renderer: Renderer, gaussians: Gaussians, cameras: Cameras) -> tuple[float, float]:
    """Seconds of one forward and one backward pass to every Gaussian parameter."""
    leaves = {
        f.name: getattr(gaussians, f.name).detach().requires_grad_() for f in fields(gaussians)
    }
    start = perf_counter()
    out = renderer(Gaussians(**leaves), cameras)
    loss = out.rgb.square().mean() + out.alpha.mean() + out.depth.mean()
    middle = perf_counter()
    torch.autograd.grad(loss, list(leaves.values()))
    return middle - start, perf_counter() - middle


def timed(case: tuple[int, int, int, float, int], repeats: int) -> str:
    """One line of the table."""
    pixels, count, views, scale, oracle_views = case
    gaussians, cameras = make_scene(pixels, count, views, scale)
    fast, dense = CpuRenderer(RendererConfig()), TorchRenderer(RendererConfig())
    step(fast, gaussians, cameras)
    forward, backward, oracle = [], [], []
    for repeat in range(repeats):
        seconds = step(fast, gaussians, cameras)
        forward.append(seconds[0])
        backward.append(seconds[1])
        if oracle_views and repeat < 3:
            seconds = step(dense, gaussians, cameras[:, :oracle_views])
            oracle.append(sum(seconds) * views / oracle_views)
    total = median(f + b for f, b in zip(forward, backward, strict=True))
    line = (
        f"{pixels:>4} {count:>6} {views:>3} {scale:>6} {1e3 * median(forward):>9.1f} "
        f"{1e3 * median(backward):>9.1f} {1e3 * total / views:>10.2f}"
    )
    if not oracle:
        return line + f"{'-':>12} {'-':>7}"
    return line + f"{1e3 * median(oracle) / views:>12.1f} {median(oracle) / total:>6.0f}x"


def extra_megabytes(case: tuple[int, int, int, float, int], threads: int) -> float:
    """Growth of peak memory by one forward and backward pass, in a process of its own."""
    code = f"import bench_renderer as b; b.report_memory({case!r}, {threads})"
    return float(subprocess.check_output([sys.executable, "-c", code], cwd=Path(__file__).parent))


def report_memory(case: tuple[int, int, int, float, int], threads: int) -> None:
    """Print the growth in MB; run in a fresh process."""
    torch.set_num_threads(threads)
    renderer = CpuRenderer(RendererConfig())
    step(renderer, *make_scene(64, 256, 2, 0.03))
    gaussians, cameras = make_scene(*case[:4])
    before = megabytes("VmHWM")  # unlike getrusage's peak, it does not start at the parent's
    step(renderer, gaussians, cameras)
    print(megabytes("VmHWM") - before)


def first_call(threads: int) -> float:
    """Seconds of the first small call in this process (compilation, or reading its cache)."""
    torch.set_num_threads(threads)
    start = perf_counter()
    step(CpuRenderer(RendererConfig()), *make_scene(64, 256, 2, 0.03))
    return perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description="Time and memory of the renderers.")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    print(f"{options.threads} threads; first call {first_call(options.threads):.1f} s")
    print("pixels  count cameras scale  forward  backward  cpu/camera  oracle/camera ratio   (ms)")
    for case in CASES:
        print(timed(case, options.repeats), flush=True)
    for case in CASES:
        extra = extra_megabytes(case, options.threads)
        pixels, count, views, *_ = case
        print(f"extra memory, {pixels} px, {count} Gaussians, {views} cameras: {extra:.0f} MB")


if __name__ == "__main__":
    main()

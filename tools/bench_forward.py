"""Forward pass to Gaussians: LocusGS against TokenGS, in turn, in one run.

    python tools/bench_forward.py [--rounds 15]

Prints medians, the median of the paired ratios, and the share of LocusGS's time that is spent
outside linear layers and scaled dot-product attention.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import qgs  # first: it asks for huge pages before torch allocates

# isort: split
import torch
from torch.profiler import ProfilerActivity, profile

RECIPES = Path(__file__).parents[1] / "recipes"
SIZE = [
    "model.width=384",
    "model.heads=6",
    "model.queries.count=1024",
    "model.head.gaussians_per_query=64",
]
MATRIX_PRODUCTS = ("aten::addmm", "aten::mm", "aten::_scaled_dot_product_flash_attention_for_cpu")


def views(count: int = 4, side: int = 256) -> qgs.Views:
    """Random photos from cameras in a row."""
    c2w = torch.eye(4).repeat(1, count, 1, 1)
    c2w[0, :, 0, 3] = 0.3 * torch.arange(count)
    intrinsics = torch.tensor([side, side, side / 2, side / 2]).float().expand(1, count, 4)
    return qgs.Views(
        torch.rand(1, count, 3, side, side), qgs.Cameras(c2w, intrinsics, (side, side))
    )


def seconds(model: qgs.QueryGaussianModel, photos: qgs.Views) -> float:
    """Wall-clock seconds of one forward pass."""
    start = time.perf_counter()
    model(photos)
    return time.perf_counter() - start


def share_outside_products(model: qgs.QueryGaussianModel, photos: qgs.Views) -> float:
    """Share of CPU time outside linear layers and scaled dot-product attention."""
    with profile(activities=[ProfilerActivity.CPU]) as profiled:
        model(photos)
    times = {event.key: event.self_cpu_time_total for event in profiled.key_averages()}
    return 1 - sum(times.get(name, 0) for name in MATRIX_PRODUCTS) / sum(times.values())


def main() -> None:
    parser = argparse.ArgumentParser(description="Forward pass: LocusGS against TokenGS.")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)

    tokengs = qgs.compose(RECIPES / "tokengs/dl3dv.yaml", overrides=SIZE).eval()
    locus = qgs.compose(RECIPES / "locus/dl3dv.yaml", overrides=SIZE).eval()
    photos = views()
    with torch.inference_mode():
        for model in (tokengs, locus):
            model(photos)
        pairs = [
            (seconds(tokengs, photos), seconds(locus, photos)) for _ in range(arguments.rounds)
        ]
        share = share_outside_products(locus, photos)
    base, ours = (statistics.median(column) for column in zip(*pairs, strict=True))
    paired = statistics.median(b / a for a, b in pairs)
    print(f"TokenGS {base:.3f} s, LocusGS {ours:.3f} s, {arguments.rounds} rounds each")
    print(f"ratio of medians {ours / base:.3f}, median of paired ratios {paired:.3f}")
    print(f"LocusGS outside linear layers and attention: {share:.1%}")


if __name__ == "__main__":
    main()

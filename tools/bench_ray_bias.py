"""The attention bias of one layer: ellipsoidal anchors against LocusGS's, in turn, in one run.

    python tools/bench_ray_bias.py [--anchors 1024] [--rays 4096] [--rounds 15]

Prints medians, and medians of the ratios to LocusGS round by round, without and with the backward
pass.
"""

import argparse
import statistics
from collections.abc import Callable
from operator import truediv

import torch
import torch.nn.functional as F
from qgs_bench.run import in_turn
from qgs_ellipsoid.fields import anchor_rotation
from qgs_ellipsoid.ray_bias import EllipsoidBias
from qgs_ellipsoid.ray_bias import ray_tokens as ellipsoid_tokens
from qgs_locus.ray_bias import RayBias
from qgs_locus.ray_bias import ray_tokens as locus_tokens
from torch import Tensor


def biases(anchors: int, rays: int) -> dict[str, Callable[[], Tensor]]:
    """The bias (1, N, M) by name, of the same anchors and rays."""
    center = (torch.randn(1, anchors, 3) + torch.tensor([0.0, 0.0, 1.5])).requires_grad_()
    rotation = anchor_rotation(torch.randn(1, anchors, 4)).requires_grad_()
    sigma_sq = (1e-3 + 0.05 * torch.rand(1, anchors, 3)).requires_grad_()
    origins = 0.3 * torch.randn(1, rays, 3)
    directions = F.normalize(torch.randn(1, rays, 3), dim=-1)
    plucker = torch.cat([torch.linalg.cross(origins, directions), directions], -1)
    last = -20.0, torch.tensor(0.1)
    locus = RayBias.of(center, sigma_sq[..., :1], locus_tokens(plucker), *last)
    shaped = EllipsoidBias.of(center, rotation, sigma_sq, ellipsoid_tokens(plucker), *last)
    return {
        "locus": locus.dense,
        "ellipsoid": shaped.dense,
        "ellipsoid, torch": lambda: shaped.value(shaped.queries[0], shaped.tokens[0]),
    }


def compare(runs: dict[str, Callable[[], object]], rounds: int) -> None:
    """Time every run in turn, once a round, and print what came out, as ratios to the first."""
    columns = in_turn([*runs.values()], rounds, warmup=1)
    for name, samples in zip(runs, columns, strict=True):
        median = statistics.median(samples)
        ratio = statistics.median(map(truediv, samples, columns[0]))
        print(f"  {name:18} {1e3 * median:8.2f} ms   {ratio:6.3f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="The bias of one layer, against LocusGS's.")
    parser.add_argument("--anchors", type=int, default=1024)
    parser.add_argument("--rays", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    runs = biases(options.anchors, options.rays)
    print(f"{options.anchors} anchors, {options.rays} rays, {options.threads} threads; forward")
    with torch.no_grad():
        compare(dict(runs), options.rounds)
    print("forward and backward")
    compare(
        {n: lambda run=run: run().sum().backward(retain_graph=True) for n, run in runs.items()},
        options.rounds,
    )


if __name__ == "__main__":
    main()

"""Peak memory of one cross-attention, forward and backward: none, LocusGS's, and ellipsoid's bias.

    python tools/measure_attention_memory.py [--grow]

Each measurement runs in a process of its own, on the CPU (Linux), with glibc told to give freed
memory back; what the process holds before, queries, keys and values among it, is left out. The size
is that of 4,096 queries and 4 photos of 448 x 256 in patches of 8 x 8: 7,168 tokens, 16 heads.
--grow measures LocusGS's from 512 to 16,384 queries and from 1,024 to 32,768 tokens instead, with 2
heads. What is constant, as the buffers of blocks, drops out of the exponent that it prints: the
binary logarithm of the last doubling's growth over that of the one before.
"""

import argparse
import json
import math
import os
import subprocess
import sys

import torch
import torch.nn.functional as F
from measure_render_memory import peak, restart_peak
from qgs_ellipsoid.fields import anchor_rotation
from qgs_ellipsoid.ray_bias import EllipsoidBias
from qgs_ellipsoid.ray_bias import ray_tokens as ellipsoid_tokens
from qgs_locus.ray_bias import RayBias
from qgs_locus.ray_bias import ray_tokens as locus_tokens
from torch import Tensor

from qgs.components import AttentionBias
from qgs.components.attention_bias import biased_attention

KINDS = ("none", "locus", "ellipsoid")
WIDTH = 64


def bias_of(kind: str, queries: int, tokens: int) -> AttentionBias | None:
    """A bias of random anchors and rays, to whose anchors gradients flow."""
    if kind == "none":
        return None
    center = (torch.randn(1, queries, 3) + torch.tensor([0.0, 0.0, 1.5])).requires_grad_()
    sigma_sq = (1e-3 + 0.05 * torch.rand(1, queries, 3)).requires_grad_()
    directions = F.normalize(torch.randn(1, tokens, 3), dim=-1)
    moments = torch.linalg.cross(0.3 * torch.randn(1, tokens, 3), directions)
    rays, last = torch.cat([moments, directions], -1), (-20.0, torch.tensor(0.1))
    if kind == "locus":
        return RayBias.of(center, sigma_sq[..., :1], locus_tokens(rays), *last)
    rotation = anchor_rotation(torch.randn(1, queries, 4))
    return EllipsoidBias.of(center, rotation, sigma_sq, ellipsoid_tokens(rays), *last)


def step(kind: str, heads: int, queries: int, tokens: int) -> float:
    """10^6 bytes that one forward and backward pass takes at its peak."""
    q, k, v = (torch.randn(1, heads, n, WIDTH).requires_grad_() for n in (queries, tokens, tokens))
    bias = bias_of(kind, queries, tokens)
    small = bias_of(kind, 8, 8)
    attend(q[:, :, :8], k[:, :, :8], v[:, :, :8], small).sum().backward()  # compiles kernels
    q.grad = k.grad = v.grad = None
    before = restart_peak("cpu")
    attend(q, k, v, bias).sum().backward()
    return peak("cpu") - before


def attend(q: Tensor, k: Tensor, v: Tensor, bias: AttentionBias | None) -> Tensor:
    """Attention with or without a bias."""
    return (
        F.scaled_dot_product_attention(q, k, v) if bias is None else biased_attention(q, k, v, bias)
    )


def in_own_process(kind: str, *size: int) -> float:
    """`step` of a fresh process."""
    command = [sys.executable, __file__, "--alone", kind, *map(str, size)]
    environment = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "65536"}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return json.loads(done.stdout)


def exponent(found: list[float]) -> float:
    """Of c in a + b n^c, through the last three sizes, each twice the one before."""
    *_, first, second, third = found
    return math.log2((third - second) / (second - first))


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--grow", action="store_true")
    parser.add_argument("--alone", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.alone:
        print(step(options.alone[0], *map(int, options.alone[1:])))
        return
    if not options.grow:
        found = {kind: in_own_process(kind, 16, 4096, 7168) for kind in KINDS}
        for kind, memory in found.items():
            print(f"{kind:10} {memory:7.1f} MB   {memory / found['none']:.3f}")
        return
    for name, sizes in (
        ("queries", [2**n for n in range(9, 15)]),
        ("tokens", [2**n for n in range(10, 16)]),
    ):
        of = {"queries": lambda n: (2, n, 32768), "tokens": lambda n: (2, 16384, n)}[name]
        rows = {kind: [in_own_process(kind, *of(n)) for n in sizes] for kind in ("none", "locus")}
        for n, none, locus in zip(sizes, rows["none"], rows["locus"], strict=True):
            print(f"{name} {n:6,}: {none:7.1f} MB without a bias, {locus:7.1f} MB with LocusGS's")
        print(f"  exponents {exponent(rows['none']):.3f}, {exponent(rows['locus']):.3f}")


if __name__ == "__main__":
    main()

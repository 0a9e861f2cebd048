"""LocusGS and ellipsoid against TokenGS, in turn, in one run: forward, and forward and backward.

    python tools/bench_models.py [--size first|small] [--rounds 9] [--threads 2]

Two sizes: "first" has width 384, 6 heads, 3 + 12 layers, 1,024 queries and 4 photos of 256 x 256;
"small" has width 256, 8 heads, 3 + 6 layers, 512 queries and 4 photos of 128 x 128. Gradients go to
all parameters from the Gaussians of the last layer, without renderer or losses. Prints medians, and
medians of the ratios to TokenGS round by round.
"""

import argparse
import statistics
from collections.abc import Callable, Mapping
from functools import partial
from operator import truediv

import torch
from qgs_research.bench.run import in_turn
from qgs_research.bench.work import posed_photos

from qgs.model import QueryGaussianModel
from qgs.recipe import resolve
from qgs.types import Views

SIZES = {
    "first": ({"width": 384, "heads": 6, "queries": 1024, "depth": 12}, (256, 256)),
    "small": ({"width": 256, "heads": 8, "queries": 512, "depth": 6}, (128, 128)),
}
MODELS = {
    "tokengs": ("tokengs", ()),
    "locus": ("locus", ()),
    "locus, no bias": ("locus", ("model.decoder.cross_attention={type: qgs/content}",)),
    "ellipsoid": ("ellipsoid", ()),
}
"""Recipes and changes. Without the bias LocusGS has its position MLPs and refinement left: the
least that it can cost beside TokenGS."""


def build(name: str, size: str) -> QueryGaussianModel:
    """A published model, made smaller."""
    options, _ = SIZES[size]
    changes = [
        f"model.width={options['width']}",
        f"model.heads={options['heads']}",
        f"model.queries.count={options['queries']}",
        f"model.decoder.depth={options['depth']}",
        f"model.supervision.layers=[{options['depth']}]",
        *MODELS[name][1],
    ]
    return resolve(f"{MODELS[name][0]}/dl3dv_4096_4views.yaml", changes).build_model()


def backward(model: QueryGaussianModel, photos: Views) -> None:
    """Forward, and gradients of all parameters."""
    model.zero_grad(set_to_none=True)
    found = model(photos).gaussians
    parts = (found.means, found.scales, found.quats, found.opacities)
    torch.stack([x.square().mean() for x in parts]).sum().backward()


def compare(runs: Mapping[str, Callable[[], object]], rounds: int) -> None:
    """Time every run in turn, once a round; print medians and ratios to the first run."""
    columns = in_turn([*runs.values()], rounds, warmup=1)
    for name, samples in zip(runs, columns, strict=True):
        median = statistics.median(samples)
        ratio = statistics.median(map(truediv, samples, columns[0]))
        print(f"  {name:18} {1e3 * median:8.2f} ms   {ratio:6.3f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="LocusGS and ellipsoid against TokenGS.")
    parser.add_argument("--size", choices=[*SIZES], action="append")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    for size in options.size or SIZES:
        photos = posed_photos(1, 4, SIZES[size][1], 0)
        models = {name: build(name, size) for name in MODELS}
        print(f"{size}, {options.threads} threads; forward", flush=True)
        with torch.inference_mode():
            compare({n: partial(model, photos) for n, model in models.items()}, options.rounds)
        print("forward and backward", flush=True)
        runs = {name: partial(backward, model, photos) for name, model in models.items()}
        compare(runs, options.rounds)


if __name__ == "__main__":
    main()

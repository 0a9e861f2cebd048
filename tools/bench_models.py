"""LocusGS and ellipsoid against TokenGS, in turn, in one run: forward, and forward and backward.

    python tools/bench_models.py [--size first|small] [--also bf16|compile] [--rounds 9]

Two sizes: "first" has width 384, 6 heads, 3 + 12 layers, 1,024 queries and 4 photos of 256 x 256;
"small" has width 256, 8 heads, 3 + 6 layers, 512 queries and 4 photos of 128 x 128. Gradients go to
all parameters from the Gaussians of the supervised layers, without renderer or losses: of the last
layer, or with --layers 2 of the half and the last, as the recipes of LocusGS have it.
With --also, TokenGS and LocusGS alone, each also under autocast to bfloat16 or compiled.
Prints medians, and medians of the ratios to TokenGS round by round.
"""

import argparse
from functools import partial

import torch
from bench_ray_bias import compare
from qgs_bench.work import posed_photos
from torch import Tensor

from qgs.composer import resolve
from qgs.model import QueryGaussianModel
from qgs.types import Prediction, Views

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


def build(name: str, size: str, layers: int) -> QueryGaussianModel:
    """A published model, made smaller."""
    options, _ = SIZES[size]
    depth = options["depth"]
    supervised = [depth // 2, depth] if layers == 2 else [depth]
    changes = [
        f"model.width={options['width']}",
        f"model.heads={options['heads']}",
        f"model.queries.count={options['queries']}",
        f"model.decoder.depth={depth}",
        f"model.supervision.layers={supervised}",
        *MODELS[name][1],
    ]
    return resolve(f"{MODELS[name][0]}/dl3dv_4096_4views.yaml", changes).build_model()


def forward(model: QueryGaussianModel, photos: Views, bf16: bool = False) -> Prediction:
    """The Gaussians of the last layer, or in training of the supervised ones."""
    with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        return model(photos)


def backward(model: QueryGaussianModel, photos: Views, bf16: bool = False) -> None:
    """Forward, and gradients of all parameters."""
    model.zero_grad(set_to_none=True)
    total = torch.zeros(())
    for layer in forward(model, photos, bf16).layers.values():
        gaussians = layer.gaussians
        parts: list[Tensor] = [gaussians.means, gaussians.scales, gaussians.quats]
        total = total + sum(x.square().mean() for x in [*parts, gaussians.opacities])
    total.backward()


def main() -> None:
    parser = argparse.ArgumentParser(description="LocusGS and ellipsoid against TokenGS.")
    parser.add_argument("--size", choices=[*SIZES], action="append")
    parser.add_argument("--also", choices=["bf16", "compile"])
    parser.add_argument("--layers", type=int, choices=[1, 2], default=1, help="supervised")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    for size in options.size or SIZES:
        photos = posed_photos(1, 4, SIZES[size][1], 0)
        names = ["tokengs", "locus"] if options.also else [*MODELS]
        runs = {name: (build(name, size, options.layers), photos, False) for name in names}
        for name in names if options.also else ():
            model = build(name, size, options.layers)
            if options.also == "compile":
                model.compile()
            runs[f"{name}, {options.also}"] = model, photos, options.also == "bf16"
        print(f"{size}, {options.threads} threads; forward", flush=True)
        with torch.inference_mode():
            compare({n: partial(forward, *run) for n, run in runs.items()}, options.rounds)
        print(f"forward and backward, supervised layers: {options.layers}", flush=True)
        compare({n: partial(backward, *run) for n, run in runs.items()}, options.rounds)


if __name__ == "__main__":
    main()

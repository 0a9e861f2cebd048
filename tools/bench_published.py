"""The public TokenGS code against ours, in turn, in one run, on a CPU.

    git clone https://github.com/nv-tlabs/TokenGS
    python tools/bench_published.py TokenGS [--size tiny|small|first] [--rounds 9] [--threads 2]

Times forward, forward and backward, and a training step, without renderer and losses: backward from
the Gaussians of the last layer, clipping of the gradient's norm, fused AdamW. The sizes are those
of tools/bench_models.py; "tiny" is recipes/tiny/tokengs.yaml with 9 Gaussians a query, since the
public code makes square numbers of them. Ours computes the rays of its photos itself; the public
code is given them. Prints medians, and medians of the ratios to the public code.
"""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any
from unittest.mock import MagicMock

import torch
from bench_models import SIZES, compare
from bench_models import build as published_size
from qgs_research.bench.work import posed_photos
from torch import Tensor, nn

from qgs.geometry.rays import plucker_rays
from qgs.recipe import resolve
from qgs.types import Views

ABSENT = ("tyro", "lpips", "gsplat", "gsplat.rendering", "tokengs.rendering.fused_ssim")
"""What the public code imports, and neither its encoder nor its decoder uses."""


def public_model(checkout: str, size: str, photos: Views) -> tuple[nn.Module, Callable[[], Tensor]]:
    """TokenGS of the public code, and its forward pass on `photos`: Gaussians (1, G, 14)."""
    sys.path.insert(0, checkout)
    sys.modules.update({name: MagicMock() for name in ABSENT})
    types = import_module("tokengs.models.input_types")
    public = import_module("tokengs.models.tokengs")

    ours = model_of("tokengs", size)
    tree: Any = ours.recipe
    model, image = tree["model"], photos.images.shape[-2:]
    options = public.Options(
        img_size=tuple(image),
        patch_size=model["encoder"]["patch_size"],
        dec_patch_size=round(model["head"]["gaussians_per_query"] ** 0.5),
        enc_depth=model["encoder"]["depth"],
        dec_depth=model["decoder"]["depth"],
        dec_init_values=model["decoder"]["layer_scale"],
        enc_embed_dim=model["width"],
        token_dim=model["width"],
        enc_num_heads=model["heads"],
        num_gs_tokens=model["queries"]["count"],
        num_input_views=photos.images.shape[1],
    )
    network = public.TokenGS(options)
    count = sum(p.numel() for p in network.parameters())
    if count != (own := sum(p.numel() for p in ours.parameters())):
        raise SystemExit(f"the public model has {count:,} parameters, ours {own:,}")
    plucker = plucker_rays(photos.cameras)
    given = types.ModelInputEncoder(photos.images, plucker, *plucker.split(3, 2), None, None)
    return network, lambda: network.forward_gaussians(
        types.ModelInput(given, types.ModelInputDecoder())
    )


def model_of(name: str, size: str) -> nn.Module:
    """Ours, of recipe `name`."""
    if size != "tiny":
        return published_size(name, size, 1)
    changes = ["model.head.gaussians_per_query=9", "model.head.norm=false"]
    return resolve(f"tiny/{name}.yaml", [*changes, "model.supervision.layers=[4]"]).build_model()


def own_gaussians(model: nn.Module, photos: Views) -> Tensor:
    """The raw numbers of our model's Gaussians, (1, G, 14)."""
    g = model(photos).gaussians
    return torch.cat([g.means, g.scales, g.quats, g.opacities[..., None], g.colors], -1)


def backward(model: nn.Module, gaussians: Callable[[], Tensor]) -> None:
    """Forward, and gradients of all parameters."""
    model.zero_grad(set_to_none=True)
    gaussians().square().mean().backward()


def steps(model: nn.Module, gaussians: Callable[[], Tensor]) -> Callable[[], None]:
    """A training step, ready to be called."""
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-6, betas=(0.9, 0.95), fused=True)

    def step() -> None:
        backward(model, gaussians)
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()

    return step


def main() -> None:
    parser = argparse.ArgumentParser(description="The public TokenGS code against ours.")
    parser.add_argument("checkout", help="folder of the public code")
    parser.add_argument("--size", choices=["tiny", *SIZES], action="append")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    for size in options.size or ["tiny", *SIZES]:
        views, image = (2, (64, 64)) if size == "tiny" else (4, SIZES[size][1])
        photos = posed_photos(1, views, image, 0)
        models = {"public TokenGS": public_model(options.checkout, size, photos)}
        for name in ("tokengs", "locus"):
            model = model_of(name, size)
            models[f"qgs, {name}"] = model, partial(own_gaussians, model, photos)
        print(f"{size}, {options.threads} threads; forward", flush=True)
        with torch.inference_mode():
            compare({n: run for n, (_, run) in models.items()}, options.rounds)
        print("forward and backward", flush=True)
        compare({n: partial(backward, *pair) for n, pair in models.items()}, options.rounds)
        print("training step", flush=True)
        compare({n: steps(*pair) for n, pair in models.items()}, options.rounds)


if __name__ == "__main__":
    main()

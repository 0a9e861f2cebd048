"""The public encoders of MVSplat and DepthSplat against ours, in turn, in one run, on a CPU.

    git clone https://github.com/donydchen/mvsplat
    git clone https://github.com/cvg/depthsplat
    git clone https://github.com/facebookresearch/dinov2
    pip install e3nn jaxtyping
    python tools/bench_splats.py mvsplat mvsplat [--rounds 5] [--threads 2]
    python tools/bench_splats.py depthsplat depthsplat --dinov2 dinov2

From two photos of 256 x 256 to Gaussians, both with the same weights. Prints how far the means of
the Gaussians are apart, medians, and medians of the ratios to the public code.
"""

import argparse
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import torch
from bench_models import compare
from qgs_research.bench.work import posed_photos
from qgs_zoo.mvsplat.depthsplat_weights import DEPTHSPLAT
from qgs_zoo.mvsplat.weights import MVSPLAT
from torch import Tensor

import qgs
from qgs.types import Views

SYSTEMS = {
    "mvsplat": ("mvsplat/re10k.yaml", MVSPLAT, "encoder_costvolume", "EncoderCostVolume"),
    "depthsplat": (
        "depthsplat/small_re10k.yaml",
        DEPTHSPLAT,
        "encoder_depthsplat",
        "EncoderDepthSplat",
    ),
}
OPTIONS: Mapping[str, dict[str, Any]] = {
    "mvsplat": {
        "gaussian_scale_min": 0.5,
        "gaussian_scale_max": 15.0,
        "sh_degree": 4,
        "opacity_mapping": SimpleNamespace(initial=0.0, final=0.0, warm_up=1),
        "costvolume_unet_feat_dim": 128,
        "depth_unet_feat_dim": 32,
        "wo_depth_refine": False,
        "wo_cost_volume": False,
        "wo_backbone_cross_attn": False,
        "wo_cost_volume_refine": False,
        "use_epipolar_trans": False,
    },
    "depthsplat": {
        "gaussian_scale_min": 1e-10,
        "gaussian_scale_max": 3.0,
        "sh_degree": 2,
        "costvolume_unet_feat_dim": 128,
        "depth_unet_feat_dim": 32,
        "num_scales": 1,
        "upsample_factor": 4,
        "lowest_feature_resolution": 4,
        "depth_unet_channels": 128,
        "grid_sample_disable_cudnn": False,
        "large_gaussian_head": False,
        "color_large_unet": False,
        "init_sh_input_img": True,
        "feature_upsampler_channels": 64,
        "gaussian_regressor_channels": 64,
        "supervise_intermediate_depth": True,
        "return_depth": True,
        "train_depth_only": False,
        "monodepth_vit_type": "vits",
        "local_mv_match": 2,
    },
}
SHARED: Mapping[str, Any] = {
    "d_feature": 128,
    "num_depth_candidates": 128,
    "num_surfaces": 1,
    "gaussians_per_pixel": 1,
    "unimatch_weights_path": None,
    "downscale_factor": 4,
    "shim_patch_size": 4,
    "multiview_trans_attn_split": 2,
    "costvolume_unet_channel_mult": [1, 1, 1],
    "costvolume_unet_attn_res": [4],
    "depth_unet_attn_res": [16],
    "depth_unet_channel_mult": [1, 1, 1, 1, 1],
    "visualizer": None,
}
ABSENT = (
    "wandb",
    "torchvision",
    "torchvision.transforms",
    "omegaconf",
    "dacite",
    "lpips",
    "moviepy",
)
"""What the public code may import, and its encoders do not use."""


def public_encoder(system: str, checkout: str, dinov2: str | None) -> Any:
    """The encoder of the public code at published size, with random weights."""
    sys.path.insert(0, checkout)
    sys.modules.update({name: MagicMock() for name in ABSENT if name not in sys.modules})
    # Their __init__ import what loads data and draws pictures.
    for name in ("src.dataset", "src.model", "src.model.encoder"):
        sys.modules[name] = ModuleType(name)
        sys.modules[name].__path__ = [str(Path(checkout, *name.split(".")))]
    view_sampler = SimpleNamespace(num_context_views=2)
    cfg: Any = SimpleNamespace(mode="test", dataset=SimpleNamespace(view_sampler=view_sampler))
    import_module("src.global_cfg").set_cfg(cfg)
    if dinov2:
        torch.hub.load = lambda _, name: untrained(dinov2, name)
    options = {**SHARED, **OPTIONS[system]}
    names = ("gaussian_scale_min", "gaussian_scale_max", "sh_degree")
    adapter = import_module("src.model.encoder.common.gaussian_adapter")
    scales = adapter.GaussianAdapterCfg(*(options.pop(name) for name in names))
    module, name = SYSTEMS[system][2:]
    public = getattr(import_module(f"src.model.encoder.{module}"), name)
    return public(SimpleNamespace(**options, gaussian_adapter=scales)).eval()


def untrained(checkout: str, name: str) -> Any:
    """DINOv2 of the hub, without its weights."""
    sys.path.insert(0, checkout)
    return getattr(import_module("dinov2.hub.backbones"), name)(pretrained=False)


def context_of(photos: Views, near: float, far: float) -> dict[str, Tensor]:
    """Photos as the public code takes them."""
    cameras = photos.cameras
    (height, width), (scenes, views) = cameras.size, cameras.shape
    fx, fy, cx, cy = cameras.intrinsics.unbind(-1)
    k = torch.eye(3).expand(scenes, views, 3, 3).clone()
    k[..., 0, 0], k[..., 1, 1], k[..., 0, 2], k[..., 1, 2] = (
        fx / width,
        fy / height,
        cx / width,
        cy / height,
    )
    bounds = {"near": torch.full((scenes, views), near), "far": torch.full((scenes, views), far)}
    return {"image": photos.images, "extrinsics": cameras.c2w, "intrinsics": k, **bounds}


def runs_of(system: str, checkout: str, dinov2: str | None) -> dict[str, Callable[[], Tensor]]:
    """Forward passes of the public code and of ours: means of the Gaussians (1, G, 3)."""
    recipe, layout, _, _ = SYSTEMS[system]
    torch.manual_seed(0)
    public = public_encoder(system, checkout, dinov2)
    own = qgs.compose(recipe).eval()
    weights = {f"encoder.{name}": x for name, x in public.state_dict().items()}
    state = {name: weights.pop(str(layout.published_name(name))) for name in own.state_dict()}
    if weights:
        raise SystemExit(f"the public model has more: {', '.join(weights)}")
    own.load_state_dict(state)
    photos = posed_photos(1, 2, (256, 256), 0)
    config: Any = own.encoder.config
    context = context_of(photos, config.near, config.far)

    def theirs() -> Tensor:
        found = public(context, 0, False)
        return (found["gaussians"] if isinstance(found, dict) else found).means

    return {f"public {system}": theirs, f"qgs, {system}": lambda: own(photos).gaussians.means}


def main() -> None:
    parser = argparse.ArgumentParser(description="The public encoders against ours.")
    parser.add_argument("system", choices=[*SYSTEMS])
    parser.add_argument("checkout", help="folder of the public code")
    parser.add_argument("--dinov2", help="folder of DINOv2's public code")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    with torch.inference_mode():
        runs = runs_of(options.system, options.checkout, options.dinov2)
        theirs, ours = (run() for run in runs.values())
        apart = ((theirs - ours).norm(dim=-1) / theirs.norm(dim=-1)).max()
        print(f"means are apart by {apart:.1e} of their distances at most", flush=True)
        print(f"{options.system}, {options.threads} threads; forward", flush=True)
        compare(runs, options.rounds)


if __name__ == "__main__":
    main()

"""Tensors of a golden file of DepthSplat, computed by the components of qgs."""

from typing import Any

import torch
from qgs_zoo.dinov2.vit import PATCH
from qgs_zoo.mvsplat.depthsplat import DepthPredictor, finer_candidates, nearest_neighbours
from qgs_zoo.mvsplat.depthsplat_encoder import DepthSplatEncoder
from qgs_zoo.mvsplat.mvsplat import expected_disparity
from qgs_zoo.mvsplat.sweep import (
    Sweep,
    inverse_depth_candidates,
    relative_poses,
)
from qgs_zoo.mvsplat.windows import shift_mask
from torch import Tensor

from published.files import GoldenFile
from published.splats import (
    Recorder,
    gaussians,
    model_of,
    of_views,
    predicted,
    views_of,
    warps,
    watch_transformer,
    watch_unet,
)
from qgs.types import Views

OUTPUTS = """
features_cnn.0                        depth_predictor.backbone.conv2
dino_block.0                          depth_predictor.pretrained.blocks.0
delta_inverse_depth                   depth_predictor.upsampler
upsampler.concat_projects.0           depth_predictor.upsampler.concat_projects.0
upsampler.concat_projects.1           depth_predictor.upsampler.concat_projects.1
upsampler.concat_projects.2           depth_predictor.upsampler.concat_projects.2
upsampler.refinenet1                  depth_predictor.upsampler.scratch.refinenet1
upsampler.refinenet2                  depth_predictor.upsampler.scratch.refinenet2
upsampler.refinenet3                  depth_predictor.upsampler.scratch.refinenet3
upsampler.refinenet4                  depth_predictor.upsampler.scratch.refinenet4
upsampled_features                    feature_upsampler
feature_upsampler.concat_projects.0   feature_upsampler.concat_projects.0
feature_upsampler.concat_projects.1   feature_upsampler.concat_projects.1
feature_upsampler.concat_projects.2   feature_upsampler.concat_projects.2
feature_upsampler.refinenet1          feature_upsampler.scratch.refinenet1
feature_upsampler.refinenet2          feature_upsampler.scratch.refinenet2
feature_upsampler.refinenet3          feature_upsampler.scratch.refinenet3
feature_upsampler.refinenet4          feature_upsampler.scratch.refinenet4
"""
"""Lines with a name in the golden file and the module whose output has this name."""
FINER_OUTPUTS = """
features_mv.1     mv_pyramid.stages.1
features_mono.1   mono_pyramid.stages.1
"""


def depthsplat_tensors(golden: GoldenFile) -> dict[str, Tensor]:
    """Compute every output that a golden file has, by name."""
    neighbours = golden.config["options"]["local_mv_match"]
    model = model_of(golden, [f"model.encoder.neighbours={neighbours}"])
    encoder = model.encoder
    assert isinstance(encoder, DepthSplatEncoder)
    views = views_of(golden)
    near = golden.input("near")
    far = golden.input("far")
    kept = of_views(near.shape[1])
    watch(kept, encoder, views.cameras.size)
    numbers = encoder.predict(views, near, far)
    found = kept.found
    predictor = encoder.network.depth_predictor
    neighbours = nearest_neighbours(views.cameras.c2w, encoder.config.neighbours)
    sweep = Sweep(views.cameras, neighbours, near, far)
    size = views.cameras.size
    grid = (size[0] // PATCH, size[1] // PATCH)
    found["dino_positions"] = predictor.pretrained.positions(*grid)
    first = torch.arange(near.shape[1]).expand(len(near), -1)[..., None]
    found["neighbours"] = torch.cat([first, neighbours], -1)
    found["shift_mask"] = shift_mask(
        *(side // encoder.config.stride for side in size), device=near.device
    )
    swept(found, predictor, views, sweep)
    numbers = numbers.movedim(2, -1)
    prediction = predicted(model, views, numbers)
    found |= gaussians(views, numbers, prediction)
    found["depth"] = numbers[..., 0].exp()
    if model.depth:
        # Of both scales, concatenated as in training.
        found["training.depths"] = torch.cat([numbers[..., -1], numbers[..., 0]]).exp()
        layers = prediction.layers.values()
        found["training.means"] = torch.cat([layer.gaussians.means for layer in layers])
    return found


def watch(kept: Recorder, encoder: DepthSplatEncoder, size: tuple[int, int]) -> None:
    """Record all modules whose output is in the golden file. size: image size (H, W)."""
    network = encoder.network
    predictor = encoder.network.depth_predictor
    low = (size[0] // encoder.config.stride, size[1] // encoder.config.stride)
    kept.outputs(network, OUTPUTS)
    watch_transformer(kept, predictor.transformer, low, "features_mv.0")
    vit = predictor.pretrained
    if encoder.config.scales > 1:
        kept.outputs(predictor, FINER_OUTPUTS)
    kept.input("dino_input", vit)
    vit.register_forward_hook(
        lambda _, __, out: kept.found.update(
            {f"dino_features.{index}": kept.shaped(x) for index, x in enumerate(out)}
        )
    )
    network.feature_upsampler.register_forward_pre_hook(
        lambda _, given: kept.found.update({"features_mono_eighth.3": kept.shaped(given[0][-1])})
    )
    for scale in range(encoder.config.scales):
        regressor: Any = predictor.regressor[scale]
        head = predictor.depth_head[scale]
        kept.input(f"cost_volume.{scale}", regressor, slice(predictor.candidates(scale)))
        kept.output(f"cost_unet.{scale}.stem", regressor[2])
        watch_unet(kept, f"cost_unet.{scale}", regressor[3])
        kept.output(f"cost_unet_out.{scale}", regressor)
        kept.input(f"cost_volume_refined.{scale}", head)
        kept.output(f"match_logits.{scale}", head)
    kept.output("raw_gaussians", network.gaussian_head, lambda x: kept.shaped(x).movedim(2, -1))
    kept.input("match_probability_max", network.gaussian_regressor, slice(4, 5))


def swept(found: dict[str, Tensor], predictor: DepthPredictor, views: Views, sweep: Sweep) -> None:
    """Add to `found` the tensors of plane sweeps that no module outputs."""
    shape = sweep.near.shape
    poses = relative_poses(sweep.cameras.c2w, sweep.neighbours)
    counts = [predictor.candidates(scale) for scale in range(predictor.sizes.scales)]
    candidates = inverse_depth_candidates(sweep.near, sweep.far, counts[0])
    found["inverse_depth_candidates.0"] = candidates
    low = found["cost_volume.0"].shape[-2:]
    found["warp_grid.0"] = warps(views, poses, low, candidates[..., ::8])
    candidates = candidates.flatten(0, 1)[..., None, None]
    for scale, count in enumerate(counts):
        if scale:
            coarse = found["coarse_inverse_depth.0"].flatten(0, 1)
            candidates = finer_candidates(coarse, sweep, counts[0], count)
            found["inverse_depth_candidates.1"] = candidates.unflatten(0, shape)
        found[f"relative_pose.{scale}"] = poses
        logits = found[f"match_logits.{scale}"]
        found[f"match_probability.{scale}"] = logits.softmax(2)
        inverse = expected_disparity(logits.flatten(0, 1), candidates)[0]
        found[f"coarse_inverse_depth.{scale}"] = inverse.unflatten(0, shape)

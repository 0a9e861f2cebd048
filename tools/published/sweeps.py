"""Tensors of golden files of MVSplat and DepthSplat, computed by the components of qgs."""

from collections.abc import Sequence
from typing import Any

import torch
from qgs_zoo.dinov2.vit import PATCH
from qgs_zoo.mvsplat.depthsplat import DepthSplatEncoder, finer_candidates
from qgs_zoo.mvsplat.mvsplat import MVSplatEncoder, expected_disparity
from qgs_zoo.mvsplat.sweep import (
    Sweep,
    bounds,
    cyclic_neighbours,
    evenly_spaced,
    nearest_neighbours,
    relative_poses,
)
from qgs_zoo.mvsplat.windows import shift_mask
from torch import Tensor, nn

from published.files import GoldenFile, Tensors
from published.splats import (
    Recorder,
    gaussians,
    model_of,
    predicted,
    views_of,
    warps,
    watch_transformer,
    watch_unet,
)

MVSPLAT_OUTPUTS = """
cnn.layer2                          backbone.backbone.layer2
features_cnn                        backbone.backbone.conv2
fullres_features                    depth_predictor.upsampler
projected_features                  depth_predictor.proj_feature
delta_disparity_and_density_logit   depth_predictor.to_disparity
"""
"""Lines with a name in the golden file and the encoder module whose output has this name."""
MVSPLAT_NAMES = """
coarse_inverse_depth.0       coarse_disparity
cost_unet.0.                 cost_unet.
cost_unet_out.0              cost_volume_unet
cost_volume.0                cost_volume
cost_volume_refined.0        cost_volume_refined
inverse_depth_candidates.0   disparity_candidates
match_logits.0               match_logits
match_probability.0          match_pdf
relative_pose.0              relative_pose
warp_grid.0                  warp_grid
"""
"""Lines with the start of a name in files of DepthSplat and in those of MVSplat."""
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


def sweep_tensors(golden: GoldenFile) -> Tensors:
    """Compute every output that a golden file has, by name."""
    model = model_of(golden)
    encoder = model.encoder
    views = views_of(golden)
    near = golden.input("near")
    far = golden.input("far")
    # The first axis of outputs becomes scenes and views.
    kept = Recorder(lambda x: x.detach().unflatten(0, (-1, near.shape[1])))
    found = kept.found
    stride = encoder.config.stride if isinstance(encoder, DepthSplatEncoder) else 4
    low = tuple(side // stride for side in views.cameras.size)
    if isinstance(encoder, DepthSplatEncoder):
        neighbours = nearest_neighbours(views.cameras.c2w, encoder.config.neighbours)
        watch_depthsplat(kept, encoder, low)
    else:
        assert isinstance(encoder, MVSplatEncoder)
        neighbours = cyclic_neighbours(*near.shape, device=near.device)
        watch_mvsplat(kept, encoder, low)
    numbers = encoder.predict(views, near, far).movedim(2, -1)
    prediction = predicted(model, views, numbers)
    found |= gaussians(views, numbers, prediction)
    found["shift_mask"] = shift_mask(*low, device=near.device)
    sweep = Sweep(views.cameras, neighbours, near, far)
    if isinstance(encoder, MVSplatEncoder):
        of_sweep(found, sweep, [encoder.config.candidates])
        of_mvsplat(found, numbers)
        return {mvsplat_name(name): x for name, x in found.items()}
    predictor = encoder.network.depth_predictor
    counts = [predictor.candidates(scale) for scale in range(encoder.config.scales)]
    of_sweep(found, sweep, counts, 8)
    height, width = views.cameras.size
    found["dino_positions"] = predictor.pretrained.positions(height // PATCH, width // PATCH)
    first = torch.arange(near.shape[1]).expand(near.shape)[..., None]
    found["neighbours"] = torch.cat([first, neighbours], -1)
    found["depth"] = numbers[..., 0].exp()
    if model.depth:
        # Of both scales, concatenated as in training.
        found["training.depths"] = torch.cat([numbers[..., -1], numbers[..., 0]]).exp()
        layers = prediction.layers.values()
        found["training.means"] = torch.cat([layer.gaussians.means for layer in layers])
    return found


def of_mvsplat(found: Tensors, numbers: Tensor) -> None:
    """Add to `found` further tensors of MVSplat that no module outputs.

    numbers: output of the networks for each pixel, (B, V, H, W, C).
    """
    # The release keeps an axis of Gaussians a pixel here.
    for name in ("scales", "rotations"):
        found[name] = found[name][..., None, :]
    found["depth"] = numbers[..., :1].exp()
    found["density"] = numbers[..., 1:2].sigmoid()
    found["raw_gaussians"] = numbers[..., 2:]


def mvsplat_name(name: str) -> str:
    """Return the name in files of MVSplat for a name in files of DepthSplat."""
    for line in MVSPLAT_NAMES.strip().splitlines():
        own, released = line.split()
        name = name.replace(own, released)
    return name


def watch_mvsplat(kept: Recorder, encoder: MVSplatEncoder, low: tuple[int, ...]) -> None:
    """Record all modules whose input or output is in the golden file.

    low: size of the feature maps.
    """
    predictor = encoder.depth_predictor
    kept.outputs(encoder, MVSPLAT_OUTPUTS)
    watch_transformer(kept, encoder.backbone.transformer, low, "features")
    head = predictor.depth_head_lowres
    watch_matching(kept, predictor.corr_refine_net, head, encoder.config.candidates)
    kept.input("fullres_disparity", predictor.refine_unet, slice(-2, -1))
    kept.input("pdf_max_fullres", predictor.refine_unet, slice(-1, None))
    watch_unet(kept, "depth_unet", predictor.refine_unet[3])


def watch_depthsplat(kept: Recorder, encoder: DepthSplatEncoder, low: tuple[int, ...]) -> None:
    """Record all modules whose output is in the golden file. low: size of the feature maps."""
    network = encoder.network
    predictor = network.depth_predictor
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
        count = predictor.candidates(scale)
        watch_matching(kept, predictor.regressor[scale], predictor.depth_head[scale], count, scale)
    kept.output("raw_gaussians", network.gaussian_head, lambda x: kept.shaped(x).movedim(2, -1))
    kept.input("match_probability_max", network.gaussian_regressor, slice(4, 5))


def watch_matching(
    kept: Recorder, regressor: Any, head: nn.Module, count: int, scale: int = 0
) -> None:
    """Record the networks that correct a cost volume with `count` candidates and match views."""
    kept.input(f"cost_volume.{scale}", regressor, slice(count))
    kept.output(f"cost_unet.{scale}.stem", regressor[2])
    watch_unet(kept, f"cost_unet.{scale}", regressor[3])
    kept.output(f"cost_unet_out.{scale}", regressor)
    kept.input(f"cost_volume_refined.{scale}", head)
    kept.output(f"match_logits.{scale}", head)


def of_sweep(found: Tensors, sweep: Sweep, counts: Sequence[int], step: int = 1) -> None:
    """Add to `found` the tensors of a sweep that no module outputs, by the names of DepthSplat.

    counts: number of candidates at each scale. step: the file has the warp of each `step`-th one.
    """
    shape = sweep.near.shape
    poses = relative_poses(sweep.cameras.c2w, sweep.neighbours)
    candidates = evenly_spaced(*bounds(sweep), counts[0])
    coarsest = candidates.flatten(1).unflatten(0, shape)
    found["inverse_depth_candidates.0"] = coarsest
    low = found["cost_volume.0"].shape[-2:]
    found["warp_grid.0"] = warps(sweep.cameras, poses, low, coarsest[..., ::step])
    for scale in range(len(counts)):
        if scale:
            coarse = found["coarse_inverse_depth.0"].flatten(0, 1)
            candidates = finer_candidates(coarse, sweep, counts[0])
            found["inverse_depth_candidates.1"] = candidates.unflatten(0, shape)
        found[f"relative_pose.{scale}"] = poses
        logits = found[f"match_logits.{scale}"]
        found[f"match_probability.{scale}"] = logits.softmax(2)
        inverse = expected_disparity(logits.flatten(0, 1), candidates)[0]
        found[f"coarse_inverse_depth.{scale}"] = inverse.unflatten(0, shape)

"""Tensors of a golden file of MVSplat, computed by the components of qgs."""

from qgs_zoo.mvsplat.mvsplat import MVSplatEncoder
from qgs_zoo.mvsplat.sweep import (
    Sweep,
    cyclic_neighbours,
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

OUTPUTS = """
cnn.layer2                          backbone.backbone.layer2
features_cnn                        backbone.backbone.conv2
cost_unet.stem                      depth_predictor.corr_refine_net.2
cost_volume_unet                    depth_predictor.corr_refine_net
match_logits                        depth_predictor.depth_head_lowres
fullres_features                    depth_predictor.upsampler
projected_features                  depth_predictor.proj_feature
delta_disparity_and_density_logit   depth_predictor.to_disparity
"""
"""Lines with a name in the golden file and the encoder module whose output has this name."""


def mvsplat_tensors(golden: GoldenFile) -> dict[str, Tensor]:
    """Compute every output that a golden file has, by name."""
    model = model_of(golden)
    encoder = model.encoder
    assert isinstance(encoder, MVSplatEncoder)
    views = views_of(golden)
    near = golden.input("near")
    far = golden.input("far")
    low = tuple(side // 4 for side in views.cameras.size)
    kept = of_views(near.shape[1])
    watch(kept, encoder, low)
    raw = encoder.predict(views, near, far)
    found = kept.found
    count = encoder.config.candidates
    found["disparity_candidates"] = disparity = inverse_depth_candidates(near, far, count)
    found["match_pdf"] = found["match_logits"].softmax(2)
    neighbours = cyclic_neighbours(*near.shape, device=near.device)
    sweep = Sweep(views.cameras, neighbours, near, far)
    coarse = encoder.depth_predictor.match(found["features"], sweep)[0]
    found["coarse_disparity"] = coarse.unflatten(0, near.shape)
    found["relative_pose"] = poses = relative_poses(views.cameras.c2w, neighbours)
    found["warp_grid"] = warps(views, poses, low, disparity)
    found["shift_mask"] = shift_mask(*low, device=near.device)
    numbers = raw.movedim(2, -1)
    found |= gaussians(views, numbers, predicted(model, views, numbers))
    # The release keeps an axis of Gaussians a pixel here.
    for name in ("scales", "rotations"):
        found[name] = found[name][..., None, :]
    found["depth"] = numbers[..., :1].exp()
    found["density"] = numbers[..., 1:2].sigmoid()
    found["raw_gaussians"] = numbers[..., 2:]
    return found


def watch(kept: Recorder, encoder: MVSplatEncoder, low: tuple[int, ...]) -> None:
    """Record all modules whose input or output is in the golden file.

    low: size of the feature maps.
    """
    predictor = encoder.depth_predictor
    refined = predictor.corr_refine_net
    kept.outputs(encoder, OUTPUTS)
    watch_transformer(kept, encoder.backbone.transformer, low, "features")
    kept.input("cost_volume", refined, slice(encoder.config.candidates))
    watch_unet(kept, "cost_unet", refined[3])
    kept.input("cost_volume_refined", predictor.depth_head_lowres)
    kept.input("fullres_disparity", predictor.refine_unet, slice(-2, -1))
    kept.input("pdf_max_fullres", predictor.refine_unet, slice(-1, None))
    watch_unet(kept, "depth_unet", predictor.refine_unet[3])

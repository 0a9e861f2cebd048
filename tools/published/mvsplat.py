"""Every tensor of a golden file of MVSplat, computed by the components."""

import torch
from qgs_zoo.mvsplat.adapter import band_mask, camera_quaternions, turn_of_harmonics
from qgs_zoo.mvsplat.head import RayHead
from qgs_zoo.mvsplat.mvsplat import MVSplatEncoder, Sweep
from qgs_zoo.mvsplat.pixels import OnRays, PixelQueries
from qgs_zoo.mvsplat.sweep import (
    cyclic_neighbours,
    feature_lenses,
    inverse_depth_candidates,
    relative_poses,
    warp_grid,
)
from qgs_zoo.mvsplat.windows import shift_mask
from torch import Tensor

from published.files import GoldenFile
from published.splats import Recorder, views_of, weights_of
from qgs.contracts import ModelDims
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import ImageMemory, Views


def encoder_of(golden: GoldenFile) -> MVSplatEncoder:
    """The encoder with the options and the weights of a file."""
    options = golden.options("options")
    config = MVSplatEncoder.Config(
        candidates=options["num_depth_candidates"],
        cost_width=options["costvolume_unet_feat_dim"],
        cost_levels=len(options["costvolume_unet_channel_mult"]),
        depth_width=options["depth_unet_feat_dim"],
        depth_levels=len(options["depth_unet_channel_mult"]),
        near=1.0,
        far=100.0,
        features=options["d_feature"],
    )
    dims = ModelDims(11 + 3 * (options["gaussian_adapter"]["sh_degree"] + 1) ** 2, 1, 0)
    encoder = MVSplatEncoder(config, dims).eval()
    encoder.load_state_dict(weights_of(golden))
    return encoder


@torch.no_grad()
def mvsplat_tensors(golden: GoldenFile) -> dict[str, Tensor]:
    """Every output of a golden file."""
    encoder, views = encoder_of(golden), views_of(golden)
    near, far = golden.input("near"), golden.input("far")
    low = tuple(side // 4 for side in views.cameras.size)
    kept = Recorder(near.shape[1])
    watch(kept, encoder, low)
    raw = encoder.predict(views, near, far)
    found, count = kept.found, encoder.config.candidates
    found["disparity_candidates"] = disparity = inverse_depth_candidates(near, far, count)
    found["match_pdf"] = found["match_logits"].softmax(2)
    neighbours = cyclic_neighbours(*near.shape, device=near.device)
    sweep = Sweep(views.cameras, neighbours, near, far)
    coarse = encoder.depth_predictor.match(found["features"], sweep)[0]
    found["coarse_disparity"] = coarse.unflatten(0, near.shape)
    found["relative_pose"] = poses = relative_poses(views.cameras.c2w, neighbours)
    lens = feature_lenses(views.cameras, low)[:, :, None].expand(*poses.shape[:3], 4)
    depth = (1 / disparity)[:, :, None, :, None, None].expand(*poses.shape[:3], -1, *low)
    grid = warp_grid(*(x.flatten(0, 2) for x in (depth, lens, poses)))
    found["warp_grid"] = grid.unflatten(0, poses.shape[:3])
    found["shift_mask"] = shift_mask(*low, device=near.device)
    return found | gaussians(views, raw, encoder.dims)


def watch(kept: Recorder, encoder: MVSplatEncoder, low: tuple[int, ...]) -> None:
    """Hooks on all modules whose output or input a file has."""
    predictor, cnn = encoder.depth_predictor, encoder.backbone.backbone
    kept.output("cnn.layer2", cnn.layer2)
    kept.output("features_cnn", cnn.conv2)
    kept.transformer(encoder.backbone.transformer, low, "features")
    refined = predictor.corr_refine_net
    kept.input("cost_volume", refined, slice(encoder.config.candidates))
    kept.output("cost_unet.stem", refined[2])
    kept.unet("cost_unet", refined[3])
    kept.output("cost_volume_unet", refined)
    kept.input("cost_volume_refined", predictor.depth_head_lowres)
    kept.output("match_logits", predictor.depth_head_lowres)
    kept.output("fullres_features", predictor.upsampler)
    kept.output("projected_features", predictor.proj_feature)
    kept.input("fullres_disparity", predictor.refine_unet, slice(-2, -1))
    kept.input("pdf_max_fullres", predictor.refine_unet, slice(-1, None))
    kept.unet("depth_unet", predictor.refine_unet[3])
    kept.output("delta_disparity_and_density_logit", predictor.to_disparity)


def gaussians(views: Views, raw_BVCHW: Tensor, dims: ModelDims) -> dict[str, Tensor]:
    """Outputs behind the networks, by queries, head and centres."""
    raw, cameras = raw_BVCHW.movedim(2, -1), views.cameras
    count, size = cameras.shape[1], cameras.size
    memory = ImageMemory(raw.flatten(1, 3), grid=(count, *size))
    state = PixelQueries(PixelQueries.Config(), dims)(memory, views)
    out = RayHead(RayHead.Config(), dims)(state)
    means = OnRays(OnRays.Config(), dims)(out.offsets, state)
    factors = quat_to_matrix(out.quats) * out.scales[..., None, :]
    sh = raw[..., 11:].unflatten(-1, (3, -1))
    degree = round(sh.shape[-1] ** 0.5) - 1
    turn = turn_of_harmonics(cameras.c2w[..., :3, :3], degree) * band_mask(degree, cameras.c2w)
    row, column = torch.meshgrid(*(torch.arange(n) for n in size), indexing="ij")
    place = torch.stack([column, row], -1) + raw[..., 2:4].sigmoid()
    return {
        "depth": raw[..., :1].exp(),
        "density": raw[..., 1:2].sigmoid(),
        "raw_gaussians": raw[..., 2:],
        "ray_xy": place / torch.tensor([size[1], size[0]]),
        "means": means[:, :, 0],
        "covariances": (factors @ factors.mT)[:, :, 0],
        "opacities": out.opacities[..., 0],
        "scales": out.scales.unflatten(1, (count, *size)),
        "rotations": camera_quaternions(raw[..., 7:11])[..., None, :],
        "harmonics": torch.einsum("bvkl,bvhwxl->bvhwxk", turn, sh).flatten(1, 3),
    }

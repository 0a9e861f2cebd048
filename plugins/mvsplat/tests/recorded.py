"""Every tensor of a golden file of MVSplat, computed by the components."""

from typing import Any

import torch
from qgs_mvsplat.adapter import band_mask, camera_quaternions, turn_of_harmonics
from qgs_mvsplat.head import RayHead
from qgs_mvsplat.mvsplat import MVSplatEncoder
from qgs_mvsplat.pixels import OnRays, PixelQueries
from qgs_mvsplat.sweep import (
    cyclic_neighbours,
    feature_lenses,
    inverse_depth_candidates,
    relative_poses,
    warp_grid,
)
from qgs_mvsplat.windows import out_of_windows, shift_mask
from released import Released
from torch import Tensor, nn

from qgs.contracts import ModelDims
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import ImageMemory


class Recorder:
    """Outputs of modules by name, (B, V, ...)."""

    def __init__(self, views: int) -> None:
        self.views = views
        self.found: dict[str, Tensor] = {}

    def keep(self, name: str, x: Tensor) -> None:
        self.found[name] = x.detach().unflatten(0, (-1, self.views))

    def output(self, name: str, module: nn.Module) -> None:
        module.register_forward_hook(lambda _, __, out: self.keep(name, out))

    def input(self, name: str, module: nn.Module, channels: slice = slice(None)) -> None:
        module.register_forward_pre_hook(lambda _, given: self.keep(name, given[0][:, channels]))

    def windows(self, name: str, module: nn.Module, size: Any, shifted: bool) -> None:
        """The stream behind an attention in windows."""
        shift = (size[0] // 4, size[1] // 4) if shifted else (0, 0)

        def keep(_: Any, __: Any, out: Tensor) -> None:
            self.found[name] = out_of_windows(out, size, shift).permute(0, 1, 4, 2, 3)

        module.register_forward_hook(keep)

    def unet(self, name: str, unet: Any) -> None:
        """Blocks, and each attention with what it has before its projection."""
        for part in ("input_blocks", "output_blocks", "middle_block"):
            for index, block in enumerate(getattr(unet, part)):
                self.output(f"{name}.{part}.{index}", block)
                inside = list(block) if part != "middle_block" else []
                if len(inside) > 1 and hasattr(inside[1], "qkv"):
                    self.output(f"{name}.{part}.{index}.1", inside[1])
                    self.input(f"{name}.{part}.{index}.1.attention", inside[1].proj_out)
        self.output(f"{name}.out", unet.out)


def encoder_of(released: Released) -> MVSplatEncoder:
    """The encoder with the options and the weights of a file."""
    options = released.options
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
    encoder = MVSplatEncoder(config, dims_of(released)).eval()
    encoder.load_state_dict(released.weights())
    return encoder


def dims_of(released: Released) -> ModelDims:
    """The model is as wide as a pixel has numbers."""
    return ModelDims(11 + 3 * (released.options["gaussian_adapter"]["sh_degree"] + 1) ** 2, 1, 0)


@torch.no_grad()
def recorded(released: Released) -> dict[str, Tensor]:
    """Every output of a golden file."""
    encoder, views = encoder_of(released), released.views()
    near, far = released.tensors["near"], released.tensors["far"]
    count, (height, width) = near.shape[1], views.cameras.size
    low = (height // 4, width // 4)
    kept, predictor = Recorder(count), encoder.depth_predictor
    cnn, transformer = encoder.backbone.backbone, encoder.backbone.transformer
    kept.output("cnn.layer2", cnn.layer2)
    kept.output("features_cnn", cnn.conv2)
    for index, layer in enumerate(transformer.layers):
        kept.windows(f"transformer_self.{index}", layer.self_attn, low, bool(index % 2))
        kept.windows(f"transformer.{index + 1}", layer, low, bool(index % 2))
    transformer.register_forward_pre_hook(
        lambda _, given: kept.found.update({"transformer.0": given[0]})
    )
    transformer.register_forward_hook(lambda _, __, out: kept.found.update({"features": out}))
    candidates = encoder.config.candidates
    kept.input("cost_volume", predictor.corr_refine_net, slice(candidates))
    kept.output("cost_unet.stem", predictor.corr_refine_net[2])
    kept.unet("cost_unet", predictor.corr_refine_net[3])
    kept.output("cost_volume_unet", predictor.corr_refine_net)
    kept.input("cost_volume_refined", predictor.depth_head_lowres)
    kept.output("match_logits", predictor.depth_head_lowres)
    kept.output("fullres_features", predictor.upsampler)
    kept.output("projected_features", predictor.proj_feature)
    kept.input("fullres_disparity", predictor.refine_unet, slice(-2, -1))
    kept.input("pdf_max_fullres", predictor.refine_unet, slice(-1, None))
    kept.unet("depth_unet", predictor.refine_unet[3])
    kept.output("delta_disparity_and_density_logit", predictor.to_disparity)
    raw = encoder.predict(views, near, far)
    found = kept.found
    disparity = inverse_depth_candidates(near, far, candidates)
    found["disparity_candidates"] = disparity
    found["match_pdf"] = found["match_logits"].softmax(2)
    found["coarse_disparity"] = predictor.match(found["features"], sweep_of(released))[0].unflatten(
        0, (-1, count)
    )
    neighbours = cyclic_neighbours(*near.shape)
    found["relative_pose"] = poses = relative_poses(views.cameras.c2w, neighbours)
    lens = feature_lenses(views.cameras, low)[:, :, None].expand(*poses.shape[:3], 4)
    depth = (1 / disparity)[:, :, None, :, None, None].expand(*poses.shape[:3], -1, *low)
    grid = warp_grid(*(x.flatten(0, 2) for x in (depth, lens, poses)))
    found["warp_grid"] = grid.unflatten(0, poses.shape[:3])
    found["shift_mask"] = shift_mask(*low)
    return found | gaussians(released, raw)


def sweep_of(released: Released) -> Any:
    from qgs_mvsplat.mvsplat import Sweep

    near, far = released.tensors["near"], released.tensors["far"]
    return Sweep(released.views().cameras, cyclic_neighbours(*near.shape), near, far)


def gaussians(released: Released, raw_BVCHW: Tensor) -> dict[str, Tensor]:
    """Outputs behind the networks, by queries, head and centres."""
    cameras, degree = released.views().cameras, released.options["gaussian_adapter"]["sh_degree"]
    views, size = cameras.shape[1], cameras.size
    raw = raw_BVCHW.movedim(2, -1)
    memory = ImageMemory(raw.flatten(1, 3), grid=(views, *size))
    dims = dims_of(released)
    state = PixelQueries(PixelQueries.Config(), dims)(memory, released.views())
    out = RayHead(RayHead.Config(), dims)(state)
    means = OnRays(OnRays.Config(), dims)(out.offsets, state)
    factors = quat_to_matrix(out.quats) * out.scales[..., None, :]
    turn = turn_of_harmonics(cameras.c2w[..., :3, :3], degree) * band_mask(degree)
    sh = raw[..., 11:].unflatten(-1, (3, -1))
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
        "scales": out.scales.unflatten(1, (views, *size)),
        "rotations": camera_quaternions(raw[..., 7:11])[..., None, :],
        "harmonics": torch.einsum("bvkl,bvhwxl->bvhwxk", turn, sh).flatten(1, 3),
    }

"""Tensors of a golden file of a model, which is built to fit the weights in the file.

Names of tensors: tokens.l and anchor_*.l are the state after l layers; other names that end in .i
are inside layer i, counted from 0.
"""

from typing import Any

import torch
from qgs_locus.anchors import AnchoredQueries
from qgs_locus.cross_attention import RayBiasedCrossAttention
from qgs_locus.fields import CENTER, RAW_RADIUS, support_radius
from qgs_locus.self_attention import AnchorAwareSelfAttention
from qgs_zoo.tokengs2026.multiscale import LatentBottleneck, time_features
from torch import Tensor

from published.files import GoldenFile, Tensors
from published.splats import Recorder, model_of
from qgs.geometry.rays import camera_rays, plucker_rays
from qgs.model import QueryGaussianModel
from qgs.tokengs import CrossSelfMlp
from qgs.tokengs.encoder import PatchViT, imagenet_normalised
from qgs.types import Cameras, Gaussians, ImageMemory, QueryState, Views

TIMES = ("times", "target_time")
TUNED = "tuned_latents"


def golden_tensors(golden: GoldenFile) -> Tensors:
    """Compute all tensors that a golden file may hold, by its model on its photos and cameras."""
    model = model_of(golden)
    size = golden.config["options"]["img_size"]
    cameras = Cameras(golden.input("c2w"), golden.input("intrinsics"), tuple(size))
    times = (golden.input(name) if name in golden.tensors else None for name in TIMES)
    views = Views(golden.input("rgb"), cameras, None, *times)
    kept = Recorder()
    watch(kept, model)
    memory = model.encoder(views)
    state = model.queries(memory, views)
    prediction = model.predict(views, memory, state, range(1, model.depth + 1))
    found = kept.found | of_views(views, model) | {"gaussians": packed(prediction.gaussians)}
    found |= {"keys": memory["keys"], "values": memory["values"]}
    if memory.patch_rays is not None:
        # Then its features are those of image tokens.
        found |= {"encoder_features": memory.features, "plucker_patch": memory.patch_rays}
    found |= of_state(model, memory, state, 0)
    for number, layer in prediction.layers.items():
        found[f"gaussians_layer.{number}"] = packed(layer.gaussians)
        found |= of_state(model, memory, layer.state, number)
    if TUNED in golden.tensors:
        # Latents to decode in place of those that the photos give.
        memory = model.encoder.project(golden.input(TUNED), memory)
        found["gaussians_of_tuned_latents"] = packed(model.predict(views, memory, state).gaussians)
    return found


def watch(kept: Recorder, model: QueryGaussianModel) -> None:
    """Record the outputs of modules inside the encoder and the decoder layers."""
    encoder = model.encoder
    assert isinstance(encoder, PatchViT)
    kept.input("encoder_in", encoder.blocks[0])
    if isinstance(encoder, LatentBottleneck):
        kept.input("encoder_features", encoder.feature_kv_proj)
        kept.input("scene_latents.0", encoder.latent_blocks[0])
        for index, block in enumerate(encoder.latent_blocks):
            kept.output(f"latent_cross_attn_out.{index}", block.get_submodule("cross_attention"))
            kept.output(f"latent_self_attn_out.{index}", block.get_submodule("self_attention"))
            kept.output(f"scene_latents.{index + 1}", block)
    for index, layer in enumerate(model.decoder):
        assert isinstance(layer, CrossSelfMlp)
        kept.output(f"cross_attn_out.{index}", layer.cross_attention)
        kept.output(f"self_attn_out.{index}", layer.self_attention)
        if isinstance(layer.self_attention, AnchorAwareSelfAttention):
            kept.input(f"anchor_sine.{index}", layer.self_attention.position_mlp)
            kept.output(f"anchor_pe.{index}", layer.self_attention.position_mlp)


def of_views(views: Views, model: QueryGaussianModel) -> Tensors:
    """Return the inputs of the encoder's network by name: photos, rays and times."""
    origins, directions = camera_rays(views.cameras)
    found = {
        "images": imagenet_normalised(views.images),
        "rays_o": origins.movedim(-1, -3),  # channels before pixels
        "rays_d": directions.movedim(-1, -3),
        "plucker": plucker_rays(views.cameras),
    }
    channels = getattr(model.encoder.config, "time_channels", 0)
    for name, times in (("input", views.times), ("target", views.target_time)):
        if times is not None and channels:
            found[f"time_embedding_{name}"] = time_features(times, channels)
    return found


def of_state(
    model: QueryGaussianModel, memory: ImageMemory, state: QueryState, number: int
) -> Tensors:
    """Return the state after `number` layers, and the attention bias of the next layer."""
    found = {f"tokens.{number}": state.features}
    queries = model.queries
    if isinstance(queries, AnchoredQueries):
        found[f"anchor_center.{number}"] = state[CENTER]
        if queries.config.radius:
            found[f"anchor_radius.{number}"] = support_radius(state[RAW_RADIUS], queries.config)
    following: Any = model.decoder[number] if number < len(model.decoder) else None
    attention = getattr(following, "cross_attention", None)
    if isinstance(attention, RayBiasedCrossAttention):
        found[f"geo_gamma.{number}"] = attention.gamma
        found[f"geo_bias.{number}"] = attention.bias(state, memory).dense() / attention.gamma
    return found


def packed(g: Gaussians) -> Tensor:
    """Return all attributes of Gaussians in one tensor, as in the published code."""
    return torch.cat([g.means, g.opacities[..., None], g.scales, g.quats, g.colors], -1)

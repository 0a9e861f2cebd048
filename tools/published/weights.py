"""Published weight names to ours."""

from __future__ import annotations

import re

from torch import Tensor

RENAMES = [
    (r"^patch_embed\.", "encoder.rgb_embedding."),
    (r"^patch_plucker_embed\.", "encoder.ray_embedding."),
    (r"^enc_dec_backbone\.encoder_norm\.", "encoder.norm."),
    (r"^enc_dec_backbone\.kv_proj\.", "encoder.kv_proj."),
    (r"^enc_dec_backbone\.k_proj_norm\.", "encoder.k_norm."),
    (r"^enc_dec_backbone\.encoder\.(\d+)\.attn\.", r"encoder.blocks.\1.attention."),
    (r"^enc_dec_backbone\.encoder\.(\d+)\.ls([12])\.", r"encoder.blocks.\1.scale\2."),
    (r"^enc_dec_backbone\.encoder\.", "encoder.blocks."),
    (r"^enc_dec_backbone\.decoder_blocks\.", "decoder."),
    (r"\.gs_cross_attn\.gs_token_norm\.", ".cross_attention.core.norm."),
    (r"\.gs_cross_attn\.q_(?:content_)?proj\.", ".cross_attention.core.q_proj."),
    (r"\.gs_cross_attn\.(q_norm|out_proj)\.", r".cross_attention.core.\1."),
    (r"\.gs_cross_attn\.geo_scale$", ".cross_attention.raw_gamma"),
    (r"\.gs_cross_attn_scale\.", ".cross_scale."),
    (r"\.gs_self_attn\.norm\.", ".self_attention.norm."),
    (r"\.gs_self_attn\.gs_self_attn\.", ".self_attention.attention."),
    (r"\.gs_self_attn_scale\.", ".self_scale."),
    (r"\.anchor_head_self_attn\.", ".self_attention.position_mlp."),
    (r"^(decoder\.\d+)\.mlp\.norm\.", r"\1.feed_forward.norm."),
    (r"^(decoder\.\d+)\.mlp\.mlp\.", r"\1.feed_forward.mlp."),
    (r"^(decoder\.\d+)\.mlp_scale\.", r"\1.feed_forward_scale."),
    (r"^gs_tokens$", "queries.features"),
    (r"^gs_anchor_xyz_raw$", "queries.center"),
    (r"^gs_anchor_radius_raw$", "queries.raw_radius"),
    (r"^xyz_embed\.", "refinements.0.center_mlp."),
    (r"^radius_embed\.", "refinements.0.radius_mlp."),
    (r"^activation_head\.deconv\.", "head.linear."),
]

UNUSED = re.compile(r"\.(anchor_norm|plucker_norm|q_pos_norm|k_pos_norm)\.|\.tau_sample$")
"""Parameters that the published LocusGS carries and never uses."""


def renamed(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """A published state dict under our parameter names, unused parameters left out."""
    found = {}
    for key, tensor in weights.items():
        if not UNUSED.search(key):
            name = key
            for pattern, replacement in RENAMES:
                name = re.sub(pattern, replacement, name)
            found[name] = tensor
    return found

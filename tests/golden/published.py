"""Reading the golden files: options to a recipe, published weight names to ours."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from safetensors import safe_open
from torch import Tensor

GOLDEN = Path(__file__).parent

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


def read_golden(name: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and metadata of a golden file."""
    with safe_open(GOLDEN / f"{name}.safetensors", "pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        return tensors, json.loads(file.metadata()["config"])


def our_weights(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The published `weights.*` of a golden file under our parameter names."""
    weights = {}
    for key, tensor in tensors.items():
        if key.startswith("weights.") and not UNUSED.search(key):
            name = key.removeprefix("weights.")
            for pattern, replacement in RENAMES:
                name = re.sub(pattern, replacement, name)
            weights[name] = tensor
    return weights


def recipe_of(config: dict[str, Any]) -> dict[str, Any]:
    """The recipe of the model that a golden file was computed with."""
    return (_tokengs if config["kind"] == "tokengs" else _locusgs)(config)


def _tokengs(config: dict[str, Any]) -> dict[str, Any]:
    options = config["options"]
    return {
        "recipe": 1,
        "model": {
            "width": options["enc_embed_dim"],
            "heads": options["enc_num_heads"],
            "encoder": {
                "patch_size": options["patch_size"],
                "depth": options["enc_depth"],
                "mlp_ratio": options["mlp_ratio"],
            },
            "queries": {"type": "qgs/latent", "count": options["num_gs_tokens"]},
            "decoder": {"depth": options["dec_depth"]},
            "head": {
                "gaussians_per_query": config["gaussians_per_token"],
                "scale_cap": options["gaussian_scale_cap"],
                "scale_input_limit": None,
                "quat_eps": 1e-12,
            },
            "centers": {
                "type": "qgs/free",
                "z_offset": options["gaussian_z_offset"],
                "input_limit": None,
                "output_limit": None,
            },
            "supervision": {"layers": [options["dec_depth"]]},
        },
    }


def _locusgs(config: dict[str, Any]) -> dict[str, Any]:
    options = config["options"]
    recipe = _tokengs(config)
    model, decoder = recipe["model"], recipe["model"]["decoder"]
    recipe["plugins"] = ["locus"]
    model["queries"] = {
        "type": "locus/anchored",
        "count": options["num_gs_tokens"],
        "radius": options["use_anchor_radius"],
    }
    decoder["refinement"] = {
        "type": "locus/refine",
        "radius": options["anchor_radius_refinement"],
    }
    if options["cross_attn_variant"] != "content_only":
        bandwidth = "radius" if options["anchor_radius_affects_bias"] else "fixed"
        decoder["cross_attention"] = {"type": "locus/ray_biased", "bandwidth": bandwidth}
    if options["self_attn_variant"] != "content_only":
        decoder["self_attention"] = {"type": "locus/anchor_aware"}
    model["centers"] = {
        "free_center": {"type": "qgs/free", "z_offset": 0.0},
        "anchor_offset": {"type": "locus/anchor_offset"},
        "radius_scaled_offset": {"type": "locus/radius_scaled"},
    }[options["gaussian_center_variant"]]
    for option in ("scale_input_limit", "quat_eps"):
        del model["head"][option]
    model["supervision"] = {"layers": options["anchor_supervision_layers"]}
    return recipe

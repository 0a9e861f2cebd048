"""Layout of TokenGS: published names of weights, and the recipe that fits a state dict."""

from typing import Any

from qgs.checkpoint.tensors import Shapes
from qgs.tokengs.head import CHANNELS
from qgs_research.published.weight_layout import (
    WeightLayout,
    layer_count,
    real_ratio,
    size_at,
    whole_ratio,
)

ENCODER = "enc_dec_backbone.encoder."
DECODER = "enc_dec_backbone.decoder_blocks."

BACKBONE_RENAMES = {
    "encoder.rgb_embedding.": "patch_embed.",
    "encoder.ray_embedding.": "patch_plucker_embed.",
    "encoder.norm.": "enc_dec_backbone.encoder_norm.",
    "encoder.kv_proj.": "enc_dec_backbone.kv_proj.",
    "encoder.k_norm.": "enc_dec_backbone.k_proj_norm.",
    "encoder.blocks.{}.attention.": ENCODER + "{}.attn.",
    "encoder.blocks.{}.scale1.": ENCODER + "{}.ls1.",
    "encoder.blocks.{}.scale2.": ENCODER + "{}.ls2.",
    "encoder.blocks.{}.norm1.": ENCODER + "{}.norm1.",
    "encoder.blocks.{}.norm2.": ENCODER + "{}.norm2.",
    "encoder.blocks.{}.mlp.": ENCODER + "{}.mlp.",
    "queries.features": "gs_tokens",
    "decoder.{}.cross_attention.core.norm.": DECODER + "{}.gs_cross_attn.gs_token_norm.",
    "decoder.{}.cross_attention.core.q_norm.": DECODER + "{}.gs_cross_attn.q_norm.",
    "decoder.{}.cross_attention.core.out_proj.": DECODER + "{}.gs_cross_attn.out_proj.",
    "decoder.{}.cross_scale.": DECODER + "{}.gs_cross_attn_scale.",
    "decoder.{}.self_attention.norm.": DECODER + "{}.gs_self_attn.norm.",
    "decoder.{}.self_attention.attention.": DECODER + "{}.gs_self_attn.gs_self_attn.",
    "decoder.{}.self_scale.": DECODER + "{}.gs_self_attn_scale.",
    "decoder.{}.feed_forward.norm.": DECODER + "{}.mlp.norm.",
    "decoder.{}.feed_forward.mlp.": DECODER + "{}.mlp.mlp.",
    "decoder.{}.feed_forward_scale.": DECODER + "{}.mlp_scale.",
    "head.linear.": "activation_head.deconv.",
}
"""Names that TokenGS and models built on it have in common."""

CROSS_QUERY = {
    "decoder.{}.cross_attention.core.q_proj.": DECODER + "{}.gs_cross_attn.q_proj.",
}


def backbone(shapes: Shapes, queries: str) -> dict[str, Any]:
    """Return the part of `model` that TokenGS and models built on it share; raises LayoutError.

    queries: the `type` of the queries.
    """
    count = size_at(shapes, "gs_tokens", 0)
    width = size_at(shapes, "gs_tokens", 1)
    head_width = size_at(shapes, "enc_dec_backbone.k_proj_norm.weight", 0)
    channels = size_at(shapes, "activation_head.deconv.weight", 0)
    encoder = {
        "type": "qgs/multiview_vit",
        "patch_size": size_at(shapes, "patch_embed.proj.weight", -1),
        "depth": layer_count(shapes, ENCODER),
    }
    if encoder["depth"]:
        hidden = size_at(shapes, ENCODER + "0.mlp.fc1.weight", 0)
        encoder["mlp_ratio"] = real_ratio(hidden, width, "hidden width of the encoder's MLP")
    hidden = size_at(shapes, DECODER + "0.mlp.mlp.fc1.weight", 0)
    ratio = real_ratio(hidden, width, "hidden width of the decoder's MLP")
    gaussians = whole_ratio(channels, sum(CHANNELS), "channels of the head")
    return {
        "width": width,
        "heads": whole_ratio(width, head_width, "width over the width of one head"),
        "encoder": encoder,
        "queries": {"type": queries, "count": count},
        "decoder": {
            "depth": layer_count(shapes, DECODER),
            "feed_forward": {"type": "qgs/mlp", "ratio": ratio},
        },
        "head": {"type": "qgs/gaussian_head", "gaussians_per_query": gaussians},
    }


def read_tokengs(shapes: Shapes) -> dict[str, Any]:
    """Return the recipe of a TokenGS from its names and shapes; raises LayoutError."""
    model = backbone(shapes, "qgs/latent")
    model["decoder"] |= {
        "cross_attention": {"type": "qgs/content"},
        "self_attention": {"type": "qgs/content"},
        "refinement": {"type": "qgs/none"},
    }
    model["head"] |= {"scale_input_limit": None, "quat_eps": 1e-12}
    unlimited = {"input_limit": None, "output_limit": None}
    model["centers"] = {"type": "qgs/free", "z_offset": 1.0, **unlimited}
    model["supervision"] = {"type": "qgs/layers", "layers": [model["decoder"]["depth"]]}
    return {"recipe": 1, "model": model}


TOKENGS = WeightLayout(
    name="TokenGS",
    plugin="qgs",
    source="nv-tlabs/TokenGS",
    components={
        "encoder": ("qgs/multiview_vit",),
        "queries": ("qgs/latent",),
        "cross_attention": ("qgs/content",),
        "self_attention": ("qgs/content",),
        "feed_forward": ("qgs/mlp",),
        "refinement": ("qgs/none",),
        "head": ("qgs/gaussian_head",),
        "centers": ("qgs/free",),
    },
    renames=BACKBONE_RENAMES | CROSS_QUERY,
    marks=(DECODER + "0.gs_cross_attn.q_proj.weight",),
    read=read_tokengs,
    undecided=(
        "activations of the head and of the positions, their clamps and epsilons: as in TokenGS",
        "supervised layers: the last",
        "scale and frame of the world, losses, renderer, training: the framework's defaults",
    ),
)
"""Layout of the released TokenGS before its version of June 2026."""

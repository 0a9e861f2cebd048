"""The weights of TokenGS: published names, and the recipe that fits a state dict."""

from typing import Any

from qgs.components.head import CHANNELS
from qgs.contracts.weights import (
    LayoutError,
    Rename,
    Shapes,
    WeightLayout,
    layer_count,
    real_ratio,
    size_at,
    whole_ratio,
)

ENCODER = "enc_dec_backbone.encoder."
DECODER = "enc_dec_backbone.decoder_blocks."
READOUT = "enc_dec_backbone.multiscale_norms."
DYNAMIC, TIME, TARGET_TIME = "gs_tokens_dynamic", "patch_time_embed", "patch_time_embed_tgt"
LATENTS = "enc_dec_backbone.latents"
LATENT_BLOCK = "enc_dec_backbone.latent_blocks."

BACKBONE_RENAMES = (
    Rename("encoder.rgb_embedding.", "patch_embed."),
    Rename("encoder.ray_embedding.", "patch_plucker_embed."),
    Rename("encoder.norm.", "enc_dec_backbone.encoder_norm."),
    Rename("encoder.kv_proj.", "enc_dec_backbone.kv_proj."),
    Rename("encoder.k_norm.", "enc_dec_backbone.k_proj_norm."),
    Rename("encoder.blocks.{}.attention.", ENCODER + "{}.attn."),
    Rename("encoder.blocks.{}.scale1.", ENCODER + "{}.ls1."),
    Rename("encoder.blocks.{}.scale2.", ENCODER + "{}.ls2."),
    Rename("encoder.blocks.{}.norm1.", ENCODER + "{}.norm1."),
    Rename("encoder.blocks.{}.norm2.", ENCODER + "{}.norm2."),
    Rename("encoder.blocks.{}.mlp.", ENCODER + "{}.mlp."),
    Rename("queries.features", "gs_tokens"),
    Rename("decoder.{}.cross_attention.core.norm.", DECODER + "{}.gs_cross_attn.gs_token_norm."),
    Rename("decoder.{}.cross_attention.core.q_norm.", DECODER + "{}.gs_cross_attn.q_norm."),
    Rename("decoder.{}.cross_attention.core.out_proj.", DECODER + "{}.gs_cross_attn.out_proj."),
    Rename("decoder.{}.cross_scale.", DECODER + "{}.gs_cross_attn_scale."),
    Rename("decoder.{}.self_attention.norm.", DECODER + "{}.gs_self_attn.norm."),
    Rename("decoder.{}.self_attention.attention.", DECODER + "{}.gs_self_attn.gs_self_attn."),
    Rename("decoder.{}.self_scale.", DECODER + "{}.gs_self_attn_scale."),
    Rename("decoder.{}.feed_forward.norm.", DECODER + "{}.mlp.norm."),
    Rename("decoder.{}.feed_forward.mlp.", DECODER + "{}.mlp.mlp."),
    Rename("decoder.{}.feed_forward_scale.", DECODER + "{}.mlp_scale."),
    Rename("head.linear.", "activation_head.deconv."),
)
"""Names that TokenGS and the models built on it share."""

LATENT_RENAMES = (
    Rename("encoder.time_embedding.", "patch_time_embed."),
    Rename("queries.time_embedding.", "patch_time_embed_tgt."),
    Rename("queries.dynamic", DYNAMIC),
    Rename("encoder.norms.{}.", READOUT + "{}."),
    Rename("encoder.latents", LATENTS),
    Rename("encoder.feature_kv_proj.", "enc_dec_backbone.latent_feature_kv_proj."),
    Rename("encoder.feature_k_norm.", "enc_dec_backbone.latent_feature_k_norm."),
    Rename("encoder.latent_kv_proj.", "enc_dec_backbone.latent_kv_proj."),
    *(
        Rename(f"encoder.latent_blocks.{{}}.{ours}", LATENT_BLOCK + f"{{}}.{theirs}")
        for ours, theirs in (
            ("cross_attention.norm.", "gs_cross_attn.gs_token_norm."),
            ("cross_attention.", "gs_cross_attn."),
            ("cross_scale.", "gs_cross_attn_scale."),
            ("self_norm.", "gs_self_attn.norm."),
            ("self_attention.", "gs_self_attn.gs_self_attn."),
            ("self_scale.", "gs_self_attn_scale."),
            ("mlp_norm.", "mlp.norm."),
            ("mlp.", "mlp.mlp."),
            ("mlp_scale.", "mlp_scale."),
        )
    ),
)
"""Names in TokenGS 2026.6: times, dynamic queries, the readout of several blocks, latents."""

"""Options that follow from the names and shapes of the parameters."""


def backbone(shapes: Shapes, queries: str) -> dict[str, Any]:
    """The part of `model` that TokenGS and the models built on it share; raises LayoutError.

    queries: the `type` of its queries.
    """
    count, width = size_at(shapes, "gs_tokens", 0), size_at(shapes, "gs_tokens", 1)
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


def _read(shapes: Shapes) -> dict[str, Any]:
    model = backbone(shapes, "qgs/latent")
    later = _encoder_of_2026_6(shapes, model["encoder"]["depth"])
    model["encoder"] |= later
    model["decoder"] |= {
        "cross_attention": {"type": "qgs/content"},
        "self_attention": {"type": "qgs/content"},
        "refinement": {"type": "qgs/none"},
    }
    _read_times(shapes, model)
    model["head"] |= {"scale_input_limit": None, "quat_eps": 1e-12}
    unlimited = {"input_limit": None, "output_limit": None}
    model["centers"] = {"type": "qgs/free", "z_offset": 0.0 if later else 1.0, **unlimited}
    model["supervision"] = {"type": "qgs/layers", "layers": [model["decoder"]["depth"]]}
    tree: dict[str, Any] = {"recipe": 1, "model": model}
    tree |= {"views": {"frame": "mean_cam"}} if later else {}
    return tree | ({"evaluation": {"tuning": "latents"}} if LATENTS in shapes else {})


def _read_times(shapes: Shapes, model: dict[str, Any]) -> None:
    """Change `model` to what reads the times of photos, and to queries of the moment asked for."""

    def channels(module: str) -> int:
        name = f"{module}.proj.weight"
        return size_at(shapes, name, 1) if name in shapes else 0

    model["encoder"] |= {"time_channels": channels(TIME)}
    dynamic = size_at(shapes, DYNAMIC, 0) if DYNAMIC in shapes else 0
    if dynamic:
        model["decoder"]["self_attention"] = {"type": "qgs/block_causal"}
    if dynamic or channels(TARGET_TIME):
        count, patch = model["queries"]["count"] + dynamic, model["encoder"]["patch_size"]
        sizes = {"count": count, "dynamic": dynamic, "patch_size": patch}
        times = {"time_channels": channels(TARGET_TIME)}
        model["queries"] = {"type": "qgs/dynamic", **sizes, **times}


def _encoder_of_2026_6(shapes: Shapes, depth: int) -> dict[str, Any]:
    """What the encoder, of `depth` blocks, has besides; nothing if it is none of 2026.6."""
    scales = layer_count(shapes, READOUT)
    if not scales and LATENTS in shapes:  # published with `use_multiscale_encoder: False`
        raise LayoutError(
            f"{LATENTS} without {READOUT}0: latents that read the last block alone name its norm "
            f"enc_dec_backbone.encoder_norm; rename that to {READOUT}0 in the file"
        )
    if not scales:
        return {}
    if scales > depth:
        raise LayoutError(f"{READOUT}: {scales} norms, one for each block read, of {depth} blocks")
    step = 2 if 2 * scales <= depth + 1 else 1
    found: dict[str, Any] = {"blocks": list(range(depth - step * (scales - 1), depth + 1, step))}
    if LATENTS not in shapes:
        return {"type": "qgs/multiscale_vit", **found}
    blocks = layer_count(shapes, LATENT_BLOCK)
    found |= {"latents": size_at(shapes, LATENTS, 0), "latent_depth": blocks}
    return {"type": "qgs/latent_bottleneck", **found}


TOKENGS = WeightLayout(
    name="TokenGS",
    source="nv-tlabs/TokenGS",
    components={
        "encoder": ("qgs/multiview_vit", "qgs/multiscale_vit", "qgs/latent_bottleneck"),
        "queries": ("qgs/latent", "qgs/dynamic"),
        "cross_attention": ("qgs/content",),
        "self_attention": ("qgs/content", "qgs/block_causal"),
        "feed_forward": ("qgs/mlp",),
        "refinement": ("qgs/none",),
        "head": ("qgs/gaussian_head",),
        "centers": ("qgs/free",),
    },
    renames=(
        *BACKBONE_RENAMES,
        *LATENT_RENAMES,
        Rename("decoder.{}.cross_attention.core.q_proj.", DECODER + "{}.gs_cross_attn.q_proj."),
    ),
    marks=(DECODER + "0.gs_cross_attn.q_proj.weight",),
    read=_read,
    undecided=(
        "activations of the head and of the positions, their clamps and epsilons: TokenGS's",
        "blocks that an encoder of 2026.6 reads: every second one up to the last",
        "supervised layers: the last",
        "frame of the world: the mean camera for encoders of 2026.6, else the first",
        "scale of the world, losses, renderer, training: the framework's defaults",
    ),
)
"""The released TokenGS, up to 2026.6."""

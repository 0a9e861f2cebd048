"""Published weights of TokenGS, LocusGS and TokenGS 2026.6: names, and recipes that fit."""

from qgs.checkpoint.tensors import Shapes
from qgs.tokengs.head import CHANNELS
from qgs_research.published.weight_layout import (
    LayoutError,
    Tree,
    layer_count,
    layout,
    real_ratio,
    size_at,
    whole_ratio,
)

ENCODER = "enc_dec_backbone.encoder."
DECODER = "enc_dec_backbone.decoder_blocks."
READOUT = "enc_dec_backbone.multiscale_norms."
DYNAMIC = "gs_tokens_dynamic"
LATENTS = "enc_dec_backbone.latents"
LATENT_BLOCK = "enc_dec_backbone.latent_blocks."


def backbone(shapes: Shapes, queries: str) -> Tree:
    """Return the options of `model` that TokenGS shares with models built on it.

    queries: component type of `model.queries`. Raises LayoutError for shapes that do not fit.
    """
    count = size_at(shapes, "gs_tokens")
    width = size_at(shapes, "gs_tokens", 1)
    head_width = size_at(shapes, "enc_dec_backbone.k_proj_norm.weight")
    channels = size_at(shapes, "activation_head.deconv.weight")
    encoder = {
        "type": "qgs/multiview_vit",
        "patch_size": size_at(shapes, "patch_embed.proj.weight", -1),
        "depth": layer_count(shapes, ENCODER),
    }
    if encoder["depth"]:
        hidden = size_at(shapes, ENCODER + "0.mlp.fc1.weight")
        encoder["mlp_ratio"] = real_ratio(hidden, width, "hidden width of the encoder's MLP")
    hidden = size_at(shapes, DECODER + "0.mlp.mlp.fc1.weight")
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


def read_tokengs(shapes: Shapes) -> Tree:
    """Return the recipe that fits the weights of a TokenGS. Raises LayoutError if none fits."""
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


TOKENGS = layout("tokengs", read_tokengs)


def _read_locus(shapes: Shapes) -> Tree:
    # The ablations of the paper omit parts, so the names that exist determine the variant.
    radius = "gs_anchor_radius_raw" in shapes
    ray_biased = DECODER + "0.gs_cross_attn.geo_scale" in shapes
    anchor_aware = DECODER + "0.anchor_head_self_attn.fc1.weight" in shapes
    model = backbone(shapes, "locus/anchored")
    model["queries"]["radius"] = radius
    bandwidth = {"bandwidth": "radius" if radius else "fixed"}
    biased = {"type": "locus/ray_biased", **bandwidth}
    model["decoder"] |= {
        "cross_attention": biased if ray_biased else {"type": "qgs/content"},
        "self_attention": {"type": "locus/anchor_aware" if anchor_aware else "qgs/content"},
        "refinement": {"type": "locus/refine", "radius": "radius_embed.fc1.weight" in shapes},
    }
    model["centers"] = {"type": "locus/radius_scaled" if radius else "locus/anchor_offset"}
    # No tensor shows which layers were supervised; the paper uses the middle and the last layer.
    depth = model["decoder"]["depth"]
    model["supervision"] = {"type": "qgs/layers", "layers": sorted({(depth + 1) // 2, depth})}
    losses = {
        "photometric": {"type": "qgs/photometric"},
        "visibility": {"type": "qgs/visibility"},
        "anchor_visibility": {"type": "locus/anchor_visibility", "weight": 0.1},
    }
    return {"recipe": 1, "plugins": ["locus"], "model": model, "losses": losses}


LOCUSGS = layout("locus", _read_locus, TOKENGS)


def _read_2026(shapes: Shapes) -> Tree:
    tree = read_tokengs(shapes)
    model = tree["model"]
    model["encoder"] |= _encoder(shapes, model["encoder"]["depth"])
    model["encoder"]["time_channels"] = _channels(shapes, "patch_time_embed")
    dynamic = DYNAMIC in shapes
    timed = _channels(shapes, "patch_time_embed_tgt")
    if dynamic:
        model["decoder"]["self_attention"] = {"type": "tokengs2026/block_causal"}
    if dynamic or timed:
        moving = size_at(shapes, DYNAMIC) if dynamic else 0
        model["queries"] = {
            "type": "tokengs2026/dynamic",
            "count": model["queries"]["count"] + moving,
            "dynamic": moving,
            "patch_size": model["encoder"]["patch_size"],
            "time_channels": timed,
        }
    model["centers"]["z_offset"] = 0.0
    tree |= {"plugins": ["tokengs2026"], "views": {"frame": "mean_cam"}}
    return tree | ({"evaluation": {"tuning": "latents"}} if LATENTS in shapes else {})


def _channels(shapes: Shapes, module: str) -> int:
    """Return the channels of the time embedding in `module`, or 0 if it has none."""
    name = f"{module}.proj.weight"
    return size_at(shapes, name, 1) if name in shapes else 0


def _encoder(shapes: Shapes, depth: int) -> Tree:
    """Return the encoder options that TokenGS 2026.6 adds to TokenGS. depth: number of blocks."""
    scales = layer_count(shapes, READOUT)
    if scales > depth:
        raise LayoutError(
            f"{READOUT} has {scales} norms, one for each used block, but there are only {depth} "
            "blocks"
        )
    # files do not say which blocks are read: the release reads every second one
    step = 2 if 2 * scales <= depth + 1 else 1
    found: Tree = {"blocks": list(range(depth - step * (scales - 1), depth + 1, step))}
    if LATENTS not in shapes:
        return {"type": "tokengs2026/multiscale_vit", **found}
    blocks = layer_count(shapes, LATENT_BLOCK)
    found |= {"latents": size_at(shapes, LATENTS), "latent_depth": blocks}
    return {"type": "tokengs2026/latent_bottleneck", **found}


TOKENGS_2026_6 = layout("tokengs2026", _read_2026, TOKENGS)

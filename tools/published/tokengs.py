"""The recipe for the options of a TokenGS run (TokenGS release)."""

from collections.abc import Mapping
from typing import Any

from published.options import ReleasedOptions

FRAMES = ("first_cam", "mean_cam")

OF_2026_6 = {"use_multiscale_encoder": False, "use_latent_bottleneck": False}
OF_MOTION = {"num_dynamic_gs_tokens": 0, "time_embedding": False}
"""Parts of the release that LocusGS's does not have."""


def tokengs_recipe(options: Mapping[str, Any]) -> dict[str, Any]:
    """The recipe of the model that TokenGS builds from `options`.

    Raises ReleasedOptionError for options that are missing or not understood.
    """
    released = ReleasedOptions(options)
    model = backbone(released)
    model["encoder"] |= encoder_options(released)
    model["head"] |= {
        "gaussians_per_query": released.count("dec_patch_size") ** 2,
        "opacity_bias": -released["opacity_bias"],
        "scale_input_limit": None,
        "quat_eps": 1e-12,
    }
    model["queries"] = {"type": "qgs/latent", **query_options(released)}
    model |= motion_options(released, model)
    model["centers"] = {
        "type": "qgs/free",
        "z_offset": released["gaussian_z_offset"],
        "input_limit": None,
        "output_limit": None,
    }
    model["supervision"] = {"layers": [released.count("dec_depth")]}
    frame = released.meaning("camera_normalization_method", {name: name for name in FRAMES})
    plugins = ["tokengs2026"]
    return {"recipe": 1, "plugins": plugins, "model": model, "views": {"frame": frame}}


def backbone(options: ReleasedOptions) -> dict[str, Any]:
    """What TokenGS and LocusGS share: sizes, encoder, decoder depth, scale cap."""
    width = options.count("enc_embed_dim")
    options.only({"token_dim": width})
    return {
        "width": width,
        "heads": options.count("enc_num_heads"),
        "encoder": {
            "patch_size": options.count("patch_size"),
            "depth": options.count("enc_depth"),
            "mlp_ratio": options["mlp_ratio"],
        },
        "decoder": {"depth": options.count("dec_depth")},
        "head": {"scale_cap": options["gaussian_scale_cap"]},
    }


def motion_options(options: ReleasedOptions, model: dict[str, Any]) -> dict[str, Any]:
    """The parts of `model` that times and dynamic tokens change."""
    dynamic, timed = (name in options and options[name] for name in OF_MOTION)
    if not (dynamic or timed):
        return {}
    count = options.count("num_dynamic_gs_tokens")
    channels = options.count("time_embedding_dim") if options["time_embedding"] else 0
    queries = {**model["queries"], "type": "tokengs2026/dynamic", "dynamic": count}
    queries |= {"count": queries["count"] + count, "time_channels": channels}
    queries |= {"patch_size": model["encoder"]["patch_size"]}
    own = {"self_attention": {"type": "tokengs2026/block_causal"}} if count else {}
    return {
        "encoder": {**model["encoder"], "time_channels": channels},
        "queries": queries,
        "decoder": {**model["decoder"], **own},
    }


def encoder_options(options: ReleasedOptions) -> dict[str, Any]:
    """Which encoder it is, and the options that only the encoders of TokenGS 2026.6 have."""
    multiscale, latent = (name in options and options[name] for name in OF_2026_6)
    timed = "time_embedding" in options and options["time_embedding"]
    if not (multiscale or latent or timed):
        return {"type": "qgs/multiview_vit"}
    depth = options.count("enc_depth")
    # The release numbers blocks from 0; without the readout it reads the last one.
    read = sorted(set(options["multiscale_encoder_layers"])) if multiscale else [depth - 1]
    found: dict[str, Any] = {"type": "tokengs2026/multiscale_vit", "blocks": [n + 1 for n in read]}
    if latent:
        found |= {
            "type": "tokengs2026/latent_bottleneck",
            "latents": options.count("num_latents"),
            "latent_depth": options.count("latent_cross_attn_depth"),
        }
    return found


def query_options(options: ReleasedOptions) -> dict[str, Any]:
    """Number and initial spread of the queries."""
    return {"count": options.count("num_gs_tokens"), "std": options["gs_token_std"]}

"""The recipes for the options of TokenGS and LocusGS runs, by the names of both releases.

An option that is missing is a KeyError, as is a value that no recipe can express.
"""

from collections.abc import Mapping
from typing import Any

OF_2026_6 = {"use_multiscale_encoder": False, "use_latent_bottleneck": False}
OF_MOTION = {"num_dynamic_gs_tokens": 0, "time_embedding": False}
"""Parts of TokenGS that LocusGS does not have."""
UNSUPPORTED_BUT = {
    "geo_sparse_sampling_k": 0,
    "use_dense_sparse_attn_mask": False,
    "cross_attn_handcraft": False,
    "unposed_input": False,
}
"""Parts of LocusGS that its published models and ablations do not use."""

SELF_ATTENTION = {"content_only": "qgs/content", "learned_positional": "locus/anchor_aware"}
CROSS_ATTENTION = {"content_only": "qgs/content", "geometric_positional": "locus/ray_biased"}
CENTERS = {
    "free_center": "qgs/free",
    "anchor_offset": "locus/anchor_offset",
    "radius_scaled_offset": "locus/radius_scaled",
}

Options = Mapping[str, Any]


def only(options: Options, expected: Options) -> None:
    """Raise ValueError for an option that is there with another value."""
    for name, value in expected.items():
        if options.get(name, value) != value:
            raise ValueError(f"the option {name} is {options[name]!r}; only {value!r} is supported")


def tokengs_recipe(options: Options) -> dict[str, Any]:
    """The recipe of the model that TokenGS builds from `options`."""
    model = backbone(options)
    model["encoder"] |= encoder_options(options)
    model["head"] |= {
        "gaussians_per_query": int(options["dec_patch_size"]) ** 2,
        "opacity_bias": -options["opacity_bias"],
        "scale_input_limit": None,
        "quat_eps": 1e-12,
    }
    model["queries"] = {"type": "qgs/latent", **query_options(options)}
    model |= motion_options(options, model)
    model["centers"] = {
        "type": "qgs/free",
        "z_offset": options["gaussian_z_offset"],
        "input_limit": None,
        "output_limit": None,
    }
    model["supervision"] = {"layers": [int(options["dec_depth"])]}
    views = {"frame": options["camera_normalization_method"]}
    return {"recipe": 1, "plugins": ["tokengs2026"], "model": model, "views": views}


def backbone(options: Options) -> dict[str, Any]:
    """What TokenGS and LocusGS share: sizes, encoder, decoder depth, scale cap."""
    width = int(options["enc_embed_dim"])
    only(options, {"token_dim": width})
    return {
        "width": width,
        "heads": int(options["enc_num_heads"]),
        "encoder": {
            "patch_size": int(options["patch_size"]),
            "depth": int(options["enc_depth"]),
            "mlp_ratio": options["mlp_ratio"],
        },
        "decoder": {"depth": int(options["dec_depth"])},
        "head": {"scale_cap": options["gaussian_scale_cap"]},
    }


def query_options(options: Options) -> dict[str, Any]:
    """Number and initial spread of the queries."""
    return {"count": int(options["num_gs_tokens"]), "std": options["gs_token_std"]}


def encoder_options(options: Options) -> dict[str, Any]:
    """Which encoder it is, and the options that only the encoders of TokenGS 2026.6 have."""
    multiscale, latent = (options.get(name) for name in OF_2026_6)
    if not (multiscale or latent or options.get("time_embedding")):
        return {"type": "qgs/multiview_vit"}
    depth = int(options["enc_depth"])
    # The release numbers blocks from 0; without the readout it reads the last one.
    read = sorted(set(options["multiscale_encoder_layers"])) if multiscale else [depth - 1]
    found: dict[str, Any] = {"type": "tokengs2026/multiscale_vit", "blocks": [n + 1 for n in read]}
    if latent:
        found |= {
            "type": "tokengs2026/latent_bottleneck",
            "latents": int(options["num_latents"]),
            "latent_depth": int(options["latent_cross_attn_depth"]),
        }
    return found


def motion_options(options: Options, model: dict[str, Any]) -> dict[str, Any]:
    """The parts of `model` that times and dynamic tokens change."""
    count, timed = (options.get(name, 0) for name in OF_MOTION)
    if not (count or timed):
        return {}
    channels = int(options["time_embedding_dim"]) if timed else 0
    queries = {**model["queries"], "type": "tokengs2026/dynamic", "dynamic": int(count)}
    queries |= {"count": queries["count"] + int(count), "time_channels": channels}
    queries |= {"patch_size": model["encoder"]["patch_size"]}
    own = {"self_attention": {"type": "tokengs2026/block_causal"}} if count else {}
    return {
        "encoder": {**model["encoder"], "time_channels": channels},
        "queries": queries,
        "decoder": {**model["decoder"], **own},
    }


def locusgs_recipe(options: Options) -> dict[str, Any]:
    """The recipe of the model that LocusGS builds from `options`.

    `geo_sigma`, a constant of the release, may stand among the options.
    """
    only(options, {**UNSUPPORTED_BUT, **OF_2026_6, **OF_MOTION})
    model = backbone(options)
    model["head"]["gaussians_per_query"] = int(options["num_gaussians_per_token"])
    least = {"radius_min": options["anchor_radius_min"]}
    mean = [0.0, 0.0, options["gaussian_z_offset"]]
    start = {"center_init": {"kind": "normal", "mean": mean}}
    radius = {"radius": False}
    if options["use_anchor_radius"]:
        radius = {**least, "init_radius": options["anchor_radius_init"]}
    model["queries"] = {"type": "locus/anchored", **query_options(options), **start, **radius}
    attention = {"type": CROSS_ATTENTION[options["cross_attn_variant"]]}
    if attention["type"] == "locus/ray_biased":
        by_radius = options["anchor_radius_affects_bias"]
        attention["bandwidth"] = "radius" if by_radius else "fixed"
        attention["sigma0"] = options.get("geo_sigma", 0.1)
        attention |= least if by_radius else {}
    refined = options["anchor_radius_refinement"]
    model["decoder"] |= {
        "cross_attention": attention,
        "self_attention": {"type": SELF_ATTENTION[options["self_attn_variant"]]},
        "refinement": {"type": "locus/refine", "radius": refined, **(least if refined else {})},
    }
    centers = CENTERS[options["gaussian_center_variant"]]
    of_centers = {"qgs/free": {"z_offset": 0.0}, "locus/radius_scaled": least}
    model["centers"] = {"type": centers, **of_centers.get(centers, {})}
    model["supervision"] = {"layers": sorted(set(options["anchor_supervision_layers"]))}
    return {"recipe": 1, "plugins": ["locus"], "model": model}

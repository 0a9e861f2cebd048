"""Translation of published options of TokenGS and LocusGS into recipes.

A missing option, or a value that no recipe can express, raises KeyError.
"""

from collections.abc import Mapping
from typing import Any

OF_2026_6 = {"use_multiscale_encoder": False, "use_latent_bottleneck": False}
OF_MOTION = {"num_dynamic_gs_tokens": 0, "time_embedding": False}
"""Options of TokenGS that LocusGS does not have, with the values that turn them off."""
UNSUPPORTED_BUT = {
    "geo_sparse_sampling_k": 0,
    "use_dense_sparse_attn_mask": False,
    "cross_attn_handcraft": False,
    "unposed_input": False,
}
"""Options of LocusGS that qgs does not support, with the values that turn them off.

The published models and ablations of LocusGS do not use them.
"""

BOTH = """
enc_embed_dim       width
enc_num_heads       heads
patch_size          encoder.patch_size
enc_depth           encoder.depth
mlp_ratio           encoder.mlp_ratio
dec_depth           decoder.depth
gaussian_scale_cap  head.scale_cap
num_gs_tokens       queries.count
gs_token_std        queries.std
"""
TOKENGS = """
gaussian_z_offset   centers.z_offset
"""
LATENT = """
num_latents              encoder.latents
latent_cross_attn_depth  encoder.latent_depth
"""
LOCUS = """
num_gaussians_per_token     head.gaussians_per_query
anchor_radius_refinement    decoder.refinement.radius
anchor_supervision_layers   supervision.layers
use_anchor_radius           queries.radius
"""
"""Lines with a published option and its path in the section `model` of a recipe."""
SELF_ATTENTION = {"content_only": "qgs/content", "learned_positional": "locus/anchor_aware"}
CROSS_ATTENTION = {"content_only": "qgs/content", "geometric_positional": "locus/ray_biased"}
CENTERS = {
    "free_center": "qgs/free",
    "anchor_offset": "locus/anchor_offset",
    "radius_scaled_offset": "locus/radius_scaled",
}

Options = Mapping[str, Any]
Tree = dict[str, Any]
"""Recipe, or a section of one, as nested mappings."""


def model_of(options: Options, *tables: str) -> Tree:
    """Translate published options into the section `model` of a recipe, by `tables`.

    tables: texts whose lines are a published option and its path in `model`.
    """
    model: Tree = {}
    for line in "".join(tables).split("\n"):
        if line:
            option, path = line.split()
            *sections, name = path.split(".")
            section = model
            for key in sections:
                section = section.setdefault(key, {})
            section[name] = options[option]
    return model


def tokengs_recipe(options: Options) -> Tree:
    """Return the recipe of the model that TokenGS builds from `options`."""
    multiscale, latent = (options.get(name) for name in OF_2026_6)
    moving, timed = (options.get(name, 0) for name in OF_MOTION)
    model = model_of(options, BOTH, TOKENGS, LATENT if latent else "")
    model["encoder"]["type"] = "qgs/multiview_vit"
    if multiscale or latent or timed:
        # The release numbers blocks from 0; without the readout it reads the last one.
        last = [options["enc_depth"] - 1]
        read = sorted(set(options["multiscale_encoder_layers"])) if multiscale else last
        model["encoder"]["blocks"] = [n + 1 for n in read]
        kind = "latent_bottleneck" if latent else "multiscale_vit"
        model["encoder"]["type"] = f"tokengs2026/{kind}"
    model["head"] |= {
        "gaussians_per_query": options["dec_patch_size"] ** 2,
        "opacity_bias": -options["opacity_bias"],
        "scale_input_limit": None,
        "quat_eps": 1e-12,
    }
    if moving or timed:
        channels = options["time_embedding_dim"] if timed else 0
        model["encoder"]["time_channels"] = channels
        model["queries"] |= {
            "type": "tokengs2026/dynamic",
            "count": model["queries"]["count"] + moving,
            "dynamic": moving,
            "time_channels": channels,
            "patch_size": options["patch_size"],
        }
    if moving:
        model["decoder"]["self_attention"] = {"type": "tokengs2026/block_causal"}
    model["centers"] |= {"type": "qgs/free", "input_limit": None, "output_limit": None}
    model["supervision"] = {"layers": [options["dec_depth"]]}
    views = {"frame": options["camera_normalization_method"]}
    return {"recipe": 1, "plugins": ["tokengs2026"], "model": model, "views": views}


def locusgs_recipe(options: Options) -> Tree:
    """Return the recipe of the model that LocusGS builds from `options`.

    `geo_sigma`, a constant in the published code, may be given as an option.
    """
    for name, value in {**UNSUPPORTED_BUT, **OF_2026_6, **OF_MOTION}.items():
        if options.get(name, value) != value:
            raise ValueError(f"the option {name} is {options[name]!r}; only {value!r} is supported")
    model = model_of(options, BOTH, LOCUS)
    least = {"radius_min": options["anchor_radius_min"]}
    mean = [0.0, 0.0, options["gaussian_z_offset"]]
    model["queries"] |= {"type": "locus/anchored", "center_init": {"kind": "normal", "mean": mean}}
    if options["use_anchor_radius"]:
        model["queries"] |= {**least, "init_radius": options["anchor_radius_init"]}
    attention = {"type": CROSS_ATTENTION[options["cross_attn_variant"]]}
    if attention["type"] == "locus/ray_biased":
        by_radius = options["anchor_radius_affects_bias"]
        attention["bandwidth"] = "radius" if by_radius else "fixed"
        attention["sigma0"] = options.get("geo_sigma", 0.1)
        attention |= least if by_radius else {}
    decoder = model["decoder"]
    decoder["cross_attention"] = attention
    decoder["self_attention"] = {"type": SELF_ATTENTION[options["self_attn_variant"]]}
    refined = decoder["refinement"]["radius"]
    decoder["refinement"] |= {"type": "locus/refine", **(least if refined else {})}
    centers = CENTERS[options["gaussian_center_variant"]]
    of_centers = {"qgs/free": {"z_offset": 0.0}, "locus/radius_scaled": least}
    model["centers"] = {"type": centers, **of_centers.get(centers, {})}
    return {"recipe": 1, "plugins": ["locus"], "model": model}

"""The recipe for the options of a LocusGS run (LocusGS release)."""

from collections.abc import Mapping
from typing import Any

from published.options import ReleasedOptions
from published.tokengs import OF_2026_6, OF_MOTION, backbone, query_options

UNSUPPORTED_BUT = {
    "geo_sparse_sampling_k": 0,
    "use_dense_sparse_attn_mask": False,
    "cross_attn_handcraft": False,
    "unposed_input": False,
}
"""Parts of the release that its published models and ablations do not use."""

SELF_ATTENTION = {"content_only": "qgs/content", "learned_positional": "locus/anchor_aware"}
CROSS_ATTENTION = {"content_only": "qgs/content", "geometric_positional": "locus/ray_biased"}
CENTERS = {
    "free_center": "qgs/free",
    "anchor_offset": "locus/anchor_offset",
    "radius_scaled_offset": "locus/radius_scaled",
}


def locusgs_recipe(options: Mapping[str, Any]) -> dict[str, Any]:
    """The recipe of the model that LocusGS builds from `options`.

    `geo_sigma`, a constant of the release, may stand among the options.
    Raises ReleasedOptionError for options that are missing or not understood.
    """
    released = ReleasedOptions(options)
    released.only({**UNSUPPORTED_BUT, **OF_2026_6, **OF_MOTION})
    model = backbone(released)
    model["head"]["gaussians_per_query"] = released.count("num_gaussians_per_token")
    model["queries"] = _queries(released)
    model["decoder"] |= {
        "cross_attention": _cross_attention(released),
        "self_attention": {"type": released.meaning("self_attn_variant", SELF_ATTENTION)},
        "refinement": _refinement(released),
    }
    model["centers"] = _centers(released)
    model["supervision"] = {"layers": sorted(set(released["anchor_supervision_layers"]))}
    return {"recipe": 1, "plugins": ["locus"], "model": model}


def _radius(options: ReleasedOptions, read: bool) -> dict[str, Any]:
    return {"radius_min": options["anchor_radius_min"]} if read else {}


def _queries(options: ReleasedOptions) -> dict[str, Any]:
    queries = {"type": "locus/anchored", **query_options(options)}
    queries["center_init"] = {
        "kind": "normal",
        "mean": [0.0, 0.0, options["gaussian_z_offset"]],
    }
    if not options["use_anchor_radius"]:
        return queries | {"radius": False}
    return queries | _radius(options, True) | {"init_radius": options["anchor_radius_init"]}


def _cross_attention(options: ReleasedOptions) -> dict[str, Any]:
    chosen = options.meaning("cross_attn_variant", CROSS_ATTENTION)
    if chosen == "qgs/content":
        return {"type": chosen}
    sigma = options.get("geo_sigma", 0.1)
    by_radius = options["anchor_radius_affects_bias"]
    bandwidth = "radius" if by_radius else "fixed"
    return {"type": chosen, "bandwidth": bandwidth, "sigma0": sigma} | _radius(options, by_radius)


def _refinement(options: ReleasedOptions) -> dict[str, Any]:
    refined = options["anchor_radius_refinement"]
    return {"type": "locus/refine", "radius": refined} | _radius(options, refined)


def _centers(options: ReleasedOptions) -> dict[str, Any]:
    chosen = options.meaning("gaussian_center_variant", CENTERS)
    if chosen == "qgs/free":
        return {"type": chosen, "z_offset": 0.0}
    return {"type": chosen} | _radius(options, chosen == "locus/radius_scaled")

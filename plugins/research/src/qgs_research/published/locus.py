"""Layout of LocusGS: published names of weights, and the recipe that fits a state dict."""

from typing import Any

from qgs.checkpoint.tensors import Shapes
from qgs_research.published.tokengs import BACKBONE_RENAMES, DECODER, backbone
from qgs_research.published.weight_layout import WeightLayout

_CROSS = DECODER + "{}.gs_cross_attn."
_UNUSED_NORMS = ("anchor_norm.", "plucker_norm.", "q_pos_norm.", "k_pos_norm.")


def _read(shapes: Shapes) -> dict[str, Any]:
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


LOCUSGS = WeightLayout(
    name="LocusGS",
    plugin="locus",
    source="leo-frank/LocusGS",
    components={
        "encoder": ("qgs/multiview_vit",),
        "queries": ("locus/anchored",),
        "cross_attention": ("locus/ray_biased", "qgs/content"),
        "self_attention": ("locus/anchor_aware", "qgs/content"),
        "feed_forward": ("qgs/mlp",),
        "refinement": ("locus/refine",),
        "head": ("qgs/gaussian_head",),
        "centers": ("locus/radius_scaled", "locus/anchor_offset", "qgs/free"),
    },
    renames={
        **BACKBONE_RENAMES,
        "decoder.{}.cross_attention.core.q_proj.": _CROSS + "q_content_proj.",
        "decoder.{}.cross_attention.raw_gamma": _CROSS + "geo_scale",
        "decoder.{}.self_attention.position_mlp.": DECODER + "{}.anchor_head_self_attn.",
        "queries.center": "gs_anchor_xyz_raw",
        "queries.raw_radius": "gs_anchor_radius_raw",
        "refinements.0.center_mlp.": "xyz_embed.",
        "refinements.0.radius_mlp.": "radius_embed.",
    },
    marks=(DECODER + "0.gs_cross_attn.q_content_proj.weight",),
    read=_read,
    # The release builds these norms and never calls them. They are here to load its files whole.
    unused=(
        *((_CROSS + "q_norm.", _CROSS + name) for name in _UNUSED_NORMS),
        (_CROSS + "geo_scale", _CROSS + "tau_sample"),
    ),
    undecided=(
        "bandwidth of the ray bias: the radius if there is one, otherwise fixed",
        "Gaussian centres: scaled by the radius if there is one, otherwise anchor + offset",
        "clamps, epsilons, sigma0, lower bound of the radius: as in the LocusGS release",
        "supervised layers: the middle one and the last",
        "losses: photometric, visibility, and anchor visibility with weight 0.1",
        "scale and frame of the world, renderer, training: the framework's defaults",
    ),
)
"""Layout of the released LocusGS and of its ablations that change parameters."""

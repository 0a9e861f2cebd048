"""Published weights of LocusGS: parameter names, and the recipe that fits a state dict."""

from typing import Any

from qgs.checkpoint.tensors import Shapes
from qgs_research.published.tokengs import DECODER, TOKENGS, backbone
from qgs_research.published.weight_layout import layout


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


LOCUSGS = layout("locus", _read, TOKENGS)

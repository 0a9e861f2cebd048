"""Parts of GlobalSplat, TokenGS, LocusGS: a combination trains, or is refused when composed."""

from itertools import product
from typing import Any

import pytest
from qgs_plugintools import Case
from qgs_plugintools.checks.fields import run_training_step
from qgs_plugintools.inputs import Sizes

from qgs.components import LatentQueries
from qgs.composer import RecipeError, resolve
from qgs.contracts import ModelDims

PATCHES = {"type": "globalsplat/patches", "rgb_width": 24, "ray_width": 16, "lens_width": 4}
ENCODERS: dict[str, dict[str, Any]] = {
    "qgs": {"type": "qgs/multiview_vit", "depth": 0},
    "globalsplat": PATCHES,
    "as wide as the model": {**PATCHES, "ray_width": 8},
}
QUERIES: dict[str, dict[str, Any]] = {
    "qgs": {"type": "qgs/latent", "count": 6},
    "locus": {"type": "locus/anchored", "count": 6},
    "globalsplat": {"type": "globalsplat/slots", "count": 6, "extra": 2},
}
LAYERS: dict[str, dict[str, Any]] = {
    "qgs": {},
    "locus": {
        "cross_attention": {"type": "locus/ray_biased"},
        "self_attention": {"type": "locus/anchor_aware"},
        "refinement": {"type": "locus/refine"},
    },
    "round of 40": {"layer": {"type": "globalsplat/round", "memory_width": 40}},
    "round of D": {"layer": {"type": "globalsplat/round"}},
}
HEADS: dict[str, dict[str, Any]] = {
    "qgs": {"gaussians_per_query": 2},
    "globalsplat": {"type": "globalsplat/merging_head", "level": 1.5},
}
CENTERS: dict[str, dict[str, Any]] = {
    "qgs": {"type": "qgs/free"},
    "locus": {"type": "locus/radius_scaled"},
    "globalsplat": {"type": "qgs/offset", "z_offset": 1.5},
}


def fits(encoder: str, queries: str, layer: str, head: str, centers: str) -> bool:
    """What a reader of the components' documentation expects."""
    reads = {"qgs": encoder == "qgs", "locus": encoder == "qgs" and queries == "locus"}
    # A width of its own is one even where the number is that of the model.
    reads |= {"round of 40": encoder == "globalsplat", "round of D": encoder == "qgs"}
    streams = "round" in layer or head == "globalsplat"
    anchors = layer == "locus" or centers == "locus"
    return (
        reads[layer]
        and not (streams and queries != "globalsplat")
        and not (anchors and queries != "locus")
    )


@pytest.mark.parametrize(("encoder", "queries"), list(product(ENCODERS, QUERIES)))
def test_a_combination_trains_or_is_refused(encoder: str, queries: str) -> None:
    for layer, head, centers in product(LAYERS, HEADS, CENTERS):
        recipe = {
            "recipe": 1,
            "plugins": ["locus", "globalsplat"],
            "model": {
                **{"width": 32, "heads": 2, "renderer": {"type": "qgs/torch"}},
                **{"encoder": ENCODERS[encoder], "queries": QUERIES[queries]},
                **{"head": HEADS[head], "centers": CENTERS[centers]},
                **{"decoder": {"depth": 1, **LAYERS[layer]}, "supervision": {"layers": [1]}},
            },
            "losses": {"photometric": {"type": "qgs/photometric"}},
        }
        chosen = (encoder, queries, layer, head, centers)
        if fits(*chosen):
            made = resolve(recipe)
            case = Case(LatentQueries.Config(count=6), ModelDims(32, 2, 1))
            run_training_step(made, case, Sizes(batch=1, views=3, image=(16, 24)))
        else:
            with pytest.raises(RecipeError, match=r"needs|reads memory\.features as"):
                resolve(recipe)

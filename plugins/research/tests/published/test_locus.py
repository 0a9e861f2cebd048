"""LocusGS's published layout: sizes and variants are read off names and shapes."""

import pytest
import yaml
from qgs_research.published.tokengs import LOCUSGS
from qgs_research.published.weight_layout import LayoutError

import qgs

RECIPE = yaml.safe_load("""
recipe: 1
plugins: [locus]
model:
  width: 48
  heads: 3
  encoder: {patch_size: 4, depth: 2, mlp_ratio: 3}
  queries: {type: locus/anchored, count: 10}
  decoder:
    depth: 3
    cross_attention: {type: locus/ray_biased}
    self_attention: {type: locus/anchor_aware}
    feed_forward: {ratio: 2}
    refinement: {type: locus/refine}
  head: {gaussians_per_query: 5}
  centers: {type: locus/radius_scaled}
  supervision: {layers: [2, 3]}
""")
FIXED_CENTERS = ("model.queries.radius=false", "model.decoder.refinement.radius=false",
                 "model.decoder.cross_attention.bandwidth=fixed",
                 "model.centers={type: locus/anchor_offset}")  # fmt: skip


def published_shapes(model):
    state = model.state_dict()
    shapes = {LOCUSGS.published_name(ours): tuple(tensor.shape) for ours, tensor in state.items()}
    assert None not in shapes
    return shapes


def composed(*overrides):
    return qgs.compose(RECIPE, overrides, device="meta")


def test_the_recipe_that_is_read_makes_the_same_model():
    for overrides in (
        (),
        FIXED_CENTERS,
        ("model.decoder.refinement.radius=false",),
        ("model.decoder.cross_attention={type: qgs/content}",),
        ("model.decoder.self_attention={type: qgs/content}",),
        ("model.encoder.depth=0", "model.encoder.mlp_ratio=4"),
    ):
        own = composed(*overrides)
        shapes = published_shapes(own)
        read = qgs.compose(LOCUSGS.read(shapes), device="meta")
        assert published_shapes(read) == shapes
        assert read.recipe["model"] == own.recipe["model"]


def test_shapes_without_a_recipe_are_refused():
    shapes = published_shapes(composed())
    for changes, why in (
        ({"gs_tokens": None}, "gs_tokens is missing"),
        ({"activation_head.deconv.weight": (71, 48)}, "head: 71 must be a multiple of 14"),
        ({"gs_tokens": (10,)}, "without axis"),
    ):
        given = {name: shape for name, shape in (shapes | changes).items() if shape}
        with pytest.raises(LayoutError, match=why):
            LOCUSGS.read(given)

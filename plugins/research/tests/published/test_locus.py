"""LocusGS's published layout: sizes and variants are read off names and shapes."""

import yaml
from qgs_research.published.tokengs import LOCUSGS
from qgs_research.published.weight_layout import LayoutError
from tables import must_refuse

from qgs.checkpoint.tensors import shapes_of
from qgs.recipe import resolve

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
FIXED_CENTERS = (
    "model={queries: {radius: false}, centers: {type: locus/anchor_offset}, "
    "decoder: {refinement: {radius: false}, cross_attention: {bandwidth: fixed}}}",
)


def published(*overrides):
    """A recipe, and the shapes of its model's weights by their published names."""
    recipe = resolve(RECIPE, overrides)
    shapes = shapes_of(recipe.build_model("meta").state_dict())
    return recipe, {LOCUSGS.published_name(ours): shape for ours, shape in shapes.items()}


def test_the_recipe_that_is_read_makes_the_same_model():
    for overrides in (
        (),
        FIXED_CENTERS,
        ("model.decoder.refinement.radius=false",),
        ("model.decoder.cross_attention={type: qgs/content}",),
        ("model.decoder.self_attention={type: qgs/content}",),
        ("model.encoder.depth=0", "model.encoder.mlp_ratio=4"),
    ):
        recipe, shapes = published(*overrides)
        assert None not in shapes
        assert resolve(LOCUSGS.read(shapes)).tree["model"] == recipe.tree["model"]


def test_shapes_without_a_recipe_are_refused():
    _, shapes = published()
    for changes, why in (
        ({"gs_tokens": None}, "gs_tokens is missing"),
        ({"activation_head.deconv.weight": (71, 48)}, "head: 71 must be a multiple of 14"),
        ({"gs_tokens": (10,)}, "without axis"),
    ):
        given = {name: shape for name, shape in (shapes | changes).items() if shape}
        must_refuse(why, LOCUSGS.read, given, kind=LayoutError)

"""With three equal radii and a shape that does not turn it is LocusGS, in every tensor."""

import pytest
import torch
import yaml
from odd_views import odd_views
from qgs_anchors.ellipsoid.anchors import from_locus
from qgs_anchors.ellipsoid.fields import RAW_RADII, ROTATION
from qgs_locus.fields import CENTER, RAW_RADIUS
from torch.testing import assert_close

from qgs import compose
from qgs.containers import named_tensors

ELLIPSOID = """
recipe: 1
plugins: [locus, ellipsoid]
model:
  width: 48
  heads: 3
  encoder: {depth: 1}
  queries: {type: ellipsoid/anchored, count: 40, std: 0.5}
  decoder:
    depth: 3
    layer_scale: 0.5
    cross_attention: {type: ellipsoid/ray_biased, gamma_init: 0.5}
    self_attention: {type: locus/anchor_aware}
    refinement: {type: ellipsoid/refine}
  head: {gaussians_per_query: 4, init_std: 0.1}
  centers: {type: ellipsoid/axis_scaled}
  supervision: {layers: [1, 2, 3]}
  renderer: {type: qgs/torch}
"""
LOCUS = ELLIPSOID.replace("axis_scaled", "radius_scaled").replace("ellipsoid/", "locus/")


def _model(recipe, *overrides):
    return compose(yaml.safe_load(recipe), [f"model.{each}" for each in overrides]).eval()


def _pair(refined=True, bound="floor"):
    """LocusGS whose radii differ from anchor to anchor, and its ellipsoidal equal."""
    reading = ["queries", "centers", "decoder.cross_attention"] + ["decoder.refinement"] * refined
    options = [f"{part}.radius_bound={bound}" for part in reading]
    options.append(f"decoder.refinement.radius={refined}")
    locus = _model(LOCUS, *options)
    with torch.no_grad():
        locus.queries.raw_radius.normal_(-1.0, 1.0)
    ellipsoid = _model(ELLIPSOID, *options, "decoder.refinement.rotation=false")
    ellipsoid.load_state_dict(from_locus(locus.state_dict()))
    return locus, ellipsoid


def _shared(layer):
    """What both models have; three equal radii are one."""
    state = layer.state
    raw = state[RAW_RADII] if RAW_RADII in state.fields else state[RAW_RADIUS].expand(-1, -1, 3)
    own = {"center": state[CENTER], "radii": raw, "features": state.features}
    return {**own, **dict(named_tensors(layer.gaussians))}


@pytest.mark.parametrize(("radius_refined", "bound"), [(False, "floor"), (True, "offset")])
def test_every_tensor_of_every_layer_is_that_of_locusgs(radius_refined, bound):
    models = _pair(radius_refined, bound)
    photos = odd_views(2, 32, 40)
    theirs, ours = (model(photos, layers=(1, 2, 3)) for model in models)
    for number, expected in theirs.layers.items():
        seen = ours.layers[number]
        assert_close(_shared(seen), _shared(expected))
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(2, 40, 4)
        assert torch.equal(seen.state[ROTATION], identity)
    moved = theirs.state[CENTER] - models[0].queries.center
    assert moved.abs().max() > 0.01, "the anchors must move for this to say anything"


def test_a_trained_locusgs_is_where_a_model_that_turns_can_start():
    locus, _ = _pair()
    turning = _model(ELLIPSOID, "decoder.refinement.zero_init=true")
    absent = turning.load_state_dict(from_locus(locus.state_dict()), strict=False)
    mlps = {name.rpartition(".fc")[0] for name in absent.missing_keys}
    assert mlps == {"refinements.0.rotation_mlp"}
    assert absent.unexpected_keys == []
    photos = odd_views(2, 32, 40)
    theirs, ours = (model(photos).gaussians.means for model in (locus, turning))
    assert_close(ours, theirs)

"""Parts by their formulas; with three equal radii it is LocusGS, in every tensor."""

import math

import pytest
import torch
import torch.nn.functional as F
import yaml
from odd_views import odd_views
from qgs_anchors.ellipsoid.components import (
    RAW_RADII,
    ROTATION,
    AxisScaledCenters,
    EllipsoidCrossAttention,
    EllipsoidHead,
    EllipsoidQueries,
    anchor_rotation,
    from_locus,
    radii_along,
    turned,
)
from qgs_anchors.ellipsoid.ray_bias import EllipsoidBias, ray_tokens
from qgs_locus.anchors import FrustumCenters
from qgs_locus.fields import CENTER, RAW_RADIUS
from scipy.spatial.transform import Rotation
from small_parts import made, shaken
from tables import assert_equal
from torch.testing import assert_close

from qgs import compose
from qgs.containers import named_tensors
from qgs.geometry.transforms import quat_to_matrix
from qgs.tokengs import GaussianHead, posact
from qgs.types import ImageMemory, QueryState

HALF = math.sqrt(0.5)
PHOTOS = odd_views(2, 32, 40)
OFFSET = {"radius_bound": "offset", "radius_min": 0.05}


def _state():
    """Turned anchors of unequal radii in front of the cameras."""
    fields = {
        CENTER: torch.randn(2, 6, 3) * 0.4 + torch.tensor([0.0, 0.0, 1.5]),
        ROTATION: F.normalize(torch.randn(2, 6, 4), dim=-1),
        RAW_RADII: torch.randn(2, 6, 3) - 1,
    }
    return QueryState(torch.randn(2, 6, 16), fields)


def test_a_turn_is_about_an_axis_of_the_world_and_never_half_a_turn():
    about_z = torch.tensor([HALF, 0.0, 0.0, HALF]).double()
    for length in (0.0, 0.01, 1.0, 1e4):
        angle = 2 * math.atan(length / 2)
        quat = turned(about_z, torch.tensor([length, 0.0, 0.0]).double())
        assert_close(quat.norm().item(), 1.0)
        about_x = torch.from_numpy(Rotation.from_euler("x", angle).as_matrix())
        assert_close(quat_to_matrix(quat), about_x @ quat_to_matrix(about_z))


def test_queries_give_what_they_learned_in_the_form_that_they_promise():
    options = {**OFFSET, "count": 500, "std": 2.0, "init_radii": (0.1, 0.2, 0.4)}
    queries = made(EllipsoidQueries, **options, center_init=FrustumCenters(kind="frustum"))
    assert_close(queries.features.std().item(), 2.0, rtol=0.1, atol=0)
    assert (queries.center[:, 2] >= 0.3).all()
    at_first = queries.support(queries.start(2))
    assert_close(at_first.axes, torch.diag(torch.tensor([0.15, 0.25, 0.45])).expand(2, 500, 3, 3))
    decaying = [name for name, p in queries.named_parameters() if queries.decays(name, p)]
    assert decaying == ["features", "center", "raw_radii"]
    state = shaken(queries, 1.0).start(2)
    assert_close(state[ROTATION][1], F.normalize(queries.rotation, dim=-1))
    assert_equal(state[CENTER][1], queries.center)
    axes = quat_to_matrix(state[ROTATION]) * (F.softplus(state[RAW_RADII]) + 0.05)[:, :, None]
    assert_close(queries.support(state).axes, axes)


def test_attention_and_pictures_speak_of_one_ellipsoid():
    state = _state()
    rays = torch.cat([0.5 * torch.randn(2, 24, 3), torch.randn(2, 24, 3)], -1)
    memory = ImageMemory(torch.randn(2, 24, 16), patch_rays=rays)
    chosen = {"sigma0": 0.3, "sigma_sq_min": 0.05, "bias_min": -7.0, "gamma_init": 0.4}
    bias = made(EllipsoidCrossAttention, **chosen, **OFFSET).bias(state, memory).dense()
    axes = made(EllipsoidQueries, **OFFSET).support(state).axes
    radii = axes.norm(dim=-2)
    ellipsoids = state[CENTER], axes / radii[..., None, :], (0.3 * radii).square().clamp(min=0.05)
    gamma = F.softplus(torch.tensor(0.4))
    expected = EllipsoidBias.of(*ellipsoids, ray_tokens(rays), -7.0, gamma).dense()
    assert_close(bias, expected, rtol=1e-4, atol=1e-4)
    assert bias.min() == -7.0 * gamma
    assert bias.max() > -1.0


def test_centers_follow_their_formula():
    state = _state()
    offsets = torch.randn(2, 6, 3, 3)
    local = F.softplus(state[RAW_RADII])[:, :, None] * posact(offsets)
    steps = torch.einsum("bnij,bnkj->bnki", quat_to_matrix(state[ROTATION]), local)
    assert_close(made(AxisScaledCenters)(offsets, state), state[CENTER][:, :, None] + steps)


def test_a_radius_along_a_direction_reaches_the_surface():
    radii = 0.1 + torch.rand(2, 5, 3)
    quats = F.normalize(torch.randn(2, 5, 4, 4), dim=-1)
    surface = quat_to_matrix(quats) * radii_along(radii, quats)[..., None, :]
    in_ball = surface / radii[:, :, None, :, None]
    assert_close(in_ball.norm(dim=-2), torch.ones(2, 5, 4, 3))


def test_gaussians_turn_and_grow_with_their_anchor():
    head = made(EllipsoidHead, gaussians_per_query=3, init_std=0.5)
    plain = made(GaussianHead, gaussians_per_query=3)
    plain.load_state_dict(head.state_dict())
    state = _state()
    local = plain(state)
    placed = head(state)
    expected = anchor_rotation(state[ROTATION])[:, :, None] @ quat_to_matrix(local.quats)
    assert_equal(quat_to_matrix(placed.quats), expected, atol=1e-5)
    radii = F.softplus(state[RAW_RADII])
    assert_close(placed.scales, local.scales * radii_along(radii, local.quats))
    for name in ("offsets", "opacities", "colors"):
        assert_equal(getattr(placed, name), getattr(local, name))


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


def _pair(*options):
    """LocusGS whose radii differ from anchor to anchor, and its ellipsoidal equal."""
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
    return own | dict(named_tensors(layer.gaussians))


READING = ("queries", "centers", "decoder.cross_attention", "decoder.refinement")
OFFSETS = [f"{part}.radius_bound=offset" for part in READING]
"""Options of all that read a radius."""


@pytest.mark.parametrize("options", [["decoder.refinement.radius=false"], OFFSETS])
def test_every_tensor_of_every_layer_is_that_of_locusgs(options):
    models = _pair(*options)
    theirs, ours = (model(PHOTOS, layers=(1, 2, 3)) for model in models)
    for number, expected in theirs.layers.items():
        seen = ours.layers[number]
        assert_close(_shared(seen), _shared(expected))
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(2, 40, 4)
        assert_equal(seen.state[ROTATION], identity)
    moved = theirs.state[CENTER] - models[0].queries.center
    assert moved.abs().max() > 0.01, "the anchors must move for this to say anything"


def test_a_trained_locusgs_is_where_a_model_that_turns_can_start():
    locus, _ = _pair()
    turning = _model(ELLIPSOID, "decoder.refinement.zero_init=true")
    absent = turning.load_state_dict(from_locus(locus.state_dict()), strict=False)
    mlps = {name.rpartition(".fc")[0] for name in absent.missing_keys}
    assert mlps == {"refinements.0.rotation_mlp"}
    assert not absent.unexpected_keys
    theirs, ours = (model(PHOTOS).gaussians.means for model in (locus, turning))
    assert_close(ours, theirs)

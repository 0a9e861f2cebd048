"""Anchors, refinement, decoding and head, each on its own."""

import math

import pytest
import torch
import torch.nn.functional as F
from qgs_ellipsoid.anchors import EllipsoidQueries
from qgs_ellipsoid.cross_attention import EllipsoidCrossAttention
from qgs_ellipsoid.fields import RAW_RADII, ROTATION, anchor_rotation
from qgs_ellipsoid.head import AxisScaledCenters, EllipsoidHead, radii_along
from qgs_ellipsoid.refinement import EllipsoidRefinement
from qgs_ellipsoid.rotations import quat_product, turned
from qgs_locus.fields import CENTER, RadiusOptions, support_radius
from refusals import refused

from qgs import QueryState
from qgs.components import GaussianHead, posact
from qgs.composer import RecipeError, resolve
from qgs.contracts import ModelDims
from qgs.geometry.transforms import quat_to_matrix

DIMS = ModelDims(width=16, heads=2, depth=2)
HALF = math.sqrt(0.5)


def _state(batch: int = 2, count: int = 5) -> QueryState:
    fields = {
        CENTER: torch.randn(batch, count, 3),
        ROTATION: F.normalize(torch.randn(batch, count, 4), dim=-1),
        RAW_RADII: torch.randn(batch, count, 3),
    }
    return QueryState(torch.randn(batch, count, DIMS.width), fields)


def test_products_of_quaternions_are_those_of_their_matrices() -> None:
    left, right = (F.normalize(torch.randn(7, 4), dim=-1) for _ in range(2))
    product = quat_to_matrix(quat_product(left, right))
    torch.testing.assert_close(product, quat_to_matrix(left) @ quat_to_matrix(right))


def test_a_turn_is_about_an_axis_of_the_world() -> None:
    about_z = torch.tensor([[HALF, 0.0, 0.0, HALF]])
    angle = 0.01
    seen = quat_to_matrix(turned(about_z, torch.tensor([[angle, 0.0, 0.0]])))
    c, s = math.cos(angle), math.sin(angle)
    about_x = torch.tensor([[1.0, 0, 0], [0, c, -s], [0, s, c]])
    torch.testing.assert_close(seen[0], about_x @ quat_to_matrix(about_z)[0], atol=1e-6, rtol=0)


@pytest.mark.parametrize("length", [0.0, 1.0, 1e4])
def test_a_turn_is_never_half_a_turn(length: float) -> None:
    identity = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
    quat = turned(identity, torch.tensor([[0.0, length, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(quat.norm(), torch.ones((), dtype=torch.float64))
    assert 2 * torch.acos(quat[0, 0]) == pytest.approx(2 * math.atan(length / 2))
    assert 2 * math.atan(length / 2) < math.pi


def test_queries_start_as_configured() -> None:
    config = EllipsoidQueries.Config(count=30, init_radii=(0.1, 0.2, 0.4))
    queries = EllipsoidQueries(config, DIMS)
    support = queries.support(queries.start(3))
    expected = torch.diag(torch.tensor([0.1, 0.2, 0.4])).expand(3, 30, 3, 3)
    torch.testing.assert_close(support.axes, expected)
    decaying = [name for name, p in queries.named_parameters() if queries.decays(name, p)]
    assert decaying == ["features", "center", "raw_radii"]


def test_support_shows_the_ellipsoid_of_a_turned_anchor() -> None:
    queries = EllipsoidQueries(EllipsoidQueries.Config(count=1, init_radii=(1, 2, 3)), DIMS)
    about_z = torch.tensor([[[HALF, 0.0, 0.0, HALF]]])
    axes = queries.support(queries.start(1).replace(fields={ROTATION: about_z})).axes[0, 0]
    expected = torch.tensor([[0.0, -2.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 3.0]])
    torch.testing.assert_close(axes, expected, atol=1e-5, rtol=0)


def test_refinement_moves_only_what_it_is_told_to() -> None:
    state = _state()
    for chosen in ((True, False, False), (False, True, False), (False, False, True)):
        told = dict(zip(("center", "rotation", "radius"), chosen, strict=True))
        refined = EllipsoidRefinement(EllipsoidRefinement.Config(**told), DIMS)(state)
        fields = {"center": CENTER, "rotation": ROTATION, "radius": RAW_RADII}
        moved = {key: not torch.equal(refined[f], state[f]) for key, f in fields.items()}
        assert moved == told
        assert refined.features is state.features


def test_refined_rotations_stay_unit_over_many_layers() -> None:
    refinement, state = EllipsoidRefinement(EllipsoidRefinement.Config(), DIMS), _state()
    for _ in range(50):
        state = refinement(state)
    torch.testing.assert_close(state[ROTATION].norm(dim=-1), torch.ones(2, 5))


def test_a_refinement_that_starts_at_zero_can_learn() -> None:
    refinement = EllipsoidRefinement(EllipsoidRefinement.Config(zero_init=True), DIMS)
    state = _state()
    refined = refinement(state)
    for name, field in state.fields.items():
        torch.testing.assert_close(refined[name], field)
    sum((refined[name] * torch.randn_like(refined[name])).sum() for name in state.fields).backward()
    heads = (refinement.center_mlp, refinement.rotation_mlp, refinement.radius_mlp)
    assert all(head.fc2.weight.grad.abs().sum() > 0 for head in heads)


def test_centers_follow_their_formula() -> None:
    state, offsets = _state(), torch.randn(2, 5, 3, 3)
    means = AxisScaledCenters(AxisScaledCenters.Config(), DIMS)(offsets, state)
    radii = support_radius(state[RAW_RADII], RadiusOptions())
    for scene, query, gaussian in ((0, 0, 0), (1, 4, 2)):
        local = radii[scene, query] * posact(offsets[scene, query, gaussian])
        rotation = quat_to_matrix(state[ROTATION][scene, query])
        expected = state[CENTER][scene, query] + rotation @ local
        torch.testing.assert_close(means[scene, query, gaussian], expected)


def test_bandwidths_have_their_floor_along_each_axis() -> None:
    attention = EllipsoidCrossAttention(EllipsoidCrossAttention.Config(), DIMS)
    raw = torch.tensor([[[-20.0, 20.0, 20.0]]])
    sigma_sq = attention.sigma_sq(_state(1, 1).replace(fields={RAW_RADII: raw}))
    torch.testing.assert_close(sigma_sq, torch.tensor([[[1e-3, 4.0, 4.0]]]))


def test_a_radius_along_a_direction_reaches_the_surface() -> None:
    radii, quats = 0.1 + torch.rand(2, 5, 3), F.normalize(torch.randn(2, 5, 4, 4), dim=-1)
    along = radii_along(radii, quats)
    surface = quat_to_matrix(quats) * along[..., None, :]
    in_ball = surface / radii[:, :, None, :, None]
    torch.testing.assert_close(in_ball.norm(dim=-2), torch.ones(2, 5, 4, 3))


def test_gaussians_turn_and_grow_with_their_anchor() -> None:
    head = EllipsoidHead(EllipsoidHead.Config(gaussians_per_query=3, init_std=0.5), DIMS)
    plain = GaussianHead(GaussianHead.Config(gaussians_per_query=3), DIMS)
    plain.load_state_dict(head.state_dict())
    state = _state()
    local, placed = plain(state), head(state)
    axes = quat_to_matrix(local.quats)
    expected = anchor_rotation(state[ROTATION])[:, :, None] @ axes
    torch.testing.assert_close(quat_to_matrix(placed.quats), expected, atol=1e-5, rtol=0)
    radii = support_radius(state[RAW_RADII], RadiusOptions())
    torch.testing.assert_close(placed.scales, local.scales * radii_along(radii, local.quats))
    for name in ("offsets", "opacities", "colors"):
        assert torch.equal(getattr(placed, name), getattr(local, name))


def test_gaussians_along_the_axes_of_the_anchor_scale_with_its_radii() -> None:
    head, state = EllipsoidHead(EllipsoidHead.Config(gaussians_per_query=2), DIMS), _state()
    with torch.no_grad():
        head.linear.weight.zero_()
        head.linear.bias.view(2, 14)[:, 9] = 1.0
    scales = head(state).scales
    radii = support_radius(state[RAW_RADII], RadiusOptions())
    torch.testing.assert_close(scales, (0.075 / math.e * radii)[:, :, None].expand_as(scales))


ELLIPSOID = {"recipe": 1, "plugins": ["locus", "ellipsoid"]}
ANCHORED = {"queries": {"type": "ellipsoid/anchored"}}


@pytest.mark.parametrize(
    ("options", "path", "why"),
    [
        ({"refinement": {"center": False, "rotation": False, "radius": False}}, "", "nothing is"),
        ({"refinement": {"center_step": "linear", "input_limit": 7.0}}, ".input_limit",
         "no effect"),
        ({"refinement": {"center": False, "center_step": "linear"}}, ".center_step", "no effect"),
        ({"refinement": {"radius": False, "radius_min": 0.5}}, ".radius_min", "no effect"),
        ({"cross_attention": {"bandwidth": "fixed", "radius_min": 0.5}}, ".radius_min",
         "no effect"),
    ],
)  # fmt: skip
def test_options_without_effect_are_refused(options: dict, path: str, why: str) -> None:
    ((slot, given),) = options.items()
    kinds = {"refinement": "refine", "cross_attention": "ray_biased"}
    decoder = {slot: {"type": f"ellipsoid/{kinds[slot]}", **given}}
    problem = refused({**ELLIPSOID, "model": {**ANCHORED, "decoder": decoder}})
    assert problem.option.endswith(path)
    assert why in problem.reason


def test_radii_that_are_read_in_two_ways_are_refused() -> None:
    centers = {"type": "ellipsoid/axis_scaled", "radius_bound": "offset"}
    with pytest.raises(RecipeError, match="softplus"):
        resolve({**ELLIPSOID, "model": {**ANCHORED, "centers": centers}})
